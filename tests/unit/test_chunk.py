"""What is kept of a file's chunks while it is written."""

import random
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from hilrig_recorder.channels import encode_message
from hilrig_recorder.chunk import CHUNK_BYTES, ChunkNote, ChunkNotes, cut, encode_chunk

TIMES = st.integers(0, 2**62)
SIZES = st.integers(0, 2**31)


@st.composite
def notes(draw: st.DrawFn) -> list[ChunkNote]:
    made: list[ChunkNote] = []
    end = 0
    for gap in draw(st.lists(SIZES, max_size=10)):
        first_ns, span_ns = draw(TIMES), draw(SIZES)
        counts = draw(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 1000)), min_size=1, max_size=4))
        made.append(ChunkNote(end + gap, first_ns, first_ns + span_ns, draw(SIZES), draw(SIZES), tuple(counts)))
        end = made[-1].end
    return made


@given(notes())
def test_notes_come_back_as_they_were_given(given_notes: list[ChunkNote]) -> None:
    kept = ChunkNotes()
    assert not kept
    for note in given_notes:
        kept.add(note)
    assert list(kept) == given_notes
    while given_notes:
        assert kept.take_back() == given_notes.pop()
        assert list(kept) == given_notes


def test_an_hour_of_a_rig_is_sixty_kilobytes() -> None:
    rng = random.Random(1)
    kept = ChunkNotes()
    start = 10_000
    for second in range(3600):
        first_ns, span_ns = second * 10**9 + rng.randrange(10**7), 980_000_000 + rng.randrange(10**7)
        sizes = 9_000 + rng.randrange(500), 25_000 + rng.randrange(50)
        note = ChunkNote(start, first_ns, first_ns + span_ns, *sizes, ((1, 50), (2, 49 + rng.randrange(2))))
        kept.add(note)
        start = note.end
    assert kept.size < 3600 * 18


@given(st.lists(st.integers(0, CHUNK_BYTES * 2), max_size=30))
def test_runs_are_as_large_as_a_chunk_may_be_and_nothing_is_left_out(sizes: list[int]) -> None:
    records = [bytes([number]) * size for number, size in enumerate(sizes)]
    runs = [list(run) for run in cut(records)]
    assert [record for run in runs for record in run] == records
    assert all(len(run) == 1 or sum(map(len, run)) <= CHUNK_BYTES for run in runs)
    assert all(sum(map(len, run)) + len(following[0]) > CHUNK_BYTES for run, following in pairwise(runs))


def test_a_note_says_where_the_next_chunk_begins() -> None:
    records = [encode_message(1 + number % 2, number, number, number, b"x" * number) for number in range(1, 40)]
    data, note = encode_chunk(records, 500, lambda raw: raw)
    assert (note.start, note.end) == (500, 500 + len(data))
    assert (note.first_ns, note.last_ns, note.messages) == (1, 39, 39)
