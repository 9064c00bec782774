"""The summary section at the end of an MCAP file: indexes, statistics and checksum. Pure."""

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

from hilrig_recorder.mcap_format.chunk import ChunkInfo


@dataclass(slots=True)
class SummarySection:
    """Collects the entries of the summary section, except those of the chunks."""

    schemas: list[Schema] = field(default_factory=list)
    channels: list[Channel] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)

    def encode(self, size: int, chunks: Sequence[ChunkInfo]) -> bytes:
        """All bytes after the data section: data end, summary, footer and magic.

        Args:
            size: size of the file so far, bytes.
            chunks: the chunks in the file.
        """
        data_end = encode_records(DataEnd(0))
        start = size + len(data_end)
        summary = bytearray()
        offsets = bytearray()
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, encode_records(*self.schemas)),
            (Opcode.CHANNEL, encode_records(*self.channels)),
            (Opcode.STATISTICS, encode_records(self._statistics(chunks))),
            (Opcode.CHUNK_INDEX, b"".join(chunk.index_record() for chunk in chunks)),
            (Opcode.ATTACHMENT_INDEX, encode_records(*self.attachments)),
            (Opcode.METADATA_INDEX, encode_records(*self.metadata)),
        ]
        for opcode, records in groups:
            if records:
                offsets += encode_records(SummaryOffset(opcode.value, start + len(summary), len(records)))
                summary += records
        offset_start = start + len(summary)
        summary += offsets
        footer_head = struct.pack("<BQQQ", Opcode.FOOTER.value, 20, start, offset_start)
        checksum = zlib.crc32(footer_head, zlib.crc32(summary))
        return data_end + bytes(summary) + encode_records(Footer(start, offset_start, checksum)) + MCAP0_MAGIC

    def _statistics(self, chunks: Sequence[ChunkInfo]) -> Statistics:
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


def encode_records(*records: McapRecord) -> bytes:
    """Encode records in the MCAP file format."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
