"""A reorder buffer for the numbered messages of one publisher; detects gaps and losses. Pure: no bus and no clock.

Messages arrive in any order, live or from the publisher's cache. Each is delivered once, after all earlier messages
were delivered or skipped. The cache holds the newest `window` messages: an older message that is missing is lost.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

MessageT = TypeVar("MessageT")


class ReorderBuffer(Generic[MessageT]):
    """Delivers messages in order; `on_loss` gets the number of messages lost before the next one that is delivered.

    Messages before the first available one don't count as lost, because it is unknown whether there were any.
    """

    def __init__(self, deliver: Callable[[MessageT], None], on_loss: Callable[[int], None], window: int) -> None:
        self._deliver = deliver
        self._on_loss = on_loss
        self._window = window
        self._due = 0
        self._newest = -1
        self._has_delivered = False
        self._buffered: dict[int, MessageT] = {}

    def insert(self, number: int, message: MessageT) -> bool:
        """Add a message; return whether it is new."""
        if number < self._due or number in self._buffered:
            return False
        self._newest = max(self._newest, number)
        self._buffered[number] = message
        self._deliver_ready()
        return True

    def set_head(self, number: int) -> None:
        """Set the number of the newest message that the publisher has sent."""
        self._newest = max(self._newest, number)

    def missing(self, at_most: int) -> range:
        """Return the first range of missing numbers that are still cached, at most `at_most` of them; empty: none."""
        self._skip_to(self._newest + 1 - self._window)
        begin = end = self._due
        while end <= self._newest and end not in self._buffered and end - begin < at_most:
            end += 1
        return range(begin, end)

    def skip_gap(self) -> None:
        """Declare the first gap lost: all missing messages before the first buffered one, or before the head."""
        self._skip_to(min(self._buffered, default=self._newest + 1))

    def flush(self) -> None:
        """Deliver all buffered messages and declare all gaps lost; no more messages will be added."""
        while self._due <= self._newest:
            self.skip_gap()

    def _skip_to(self, end: int) -> None:
        """Declare the missing messages before `end` lost."""
        while self._due < end:
            gap_end = min(end, min(self._buffered, default=end))
            if self._has_delivered and gap_end > self._due:
                self._on_loss(gap_end - self._due)
            self._due = gap_end
            self._deliver_ready()

    def _deliver_ready(self) -> None:
        while self._due in self._buffered:
            message = self._buffered.pop(self._due)
            self._due += 1
            self._has_delivered = True
            self._deliver(message)
