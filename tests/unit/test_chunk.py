"""Encoding of chunks, and reading their infos back from a file."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Metadata

from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES, compressor, encode_chunk, split_into_chunks
from hilrig_recorder.mcap_format.reader import buffer_reader, decompress
from hilrig_recorder.mcap_format.records import ChunkInfo, DamagedError, decode_chunk, encode_message, encode_records

MESSAGES = st.lists(st.tuples(st.integers(1, 4), st.integers(0, 2**62), st.binary(max_size=300)), min_size=1)


def found(content: bytes, begin: int = 0) -> list[ChunkInfo]:
    return list(buffer_reader(content).chunk_infos(begin, len(content)))


@given(st.lists(MESSAGES, max_size=5), st.binary(max_size=40))
def test_chunk_infos_are_read_back_from_a_file(chunks: list[list[tuple[int, int, bytes]]], before: bytes) -> None:
    content = before
    expected = []
    compress = compressor()
    for number, messages in enumerate(chunks):
        records = [encode_message(channel, 1, time_ns, 0, data) for channel, time_ns, data in messages]
        start = len(content)
        content += encode_chunk(records, compress) + encode_records(Metadata(f"between {number}", {"a": "b"}))
        times = [time_ns for _, time_ns, _ in messages]
        channels = [channel for channel, _, _ in messages]
        expected.append(
            ChunkInfo(
                start,
                min(times),
                max(times),
                len(compress(b"".join(records))),
                sum(map(len, records)),
                tuple((channel, channels.count(channel)) for channel in dict.fromkeys(channels)),
            )
        )
    assert found(content, len(before)) == expected


def test_incomplete_records_are_rejected() -> None:
    content = encode_chunk([encode_message(1, 1, 1, 1, b"message")], compressor())
    for content_with_error in (content[:-1], content + b"12345", b"\x01" + content):
        with pytest.raises(DamagedError, match="record"):
            found(content_with_error)


@given(st.lists(st.integers(0, CHUNK_BYTES * 2), max_size=30))
def test_records_are_split_into_chunks_of_maximum_size(sizes: list[int]) -> None:
    records = [bytes([number]) * size for number, size in enumerate(sizes)]
    groups = [list(group) for group in split_into_chunks(records)]
    assert [record for group in groups for record in group] == records
    assert all(len(group) == 1 or sum(map(len, group)) <= CHUNK_BYTES for group in groups)
    assert all(sum(map(len, group)) + len(following[0]) > CHUNK_BYTES for group, following in pairwise(groups))


@given(st.binary(max_size=CHUNK_BYTES))
def test_compression_is_lossless(payload: bytes) -> None:
    record = encode_message(1, 2, 3, 4, payload)
    chunk = next(buffer_reader(encode_chunk([record], compressor())).heads(0, 1 << 20))
    assert decompress(decode_chunk(chunk.content, 0)) == record
