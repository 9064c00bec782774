"""A lab with one rig in simulated time: the real simulation, Modbus device and recorder, and programs of students.

A program runs unmodified in this process: its `time` is that of the lab, and its `ModbusTcpClient` exchanges PDUs with
the device. So a run of ten seconds takes a fraction of one, and its recording is a file of the recorder.
"""

import contextlib
import heapq
import io
import itertools
import random
import runpy
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import ModuleType, SimpleNamespace, TracebackType
from typing import Any, Self
from unittest.mock import patch

import pymodbus.client

from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.settings import DeviceSettings
from hilrig_modbus_edge.request_log import RequestLog
from hilrig_modbus_edge.rig_endpoint import REQUEST_LOG_PERIOD_NS, BusOutput
from hilrig_modbus_edge.server.pdu import execute
from hilrig_recorder.service import TICK_PERIOD_NS, Recorder
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.rate import Rate
from hilrig_schemas import topics
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.rig_registry import RigRegistry
from support.waiting import eventually

MS = 1_000_000
HOST, PORT = "192.0.2.7", 40001
EDGE_TICK_NS = 20 * MS
ONE_WAY_NS = 150_000
"""Shortest one-way delay of the network between program and edge."""


class OutOfTimeError(BaseException):
    """A program has used its time. Not an `Exception`, which a program may catch."""


@dataclass(order=True)
class _Timer:
    at_ns: int
    number: int
    callback: Callable[[], None] | None

    def cancel(self) -> None:
        self.callback = None


class _Output(BusOutput):
    """Output port of the device with timers of the simulated time."""

    call_later: Callable[[int, Callable[[], None]], _Timer]

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> Any:
        return self.call_later(deadline_ns, callback)


