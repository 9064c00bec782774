"""Files of the recording writer, read by the mcap library."""

import errno
import os
import random
import tracemalloc
import zlib
from io import FileIO
from pathlib import Path
from typing import BinaryIO

import pytest
import zstandard
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Footer, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, CHANNELS
from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES
from hilrig_recorder.mcap_format.file_names import part_path
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_recorder.mcap_format.scan import scan
from hilrig_recorder.mcap_format.writer import FileReplacedError, RecordingWriter
from hilrig_schemas import JointState

START = 1_767_225_600_000_000_000
STATE, COMMAND = CHANNEL_OF_TOPIC["state"], CHANNEL_OF_TOPIC["command"]


def fill(writer: RecordingWriter, count: int, seed: int = 1, size: int = 150) -> list[tuple[int, int, int, bytes]]:
    """Add messages of random bytes; returns (channel, sequence, log time, bytes) of each."""
    rng = random.Random(seed)
    added = []
    for number in range(count):
        channel = (STATE, COMMAND)[number % 2]
        data = rng.randbytes(size)
        log_time = START + number * 1_000_000
        writer.add(encode_message(channel, number, log_time, log_time - 1000, data))
        added.append((channel, number, log_time, data))
    return added


def read(path: Path) -> list[tuple[int, int, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (message.channel_id, message.sequence, message.log_time, message.data)
            for _, _, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        ]


def test_mcap_library_reads_everything(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    writer.add_metadata("about", {"rig": "rig1"})
    added = fill(writer, 2_000)
    writer.add_attachment("a.txt", "text/plain", b"hello", log_time=START)
    writer.finish(lambda: {"last": {"key": "value"}})
    assert part_path(path).exists()
    assert not path.exists()
    writer.publish()
    assert not part_path(path).exists()
    assert read(path) == added
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == 2_000
        assert statistics.channel_message_counts == {STATE: 1_000, COMMAND: 1_000}
        assert (statistics.message_start_time, statistics.message_end_time) == (added[0][2], added[-1][2])
        assert (statistics.chunk_count, statistics.channel_count) == (len(summary.chunk_indexes), len(CHANNELS))
        assert {record.name: record.metadata for record in reader.iter_metadata()} == {
            "about": {"rig": "rig1"},
            "last": {"key": "value"},
        }
        assert [(item.name, item.data) for item in reader.iter_attachments()] == [("a.txt", b"hello")]
    with path.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert type(records[-1]).__name__ == "Footer"
    # A checksum of zero means "no checksum", which every reader accepts.
    with path.open("rb") as stream:
        all_records = list(StreamReader(stream, emit_chunks=True).records)
    chunks = [record for record in all_records if isinstance(record, Chunk)]
    assert [chunk.uncompressed_crc for chunk in chunks] == [
        zlib.crc32(zstandard.decompress(chunk.data, chunk.uncompressed_size)) for chunk in chunks
    ]
    assert len(chunks) > 1
    assert isinstance(all_records[-1], Footer)
    assert all_records[-1].summary_crc


def test_index_finds_messages_of_a_time_range(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    added = fill(writer, 3_000)
    writer.finish()
    writer.publish()
    low, high = added[1_000][2], added[1_200][2]
    with path.open("rb") as stream:
        found = [
            (message.channel_id, message.sequence)
            for _, _, message in make_reader(stream).iter_messages(
                topics=["/state"], starting_at=low, ending_before=high
            )
        ]
    assert found == [(channel, number) for channel, number, at, _ in added if channel == STATE and low <= at < high]


def test_chunks_are_at_most_64_kib(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    fill(writer, 2_000, size=700)
    fill(writer, 3, size=CHUNK_BYTES * 2)
    writer.finish()
    writer.publish()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    sizes = [index.uncompressed_size for index in summary.chunk_indexes]
    assert sum(size > CHUNK_BYTES for size in sizes) == 3, "only a larger message makes a larger chunk"
    assert len(sizes) > 20


def test_recorded_state_decodes_with_the_schema_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    state = JointState(rig="rig1", step=7, position=[1, 2, 3, 4])
    with_parts = JointState(rig="rig1", step=8)
    with_parts.parts.add(name="bolt", x=0.5)
    writer = RecordingWriter(path)
    for message in (state, with_parts):
        writer.add(encode_message(STATE, message.step, START, START, message.SerializeToString()))
    writer.finish()
    writer.publish()
    with path.open("rb") as stream:
        decoded = [
            m for _, _, _, m in make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        ]
    assert [message.step for message in decoded] == [7, 8]
    assert decoded[1].parts[0].name == "bolt"


def test_empty_recording_is_a_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    writer.finish()
    writer.publish()
    assert read(path) == []


def test_chunks_are_readable_before_the_file_is_finished(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    added = fill(writer, 500)
    writer.close_chunk()
    messages = []

    def read_all(stream: BinaryIO) -> None:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Message):
                messages.append(record.data)

    with writer.temporary_path.open("rb") as stream, pytest.raises(EndOfFile):
        read_all(stream)
    writer.discard()
    assert messages == [data for _, _, _, data in added]


def test_open_recording_is_not_overwritten(tmp_path: Path) -> None:
    first = RecordingWriter(tmp_path / "run.mcap")
    with pytest.raises(FileExistsError):
        RecordingWriter(tmp_path / "run.mcap")
    first.discard()


def test_moved_file_gets_its_final_name_in_its_new_folder(tmp_path: Path) -> None:
    folder, moved = tmp_path / "rig1", tmp_path / "moved"
    folder.mkdir()
    writer = RecordingWriter(folder / "run.mcap")
    added = fill(writer, 500)
    folder.rename(moved)
    with pytest.raises(FileReplacedError, match="moved or deleted while it was being written"):
        writer.sync()
    writer.finish()
    with pytest.raises(FileReplacedError):
        writer.publish()
    assert [path.name for path in moved.iterdir()] == ["run.mcap"]
    assert read(moved / "run.mcap") == added


def test_truncation_by_another_process_is_noticed(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    fill(writer, 2_000)
    writer.sync()
    os.truncate(writer.temporary_path, 20_000)
    fill(writer, 2_000)
    for method in (writer.sync, writer.finish):
        with pytest.raises(FileReplacedError, match="truncated while it was being written"):
            method()
    writer.close()


class SmallDisk:
    """Wraps a file and limits its size to `space` bytes."""

    def __init__(self, file: FileIO, space: int) -> None:
        self._file = file
        self.space = space

    def write(self, data: memoryview) -> int:
        left = self.space - self._file.tell()
        if left <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(data[:left]) or 0

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


@pytest.mark.parametrize("space", [*range(11_000, 21_000, 613), 100_000, 200_000])
def test_file_on_a_full_disk_is_finished(tmp_path: Path, space: int) -> None:
    path = tmp_path / "run.mcap"
    failures: list[OSError] = []
    writer = RecordingWriter(path)
    writer._file = SmallDisk(writer._file, space)  # type: ignore[assignment]
    added = []
    number = 0
    while not failures:
        number += 1
        try:
            added += fill(writer, 20, seed=number)
            writer.close_chunk()
        except OSError as error:
            failures.append(error)
    writer.finish(lambda: {"hilrig.summary": {"lost_recorder": str(writer.dropped_count)}})
    writer.publish()
    assert path.stat().st_size <= space
    found = read(path)
    assert [data for *_, data in found] == [data for *_, data in added[: len(found)]]
    assert len(found) + writer.dropped_count == len(added)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        [summary_metadata] = [record.metadata for record in reader.iter_metadata()]
        assert summary_metadata == {"lost_recorder": str(writer.dropped_count)}
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(found)
        assert sum(summary.statistics.channel_message_counts.values()) == len(found)


def test_unwritten_messages_are_written_when_space_is_free(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    disk = SmallDisk(writer._file, writer.size)
    writer._file = disk  # type: ignore[assignment]
    added = fill(writer, 10)
    with pytest.raises(OSError, match="No space left"):
        writer.close_chunk()
    disk.space = 1 << 20
    writer.finish()
    writer.publish()
    assert (read(path), writer.dropped_count) == (added, 0)


def test_initial_metadata_is_in_the_first_write(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path, metadata=(Metadata("owner", {"rig": "rig1"}), Metadata("more", {})))
    assert metadata_in(writer.temporary_path.read_bytes()) == {"owner": {"rig": "rig1"}, "more": {}}
    added = fill(writer, 10)
    writer.finish()
    writer.publish()
    assert read(path) == added
    with path.open("rb") as stream:
        found = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    assert found == {"owner": {"rig": "rig1"}, "more": {}, "owner.copy": {"rig": "rig1"}, "more.copy": {}}


def metadata_in(content: bytes) -> dict[str, dict[str, str]]:
    return {item.name: item.metadata for _, item in scan(content) if isinstance(item, Metadata)}


def test_finish_without_any_space_raises(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer._file = SmallDisk(writer._file, writer.size + 100)  # type: ignore[assignment]
    fill(writer, 10)
    with pytest.raises(OSError, match="No space left"):
        writer.finish()
    assert writer.dropped_count == 10
    writer.discard()


def test_memory_does_not_grow_with_the_recording(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")

    def write(chunks: int) -> None:
        for number in range(chunks):
            writer.write([encode_message(STATE, number, START + number, START, b"state")])

    write(100)
    tracemalloc.start()
    try:
        write(100)
        before, _ = tracemalloc.get_traced_memory()
        write(2_000)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    writer.finish()
    writer.publish()
    assert after - before < 2_000
    assert len(read(tmp_path / "run.mcap")) == 2_200


def test_file_truncated_by_others_is_not_finished(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    fill(writer, 10)
    writer.close_chunk()
    os.truncate(writer.temporary_path, writer.size // 2)
    with pytest.raises(OSError, match="truncated while it was being written"):
        writer.finish()
    writer.discard()


def test_publish_does_not_replace_another_recording(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    writer.finish()
    path.write_bytes(b"another")
    with pytest.raises(FileExistsError):
        writer.publish()
    assert path.read_bytes() == b"another"
    assert writer.temporary_path.exists()
