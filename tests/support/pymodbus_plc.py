"""A controller that is a Modbus server of pymodbus, with a cyclic program, and with faults on request."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any, Self, cast

from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from support.plc import HEADER

SCAN_S = 0.005


class _Server(ModbusTcpServer):
    def __init__(self, owner: "PymodbusPlc", *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.owner = owner

    def callback_new_connection(self) -> ServerRequestHandler:
        self.owner.connections += 1
        return _Handler(self, self.trace_packet, self.trace_pdu, self.trace_connect)


class _Handler(ServerRequestHandler):
    """Passes responses to reads through the fault of its owner."""

    def send(self, data: bytes, addr: Any = None) -> None:
        fault = self.server.owner.fault
        if fault is not None and data[7] & 0x7F == 3:
            changed = fault(HEADER.unpack_from(data)[0], data[7:])
            if changed is None:
                self.close()
                return
            data = changed
        if data:
            super().send(data, addr)


class PymodbusPlc:
    """Holding registers 0-3 torques, 4-7 positions, 8 step, 9 echo, up to 15; coils 0-7. Runs in a thread."""

    def __init__(self) -> None:
        self.fault: Callable[[int, bytes], bytes | None] | None = None
        """Returns the bytes that are sent instead of a response to a read (transaction, PDU); None: it is closed."""
        self.running = True
        """Whether the program runs; the server answers all the same."""
        self.connections = 0
        self.port = 0
        self._listening = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def listen(self) -> None:
        """Start the server, at the same port each time."""
        self._listening.clear()
        self._ended.clear()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._listening.wait(10)

    def shut(self) -> None:
        """Stop the server, with its connections."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(10)

    async def _serve(self) -> None:
        coils = [SimData(0, count=8, values=False, datatype=DataType.BITS)]
        registers = [SimData(0, count=16, values=0, datatype=DataType.REGISTERS)]
        device = SimDevice(1, simdata=(coils, coils, registers, registers))
        server = _Server(self, device, address=("127.0.0.1", self.port))
        await server.serve_forever(background=True)
        self.port = cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
        self._listening.set()
        while not self._ended.is_set():
            await asyncio.sleep(SCAN_S)  # the period of the program
            if self.running:
                *positions, step = await server.async_getValues(1, 3, 4, 5)
                signed = [word - 0x10000 if word > 0x7FFF else word for word in positions]
                await server.async_setValues(1, 16, 0, [-max(-2000, min(2000, word)) & 0xFFFF for word in signed])
                await server.async_setValues(1, 16, 9, [step])
        await server.shutdown()

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        self.shut()
