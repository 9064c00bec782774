"""How fast does the edge answer, next to pymodbus's own server and to a C server on libmodbus?

A client in C reads 4 positions and writes 4 torques, again and again, on 1, 2 and 16 connections. Ours is measured
twice: the protocol alone (each write takes the lease, feeds the watchdog and is encoded, but goes nowhere), and the
whole edge, with every write published on the bus to a subscriber, and recorded. Each connection has a rig of its own,
for a rig has one writer. Then what an idle edge costs, one at 50 Hz, and 10,000 connections one after the other.
"""

import asyncio
import gc
import json
import logging
import multiprocessing
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import harness
from harness import Report, build_c, progress
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from hilrig_cli.demo import free_ports
from hilrig_modbus_edge.bridge import run as run_edge
from hilrig_modbus_edge.device import Device
from hilrig_modbus_edge.server import Connection as ModbusConnection
from hilrig_modbus_edge.server import Limits, RigServer
from hilrig_modbus_edge.settings import DeviceSettings
from hilrig_runtime.bus import KEPT, Publisher
from hilrig_runtime.config import LabConfig
from hilrig_runtime.memory_bus import MemoryBus
from hilrig_runtime.realtime import REALTIME_PRIORITIES, go_realtime, prefer_latency
from hilrig_runtime.service import Arrival, Service
from hilrig_runtime.zenoh_bus import ZenohBus
from hilrig_schemas import JointState, RigBatch, topics

QUESTION = "How fast does the edge answer, next to pymodbus's own server and to a C server on libmodbus?"
CONNECTIONS = (1, 2, 16)
STOCK, C_SERVER, ALONE, WHOLE = "pymodbus's server", "libmodbus server in C", "ours, protocol alone", "ours, whole"

Figures = dict[str, Any]


def measure(report: Report, quick: bool) -> None:
    client, c_server = build_c("modbus_client.c"), build_c("modbus_server.c")
    runs, seconds = (1, 1.0) if quick else (3, 3.0)
    servers: dict[str, Callable[[int], Any]] = {
        STOCK: lambda connections: serving(serve_stock, connections),
        C_SERVER: lambda _: serving_c(c_server),
        ALONE: lambda connections: serving(serve_alone, connections),
        WHOLE: lambda connections: serving(serve_whole, connections),
    }
    measured: dict[tuple[str, int], list[Figures]] = {}
    for number in range(runs):
        # The servers take turns, so that a slow moment of the machine does not fall on one of them.
        for connections in CONNECTIONS:
            for name, start in servers.items():
                progress(f"{name}, {connections} connections, run {number + 1} of {runs}")
                with start(connections) as (port, step, pid):
                    before = cpu_seconds(pid)
                    figures = ask(client, port, step, connections, seconds)
                    used = cpu_seconds(pid) - before
                figures["cpu_us"] = 1e6 * used / (figures["cycles_per_s"] * seconds)
                measured.setdefault((name, connections), []).append(figures)
    for (name, connections), figures in measured.items():
        case = f"{name}, {connections} connection{'s' if connections > 1 else ''}"
        report.add(case, "cycles", middle(figures, "cycles_per_s"), "1/s")
        report.add(case, "read p50", middle(figures, "read_us", "p50"), "µs")
        report.add(case, "read p99", middle(figures, "read_us", "p99"), "µs")
        report.add(case, "processor time a cycle", middle(figures, "cpu_us"), "µs")
    at_two = {name: middle(measured[name, 2], "cycles_per_s") for name in servers}
    report.bar("protocol alone against pymodbus's server, 2 connections", at_two[ALONE] / at_two[STOCK], ">=", 3.5)
    report.bar("protocol alone against libmodbus, 2 connections", at_two[ALONE] / at_two[C_SERVER], ">=", 0.45)
    report.bar("whole edge against pymodbus's server, 2 connections", at_two[WHOLE] / at_two[STOCK], ">=", 2.5)
    report.bar("whole edge against libmodbus, 2 connections", at_two[WHOLE] / at_two[C_SERVER], ">=", 0.33)
    slow = middle(measured[WHOLE, 2], "read_us", "p99") / middle(measured[C_SERVER, 2], "read_us", "p99")
    report.bar("p99 of a read, whole edge against libmodbus, 2 connections", slow, "<=", 2.0)
    measure_at_50_hz(report, client, servers, 2.0 if quick else 10.0)
    measure_own_code(report, middle(measured[ALONE, 2], "cpu_us"), middle(measured[WHOLE, 2], "cpu_us"))
    measure_resources(report, client, quick)


