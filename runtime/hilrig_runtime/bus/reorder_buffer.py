"""One publisher's numbered messages, put in order: what is missing, what is lost. Pure; no bus and no clock.

Messages come as they come, live or repeated from the publisher's cache; each is delivered once, when all before it
were, or were given up. The cache repeats the newest `window` messages: what is older and still missing can't be had.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

MessageT = TypeVar("MessageT")


class ReorderBuffer(Generic[MessageT]):
    """`deliver` gets each message in order; `on_loss` how many were lost before the next that is delivered.

    What a publisher sent before its first message that could be had is no loss: it is not known whether anything is
    missing there.
    """

    def __init__(self, deliver: Callable[[MessageT], None], on_loss: Callable[[int], None], window: int) -> None:
        self._deliver = deliver
        self._on_loss = on_loss
        self._window = window
        self._due = 0
        self._newest = -1
        self._has_delivered = False
        self._held: dict[int, MessageT] = {}

    def insert(self, number: int, message: MessageT) -> bool:
        """A message came; True: it is new."""
        if number < self._due or number in self._held:
            return False
        self._newest = max(self._newest, number)
        self._held[number] = message
        self._deliver_ready()
        return True

    def set_head(self, number: int) -> None:
        """The publisher has sent this number."""
        self._newest = max(self._newest, number)

    def missing(self, at_most: int) -> range:
        """The first numbers that are missing and can still be had, in a row, not more than `at_most`; empty: none."""
        self._skip_to(self._newest + 1 - self._window)
        begin = end = self._due
        while end <= self._newest and end not in self._held and end - begin < at_most:
            end += 1
        return range(begin, end)

    def skip_gap(self) -> None:
        """What is missing before the first message that is held, or at the end, is lost."""
        self._skip_to(min(self._held, default=self._newest + 1))

    def flush(self) -> None:
        """Deliver all that is held: nothing more will come, and what is missing is lost."""
        while self._due <= self._newest:
            self.skip_gap()

    def _skip_to(self, end: int) -> None:
        """Wait no longer for what comes before `end`."""
        while self._due < end:
            gap_end = min(end, min(self._held, default=end))
            if self._has_delivered and gap_end > self._due:
                self._on_loss(gap_end - self._due)
            self._due = gap_end
            self._deliver_ready()

    def _deliver_ready(self) -> None:
        while self._due in self._held:
            message = self._held.pop(self._due)
            self._due += 1
            self._has_delivered = True
            self._deliver(message)
