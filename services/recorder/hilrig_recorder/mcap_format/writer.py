"""Writes one recording: an MCAP file with the suffix `.part` that is renamed when it is finished.

Each chunk of at most 64 KiB is written by one call, so that a kill truncates at most the last chunk. The index is built
from the file when it is finished: memory use does not grow with the recording. After a failed write the file is
truncated to its last complete chunk and can still be finished: pending messages are written again first, and if there
is no space for the index, the newest chunks are removed until it fits.
"""

import errno
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Final

from mcap.records import Attachment, AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema

from hilrig_recorder.mcap_format.channels import CHANNELS, SCHEMAS
from hilrig_recorder.mcap_format.chunk import (
    CHUNK_BYTES,
    Compress,
    compressor,
    encode_chunk,
    split_into_chunks,
)
from hilrig_recorder.mcap_format.file_names import MAGIC, PART_SUFFIX, part_path
from hilrig_recorder.mcap_format.fsutil import lock_file, sync_folder
from hilrig_recorder.mcap_format.reader import RecordReader
from hilrig_recorder.mcap_format.records import COPY_SUFFIX, ChunkInfo, DamagedError, encode_records
from hilrig_recorder.mcap_format.summary_section import SummarySection

LIBRARY: Final = "hilrig"


class FileReplacedError(OSError):
    """The file being written was moved, deleted or truncated, alone or with its folder."""

    def __init__(self, path: Path, change: str = "moved or deleted") -> None:
        super().__init__(errno.ENOENT, f"file was {change} while it was being written", str(path))


