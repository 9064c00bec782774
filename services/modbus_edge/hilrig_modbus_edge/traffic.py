"""What controllers asked of a rig, and when: a note a request, taken apart and encoded in batches.

The request path pays for one tuple. Requests are kept as the bytes that came.
"""

from typing import Final

from hilrig_schemas import ModbusTraffic

MOST: Final = 256
"""Notes after which a batch is due though its time has not come: no batch takes long to encode."""
_SINGLE: Final = frozenset({0x05, 0x06, 0x16})
"""Functions whose third word is a value, not a count."""
_ADDRESSED: Final = frozenset({0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F, 0x10, 0x16, 0x17})


Note = tuple[bytes, int, int, int, str]
"""One request: its PDU, when it arrived and was answered (ns, monotonic clock), the exception code of the answer or 0,
and the controller's address. A plain tuple, for one is made with each request."""


def batch(rig: str, notes: list[Note], closed_ns: int, wall_ns: int) -> ModbusTraffic:
    """The message of some requests; `closed_ns` of the edge's monotonic clock, `wall_ns` the same instant."""
    message = ModbusTraffic(rig=rig, closed_ns=closed_ns, wall_ns=wall_ns)
    add = message.requests.add
    for pdu, arrived_ns, answered_ns, exception, controller in notes:
        function = pdu[0]
        addressed = function in _ADDRESSED and len(pdu) >= 5
        add(
            function=function,
            address=int.from_bytes(pdu[1:3], "big") if addressed else 0,
            count=(1 if function in _SINGLE else int.from_bytes(pdu[3:5], "big")) if addressed else 0,
            arrived_ns=arrived_ns,
            answered_ns=answered_ns,
            exception=exception,
            controller=controller,
        )
    return message