class VirtualLab:
    """Services of the first rig of a lab. `start` is the date and time of its clocks, with time zone."""

    def __init__(self, lab: LabConfig, folder: Path, start: datetime, seed: int = 1) -> None:
        source = lab.source
        lab = lab.model_copy(update={"recorder": lab.recorder.model_copy(update={"folder": folder})})
        lab._source = source
        self.lab, self.rig = lab, lab.rigs[0].name
        self.clock = ManualClock(wall_ns=round(start.timestamp() * 1e3) * MS)
        self._random = random.Random(seed)
        self._timers: list[_Timer] = []
        self._numbers = itertools.count()
        self._closing = ExitStack()
        hub = MemoryHub()
        sim, edge, recorder = (
            self._closing.enter_context(Service(name, lab, MemoryBus(hub), clock=self.clock))
            for name in ("sim", "edge", "recorder")
        )
        self._services = (sim, edge)
        self._simulation = Simulation(sim, [rig_parameters(lab, lab.rigs[0])])
        self._registry = RigRegistry(sim, self._simulation, OwnerThreadExecutor())
        self._closing.callback(self._registry.close)
        self._rate = Rate(lab.sim.step_ns, self.clock)
        states = edge.latest_value_cache(topics.STATES)
        scheduler = CommandScheduler(
            edge.source,
            edge.publisher(topics.COMMANDS),
            states,
            lab.sim.step_ns,
            self.clock,
            lambda at_s, call: self._call_at(round(at_s * 1e9), call),
        )
        self._edge = edge
        output = _Output(self.rig, edge, self._announce)
        output.call_later = self._call_at
        settings = DeviceSettings.of(lab.edge, lab.impairment_of(lab.rigs[0]))
        publisher = edge.rig_publisher(topics.COMMAND, self.rig)
        sender = CommandSender(self.rig, scheduler, publisher, self.clock, settings.repeat_ns)
        self.device = Device(self.rig, settings, self.clock, output, states, sender, self._random)
        self._log, self._log_due_ns = RequestLog(self.rig), 0
        self._traffic = edge.rig_publisher(topics.TRAFFIC, self.rig)
        self._recorder = Recorder(recorder)
        self._closing.callback(self._recorder.close)
        self.device.start()
        self.until_ns = 0
        """End of the program's time, monotonic clock, ns; 0: none."""
        self._call_at(self.clock.monotonic_ns(), self._tick)
        self._call_at(self.clock.monotonic_ns() + 7 * MS, self._edge_tick)
        self._call_at(self.clock.monotonic_ns() + 11 * MS, self._record)
        self.advance(500 * MS)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.close()

    def advance(self, duration_ns: int) -> None:
        """Let time pass, with all that is due in it."""
        end_ns = self.clock.monotonic_ns() + duration_ns
        while self._timers[0].at_ns <= end_ns:
            timer = heapq.heappop(self._timers)
            if timer.callback is not None:
                self.clock.sleep_until_ns(timer.at_ns)
                timer.callback()
        self.clock.sleep_until_ns(end_ns)
        if self.until_ns and end_ns >= self.until_ns:
            raise OutOfTimeError

    def request(self, client: Any, pdu: bytes) -> bytes:
        """Send the PDU of a request over the network; return that of the response."""
        self._transfer()
        arrived_ns = self.clock.monotonic_ns()
        client.record_request(arrived_ns)
        self.advance(20_000)
        reply = execute(self.device, client, pdu, arrived_ns, arrived_ns - 10_000)
        code = reply[1] if reply[0] & 0x80 else 0
        self._log.record(pdu, arrived_ns, self.clock.monotonic_ns() + 20_000, code, client.address)
        self._transfer()
        return reply

    def run(self, program: Path, *arguments: str, seconds: float = 60.0) -> int:
        """Run a program until it ends, at most for `seconds`; return its exit code."""
        self.until_ns = self.clock.monotonic_ns() + round(seconds * 1e9)
        code: Any = 0
        output = io.StringIO()
        with self._modules(program, arguments), contextlib.redirect_stdout(output):
            try:
                runpy.run_path(str(program), run_name="__main__")
            except SystemExit as ended:
                code = ended.code or 0
            except OutOfTimeError:
                code = 124
        self.until_ns = 0
        for client in list(self.device.clients):
            self.device.disconnect(client, "connection closed by the client")
        return code if isinstance(code, int) else 1

    def recording(self) -> Path:
        """Close the session and return the recording."""
        folder = self.lab.recorder.folder / self.lab.name / self.rig
        self.advance(100 * MS)
        self.advance(round(self.lab.edge.session_grace_ms * MS))

        def finished() -> bool:
            # Configuration and files are processed by threads of the recorder.
            self.advance(200 * MS)
            return bool(list(folder.glob("*.mcap")))

        eventually(finished, every_s=0.002)
        (path,) = folder.glob("*.mcap")
        return path

    # -- inside

    @contextlib.contextmanager
    def _modules(self, program: Path, arguments: Sequence[str]) -> Iterator[None]:
        begin_ns = self.clock.monotonic_ns()
        virtual = ModuleType("time")
        virtual.__dict__.update(time.__dict__)
        virtual.__dict__["monotonic_ns"] = virtual.__dict__["perf_counter_ns"] = self.clock.monotonic_ns
        seconds = lambda: (self.clock.monotonic_ns() - begin_ns) / 1e9 + 100.0  # noqa: E731
        virtual.__dict__["monotonic"] = virtual.__dict__["perf_counter"] = seconds
        virtual.__dict__["time"] = lambda: self.clock.wall_ns() / 1e9
        virtual.__dict__["sleep"] = lambda duration: self.advance(round(duration * 1e9) + self._jitter())
        with ExitStack() as patched:
            patched.enter_context(patch.dict(sys.modules, {"time": virtual}))
            patched.enter_context(patch.object(pymodbus.client, "ModbusTcpClient", lambda *_, **__: _Modbus(self)))
            patched.enter_context(patch.object(sys, "argv", [str(program), *arguments]))
            patched.enter_context(patch.object(sys, "path", [str(program.parent), *sys.path]))
            yield

    def _jitter(self) -> int:
        return round(self._random.gammavariate(2.0, 20_000))

    def _transfer(self) -> None:
        self.advance(ONE_WAY_NS + self._jitter())

    def _call_at(self, at_ns: int, callback: Callable[[], None]) -> _Timer:
        timer = _Timer(max(at_ns, self.clock.monotonic_ns()), next(self._numbers), callback)
        heapq.heappush(self._timers, timer)
        return timer

    def _tick(self) -> None:
        self.clock.advance(self._random.randrange(40_000, 120_000))
        self._simulation.tick(self._rate.wait())
        self._services[0].beat(self.clock.monotonic_ns())
        self._call_at(self._rate.next_ns, self._tick)

    def _edge_tick(self) -> None:
        now_ns = self.clock.monotonic_ns()
        self.device.check(now_ns)
        if self.device.clients:
            self.device.refresh_state()
        if self._log.count and now_ns >= self._log_due_ns:
            self._log_due_ns = now_ns + REQUEST_LOG_PERIOD_NS
            self._traffic.publish(self._log.drain(now_ns, self.clock.wall_ns()))
        self._edge.beat(now_ns)
        self._call_at(now_ns + EDGE_TICK_NS, self._edge_tick)

    def _record(self) -> None:
        recorder = self._recorder
        recorder._tick(self.clock.monotonic_ns())
        while recorder._queue.depth and (received := recorder._queue.get(0.0)) is not None:
            recorder._sessions.accept(received, self.clock.monotonic_ns())
        self._call_at(self.clock.monotonic_ns() + TICK_PERIOD_NS, self._record)

    def _announce(self) -> None:
        session = self.device.session
        self._edge.recording_stream.set_sessions([] if session is None else [session.as_message()])


