"""The strict reader: malformed files are refused with a clear error, and the mcap library reads the same records."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema
from mcap.records import ChunkIndex as LibraryChunkIndex
from mcap.stream_reader import StreamReader

from hilrig_recorder.mcap_format.reader import buffer_reader, chunk_records, decompress
from hilrig_recorder.mcap_format.records import (
    MAX_CHUNK_BYTES,
    Chunk,
    ChunkIndex,
    DamagedError,
    Message,
    decode_chunk,
    encode_message,
)
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.mcap_format.scan import scan
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from support import recordings

FOOTER_BYTES = 29 + 8
"""Footer record and magic bytes."""
Change = Callable[[bytearray, dict[int, int]], None]
"""Changes a file; gets the offset of the first record of the summary section with each opcode."""


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return recordings.record(tmp_path_factory.mktemp("good") / "run.mcap", recordings.Script(seconds=3)).read_bytes()


def flip_chunk_index(data: bytearray, at: dict[int, int]) -> None:
    data[at[Opcode.CHUNK_INDEX]] = 0x90


def set_record_length(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.SCHEMA] + 1, 1 << 43)


def set_chunk_offset(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.CHUNK_INDEX] + 9 + 16, 1 << 63)


def set_chunk_length(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.CHUNK_INDEX] + 9 + 24, (1 << 64) - 1)


def set_chunk_time(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.CHUNK_INDEX] + 9 + 8, 1 << 63)


def set_metadata_offset(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.METADATA_INDEX] + 9, 8)


def set_metadata_length(data: bytearray, at: dict[int, int]) -> None:
    struct.pack_into("<Q", data, at[Opcode.METADATA_INDEX] + 17, 1 << 62)


def set_summary_start(data: bytearray, _: dict[int, int]) -> None:
    struct.pack_into("<Q", data, len(data) - FOOTER_BYTES + 9, len(data) + 1)


@pytest.mark.parametrize(
    ("change", "defect"),
    [
        (flip_chunk_index, "chunk indexes, expected"),
        (set_record_length, f"truncated record: {1 << 43} bytes, expected at most"),
        (set_chunk_offset, f"at {1 << 63}, expected between 8 and"),
        (set_chunk_length, f"chunk index record: {(1 << 64) - 1} bytes at"),
        (set_chunk_time, "increasing times"),
        (set_metadata_offset, "the index points to opcode"),
        (set_metadata_length, f"index entry of {1 << 62} bytes, in a file of"),
        (set_summary_start, "summary section at"),
    ],
)
@pytest.mark.parametrize("has_checksum", [False, True])
def test_malformed_summary_is_refused(
    tmp_path: Path, good: bytes, change: Change, defect: str, has_checksum: bool
) -> None:
    path, data = tmp_path / "run.mcap", bytearray(good)
    reader = buffer_reader(good)
    at: dict[int, int] = {}
    for record in reader.summary_records(reader.summary()):
        at.setdefault(record.opcode, record.offset)
    if not has_checksum:
        data[-12:-8] = bytes(4)
    change(data, at)
    path.write_bytes(data)
    expected = defect if not has_checksum or change is set_summary_start else "bad checksum of the summary section"
    with pytest.raises(InputError, match=f"run.mcap: damaged .*{expected}.*, at offset [0-9]+.: run `hilrig recover"):
        open_run(path)
    [entry] = RunIndex(tmp_path).load()
    # The list of recordings reads neither chunk indexes nor schemas.
    assert "damaged (" in entry.error or (not has_checksum and "CHUNK" in change.__name__.upper())
    # All messages are before the damage.
    recovery = recover(path, tmp_path / "new.mcap")
    assert recovery.damaged_bytes == 0
    assert recovery.messages == sum(open_run(tmp_path / "new.mcap").file.counts.values()) > 0


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunk_never_expands_beyond_its_stated_size(compression: str) -> None:
    raw = bytes(64 << 20)
    data = zstandard.compress(raw) if compression == "zstd" else lz4.frame.compress(raw)
    for size in (100, len(raw) - 1):
        with pytest.raises(DamagedError):
            decompress(Chunk(8, 0, 0, compression, size, 0, data))
    streamed = zstandard.ZstdCompressor().compressobj()
    without_size = streamed.compress(raw) + streamed.flush()
    with pytest.raises(DamagedError, match="decompression failed, at offset 8"):
        decompress(Chunk(8, 0, 0, "zstd", 100, 0, without_size))


def test_chunk_that_states_too_large_a_size_is_damaged() -> None:
    content = struct.pack("<QQQII4sQ", 0, 0, MAX_CHUNK_BYTES + 1, 0, 4, b"zstd", 200_000) + bytes(200_000)
    with pytest.raises(DamagedError, match=f"at most {MAX_CHUNK_BYTES}, at offset 8"):
        decode_chunk(content, 8)


@pytest.mark.parametrize("length", [30, 1 << 43, (1 << 64) - 1, 3])
def test_record_must_end_inside_its_chunk(length: int) -> None:
    first, second = encode_message(1, 1, 5, 5, b"first"), bytearray(encode_message(1, 2, 6, 6, b"second"))
    struct.pack_into("<Q", second, 1, length)
    found: list[Message | Schema | Channel] = []
    with pytest.raises(DamagedError, match=f"of {length} bytes"):
        found.extend(chunk_records(first + bytes(second)))
    assert [item.sequence for item in found if isinstance(item, Message)] == [1]
    for at in (1, 8, 9, 30):
        with pytest.raises(DamagedError, match=r"truncated|bytes in a chunk|of 3 bytes"):
            list(chunk_records(first + bytes(second[:at])))


def test_messages_of_wanted_channels_only() -> None:
    records = [encode_message(channel, number, 1, 2, b"x") for number, channel in enumerate((1, 2, 1, 3))]
    assert [message.sequence for message in chunk_records(b"".join(records), {1, 3})] == [0, 2, 3]
    assert all(isinstance(item, Message) for item in chunk_records(b"".join(records)))


def test_attachment_with_wrong_checksum_is_recovered_not_refused(tmp_path: Path, good: bytes) -> None:
    path, data = tmp_path / "run.mcap", bytearray(good)
    offset = next(at for at, item in scan(good) if isinstance(item, Attachment) and len(item.data) > 1000)
    data[offset + 1000] ^= 1
    path.write_bytes(data)
    assert open_run(path).file.counts["state"] > 0
    assert any("attachment with checksum" in reason for reason in recover(path, tmp_path / "new.mcap").reasons)


def test_indexes_are_those_of_the_mcap_library(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    writer = RecordingWriter(path)
    for number in range(300):
        writer.add(encode_message(1 + number % 3, number, 1000 + number, number, bytes(900)))
    writer.finish()
    writer.publish()
    with path.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True, emit_chunks=True).records)
    data = path.read_bytes()
    reader = buffer_reader(data)
    summary = reader.summary()
    expected = [record for record in records if isinstance(record, LibraryChunkIndex)]
    found = [item for item in reader.summary_items(summary) if isinstance(item, ChunkIndex)]
    assert [tuple(index) for index in found] == [
        (
            index.message_start_time,
            index.message_end_time,
            index.chunk_start_offset,
            index.chunk_length,
            tuple(index.message_index_offsets),
        )
        for index in expected
    ]
    for index in expected:
        # The offsets of the message indexes point to message index records of their channels.
        for channel_id, offset in index.message_index_offsets.items():
            opcode, _, channel = struct.unpack_from("<BQH", data, offset)
            assert (opcode, channel) == (Opcode.MESSAGE_INDEX, channel_id)
    assert zlib.crc32(data[summary.start : -12]) == summary.checksum


def test_two_indexes_of_one_chunk_are_damage(good: bytes, tmp_path: Path) -> None:
    data = bytearray(good)
    reader = buffer_reader(good)
    found = [one.offset for one in reader.summary_records(reader.summary()) if one.opcode == Opcode.CHUNK_INDEX]
    first, second = found[:2]
    # Offset and length of the chunk, after its two times.
    data[second + 25 : second + 41] = data[first + 25 : first + 41]
    data[-12:-8] = bytes(4)
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with pytest.raises(InputError, match="chunk indexes overlap"):
        open_run(path)
    assert recover(path, tmp_path / "new.mcap").messages == sum(open_run(tmp_path / "new.mcap").file.counts.values())


def test_chunk_with_an_impossible_ratio_is_not_expanded() -> None:
    raw = bytes(16 << 20)
    packed = zstandard.compress(raw)
    content = struct.pack("<QQQII4sQ", 0, 1, len(raw), zlib.crc32(raw), 4, b"zstd", len(packed)) + packed
    with pytest.raises(DamagedError, match="bytes uncompressed; expected"):
        decode_chunk(content, 0)


def test_zeros_in_a_chunk_are_damage() -> None:
    with pytest.raises(DamagedError, match="opcode 0"):
        list(chunk_records(bytes(100), {1}))
