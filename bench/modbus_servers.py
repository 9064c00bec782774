"""The servers that `modbus.py` compares, each in its own process: pymodbus, libmodbus and the hilrig edge.

A server reports through a pipe that it is ready and stops when the pipe is closed.
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

from hilrig_cli.local.local_lab import free_ports
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
    """Run `body` in its own process, with `arguments` and the other end of a pipe.

    Yields the object that it sent when it was ready, and its process id.
    """
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
    """Run a Python server in its own process."""
    port = free_ports(20_000, rigs)
    with running(serve, port, rigs) as (step, pid):
        yield port, step, pid


@contextmanager
def serving_c(program: Path) -> Iterator[Server]:
    """Run the C server."""
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
def serving_c_with_bus_load(program: Path) -> Iterator[Server]:
    """Run the C server at the edge's priority, while other processes produce the bus load of a fully loaded edge."""
    with serving_c(program) as (port, step, pid), serving(publish_bus_load, 2):
        with suppress(OSError):
            os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITIES["edge"]))
        yield port, step, pid


def serve_pymodbus(port: int, rigs: int, control: Connection) -> None:  # noqa: ARG001
    """Run pymodbus's server with registers in memory."""

    # pymodbus logs each closed connection.
    logging.disable()

    async def body() -> None:
        device = SimDevice(0, simdata=[SimData(0, count=16, values=0, datatype=DataType.REGISTERS)])
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        control.send(0)
        await asyncio.get_running_loop().run_in_executor(None, wait_for_end, control)
        await server.shutdown()

    asyncio.run(body())


class DiscardingBus(MemoryBus):
    """A bus that delivers states and discards published messages at no cost."""

    def publisher(self, key: str, traffic: topics.Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:  # noqa: ARG002
        return Publisher(lambda _: None)


def serve_protocol_only(port: int, rigs: int, control: Connection) -> None:
    """Run the edge with a bus that discards messages, without a recording stream and without real-time policy."""
    set_short_slice()
    lab = lab_of(port, rigs)
    bus = DiscardingBus()
    with Service("edge", lab, bus) as service:
        service.recording_stream.append = lambda *_: None  # type: ignore[method-assign]
        run_edge_service(service, bus.hub.deliver, control)


def serve_full_stack(port: int, rigs: int, control: Connection) -> None:
    """Run the edge as `hilrig edge` does; another process replaces the simulation and receives every command."""
    set_short_slice()
    go_realtime(REALTIME_PRIORITIES["edge"])
    lab = lab_of(port, rigs)
    with running(send_states, lab), Service("edge", lab, ZenohBus(lab.bus, "edge")) as service:
        run_edge_service(service, None, control)


def run_edge_service(service: Service, deliver: Callable[[str, bytes], None] | None, control: Connection) -> None:
    """Run the edge until the pipe is closed; `deliver` injects states on a bus without a simulation."""
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


COMMANDS_PER_TICK = 400
"""Commands per tick of a controller that writes without pauses."""


def publish_bus_load(port: int, rigs: int, control: Connection) -> None:
    """Replace the edge, without Modbus: two command messages and one batch of the recording stream per step."""
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
        batch = RigBatch(source=service.source, rigs=names, messages=[encoded] * rigs).SerializeToString()
        service.ready()
        control.send(0)
        last_state = None
        while not control.poll(0):
            state = states.get(names[0])
            if state is None or state is last_state:
                time.sleep(0.0002)
                continue
            last_state = state
            wait_until(state.arrived_ns + COALESCE_WINDOW_NS)
            put(batch)
            wait_until(state.arrived_ns + lab.sim.step_ns - DEADLINE_MARGIN_NS)
            put(batch)
            service.recording_stream.extend(
                [(key, number, time.time_ns(), encoded) for number in range(COMMANDS_PER_TICK)]
            )
            service.beat(time.monotonic_ns())


def wait_until(when_ns: int) -> None:
    """Sleep until a time of the monotonic clock."""
    time.sleep(max(0, when_ns - time.monotonic_ns()) * 1e-9)


def send_states(lab: LabConfig, control: Connection) -> None:
    """Replace the simulation: publish states at 50 Hz and receive every command."""
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
            new_states = [
                JointState(rig=rig.name, step=step, position=[0] * 4, velocity=[0] * 4, effort=[0] * 4)
                for rig in lab.rigs
            ]
            states.publish([state.SerializeToString() for state in new_states])
            service.beat(service.clock.monotonic_ns())


def lab_of(port: int, rigs: int) -> LabConfig:
    """Return a lab with free bus ports whose first rig listens on `port`."""
    return LabConfig.model_validate(
        {
            "edge": {"first_port": port, "max_connections": 64, "max_connections_per_host": 64},
            "bus": {"first_port": free_ports(7447, 3)},
            "rigs": [{"name": f"rig{number + 1}"} for number in range(rigs)],
        }
    )


def wait_for_end(control: Connection) -> None:
    """Block until the other end of the pipe is closed."""
    with suppress(EOFError, OSError):
        control.recv()
