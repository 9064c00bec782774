"""One recording: an MCAP file that is called `.part` while it is written and gets its name when it is whole.

Chunks of at most 64 KiB leave in one write each, so that a kill tears at most the last one. The index at the end is
made of what stands in the file: nothing is kept of a chunk once it is written, however long a recording grows. A write
that fails is taken back to the last whole chunk, and the file can still be finished: what did not fit is tried again
then, and where no space is left even for the index, the newest chunks make room for it.
"""

import errno
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import FileIO
from pathlib import Path
from typing import Final

from mcap.records import Attachment, AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema
from mcap.writer import MCAP0_MAGIC

from hilrig_recorder.mcap_format.channels import CHANNELS, SCHEMAS
from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES, ChunkNote, Compress, chunks_of, compressor, cut, encode_chunk
from hilrig_recorder.mcap_format.file_names import part_path
from hilrig_recorder.mcap_format.fsutil import lock_file, sync_folder
from hilrig_recorder.mcap_format.summary_section import Contents, encoded

LIBRARY: Final = "hilrig"


class MovedError(OSError):
    """The file is not any more where it was: somebody moved or deleted it, or its folder, while it was written."""

    def __init__(self, part: Path) -> None:
        super().__init__(errno.ENOENT, "it was moved or deleted while it was written", str(part))


class RunWriter:
    """Writes one recording; use it from one thread, and `sync` from any one other, which may `finish` it too.

    Raises:
        OSError: from every method that writes, when the disk does not take it. What was written before stays whole.
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
        part: Path | None = None,
        compress: Compress | None = None,
    ) -> None:
        self.path = path
        self.part = part_path(path) if part is None else part
        self._file = FileIO(self.part, "x+")
        lock_file(self._file.fileno())
        self.size = 0
        """Bytes in the file, all of whole records."""
        self.message_count = 0
        """Messages in the file."""
        self.given_up = 0
        """Messages that the disk did not take."""
        self._compress = compressor() if compress is None else compress
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._contents = Contents()
        try:
            # One write: a laboratory may begin hundreds of files at once, and a file that is there says whose it is.
            begin = MCAP0_MAGIC + encoded(Header(profile, library), *schemas, *channels)
            self._append(begin + encoded(*metadata))
        except OSError:
            self.discard()
            raise
        self._contents.schemas += schemas
        self._contents.channels += channels
        offset = len(begin)
        for item in metadata:
            length = len(encoded(item))
            self._contents.metadata.append(MetadataIndex(offset, length, item.name))
            offset += length

    @property
    def attachment_count(self) -> int:
        """Attachments in the file."""
        return len(self._contents.attachments)

    # -- records ----------------------------------------------------------------------------------------------------

    def add_schema(self, schema: Schema) -> None:
        """Declare a schema, outside the chunks so that a torn file has it."""
        self._append(encoded(schema))
        self._contents.schemas.append(schema)

    def add_channel(self, channel: Channel) -> None:
        """Declare a channel, outside the chunks too."""
        self._append(encoded(channel))
        self._contents.channels.append(channel)

    def add(self, record: bytes) -> None:
        """Add a message that is encoded already (`channels.encode_message`), to be written when a chunk is full."""
        if self._pending and self._pending_bytes + len(record) > CHUNK_BYTES:
            self.close_chunk()
        self._pending.append(record)
        self._pending_bytes += len(record)

    def write(self, records: Iterable[bytes]) -> None:
        """Add messages, and write them at once."""
        self._pending += records
        self.close_chunk()

    def close_chunk(self) -> None:
        """Write the messages that wait; what the disk does not take waits for `finish`."""
        written = 0
        try:
            for run in cut(self._pending):
                self._append(encode_chunk(run, self._compress))
                written += len(run)
        finally:
            self.message_count += written
            del self._pending[:written]
            self._pending_bytes = 0

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a named set of values."""
        record = encoded(Metadata(name, dict(values)))
        self._append(record)
        self._contents.metadata.append(MetadataIndex(self.size - len(record), len(record), name))

    def add_attachment(self, name: str, media_type: str, data: bytes, *, log_time: int, create_time: int = 0) -> None:
        """Add a file to the file; times are wall clock, ns."""
        record = encoded(Attachment(create_time, log_time, name, media_type, data))
        self._append(record)
        self._contents.attachments.append(
            AttachmentIndex(self.size - len(record), len(record), log_time, create_time, len(data), name, media_type)
        )

    # -- the end ----------------------------------------------------------------------------------------------------

    def finish(self, last_words: Callable[[], Mapping[str, Mapping[str, str]]] = dict) -> None:
        """Write the last chunk, `last_words` (metadata by name) and the index.

        Where the disk has no room for them, the newest chunks are given up until it has; `last_words` is asked again
        each time, for it may tell `given_up`.

        Raises:
            OSError: there is not even room for the index of nothing; what stands in the file can be recovered.
        """
        if self._pending:
            # The one that the others share is of the thread that writes.
            self._compress = compressor()
            try:
                self.close_chunk()
            except OSError:
                self.given_up += len(self._pending)
                self._pending.clear()
        chunks = self._chunks()
        while True:
            try:
                self._end(last_words(), chunks)
                return
            except OSError:
                if not chunks:
                    raise
                self._take_back(chunks.pop())

    def _chunks(self) -> list[ChunkNote]:
        try:
            return list(chunks_of(self._read, len(MCAP0_MAGIC), self.size))
        except ValueError as error:
            raise OSError(errno.EIO, f"what was written can't be read back: {error}") from error
        finally:
            self._file.seek(self.size)

    def _end(self, last_words: Mapping[str, Mapping[str, str]], chunks: Sequence[ChunkNote]) -> None:
        size, known = self.size, len(self._contents.metadata)
        try:
            for name, values in last_words.items():
                self.add_metadata(name, values)
            self._append(self._contents.end(self.size, chunks))
        except OSError:
            del self._contents.metadata[known:]
            self._cut(size)
            raise

    def _take_back(self, chunk: ChunkNote) -> None:
        """Give up the newest chunk, and whatever was written behind it."""
        contents = self._contents
        contents.metadata = [index for index in contents.metadata if index.offset < chunk.start]
        contents.attachments = [index for index in contents.attachments if index.offset < chunk.start]
        self.message_count -= chunk.messages
        self.given_up += chunk.messages
        self._cut(chunk.start)

    # -- the disk ---------------------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Make what was written survive a power cut.

        Raises:
            MovedError: under its name it would not be found; what is written goes on to where it is now.
        """
        os.fsync(self._file.fileno())
        self._find()

    def _find(self) -> None:
        try:
            is_there = os.path.samestat(self.part.stat(), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            is_there = False
        if not is_there:
            raise MovedError(self.part)

    def publish(self, *, durably: bool = True) -> Path:
        """Give the finished file its name, so that it survives a power cut; the path it has now."""
        try:
            self._find()
            if self.path.exists():
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(self.path))
            if durably:
                self.sync()
        finally:
            self._file.close()
        self.part.replace(self.path)
        if durably:
            sync_folder(self.path.parent)
        return self.path

    def close(self) -> None:
        """Let go of the file as it is, under its `.part` name."""
        self._file.close()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._file.close()
        self.part.unlink(missing_ok=True)

    def _read(self, offset: int, size: int) -> bytes:
        self._file.seek(offset)
        return self._file.read(size)

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError:
            self._cut(self.size)
            raise
        self.size += len(data)

    def _cut(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)
        self.size = size
