"""Chunks as they stand in a file, and how they are found there again."""

from itertools import pairwise

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Metadata

from hilrig_recorder.mcap_format.channels import encode_message
from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES, ChunkNote, chunks_of, compressor, cut, encode_chunk
from hilrig_recorder.mcap_format.summary_section import encoded

MESSAGES = st.lists(st.tuples(st.integers(1, 4), st.integers(0, 2**62), st.binary(max_size=300)), min_size=1)


def found(content: bytes, begin: int = 0) -> list[ChunkNote]:
    return list(chunks_of(lambda at, size: content[at : at + size], begin, len(content)))


@given(st.lists(MESSAGES, max_size=5), st.binary(max_size=40))
def test_chunks_are_found_again_with_all_that_an_index_needs(
    chunks: list[list[tuple[int, int, bytes]]], before: bytes
) -> None:
    content = before
    expected = []
    compress = compressor()
    for number, messages in enumerate(chunks):
        records = [encode_message(channel, 1, time_ns, 0, data) for channel, time_ns, data in messages]
        start = len(content)
        content += encode_chunk(records, compress) + encoded(Metadata(f"between {number}", {"a": "b"}))
        times = [time_ns for _, time_ns, _ in messages]
        channels = [channel for channel, _, _ in messages]
        expected.append(
            ChunkNote(
                start,
                min(times),
                max(times),
                len(compress(b"".join(records))),
                sum(map(len, records)),
                tuple((channel, channels.count(channel)) for channel in dict.fromkeys(channels)),
            )
        )
    assert found(content, len(before)) == expected


def test_what_is_no_row_of_records_is_no_chunk() -> None:
    content = encode_chunk([encode_message(1, 1, 1, 1, b"message")], compressor())
    for wrong in (content[:-1], content + b"12345", b"\x01" + content):
        with pytest.raises(ValueError, match="record"):
            found(wrong)


@given(st.lists(st.integers(0, CHUNK_BYTES * 2), max_size=30))
def test_runs_are_as_large_as_a_chunk_may_be_and_nothing_is_left_out(sizes: list[int]) -> None:
    records = [bytes([number]) * size for number, size in enumerate(sizes)]
    runs = [list(run) for run in cut(records)]
    assert [record for run in runs for record in run] == records
    assert all(len(run) == 1 or sum(map(len, run)) <= CHUNK_BYTES for run in runs)
    assert all(sum(map(len, run)) + len(following[0]) > CHUNK_BYTES for run, following in pairwise(runs))


@given(st.binary(max_size=CHUNK_BYTES))
def test_compressing_loses_nothing(raw: bytes) -> None:
    assert zstandard.ZstdDecompressor().decompress(compressor()(raw), max_output_size=len(raw)) == raw