def measure_at_50_hz(report: Report, client: Path, servers: dict[str, Callable[[int], Any]], seconds: float) -> None:
    """What a controller at the rig's own rate sees, where nobody is in a hurry."""
    for name in (C_SERVER, WHOLE):
        progress(f"{name}, 2 connections at 50 Hz")
        with servers[name](2) as (port, step, _):
            figures = ask(client, port, step, 2, seconds, 50.0)
        for share in ("p50", "p99"):
            report.add(f"{name}, 2 connections at 50 Hz", f"read {share}", figures["read_us"][share], "µs")


def measure_own_code(report: Report, alone_us: float, whole_us: float) -> None:
    """Where the time of a cycle goes: our own code, measured without sockets, and what is left of the whole."""
    progress("our own code")
    read_us, write_us = own_code_us(READ), own_code_us(WRITE)
    report.add("where it goes: our code", "a read", read_us, "µs")
    report.add("where it goes: our code", "a write, encoded", write_us, "µs")
    report.add("where it goes: asyncio and the kernel", "a cycle", alone_us - read_us - write_us, "µs")
    report.add("where it goes: publishing and recording", "a cycle", whole_us - alone_us, "µs")


READ = bytes.fromhex("0001 0000 0006 01 03 0004 0004")
WRITE = bytes.fromhex("0002 0000 000f 01 10 0000 0004 08 0001 0002 0003 0004")


def own_code_us(frame: bytes, times: int = 30_000) -> float:
    """Processor time of one request from the bytes that came to the bytes that go, without sockets, µs."""
    with Service("edge", lab_of(1, 1), NowhereBus()) as service:
        service.log.append = lambda *_: None  # type: ignore[method-assign]
        state = JointState(rig="rig1", step=1, position=[0] * 4, velocity=[0] * 4, effort=[0] * 4)
        arrival = Arrival(state.SerializeToString(), service.clock.monotonic_ns())
        outlet = Mock(send_command=service.sender(topics.COMMAND, "rig1").send)
        device = Device("rig1", DeviceSettings(), service.clock, outlet, lambda: arrival)
        server = RigServer(device, Limits(), service.clock, service.counters)
        transport = Mock(write=lambda _: None)
        connection = ModbusConnection(server, transport, device.connect("127.0.0.1", 1))
        for _ in range(2):
            # The first round warms up.
            begin = time.thread_time()
            for number in range(times):
                connection.get_buffer(-1)[: len(frame)] = frame
                connection.buffer_updated(len(frame))
                if number % 256 == 0:
                    server.traffic.take(0, 0)
            used = time.thread_time() - begin
    return 1e6 * used / times


def measure_resources(report: Report, client: Path, quick: bool) -> None:
    seconds, connections = (2.0, 1_000) if quick else (10.0, 10_000)
    with serving(serve_whole, 1) as (port, step, pid):
        for case, rate in (("idle rig", 0.0), ("rig at 50 Hz", 50.0)):
            progress(case)
            before, begin = cpu_seconds(pid), time.monotonic()
            if rate:
                ask(client, port, step, 1, seconds, rate)
            else:
                time.sleep(seconds)
            used = (cpu_seconds(pid) - before) / (time.monotonic() - begin)
            report.add(case, "processor", 100 * used, "% of a core")
            report.add(case, "memory", resident(pid) / 2**20, "MiB")
        progress(f"{connections} connections")
        subprocess.run([client, "churn", str(port), str(connections)], check=True, stdout=subprocess.DEVNULL)
        before_bytes, before_handles = resident(pid), handles(pid)
        subprocess.run([client, "churn", str(port), str(connections)], check=True, stdout=subprocess.DEVNULL)
        # What the last ones left is closed at the loop's next turns.
        time.sleep(0.5)
        grown = (resident(pid) - before_bytes) / 2**20
        more_handles = handles(pid) - before_handles
        report.add(f"{connections:,} connections", "memory grown", grown, "MiB")
        report.add(f"{connections:,} connections", "handles more", more_handles, "count")
        report.bar(f"memory grown over {connections:,} connections", grown, "<=", 1.0, "MiB")
        report.bar(f"handles more after {connections:,} connections", more_handles, "<=", 0, "count")