class RecordingWriter:
    """Writes one recording.

    One thread writes. One other thread may call `sync`, and finally `finish` and `publish`.

    Raises:
        OSError: from every method that writes, if the write fails. Records written before stay complete.
    """

    def __init__(
        self,
        path: Path,
        *,
        schemas: tuple[Schema, ...] = SCHEMAS,
        channels: tuple[Channel, ...] = CHANNELS,
        metadata: tuple[Metadata, ...] = (),
        profile: str = "",
        library: str = LIBRARY,
        temporary_path: Path | None = None,
        compress: Compress | None = None,
    ) -> None:
        self.path = path
        self.temporary_path = part_path(path) if temporary_path is None else temporary_path
        self._file = FileIO(self.temporary_path, "x+")
        self._folder_synced = False
        self._is_truncated = False
        lock_file(self._file.fileno())
        self.size = 0
        """Bytes in the file, all of complete records."""
        self.message_count = 0
        """Messages in the file."""
        self.dropped_count = 0
        """Messages that could not be written."""
        self._compress = compressor() if compress is None else compress
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._summary = SummarySection()
        self._repeated = {item.name: item.metadata for item in metadata}
        """Metadata records that are written a second time at the end of the file."""
        try:
            # One write: many files may be opened at once, and each file that exists states its session.
            begin = MAGIC + encode_records(Header(profile, library), *schemas, *channels)
            self._append(begin + encode_records(*metadata))
        except OSError:
            self.discard()
            raise
        self._summary.schemas += schemas
        self._summary.channels += channels
        offset = len(begin)
        for item in metadata:
            length = len(encode_records(item))
            self._summary.metadata.append(MetadataIndex(offset, length, item.name))
            offset += length

    @property
    def attachment_count(self) -> int:
        """Number of attachments in the file."""
        return len(self._summary.attachments)

    # -- records ----------------------------------------------------------------------------------------------------

    def add_schema(self, schema: Schema) -> None:
        """Add a schema outside the chunks, so that a truncated file contains it."""
        self._append(encode_records(schema))
        self._summary.schemas.append(schema)

    def add_channel(self, channel: Channel) -> None:
        """Add a channel outside the chunks, so that a truncated file contains it."""
        self._append(encode_records(channel))
        self._summary.channels.append(channel)

    def add(self, record: bytes) -> None:
        """Add an encoded message (`records.encode_message`). It is written when the chunk is full."""
        if self._pending and self._pending_bytes + len(record) > CHUNK_BYTES:
            self.close_chunk()
        self._pending.append(record)
        self._pending_bytes += len(record)

    def write(self, records: Iterable[bytes]) -> None:
        """Add encoded messages and write them immediately."""
        self._pending += records
        self.close_chunk()

    def close_chunk(self) -> None:
        """Write the pending messages. After an error, unwritten messages stay pending until `finish`."""
        written = 0
        try:
            for group in split_into_chunks(self._pending):
                self._append(encode_chunk(group, self._compress))
                written += len(group)
        finally:
            self.message_count += written
            del self._pending[:written]
            self._pending_bytes = 0

    def add_metadata(self, name: str, values: Mapping[str, str], *, is_repeated: bool = False) -> None:
        """Add a metadata record; with `is_repeated` a second time at the end, for a file whose beginning is damaged."""
        if is_repeated:
            self._repeated[name] = dict(values)
        record = encode_records(Metadata(name, dict(values)))
        self._append(record)
        self._summary.metadata.append(MetadataIndex(self.size - len(record), len(record), name))

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_time: int, create_time: int = 0) -> None:
        """Add an attachment; times are wall clock, ns."""
        record = encode_records(Attachment(create_time, log_time, name, media_type, data))
        self._append(record)
        self._summary.attachments.append(
            AttachmentIndex(self.size - len(record), len(record), log_time, create_time, len(data), name, media_type)
        )

    # -- finishing --------------------------------------------------------------------------------------------------

    def finish(self, final_metadata: Callable[[], Mapping[str, Mapping[str, str]]] = dict) -> None:
        """Write the last chunk, the final metadata and the index.

        If the disk has no space for them, the newest chunks are removed until they fit.

        Args:
            final_metadata: returns metadata records by name. It is called again after each removed chunk, because it
                may contain `dropped_count`.

        Raises:
            FileReplacedError: the file was truncated by another process.
            OSError: not even an index without chunks could be written. The file can be recovered.
        """
        self._check_size()
        if self._pending:
            # The shared compressor belongs to the writing thread.
            self._compress = compressor()
            try:
                self.close_chunk()
            except OSError:
                self.dropped_count += len(self._pending)
                self._pending.clear()
        chunks = self._chunks()
        while True:
            try:
                self._write_end(final_metadata(), chunks)
                return
            except OSError:
                if not chunks:
                    raise
                self._remove_chunk(chunks.pop())

    def _chunks(self) -> list[ChunkInfo]:
        try:
            return list(RecordReader(self._read, self.size).chunk_infos(len(MAGIC), self.size))
        except DamagedError as error:
            raise OSError(errno.EIO, f"written data can't be read back: {error}") from error
        finally:
            self._file.seek(self.size)

    def _write_end(self, final_metadata: Mapping[str, Mapping[str, str]], chunks: Sequence[ChunkInfo]) -> None:
        size, known = self.size, len(self._summary.metadata)
        try:
            for name, values in final_metadata.items():
                self.add_metadata(name, values)
            for name, values in self._repeated.items():
                self.add_metadata(f"{name}{COPY_SUFFIX}", values)
            self._append(self._summary.encode(self.size, chunks))
        except OSError:
            del self._summary.metadata[known:]
            self._truncate(size)
            raise

    def _remove_chunk(self, chunk: ChunkInfo) -> None:
        """Remove the newest chunk and all records after it."""
        summary = self._summary
        summary.metadata = [index for index in summary.metadata if index.offset < chunk.start]
        summary.attachments = [index for index in summary.attachments if index.offset < chunk.start]
        self.message_count -= chunk.messages
        self.dropped_count += chunk.messages
        self._truncate(chunk.start)

    # -- disk access ------------------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Make the written records survive a power failure.

        Raises:
            FileReplacedError: the temporary path no longer refers to this file, or bytes of it are missing. Writing
                continues to the open file.
        """
        os.fsync(self._file.fileno())
        if not self._folder_synced:
            self._folder_synced = True
            # Without it, the file itself may be missing after a power failure.
            sync_folder(self.path.parent)
        self._check_path()
        self._check_size()

    def _check_path(self) -> None:
        if not self._is_at(self.temporary_path):
            raise FileReplacedError(self.temporary_path)

    def _check_size(self) -> None:
        self._note_truncation()
        if self._is_truncated:
            raise FileReplacedError(self.temporary_path, "truncated")

    def _note_truncation(self) -> None:
        self._is_truncated |= os.fstat(self._file.fileno()).st_size < self.size

    def _is_at(self, path: Path) -> bool:
        try:
            return os.path.samestat(path.stat(), os.fstat(self._file.fileno()))
        except OSError:
            return False

    def publish(self, *, durably: bool = True) -> Path:
        """Rename the finished file to its final path and return that path.

        Args:
            durably: whether file and rename must survive a power failure.

        Raises:
            FileReplacedError: the file was moved or deleted. A moved file gets its final name in its new folder, if the
                system knows that folder (Linux).
        """
        try:
            if not self._is_at(self.temporary_path):
                self._publish_moved()
                raise FileReplacedError(self.temporary_path)
            if self.path.exists():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path))
            if durably:
                self.sync()
        finally:
            self._file.close()
        self.temporary_path.replace(self.path)
        if durably:
            sync_folder(self.path.parent)
        return self.path

    def _publish_moved(self) -> None:
        try:
            moved = Path(f"/proc/self/fd/{self._file.fileno()}").readlink()
        except OSError:
            return
        final = moved.with_name(moved.name.removesuffix(PART_SUFFIX))
        if self._is_at(moved) and not final.exists():
            moved.rename(final)

    def close(self) -> None:
        """Close the file as it is, under its temporary path."""
        self._file.close()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self.temporary_path.unlink(missing_ok=True)

    def _read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _append(self, data: bytes) -> None:
        # The next write would extend a truncated file to its old size, with zeros between.
        self._note_truncation()
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError:
            self._truncate(self.size)
            raise
        self.size += len(data)

    def _truncate(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)
        self.size = size