class _Modbus:
    """`pymodbus.client.ModbusTcpClient` of a program in the lab."""

    def __init__(self, lab: VirtualLab) -> None:
        self._lab = lab
        self._client: Any = None

    def connect(self) -> bool:
        self._client = self._lab.device.connect(HOST, PORT)
        return True

    def close(self) -> None:
        self._lab.device.disconnect(self._client, "connection closed by the client")

    def read_holding_registers(self, address: int, *, count: int = 1, **_: Any) -> Any:
        return self._ask(struct.pack(">BHH", 3, address, count))

    def read_input_registers(self, address: int, *, count: int = 1, **_: Any) -> Any:
        return self._ask(struct.pack(">BHH", 4, address, count))

    def read_coils(self, address: int, *, count: int = 1, **_: Any) -> Any:
        return self._ask(struct.pack(">BHH", 1, address, count))

    def read_discrete_inputs(self, address: int, *, count: int = 1, **_: Any) -> Any:
        return self._ask(struct.pack(">BHH", 2, address, count))

    def write_registers(self, address: int, values: Sequence[int], **_: Any) -> Any:
        count = len(values)
        return self._ask(struct.pack(f">BHHB{count}H", 16, address, count, 2 * count, *values))

    def write_coil(self, address: int, value: bool, **_: Any) -> Any:
        return self._ask(struct.pack(">BHH", 5, address, 0xFF00 if value else 0))

    def readwrite_registers(
        self, *, read_address: int, read_count: int, write_address: int, values: Sequence[int], **_: Any
    ) -> Any:
        count = len(values)
        head = struct.pack(">BHHHHB", 23, read_address, read_count, write_address, count, 2 * count)
        return self._ask(head + struct.pack(f">{count}H", *values))

    def _ask(self, pdu: bytes) -> Any:
        reply = self._lab.request(self._client, pdu)
        answer = SimpleNamespace(isError=lambda: bool(reply[0] & 0x80), registers=[], bits=[])
        if reply[0] in (3, 4, 23):
            answer.registers = list(struct.unpack(f">{reply[1] // 2}H", reply[2:]))
        elif reply[0] in (1, 2):
            answer.bits = [bool(reply[2 + bit // 8] >> bit % 8 & 1) for bit in range(8 * reply[1])]
        return answer
