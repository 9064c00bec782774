"""docs/control-path.md lists the control path; the code calls the listed functions in this order, and no others."""

import ast
import asyncio
import importlib
import inspect
import re
import struct
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.rig_endpoint import RigEndpoint
from hilrig_modbus_edge.service import EdgeService
from hilrig_recorder.service import Recorder
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_runtime.timing.rate import Tick
from hilrig_schemas import TorqueCommand, topics
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from support.plc import Plc

PAGE = (Path(__file__).parents[2] / "docs/control-path.md").read_text(encoding="utf-8")
HOP = re.compile(r"^(\d+)\. `([\w.]+)`(?:, through `(\w+)`)?(?:, called by (\d+|[a-z ]+))?: ")
STEP_NS = 20_000_000
WORDS = bytes(range(1, 9))
"""Torque registers that occur in no other message."""
EFFORT = tuple(value / 1000 for value in struct.unpack(">4h", WORDS))
EFFORT_BYTES = struct.pack("<4d", *EFFORT)
WRITE = bytes.fromhex("0002 0000 000f 01 10 0000 0004 08") + WORDS
PLANT = ("/hilrig_sim/plant/", "/hilrig_sim/arm/")
"""The path ends at the step of the plant."""
READ = bytes.fromhex("0001 0000 0006 01 03 0004 0004")


@dataclass(frozen=True)
class Hop:
    """One line of a list."""

    name: str
    function: FunctionType | None
    """None: an attribute of the class, set to a function of the transport."""
    table: str
    """Name of the table that the function is called through; empty: it is called by its name."""
    caller: int | None
    """Index of the calling line; None: it is called by a loop or by the bus."""

    @property
    def called(self) -> str:
        return self.name.rpartition(".")[2]


def resolve(name: str) -> FunctionType | None:
    """Return the function of a name without `hilrig_`, None for an attribute; raises if it does not exist."""
    parts = f"hilrig_{name}".split(".")
    for count in range(len(parts) - 1, 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if isinstance(found, type) and part not in vars(found):
                assert f"self.{part} = " in inspect.getsource(found), name
                return None
            found = inspect.getattr_static(found, part)
        assert isinstance(found, FunctionType), name
        return found
    raise AssertionError(name)


def read_paths() -> list[list[Hop]]:
    """Return the lists of the page."""
    paths: list[list[Hop]] = []
    for line in PAGE.splitlines():
        if re.match(r"\d", line):
            match = HOP.match(line)
            assert match, line
            number, name, table, caller = match.groups()
            if number == "1":
                paths.append([])
            assert int(number) == len(paths[-1]) + 1, line
            index = int(number) - 2 if caller is None else int(caller) - 1 if caller.isdecimal() else None
            paths[-1].append(Hop(name, resolve(name), table or "", None if number == "1" else index))
    return paths


SERVER_ROLE = ("torque", "state", "recorded message")
CLIENT_ROLE = ("state in the client role", "torque in the client role")
PATHS = dict(zip((*SERVER_ROLE, *CLIENT_ROLE), read_paths(), strict=True))


def names_called_in(function: FunctionType) -> set[str]:
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    called = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return {node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "") for node in called}


@pytest.mark.parametrize("path", PATHS)
def test_each_hop_is_a_visible_call(path: str) -> None:
    hops = PATHS[path]
    for hop in hops:
        if hop.caller is None:
            continue
        caller = hops[hop.caller].function
        assert caller is not None, hop.name
        if hop.table:
            assert hop.table in caller.__code__.co_names
            assert hop.function in vars(inspect.getmodule(caller))[hop.table].values()
        else:
            assert hop.called in names_called_in(caller), (hops[hop.caller].name, hop.name)


# -- the calls of one cycle


def carries_command(value: object) -> bool:
    """Return whether a value contains the command, in any of its encodings."""
    if isinstance(value, bytes | bytearray | memoryview):
        return WORDS in bytes(value) or EFFORT_BYTES in bytes(value)
    if isinstance(value, TorqueCommand):
        return tuple(value.effort) == EFFORT
    if isinstance(value, np.ndarray):
        return value.shape == (4, 1) and tuple(value[:, 0]) == EFFORT
    if not isinstance(value, tuple | list):
        return False
    return (tuple(value) == EFFORT) if value and isinstance(value[0], float) else any(map(carries_command, value))


