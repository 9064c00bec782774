"""Request log of a rig: records each Modbus request with its timestamps, for publication in batches.

The requests of clients, and in the client role those of the edge itself. The same few requests are repeated, so an
entry is an index into a table of request kinds and two timestamps, which takes half a microsecond. The message is built
entry by entry: building a whole batch at once would delay the request at that moment.
"""

from typing import Final

from hilrig_modbus_edge.protocol.functions import FunctionCode, RequestLayout
from hilrig_schemas import ModbusTraffic

MAX_REQUESTS_PER_MESSAGE: Final = 256
"""Number of requests after which a message is published before its period has passed: it bounds the memory."""
_LAYOUTS: Final = {int(function): function.layout for function in FunctionCode}

_RequestKind = tuple[int, int, int]
"""Function, address, quantity."""


class RequestLog:
    """Requests of one rig since the last call of `drain`."""

    def __init__(self, rig: str) -> None:
        self._rig = rig
        self._start_message()

    def _start_message(self) -> None:
        message = self._message = ModbusTraffic(rig=self._rig)
        # Appends directly to the message: separate lists would be as fast to fill, but have to be copied.
        self._add_index = message.kind_indexes.append
        self._add_arrived_ns = message.arrived_ns.append
        self._add_answered_after_ns = message.answered_after_ns.append
        self._index_of: dict[tuple[_RequestKind, int, str], int] = {}
        """By request kind, exception code and client: index in the kinds of the message."""
        self._index_of_head: dict[tuple[bytes, int, str], int] = {}
        """By the first bytes of a request, exception code and client: the same index, found 0.5 µs faster. The bytes
        may contain a value, so several heads have the same kind."""

    @property
    def count(self) -> int:
        """Number of recorded requests."""
        return len(self._message.kind_indexes)

    def record(self, pdu: bytes, arrived_ns: int, answered_ns: int, exception: int, controller: str) -> None:
        """Record a request: PDU, arrival and response time (ns, monotonic clock), exception code or 0, and client.

        Of a request of the edge: the times of sending and of the response, and the address of the controller.
        """
        head = pdu[:5], exception, controller
        index = self._index_of_head.get(head)
        if index is None:
            index = self._index_of_head[head] = self._index(kind_of(pdu[:5]), exception, controller)
        self._add_index(index)
        self._add_arrived_ns(arrived_ns)
        self._add_answered_after_ns(answered_ns - arrived_ns)

    def record_connection(self, controller: str, min_rtt_us: int, retransmissions: int) -> None:
        """Record the TCP figures of an open connection; fields as in `ModbusConnection`."""
        self._message.connections.add(controller=controller, min_rtt_us=min_rtt_us, retransmissions=retransmissions)

    def drain(self, closed_ns: int, wall_ns: int) -> ModbusTraffic:
        """Return the recorded requests as a message and start a new one.

        `closed_ns` and `wall_ns` are the same time on the monotonic and on the wall clock.
        """
        message = self._message
        message.closed_ns = closed_ns
        message.wall_ns = wall_ns
        self._start_message()
        return message

    def _index(self, kind: _RequestKind, exception: int, controller: str) -> int:
        kinds = self._message.kinds
        index = self._index_of.setdefault((kind, exception, controller), len(kinds))
        if index == len(kinds):
            function, address, count = kind
            kinds.add(function=function, address=address, count=count, exception=exception, controller=controller)
        return index


def kind_of(head: bytes) -> _RequestKind:
    """Return function, address and quantity from the first five bytes of a request's PDU."""
    function = head[0]
    layout = _LAYOUTS.get(function, RequestLayout.UNADDRESSED)
    if layout is RequestLayout.UNADDRESSED or len(head) < 5:
        return function, 0, 0
    count = int.from_bytes(head[3:]) if layout is RequestLayout.QUANTITY else 1
    return function, int.from_bytes(head[1:3]), count
