"""Figures that TCP itself measures on a connection, from the socket option `TCP_INFO` of Linux."""

import socket
import struct
import sys
from typing import Final, NamedTuple

_U32: Final = struct.Struct("=I")
_MIN_RTT_OFFSET: Final = 148
_RETRANSMISSIONS_OFFSET: Final = 100
_SIZE: Final = _MIN_RTT_OFFSET + _U32.size
_NOT_MEASURED: Final = 0xFFFFFFFF


class TcpFigures(NamedTuple):
    """Figures of one connection."""

    min_rtt_us: int
    """Smallest round-trip time of the last minutes, µs; 0: not measured. The smoothed one contains the peer's delayed
    acknowledgments."""
    retransmissions: int
    """Segments that were sent again since the connection was opened."""


def tcp_figures(connected: socket.socket) -> TcpFigures | None:
    """Return the figures of a TCP connection; None: the system has none."""
    if sys.platform != "linux":
        return None
    try:
        info = connected.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _SIZE)
    except OSError:
        # The peer has disconnected.
        return None
    if len(info) < _SIZE:
        # An old kernel.
        return None
    [min_rtt_us] = _U32.unpack_from(info, _MIN_RTT_OFFSET)
    [retransmissions] = _U32.unpack_from(info, _RETRANSMISSIONS_OFFSET)
    return TcpFigures(0 if min_rtt_us == _NOT_MEASURED else min_rtt_us, retransmissions)
