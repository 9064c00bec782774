"""A controller that is a Modbus server, on a bare socket: a cyclic program, network delay, and faults on request."""

import socket
import ssl
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Self

HEADER = struct.Struct(">HHHB")
Law = Callable[[tuple[int, ...]], tuple[int, ...]]
"""Torque registers of the position registers."""


def hold(positions: tuple[int, ...]) -> tuple[int, ...]:
    """A weak spring to zero on each joint."""
    return tuple(max(-2000, min(2000, -position // 10)) for position in positions)


class Plc:
    """A PLC: holding registers 0-3 torques, 4-7 positions, 8 step, 9 echo; coil 0 the magnet.

    Args:
        scan_s: period of the program; 0: it answers each write of positions at once.
        output_s: time from the inputs of a scan to its outputs.
        delay_s: delay of each direction of the network.
        law: the program.
        copies_step: whether the program copies the step number.
    """

    def __init__(
        self,
        *,
        scan_s: float = 0.0,
        output_s: float = 0.0,
        delay_s: float = 0.0,
        law: Law = hold,
        copies_step: bool = True,
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        self.registers = bytearray(200)
        self.coil = False
        self.running = True
        """Whether the program runs; the server answers all the same."""
        self.scans: list[tuple[int, int, int]] = []
        """For each scan: time of reading the inputs, time of writing the outputs, step number that it read."""
        self.requests: list[tuple[int, bytes]] = []
        """Time and PDU of each request."""
        self.fault: Callable[[int, int, bytes], bytes | None] | None = None
        """Returns the bytes that answer a request (transaction, unit, PDU); None: the connection is closed."""
        self.tls: ssl.SSLContext | None = None
        """Context of a server with TLS; None: without TLS."""
        self.closes_after_response = False
        self.connections = 0
        self._scan_s, self._delay_s, self._law, self._copies_step = scan_s, delay_s, law, copies_step
        self._output_s = output_s
        self._lock = threading.Lock()
        self._host, self.port = host, port
        self._stopping = threading.Event()
        self._open: set[socket.socket] = set()
        self._threads: list[threading.Thread] = []
        if scan_s:
            self._start(self._run_program)
        self.listen()

    def listen(self) -> None:
        """Open the port, the same one each time."""
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        self._listening = socket.create_server((self._host, self.port), family=family)
        self.port = self._listening.getsockname()[1]
        self._start(self._accept, self._listening)

    def shut(self, *, reset: bool = True) -> None:
        """Close the port and all connections; `reset`: with a reset instead of an orderly end."""
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self.drop(reset=reset)

    def drop(self, *, reset: bool = True) -> None:
        """Close all connections."""
        for each in list(self._open):
            with suppress(OSError):
                if reset:
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                else:
                    each.shutdown(socket.SHUT_RDWR)
            each.close()

    @property
    def address(self) -> str:
        return f"[{self._host}]:{self.port}" if ":" in self._host else f"{self._host}:{self.port}"

    @property
    def positions(self) -> tuple[int, ...]:
        """The position registers."""
        return struct.unpack_from(">4h", self.registers, 8)

    def written(self) -> list[bytes]:
        """PDUs of the writes."""
        return [pdu for _, pdu in self.requests if pdu[0] in (16, 23)]

    def set_torques(self, *values: int) -> None:
        struct.pack_into(">4h", self.registers, 0, *values)

    def scan(self) -> None:
        """Run the program once."""
        begin_ns = time.monotonic_ns()
        with self._lock:
            positions, step = self.positions, struct.unpack_from(">H", self.registers, 16)[0]
        torques = self._law(positions)
        if self._output_s:
            time.sleep(self._output_s)  # the program computes
        with self._lock:
            self.set_torques(*torques)
            if self._copies_step:
                struct.pack_into(">H", self.registers, 18, step)
            self.scans.append((begin_ns, time.monotonic_ns(), step))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self.shut()
        for thread in self._threads:
            thread.join(10)

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _run_program(self) -> None:
        due_s = time.monotonic()
        while not self._stopping.is_set():
            due_s += self._scan_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            if self.running:
                self.scan()

    def _accept(self, listening: socket.socket) -> None:
        while not self._stopping.is_set():
            try:
                connected, _ = listening.accept()
            except OSError:
                return
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connections += 1
            if self.tls is not None:
                try:
                    connected = self.tls.wrap_socket(connected, server_side=True)
                except OSError:
                    continue
            self._open.add(connected)
            self._start(self._serve, connected)

    def _serve(self, connected: socket.socket) -> None:
        try:
            while True:
                transaction, _, length, unit = HEADER.unpack(_exactly(connected, 7))
                pdu = _exactly(connected, length - 1)
                if self._delay_s:
                    time.sleep(self._delay_s)  # a slow network
                self.requests.append((time.monotonic_ns(), pdu))
                reply: bytes | None
                if self.fault is not None:
                    reply = self.fault(transaction, unit, pdu)
                else:
                    answer = self.execute(pdu)
                    reply = HEADER.pack(transaction, 0, len(answer) + 1, unit) + answer
                if reply is None:
                    break
                if self._delay_s:
                    time.sleep(self._delay_s)  # a slow network
                connected.sendall(reply)
                if self.closes_after_response:
                    break
        except OSError:
            pass
        finally:
            self._open.discard(connected)
            connected.close()

    def execute(self, pdu: bytes) -> bytes:
        """Execute a request; return the response."""
        function, address, count = struct.unpack_from(">BHH", pdu)
        with self._lock:
            if function in (1, 2):
                return bytes((function, 1, self.coil))
            if function in (3, 4):
                return bytes((function, 2 * count)) + bytes(self.registers[2 * address : 2 * (address + count)])
            if function == 16:
                self.registers[2 * address : 2 * (address + count)] = pdu[6:]
                reply = pdu[:5]
            elif function == 23:
                at, size = struct.unpack_from(">HH", pdu, 5)
                self.registers[2 * at : 2 * (at + size)] = pdu[10:]
                reply = bytes((function, 2 * count)) + bytes(self.registers[2 * address : 2 * (address + count)])
            else:
                return bytes((function | 0x80, 1))
        if not self._scan_s and self.running:
            self.scan()
        return reply


def _exactly(connected: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        received = connected.recv(count - len(data))
        if not received:
            raise ConnectionError
        data += received
    return data
