"""The servers that `modbus.py` compares, each in a process of its own: pymodbus's, libmodbus's, and ours.

A server says that it is ready through a pipe, and ends when the pipe does.
"""

import asyncio
import gc
import logging
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from hilrig_cli.local.demo import free_ports
from hilrig_modbus_edge.command_scheduler import COALESCE_WINDOW_NS, DEADLINE_MARGIN_NS
from hilrig_modbus_edge.service import run as run_edge
from hilrig_runtime.bus.api import CACHE_DEPTH, Publisher
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime, set_short_slice
from hilrig_schemas import JointState, RigBatch, TorqueCommand, topics

Server = tuple[int, int, int]
"""First port, step to the next connection's port, process id."""


@contextmanager
def running(body: Callable[..., None], *arguments: Any) -> Iterator[tuple[Any, int]]:
    """Run `body`, with the arguments and the other end of a pipe, in a process of its own: what it said when it was
    ready, and its process id."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=body, args=(*arguments, there))
    process.start()
    there.close()
    try:
        yield here.recv(), process.pid or 0
    finally:
        here.close()
        process.join(10)
        if process.is_alive():
            process.kill()


@contextmanager
def serving(serve: Callable[[int, int, Connection], None], rigs: int) -> Iterator[Server]:
    """Run a server of ours."""
    port = free_ports(20_000, rigs)
    with running(serve, port, rigs) as (step, pid):
        yield port, step, pid


@contextmanager
def serving_c(program: Path) -> Iterator[Server]:
    port = free_ports(20_000)
    with subprocess.Popen([program, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        if process.stdout.readline() != "ready\n":
            sys.exit(3)
        try:
            yield port, 0, process.pid
        finally:
            process.stdin.close()


@contextmanager
def serving_c_beside_the_bus(program: Path) -> Iterator[Server]:
    """The C server, as urgent as our edge, while others have as much to do with the bus as our edge under full load."""
    with serving_c(program) as (port, step, pid), serving(pass_on_commands, 2):
        with suppress(OSError):
            os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITIES["edge"]))
        yield port, step, pid


def serve_stock(port: int, rigs: int, control: Connection) -> None:  # noqa: ARG001
    """pymodbus's own server with registers in memory."""

    # It tells of every connection that goes.
    logging.disable()

    async def body() -> None:
        device = SimDevice(0, simdata=[SimData(0, count=16, values=0, datatype=DataType.REGISTERS)])
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        control.send(0)
        await asyncio.get_running_loop().run_in_executor(None, wait_for_end, control)
        await server.shutdown()

    asyncio.run(body())


