"""The summary section at the end of an MCAP file: indexes, statistics and checksum. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema, Statistics

from hilrig_recorder.mcap_format.records import (
    ChunkInfo,
    encode_chunk_index,
    encode_data_end,
    encode_records,
    encode_summary,
)


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
        data_end = encode_data_end()
        groups = {
            Opcode.SCHEMA: encode_records(*self.schemas),
            Opcode.CHANNEL: encode_records(*self.channels),
            Opcode.STATISTICS: encode_records(self._statistics(chunks)),
            Opcode.CHUNK_INDEX: b"".join(map(encode_chunk_index, chunks)),
            Opcode.ATTACHMENT_INDEX: encode_records(*self.attachments),
            Opcode.METADATA_INDEX: encode_records(*self.metadata),
        }
        return data_end + encode_summary(size + len(data_end), groups)

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
