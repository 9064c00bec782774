"""What controllers asked of a rig, and when: each request noted as it is answered, sent in batches.

A note costs about a microsecond, and it is paid at the request: encoding a whole batch at once would hold up whoever
asks at that moment.
"""

from typing import Final

from hilrig_schemas import ModbusTraffic

MOST: Final = 256
"""Requests after which a batch is due though its time has not come: memory stays bounded under a flood."""
_SINGLE: Final = frozenset({0x05, 0x06, 0x16})
"""Functions whose third word is a value, not a count."""
_COUNTED: Final = frozenset({0x01, 0x02, 0x03, 0x04, 0x0F, 0x10, 0x17})


class TrafficRecord:
    """The requests of one rig since they were last taken."""

    def __init__(self, rig: str) -> None:
        self._rig = rig
        self._begin()

    def _begin(self) -> None:
        self.count = 0
        self._message = ModbusTraffic(rig=self._rig)
        self._add = self._message.requests.add

    def note(self, pdu: bytes, arrived_ns: int, answered_ns: int, exception: int, controller: str) -> None:
        """Note one request: PDU, when it came and was answered (monotonic clock), exception code or 0, who asked."""
        request = self._add()
        function = request.function = pdu[0]
        if len(pdu) >= 5:
            if function in _COUNTED:
                request.address = (pdu[1] << 8) | pdu[2]
                request.count = (pdu[3] << 8) | pdu[4]
            elif function in _SINGLE:
                request.address = (pdu[1] << 8) | pdu[2]
                request.count = 1
        request.arrived_ns = arrived_ns
        request.answered_ns = answered_ns
        if exception:
            request.exception = exception
        request.controller = controller
        self.count += 1

    def take(self, closed_ns: int, wall_ns: int) -> ModbusTraffic:
        """What was noted, closed at `closed_ns` of the monotonic and `wall_ns` of the wall clock; begin anew."""
        message = self._message
        message.closed_ns = closed_ns
        message.wall_ns = wall_ns
        self._begin()
        return message
