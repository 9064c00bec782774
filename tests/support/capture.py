"""Packet capture of one TCP port on a network interface: an independent witness of an edge's times. Linux, root."""

import ctypes
import socket
import struct
import sys
import threading
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import pytest

ETH_P_ALL = 0x0003
PACKET_OUTGOING = 4
SO_ATTACH_FILTER = 26
SO_TIMESTAMPNS = 35


def require_capture() -> None:
    """Skip the test if packets can't be captured."""
    if sys.platform != "linux":
        pytest.skip("needs Linux to capture packets")
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0).close()
    except PermissionError:
        pytest.skip("needs root to capture packets (CAP_NET_RAW)")


@dataclass(frozen=True)
class Packet:
    """One captured TCP segment."""

    wall_ns: int
    """Kernel's timestamp, ns since 1970-01-01 UTC."""
    from_edge: bool
    peer: int
    """Port of the client."""
    end: int
    """Sequence number after its data."""
    acknowledged: int
    data: bytes


class Capture:
    """Context manager; `packets` has all segments from and to a port since entry."""

    def __init__(self, interface: str, port: int) -> None:
        self.packets: list[Packet] = []
        self._port = port
        # Each packet is delivered twice on the loopback: as it is sent, and as it is received.
        self._once = interface == "lo"
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._attach_filter()
        # A socket of one protocol gets no packets that this host sends.
        self._socket.bind((interface, ETH_P_ALL))
        self._socket.settimeout(0.1)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _attach_filter(self) -> None:
        """Keep IPv4 packets of TCP from or to the port."""
        instructions = [
            (0x30, 0, 0, 0),  # version
            (0x54, 0, 0, 0xF0),
            (0x15, 0, 8, 0x40),
            (0x30, 0, 0, 9),  # protocol
            (0x15, 0, 6, socket.IPPROTO_TCP),
            (0xB1, 0, 0, 0),  # length of the IP header
            (0x48, 0, 0, 0),  # source port
            (0x15, 2, 0, self._port),
            (0x48, 0, 0, 2),  # destination port
            (0x15, 0, 1, self._port),
            (0x06, 0, 0, 0xFFFFFFFF),  # accept
            (0x06, 0, 0, 0),  # drop
        ]
        code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *one) for one in instructions))
        program = struct.pack("HL", len(instructions), ctypes.addressof(code))
        self._socket.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, program)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                data, ancillary, _, address = self._socket.recvmsg(65536, 64)
            except TimeoutError:
                continue
            if self._once and address[2] == PACKET_OUTGOING:
                continue
            seconds, nanoseconds = struct.unpack_from("=qq", ancillary[0][2])
            self.packets.append(self._parse(seconds * 1_000_000_000 + nanoseconds, data))

    def _parse(self, wall_ns: int, data: bytes) -> Packet:
        head = 4 * (data[0] & 0xF)
        [total] = struct.unpack_from(">H", data, 2)
        source, destination, sequence, acknowledged, offset, flags = struct.unpack_from(">HHIIBB", data, head)
        payload = data[head + 4 * (offset >> 4) : total]
        # A segment that opens or closes the connection counts as one byte.
        end = (sequence + len(payload) + bool(flags & 0x03)) & 0xFFFFFFFF
        from_edge = source == self._port
        return Packet(wall_ns, from_edge, destination if from_edge else source, end, acknowledged, payload)


def without_repeats(packets: list[Packet]) -> list[Packet]:
    """Return the segments with data without those that TCP sent again."""
    seen: set[tuple[bool, int]] = set()
    found: list[Packet] = []
    for packet in packets:
        if packet.data and (packet.from_edge, packet.end) not in seen:
            seen.add((packet.from_edge, packet.end))
            found.append(packet)
    return found


def round_trips_ns(packets: list[Packet]) -> list[int]:
    """Return the time from each segment of the edge until the client acknowledged it, ns."""
    waiting: list[Packet] = []
    found: list[int] = []
    for packet in packets:
        if packet.from_edge:
            if packet.data:
                waiting.append(packet)
            continue
        done = [one for one in waiting if (packet.acknowledged - one.end) & 0xFFFFFFFF < 0x80000000]
        if done:
            # An acknowledgment covers all segments before; the last one was sent least long ago.
            found.append(packet.wall_ns - done[-1].wall_ns)
            waiting = [one for one in waiting if one not in done]
    return found