class NowhereBus(MemoryBus):
    """A bus that carries states and nothing else: what is published goes nowhere, and costs nothing."""

    def publisher(self, key: str, traffic: topics.Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:  # noqa: ARG002
        return _Nowhere()


class _Nowhere(Publisher):
    def put(self, payload: bytes) -> None:
        """Nobody listens."""

    def close(self) -> None:
        """Nothing is held."""


def serve_alone(port: int, rigs: int, control: Connection) -> None:
    """The edge with a bus that leads nowhere; nothing is kept for a recorder, and no policy but the ordinary one."""
    set_short_slice()
    lab = lab_of(port, rigs)
    bus = NowhereBus()
    with Service("edge", lab, bus) as service:
        service.recording_stream.append = lambda *_: None  # type: ignore[method-assign]
        serve_ours(service, bus.hub.deliver, control)


def serve_whole(port: int, rigs: int, control: Connection) -> None:
    """The edge as `hilrig edge` runs it; another process takes the simulation's place and hears every command."""
    set_short_slice()
    go_realtime(REALTIME_PRIORITIES["edge"])
    lab = lab_of(port, rigs)
    with running(send_states, lab), Service("edge", lab, ZenohBus(lab.bus, "edge")) as service:
        serve_ours(service, None, control)


def serve_ours(service: Service, deliver: Callable[[str, bytes], None] | None, control: Connection) -> None:
    lab = service.lab
    alive = topics.alive_key(lab.name, "edge", "*")

    def watch() -> None:
        while not service.bus.get_liveliness(alive):
            if deliver is not None:
                for rig in lab.rigs:
                    state = JointState(rig=rig.name, step=1, position=[0] * 4, velocity=[0] * 4, effort=[0] * 4)
                    batch = RigBatch(rigs=[rig.name], messages=[state.SerializeToString()])
                    deliver(topics.STATES.key(lab.name, "sim", "1"), batch.SerializeToString())
            time.sleep(0.01)
        control.send(1)
        wait_for_end(control)
        service.stop()

    threading.Thread(target=watch, daemon=True).start()
    gc.collect()
    gc.freeze()
    run_edge(service)


COMMANDS_A_TICK = 400
"""Of a controller as fast as it can be."""


def pass_on_commands(port: int, rigs: int, control: Connection) -> None:
    """In the edge's place, without Modbus: two messages of commands a step, and one batch for the log stream."""
    go_realtime(REALTIME_PRIORITIES["edge"])
    lab = lab_of(port, rigs)
    names = [rig.name for rig in lab.rigs]
    key = topics.COMMAND.key(lab.name, names[0])
    with running(send_states, lab), Service("edge", lab, ZenohBus(lab.bus, "edge")) as service:
        states = service.latest_value_cache(topics.STATES)
        put = service.publisher(topics.COMMANDS).put
        command = TorqueCommand(rig=names[0], effort=[0.1] * 4, session="a" * 24, controller="127.0.0.1:50000")
        for field in ("seq", "basis_incarnation", "basis_step", "state_arrived_ns", "state_served_ns", "sent_ns"):
            setattr(command, field, time.monotonic_ns())
        encoded = command.SerializeToString()
        departure = RigBatch(source=service.source, rigs=names, messages=[encoded] * rigs).SerializeToString()
        service.ready()
        control.send(0)
        shown = None
        while not control.poll(0):
            state = states.get(names[0])
            if state is None or state is shown:
                time.sleep(0.0002)
                continue
            shown = state
            wait_until(state.arrived_ns + COALESCE_WINDOW_NS)
            put(departure)
            wait_until(state.arrived_ns + lab.sim.step_ns - DEADLINE_MARGIN_NS)
            put(departure)
            service.recording_stream.extend(
                [(key, number, time.time_ns(), encoded) for number in range(COMMANDS_A_TICK)]
            )
            service.beat(time.monotonic_ns())


def wait_until(when_ns: int) -> None:
    time.sleep(max(0, when_ns - time.monotonic_ns()) * 1e-9)


def send_states(lab: LabConfig, control: Connection) -> None:
    """In the simulation's place: states at 50 Hz, and every command received."""
    go_realtime(REALTIME_PRIORITIES["sim"])
    with Service("sim", lab, ZenohBus(lab.bus, "sim")) as service:
        states = service.batch_publisher(topics.STATES)
        for rig in lab.rigs:
            service.add_to_batch(states, topics.STATE, rig.name)
        service.latest_value_cache(topics.COMMANDS)
        control.send(1)
        step = 0
        while not control.poll(0.02):
            step += 1
            made = [
                JointState(rig=rig.name, step=step, position=[0] * 4, velocity=[0] * 4, effort=[0] * 4)
                for rig in lab.rigs
            ]
            states.publish([state.SerializeToString() for state in made])
            service.beat(service.clock.monotonic_ns())


def lab_of(port: int, rigs: int) -> LabConfig:
    return LabConfig.model_validate(
        {
            "edge": {"first_port": port, "max_connections": 64, "max_connections_per_host": 64},
            "bus": {"first_port": free_ports(7447, 3)},
            "rigs": [{"name": f"rig{number + 1}"} for number in range(rigs)],
        }
    )


def wait_for_end(control: Connection) -> None:
    """Return when the other end of the pipe is closed."""
    with suppress(EOFError, OSError):
        control.recv()
