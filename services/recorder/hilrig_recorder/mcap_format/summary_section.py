"""The end of a recording: the index by which a reader finds everything, and the checksum that proves it. Pure."""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from hilrig_recorder.mcap_format.chunk import ChunkNote


@dataclass(slots=True)
class Contents:
    """What stands in a file beside its chunks."""

    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)

    def end(self, size: int, chunks: Sequence[ChunkNote]) -> bytes:
        """What finishes a file of `size` bytes that holds this and these chunks."""
        data_end = encoded(DataEnd(0))
        start = size + len(data_end)
        summary = bytearray()
        offsets = bytearray()
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, encoded(*self.schemas)),
            (Opcode.CHANNEL, encoded(*self.channels)),
            (Opcode.STATISTICS, encoded(self._statistics(chunks))),
            (Opcode.CHUNK_INDEX, b"".join(chunk.index_record() for chunk in chunks)),
            (Opcode.ATTACHMENT_INDEX, encoded(*self.attachments)),
            (Opcode.METADATA_INDEX, encoded(*self.metadata)),
        ]
        for opcode, records in groups:
            if records:
                offsets += encoded(SummaryOffset(opcode.value, start + len(summary), len(records)))
                summary += records
        offset_start = start + len(summary)
        summary += offsets
        footer_head = struct.pack("<BQQQ", Opcode.FOOTER.value, 20, start, offset_start)
        checksum = zlib.crc32(footer_head, zlib.crc32(summary))
        return data_end + bytes(summary) + encoded(Footer(start, offset_start, checksum)) + MCAP0_MAGIC

    def _statistics(self, chunks: Sequence[ChunkNote]) -> Statistics:
        totals: dict[int, int] = {}
        for chunk in chunks:
            for channel_id, count in chunk.counts:
                totals[channel_id] = totals.get(channel_id, 0) + count
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=totals,
            chunk_count=len(chunks),
            message_count=sum(totals.values()),
            message_start_time=min((chunk.first_ns for chunk in chunks), default=0),
            message_end_time=max((chunk.last_ns for chunk in chunks), default=0),
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


def encoded(*records: McapRecord) -> bytes:
    """Records as they stand in a file."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
