"""One publisher's messages in order, whatever way they come."""

from hypothesis import given
from hypothesis import strategies as st

from hilrig_runtime.bus.reorder_buffer import ReorderBuffer

WINDOW = 10


class Stream:
    """What a stream gave out: numbers, and how many were lost before each."""

    def __init__(self, window: int = WINDOW) -> None:
        self.got: list[int] = []
        self.lost: list[tuple[int, int]] = []
        self.messages = ReorderBuffer[int](
            self.got.append, lambda count: self.lost.append((len(self.got), count)), window
        )

    def _on_loss(self, count: int) -> None:
        self.lost.append((len(self.got), count))

    def take(self, *numbers: int) -> None:
        for number in numbers:
            self.messages.insert(number, number)


def test_messages_are_delivered_in_order_and_once() -> None:
    stream = Stream()
    stream.take(2, 0, 0, 1, 1, 2, 3)
    assert stream.got == [0, 1, 2, 3]
    assert stream.lost == []
    assert not stream.messages.missing(5)


def test_what_is_missing_is_asked_for_from_its_beginning_and_in_pieces() -> None:
    stream = Stream()
    stream.take(0, 6)
    assert stream.messages.missing(3) == range(1, 4)
    assert stream.messages.missing(100) == range(1, 6)
    stream.take(1, 3)
    assert stream.messages.missing(100) == range(2, 3)
    stream.take(2)
    assert stream.messages.missing(100) == range(4, 6)


def test_a_message_that_was_announced_and_did_not_come_is_missing() -> None:
    stream = Stream()
    stream.take(0)
    stream.messages.set_head(2)
    assert stream.messages.missing(100) == range(1, 3)


def test_what_can_not_be_had_any_more_is_lost_and_told_before_what_follows() -> None:
    stream = Stream()
    stream.take(0, 20)
    assert stream.messages.missing(100) == range(11, 20)
    assert (stream.got, stream.lost) == ([0], [(1, 10)])
    stream.take(12)
    stream.messages.skip_gap()
    assert (stream.got, stream.lost) == ([0, 12], [(1, 10), (1, 1)])
    stream.messages.flush()
    assert (stream.got, stream.lost) == ([0, 12, 20], [(1, 10), (1, 1), (2, 7)])


def test_what_was_sent_before_the_first_that_could_be_had_is_no_loss() -> None:
    stream = Stream()
    stream.take(30)
    assert stream.messages.missing(100) == range(21, 30)
    stream.take(25)
    stream.messages.skip_gap()
    assert (stream.got, stream.lost) == ([25], [])
    stream.messages.skip_gap()
    assert (stream.got, stream.lost) == ([25, 30], [(1, 4)])


def test_a_number_far_away_takes_no_time() -> None:
    stream = Stream()
    stream.take(0)
    stream.messages.set_head(2**32 - 1)
    assert len(stream.messages.missing(100)) == WINDOW
    assert stream.lost == [(1, 2**32 - 1 - WINDOW)]


@given(
    st.integers(1, 60).flatmap(
        lambda count: st.tuples(
            st.just(count), st.lists(st.integers(0, count - 1), max_size=120), st.sets(st.integers(0, 200))
        )
    )
)
def test_every_message_is_delivered_in_order_or_counted_as_lost(case: tuple[int, list[int], set[int]]) -> None:
    count, arrivals, give_ups = case
    stream = Stream()
    for at, number in enumerate(arrivals):
        stream.take(number)
        stream.messages.missing(3)
        if at in give_ups:
            stream.messages.skip_gap()
    stream.messages.set_head(count - 1)
    stream.messages.skip_gap()
    stream.messages.flush()
    assert stream.got == sorted(set(stream.got))
    assert set(stream.got) <= set(arrivals)
    assert not stream.messages.missing(100)
    if stream.got:
        assert sum(lost for _, lost in stream.lost) == count - stream.got[0] - len(stream.got)