def ask(client: Path, port: int, step: int, connections: int, seconds: float, rate: float = 0.0) -> Figures:
    command = [client, *map(str, (port, step, connections, seconds, rate))]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, timeout=seconds + 30)
    figures: Figures = json.loads(done.stdout)
    return figures


def middle(figures: list[Figures], *path: str) -> float:
    values = []
    for one in figures:
        value: Any = one
        for key in path:
            value = value[key]
        values.append(float(value))
    return statistics.median(values)


Server = tuple[int, int, int]
"""First port, step to the next connection's port, process id."""


@contextmanager
def serving(serve: Callable[[int, int, Connection], None], rigs: int) -> Iterator[Server]:
    """Run a server of ours in a process of its own; it says that it is ready, and ends when told."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    port = free_ports(20_000, rigs)
    process = context.Process(target=serve, args=(port, rigs, there))
    process.start()
    there.close()
    try:
        yield port, here.recv(), process.pid or 0
    finally:
        here.close()
        process.join(10)
        if process.is_alive():
            process.kill()


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

    def publisher(self, key: str, traffic: topics.Traffic, kept: int = KEPT) -> Publisher:  # noqa: ARG002
        return _Nowhere()


class _Nowhere(Publisher):
    def put(self, payload: bytes) -> None:
        """Nobody listens."""

    def close(self) -> None:
        """Nothing is held."""


def serve_alone(port: int, rigs: int, control: Connection) -> None:
    """The edge with a bus that leads nowhere; nothing is kept for a recorder, and no policy but the ordinary one."""
    prefer_latency()
    lab = lab_of(port, rigs)
    bus = NowhereBus()
    with Service("edge", lab, bus) as service:
        service.log.append = lambda *_: None  # type: ignore[method-assign]
        serve_ours(service, bus.hub.deliver, control)


def serve_whole(port: int, rigs: int, control: Connection) -> None:
    """The edge as `hilrig edge` runs it; another process takes the simulation's place and hears every command."""
    prefer_latency()
    go_realtime(REALTIME_PRIORITIES["edge"])
    lab = lab_of(port, rigs)
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    sim = context.Process(target=send_states, args=(lab, there))
    sim.start()
    there.close()
    here.recv()
    try:
        with Service("edge", lab, ZenohBus(lab.bus, "edge")) as service:
            serve_ours(service, None, control)
    finally:
        here.close()
        sim.join(10)


def serve_ours(service: Service, deliver: Callable[[str, bytes], None] | None, control: Connection) -> None:
    lab = service.lab
    alive = topics.alive_key(lab.name, "edge", "*")

    def watch() -> None:
        while not service.bus.alive(alive):
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


def send_states(lab: LabConfig, control: Connection) -> None:
    """In the simulation's place: states at 50 Hz, and every command received."""
    go_realtime(REALTIME_PRIORITIES["sim"])
    with Service("sim", lab, ZenohBus(lab.bus, "sim")) as service:
        states = service.batch_sender(topics.STATES)
        for rig in lab.rigs:
            service.add_to_batch(states, topics.STATE, rig.name)
        service.latest_of_batches(topics.COMMANDS)
        control.send(1)
        step = 0
        while not control.poll(0.02):
            step += 1
            made = [
                JointState(rig=rig.name, step=step, position=[0] * 4, velocity=[0] * 4, effort=[0] * 4)
                for rig in lab.rigs
            ]
            states.send([state.SerializeToString() for state in made])
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


def cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def handles(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def resident(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    sys.exit(harness.run(measure, QUESTION))
