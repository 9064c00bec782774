"""What controllers asked of a rig, and when: each request noted as it is answered, sent in batches.

A controller asks the same again and again, so a note is the number of what was asked, out of a table, and two times:
half a microsecond. It is paid at the request: to make a whole batch at once would hold up whoever asks at that moment.
"""

from typing import Final

from hilrig_schemas import ModbusTraffic

MOST: Final = 256
"""Requests after which a batch is due though its time has not come: memory stays bounded under a flood."""
_SINGLE: Final = frozenset({0x05, 0x06, 0x16})
"""Functions whose third word is a value, not a count."""
_COUNTED: Final = frozenset({0x01, 0x02, 0x03, 0x04, 0x0F, 0x10, 0x17})

_Kind = tuple[int, int, int]
"""Function, address, count."""


class TrafficRecord:
    """The requests of one rig since they were last taken."""

    def __init__(self, rig: str) -> None:
        self._rig = rig
        self._begin()

    def _begin(self) -> None:
        message = self._message = ModbusTraffic(rig=self._rig)
        # A list of their own would be as fast to fill, and then has to be copied.
        self._add_index = message.kind_indexes.append
        self._add_arrived_ns = message.arrived_ns.append
        self._add_answered_after_ns = message.answered_after_ns.append
        self._index_of: dict[tuple[_Kind, int, str], int] = {}
        """Index of the message's kinds, by request, exception and controller."""
        self._index_of_head: dict[tuple[bytes, int, str], int] = {}
        """The same by the first bytes of the request, which is 0.5 µs faster; they may hold a value, so several heads
        have one kind."""

    @property
    def count(self) -> int:
        """How many were noted."""
        return len(self._message.kind_indexes)

    def note(self, pdu: bytes, arrived_ns: int, answered_ns: int, exception: int, controller: str) -> None:
        """Note one request: PDU, when it came and was answered (monotonic clock), exception code or 0, who asked."""
        head = pdu[:5], exception, controller
        index = self._index_of_head.get(head)
        if index is None:
            index = self._index_of_head[head] = self._index(_kind_of(pdu[:5]), exception, controller)
        self._add_index(index)
        self._add_arrived_ns(arrived_ns)
        self._add_answered_after_ns(answered_ns - arrived_ns)

    def take(self, closed_ns: int, wall_ns: int) -> ModbusTraffic:
        """What was noted, closed at `closed_ns` of the monotonic and `wall_ns` of the wall clock; begin anew."""
        message = self._message
        message.closed_ns = closed_ns
        message.wall_ns = wall_ns
        self._begin()
        return message

    def _index(self, kind: _Kind, exception: int, controller: str) -> int:
        kinds = self._message.kinds
        index = self._index_of.setdefault((kind, exception, controller), len(kinds))
        if index == len(kinds):
            function, address, count = kind
            kinds.add(function=function, address=address, count=count, exception=exception, controller=controller)
        return index


def _kind_of(head: bytes) -> _Kind:
    function = head[0]
    if len(head) == 5 and function in _COUNTED:
        return function, (head[1] << 8) | head[2], (head[3] << 8) | head[4]
    if len(head) == 5 and function in _SINGLE:
        return function, (head[1] << 8) | head[2], 1
    return function, 0, 0
