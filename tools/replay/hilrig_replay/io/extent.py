"""Beginning and duration of a recording, from its first and its last state.

The arrival at the recorder is no measure: after an outage, the states of half a minute arrive at once. Nor is the wall
clock, which can be set. Two states of one simulation differ by its monotonic clock.
"""

from collections.abc import Iterable
from typing import Final, NamedTuple

from google.protobuf.message import DecodeError

from hilrig_recorder.mcap_format.reader import RecordReader, chunk_records
from hilrig_recorder.mcap_format.records import DamagedError, Message
from hilrig_schemas import JointState


class StateRange(NamedTuple):
    """The first and the last state of a recording."""

    first: JointState
    last: JointState


class Extent(NamedTuple):
    """Beginning and duration of the states of a recording."""

    start_wall_ns: int
    """Time of the first state by the clock of its sender, ns since 1970-01-01 UTC."""
    duration_s: float
    """Time from the first state to the last."""


MAX_DURATION_S: Final = 1e9


def state_range(
    reader: RecordReader, chunks: Iterable[tuple[int, int]], reverse: Iterable[tuple[int, int]], channel: int
) -> StateRange | None:
    """Read the first and the last state of a file; None: it has no state.

    Args:
        reader: reader of the file.
        chunks: offset and length of the chunks that may contain states, in file order.
        reverse: the same in reverse order.
        channel: id of the channel of the states.

    Raises:
        DamagedError: a chunk or a state is damaged.
    """
    wanted = frozenset((channel,))
    first = last = None
    for chunk in chunks:
        first = next(chunk_records(reader.indexed_chunk(*chunk), wanted), None)
        if first is not None:
            break
    if first is None:
        return None
    for chunk in reverse:
        for message in chunk_records(reader.indexed_chunk(*chunk), wanted):
            last = message
        if last is not None:
            break
    return StateRange(_decode(first), _decode(last or first))


def extent_of(states: StateRange) -> Extent:
    """Beginning and duration of a recording with these first and last states."""
    begin, end = states
    duration_ns = end.sampled_ns - begin.sampled_ns
    if end.incarnation != begin.incarnation:
        # The clock of a restarted simulation can be that of another host.
        duration_ns = end.wall_ns - begin.wall_ns
    return Extent(max(begin.wall_ns, 0), min(max(duration_ns / 1e9, 0.0), MAX_DURATION_S))


def _decode(message: Message) -> JointState:
    try:
        return JointState.FromString(message.data)
    except DecodeError as error:
        raise DamagedError(f"a state can't be decoded: {error}") from error