class Trace:
    """Records the calls of hilrig functions while it is active."""

    def __init__(self) -> None:
        self.calls: list[CodeType] = []
        self.passing: dict[CodeType, None] = {}
        """Functions that received the command as an argument and passed it on."""
        self._stack: list[tuple[CodeType, bool]] = []

    def __enter__(self) -> "Trace":
        sys.setprofile(self._on_event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _on_event(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if "/hilrig_" not in code.co_filename or code.co_name.startswith("<"):
            return
        if event == "call":
            self.calls.append(code)
            receives = not any(part in code.co_filename for part in PLANT) and any(
                carries_command(value) for name, value in frame.f_locals.items() if name != "self"
            )
            if receives and self._stack and self._stack[-1][1]:
                self.passing[self._stack[-1][0]] = None
            self._stack.append((code, receives))
        elif event == "return" and self._stack:
            self._stack.pop()


async def run_cycle(folder: Path) -> Trace:
    """Write a torque, step the plant, read the position, and record: simulation, edge and recorder on one bus."""
    hub, clock = MemoryHub(), ManualClock()
    lab = LabConfig.model_validate({"recorder": {"folder": str(folder)}, "sim": {"step_ms": STEP_NS / 1e6}})
    with (
        Service("sim", lab, MemoryBus(hub), clock=clock) as sim,
        Service("edge", lab, MemoryBus(hub), clock=clock) as edge,
        Service("recorder", lab, MemoryBus(hub), clock=clock) as recording,
    ):
        simulation = Simulation(sim, [rig_parameters(lab, rig) for rig in lab.rigs])
        recorder = Recorder(recording)
        states = edge.latest_value_cache(topics.STATES)
        commands = edge.publisher(topics.COMMANDS)
        call_at = asyncio.get_running_loop().call_at
        scheduler = CommandScheduler(edge.source, commands, states, STEP_NS, clock, call_at)
        endpoint = RigEndpoint(lab.rigs[0], edge, states, scheduler, lambda: None)
        transport = Mock(is_closing=lambda: False)
        server = endpoint._server
        server.attach(transport, "127.0.0.1", 1000)
        [connection] = server.connections

        def request(frame: bytes) -> bytes:
            connection.data_received(frame)
            response: bytes = transport.write.call_args.args[0]
            return response

        def beat_and_record() -> None:
            clock.advance(1_000_000_000)
            edge.beat(clock.monotonic_ns())
            recorder._run_once()
            recorder._tick(clock.monotonic_ns())

        endpoint.device.start()
        simulation.tick(Tick(clock.monotonic_ns(), 0, 0))
        # Starts the session, in whose file the next command is recorded.
        request(WRITE[:-8] + bytes(8))
        beat_and_record()
        with Trace() as trace:
            assert request(WRITE)[7] == 16
            for _ in range(2):
                simulation.tick(Tick(clock.monotonic_ns(), 0, 0))
            response = request(READ)
            beat_and_record()
        assert response[7:9] == bytes((3, 8))
        assert any(response[9:])
        recorder.close()
        endpoint.stop("end")
    return trace


async def run_client_cycle() -> Trace:
    """Let an edge exchange with a controller that is a server, until it has commanded its torques twice."""
    hub = MemoryHub()
    with Plc(law=lambda _: struct.unpack(">4h", WORDS)) as plc:
        rigs = [{"name": "rig1", "controller": plc.address, "registers": {"echo": 9}}]
        lab = LabConfig.model_validate({"sim": {"step_ms": STEP_NS / 1e6}, "rigs": rigs})
        with Service("sim", lab, MemoryBus(hub)) as sim, Service("edge", lab, MemoryBus(hub)) as edge:
            simulation = Simulation(sim, [rig_parameters(lab, rig) for rig in lab.rigs])
            [endpoint] = EdgeService(edge, asyncio.get_running_loop())._endpoints.values()
            assert endpoint.exchange is not None
            endpoint.device.start()
            endpoint.exchange.start()
            with Trace() as trace:
                async with asyncio.timeout(10):
                    while trace.calls.count(Device.command.__code__) < 2:
                        simulation.tick(Tick(sim.clock.monotonic_ns(), 0, 0))
                        await asyncio.sleep(STEP_NS / 1e9)  # the period of the simulation
            endpoint.stop("end")
    return trace


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Trace:
    return asyncio.run(run_cycle(tmp_path_factory.mktemp("recordings")))


@pytest.fixture(scope="module")
def client_trace() -> Trace:
    return asyncio.run(run_client_cycle())


@pytest.mark.parametrize("path", PATHS)
def test_hops_are_called_in_the_listed_order(trace: Trace, client_trace: Trace, path: str) -> None:
    calls = iter((client_trace if path in CLIENT_ROLE else trace).calls)
    for hop in PATHS[path]:
        assert hop.function is None or any(code is hop.function.__code__ for code in calls), hop.name


@pytest.mark.parametrize("role", ["server role", "client role"])
def test_no_other_function_passes_the_command_on(trace: Trace, client_trace: Trace, role: str) -> None:
    trace = client_trace if role == "client role" else trace
    listed = {hop.function.__code__ for hops in PATHS.values() for hop in hops if hop.function is not None}
    # The transport is behind the interface of the bus.
    passing = {code for code in trace.passing if not code.co_filename.endswith("/bus/memory_bus.py")}
    assert {code.co_qualname for code in passing - listed} == set()
    assert CommandSender.send.__code__ in passing


def test_unimpaired_rig_calls_no_code_of_the_impairment(trace: Trace) -> None:
    names = ("/impairment/", "/impairment_controller.py", "/delayed_commands.py")
    assert [code.co_qualname for code in trace.calls if any(name in code.co_filename for name in names)] == []
