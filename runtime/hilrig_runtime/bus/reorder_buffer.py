"""One publisher's numbered messages, put in order: what is missing, what is lost. Pure; no bus and no clock.

Messages come as they come, live or repeated from the publisher's cache; each is delivered once, when all before it
were, or were given up. The cache repeats the newest `reach` messages: what is older and still missing can't be had.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

MessageT = TypeVar("MessageT")


class InOrder(Generic[MessageT]):
    """`deliver` gets each message in order; `on_loss` how many were lost before the next that is delivered.

    What a publisher sent before its first message that could be had is no loss: it is not known whether anything is
    missing there.
    """

    def __init__(self, deliver: Callable[[MessageT], None], on_loss: Callable[[int], None], reach: int) -> None:
        self._deliver = deliver
        self._on_loss = on_loss
        self._reach = reach
        self._due = 0
        self._newest = -1
        self._has_delivered = False
        self._held: dict[int, MessageT] = {}

    def take(self, number: int, message: MessageT) -> bool:
        """A message came; True: it is new."""
        if number < self._due or number in self._held:
            return False
        self._newest = max(self._newest, number)
        self._held[number] = message
        self._go_on()
        return True

    def announce(self, number: int) -> None:
        """The publisher has sent this number."""
        self._newest = max(self._newest, number)

    def missing(self, at_most: int) -> range:
        """The first numbers that are missing and can still be had, in a row, not more than `at_most`; empty: none."""
        self._lose(self._newest + 1 - self._reach)
        begin = end = self._due
        while end <= self._newest and end not in self._held and end - begin < at_most:
            end += 1
        return range(begin, end)

    def give_up(self) -> None:
        """What is missing before the first message that is held, or at the end, is lost."""
        self._lose(min(self._held, default=self._newest + 1))

    def finish(self) -> None:
        """Deliver all that is held: nothing more will come, and what is missing is lost."""
        while self._due <= self._newest:
            self.give_up()

    def _lose(self, end: int) -> None:
        """Wait no longer for what comes before `end`."""
        while self._due < end:
            gap_end = min(end, min(self._held, default=end))
            if self._has_delivered and gap_end > self._due:
                self._on_loss(gap_end - self._due)
            self._due = gap_end
            self._go_on()

    def _go_on(self) -> None:
        while self._due in self._held:
            message = self._held.pop(self._due)
            self._due += 1
            self._has_delivered = True
            self._deliver(message)
