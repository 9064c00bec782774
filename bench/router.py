"""Measures how many hosts one router serves and how much latency it adds to a message.

The traffic of one host is the traffic of a lab of 64 rigs, each with a controller at 50 Hz, all recorded. It is
measured first: such a lab runs for a few seconds while the messages of each service and topic are counted. Then the
traffic of 4, 16 and 40 such labs is sent through `hilrig router`: two processes hold the bus sessions of the
simulations, edges and recorders and publish messages of these sizes at these rates, on the same topics and with the
same priorities. The peer is the same traffic over direct links, as in the mesh of one host.

All processes run on this machine and share its clock. The latency of a message is the time from its put to the callback
of its receiver.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import zenoh
from harness import Report, build_c, progress, services_log, write_lab

from hilrig_cli.local.local_lab import free_ports, running_lab
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_schemas.topics import COMMANDS, HEALTH, LOG, STATES, ServiceTopic

QUESTION = "How many hosts does one router serve, and how much latency does it add to a message?"
HOSTS = tuple(map(int, os.environ.get("HILRIG_BENCH_HOSTS", "4,16,40").split(",")))
REQUIRED_HOSTS = 16
RIGS = 64
STEP_MS = 20.0
SETTLE_S = 2.0
MAX_BACKLOG_NS = 50_000_000
"""Largest delay that an overloaded side catches up with, ns; older messages are skipped and count as not sent."""
RECEIVERS = {STATES.name: "edge", COMMANDS.name: "sim", LOG.name: "recorder", HEALTH.name: "recorder"}
"""Topic → the service that receives it. Tools receive health reports too; the recorder represents them here."""
SIDES = (("sim",), ("edge", "recorder"))
"""Services of all labs that each of the two processes plays."""


@dataclass(frozen=True, slots=True)
class Flow:
    """Messages of one service on one topic."""

    topic: str
    service: str
    hz: float
    size: int
    """Mean size, bytes."""

    @property
    def key(self) -> str:
        return f"{self.topic}/{self.service}/1"


TOPICS: dict[str, ServiceTopic[Any]] = {topic.name: topic for topic in (STATES, COMMANDS, LOG, HEALTH)}


# -- the traffic of one host -----------------------------------------------------------------------------------------


def measure_host_traffic(seconds: float) -> list[Flow]:
    """Run a lab of `RIGS` rigs with a controller each and count the messages of its services."""
    load = build_c("scale_load.c", library="")
    received: dict[tuple[str, str], list[int]] = {}
    counting = threading.Event()

    def count(sample: zenoh.Sample) -> None:
        if counting.is_set():
            _, _, topic, service, _ = str(sample.key_expr).split("/")
            received.setdefault((topic, service), []).append(len(sample.payload))

    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder:
        lab, config, port = write_lab(Path(folder), rigs=RIGS)
        with (
            services_log(Path(folder) / "log"),
            running_lab(lab, config, lambda _: None, threading.Event()),
            ZenohBus(lab.bus, "tool") as bus,
        ):
            subscribers = [
                bus.session.declare_subscriber(topic.key(lab.name, "*", "*"), count) for topic in TOPICS.values()
            ]
            command = [str(load), "127.0.0.1", str(port), str(RIGS), str(seconds + 2 * SETTLE_S), str(STEP_MS)]
            with subprocess.Popen(command, stdout=subprocess.DEVNULL):
                time.sleep(SETTLE_S)
                counting.set()
                time.sleep(seconds)
                counting.clear()
            for subscriber in subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
    return [
        Flow(topic, service, len(sizes) / seconds, round(sum(sizes) / len(sizes)))
        for (topic, service), sizes in sorted(received.items())
    ]


# -- the traffic generators, two separate processes ------------------------------------------------------------------


@dataclass
class TopicCount:
    """Messages of one topic."""

    sent: int = 0
    received: int = 0
    bytes: int = 0
    latencies_ns: list[int] = field(default_factory=list)


class Side:
    """Sends and receives the messages of some services of all labs."""

    def __init__(self, plan: dict[str, Any], services: tuple[str, ...]) -> None:
        self._flows = [Flow(**flow) for flow in plan["flows"]]
        self._hosts: int = plan["hosts"]
        self._begin_ns = self._end_ns = 0
        self.counted = {name: TopicCount() for name in TOPICS}
        self._closing = ExitStack()
        sends: list[tuple[float, float, Callable[[bytes], None], bytes, TopicCount]] = []
        for host in range(self._hosts):
            lab = f"lab{host}"
            bus_config = (
                BusConfig(topology="router", router=plan["router"])
                if plan["router"]
                else BusConfig(first_port=plan["first_port"] + 3 * host)
            )
            for service in services:
                bus = self._closing.enter_context(ZenohBus(bus_config, service))
                for flow in self._flows:
                    if RECEIVERS[flow.topic] == service:
                        key = TOPICS[flow.topic].key(lab, flow.service, "1")
                        bus.session.declare_subscriber(key, self._receiver(self.counted[flow.topic]))
                    if flow.service == service:
                        key = TOPICS[flow.topic].key(lab, service, "1")
                        # Phases are spread: hosts are not synchronized.
                        phase = (host + 0.37 * len(sends)) / self._hosts % 1.0
                        put = _publisher(bus, TOPICS[flow.topic], key)
                        sends.append((1 / flow.hz, phase / flow.hz, put, bytes(flow.size), self.counted[flow.topic]))
        self._sends = sends

    def _receiver(self, counted: TopicCount) -> Callable[[zenoh.Sample], None]:
        def receive(sample: zenoh.Sample) -> None:
            now_ns = time.monotonic_ns()
            payload = sample.payload.to_bytes()
            sent_ns = int.from_bytes(payload[:8], "little")
            if self._begin_ns <= sent_ns < self._end_ns:
                counted.received += 1
                counted.bytes += len(payload)
                counted.latencies_ns.append(now_ns - sent_ns)

        return receive

    def run(self, begin_ns: int, end_ns: int) -> None:
        """Send until `end_ns`; messages sent since `begin_ns` are counted."""
        self._begin_ns, self._end_ns = begin_ns, end_ns
        start_ns = time.monotonic_ns()
        due = [(start_ns + round(phase * 1e9), number) for number, (_, phase, *_) in enumerate(self._sends)]
        periods_ns = [round(period * 1e9) for period, *_ in self._sends]
        due.sort()
        while True:
            # Due messages are sent once per millisecond, which avoids one wake-up per message.
            now_ns = time.monotonic_ns()
            if now_ns >= end_ns:
                return
            later = []
            for due_ns, number in due:
                next_ns = max(due_ns, now_ns - MAX_BACKLOG_NS)
                _, _, put, body, counted = self._sends[number]
                while next_ns <= now_ns:
                    sent_ns = time.monotonic_ns()
                    put(sent_ns.to_bytes(8, "little") + body[8:])
                    counted.sent += begin_ns <= sent_ns < end_ns
                    next_ns += periods_ns[number]
                later.append((next_ns, number))
            due = later
            time.sleep(max(0.0, 1e-3 - (time.monotonic_ns() - now_ns) * 1e-9))

    def close(self) -> None:
        """Close the bus sessions."""
        self._closing.close()


def _publisher(bus: ZenohBus, topic: ServiceTopic[Any], key: str) -> Callable[[bytes], None]:
    if topic is not LOG:
        return bus.publisher(key, topic.traffic).put
    # No publisher cache: it would use a gigabyte in this process and produces no traffic.
    return bus.session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW
    ).put


def run_side(services: tuple[str, ...]) -> None:
    """Run one side: read the plan and the times from standard input, print the counts on standard output."""
    side = Side(json.loads(sys.stdin.readline()), services)
    print("ready", flush=True)
    begin_ns, end_ns = map(int, sys.stdin.readline().split())
    cpu_s = time.process_time()
    side.run(begin_ns, end_ns)
    time.sleep(0.5)
    cpu_s = time.process_time() - cpu_s
    counted = {name: vars(each) for name, each in side.counted.items()}
    print(json.dumps({"counted": counted, "cpu_s": cpu_s}), flush=True)
    side.close()


# -- the measurement -------------------------------------------------------------------------------------------------


@dataclass
class TrafficRun:
    """Results of one run."""

    counted: dict[str, TopicCount]
    router_cpu: float = 0.0
    """CPU load of the router, cores."""
    router_mib: float = 0.0
    sides_cpu: float = 0.0


def run_traffic(flows: list[Flow], hosts: int, routed: bool, seconds: float) -> TrafficRun:
    """Send the traffic of some hosts through a router or directly."""
    with tempfile.TemporaryDirectory(prefix="hilrig-bench-") as folder, ExitStack() as ending:
        plan: dict[str, Any] = {"flows": [flow_as_dict(flow) for flow in flows], "hosts": hosts, "router": ""}
        router: subprocess.Popen[str] | None = None
        if routed:
            plan["router"] = f"tcp/127.0.0.1:{free_ports(7447, 1)}"
            config = Path(folder) / "lab.toml"
            config.write_text(f'[bus]\ntopology = "router"\nrouter = "{plan["router"]}"\n')
            command = [sys.executable, "-m", "hilrig_cli", "router", "--config", str(config), "--stop-with-parent"]
            router = ending.enter_context(child(command))
            read_line(router)
        else:
            plan["first_port"] = free_ports(24_000, 3 * hosts)
        sides = []
        for services in SIDES:
            side = ending.enter_context(child([sys.executable, __file__, "--side", ",".join(services)]))
            write_line(side, json.dumps(plan))
            sides.append(side)
        for side in sides:
            read_line(side)
        # Afterwards all sessions are connected and know each other's subscriptions.
        time.sleep(SETTLE_S)
        begin_ns = time.monotonic_ns() + round(SETTLE_S * 1e9)
        end_ns = begin_ns + round(seconds * 1e9)
        for side in sides:
            write_line(side, f"{begin_ns} {end_ns}")
        time.sleep(max(0.0, (begin_ns - time.monotonic_ns()) * 1e-9))
        before_s = cpu_s(router)
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) * 1e-9))
        found = TrafficRun(
            {name: TopicCount() for name in TOPICS}, (cpu_s(router) - before_s) / seconds, resident_mib(router)
        )
        for side in sides:
            result = json.loads(read_line(side))
            found.sides_cpu += result["cpu_s"] / (seconds + SETTLE_S)
            for name, counted in result["counted"].items():
                total = found.counted[name]
                total.sent += counted["sent"]
                total.received += counted["received"]
                total.bytes += counted["bytes"]
                total.latencies_ns += counted["latencies_ns"]
    return found


def child(command: list[str]) -> subprocess.Popen[str]:
    """Start a process that stops when its standard input is closed."""
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def write_line(process: subprocess.Popen[str], line: str) -> None:
    """Write a line to the standard input of a process."""
    assert process.stdin is not None
    print(line, file=process.stdin, flush=True)


def read_line(process: subprocess.Popen[str]) -> str:
    """Read a line from the standard output of a process."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{process.args!r} ended unexpectedly")
    return line


def cpu_s(process: subprocess.Popen[str] | None) -> float:
    """Return the CPU time of a process, s; 0 without a process."""
    if process is None:
        return 0.0
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mib(process: subprocess.Popen[str] | None) -> float:
    """Return the resident memory of a process; 0 without a process."""
    if process is None:
        return 0.0
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def flow_as_dict(flow: Flow) -> dict[str, Any]:
    """Return a flow as a JSON object."""
    return {"topic": flow.topic, "service": flow.service, "hz": flow.hz, "size": flow.size}


def measure(report: Report, quick: bool) -> None:
    """Measure the traffic of one host, then send it for all numbers of hosts."""
    progress("traffic of one lab")
    flows = measure_host_traffic(3.0 if quick else 8.0)
    for flow in flows:
        report.add(f"traffic of {RIGS} rigs", f"{flow.topic} from {flow.service}: messages", flow.hz, "1/s")
        report.add(f"traffic of {RIGS} rigs", f"{flow.topic} from {flow.service}: mean size", flow.size, "bytes")
    messages_hz = sum(flow.hz for flow in flows)
    bytes_hz = sum(flow.hz * flow.size for flow in flows)
    report.add(f"traffic of {RIGS} rigs", "total: messages", messages_hz, "1/s")
    report.add(f"traffic of {RIGS} rigs", "total: bytes", bytes_hz / 1e6, "MB/s")
    runs = 1 if quick else 3
    seconds = 3.0 if quick else 6.0
    for hosts in HOSTS:
        routed, direct = [], []
        # In turn, so that other load of the machine affects both.
        for number in range(runs):
            progress(f"{hosts} hosts, run {number + 1}: through a router and directly")
            routed.append(run_traffic(flows, hosts, True, seconds))
            direct.append(run_traffic(flows, hosts, False, seconds))
        add(report, hosts, routed, direct, seconds, messages_hz)


def add(
    report: Report, hosts: int, routed: list[TrafficRun], direct: list[TrafficRun], seconds: float, messages_hz: float
) -> None:
    """Add the results and thresholds of one number of hosts."""
    case = f"{hosts} hosts"
    cores = median(routed, lambda found: found.router_cpu)
    messages = median(routed, lambda found: sum(each.received for each in found.counted.values()) / seconds)
    megabytes = median(routed, lambda found: sum(each.bytes for each in found.counted.values()) / seconds / 1e6)
    report.add(case, "through the router: messages", messages, "1/s")
    report.add(
        case,
        "through the router: messages, relative to the planned number",
        100 * messages / (hosts * messages_hz),
        "%",
    )
    report.add(case, "through the router: bytes", megabytes, "MB/s")
    report.add(case, "router: CPU load", 100 * cores, "% of a core")
    report.add(case, "router: CPU time per message", 1e6 * cores / messages, "µs")
    report.add(case, "router: CPU load per host", 100 * cores / hosts, "% of a core")
    report.add(case, "router: memory", median(routed, lambda found: found.router_mib), "MiB")
    report.add(case, "senders and receivers: CPU load", 100 * median(routed, lambda f: f.sides_cpu), "% of a core")
    for name, what in ((STATES.name, "states"), (COMMANDS.name, "commands"), (LOG.name, "records")):
        for fraction in (0.5, 0.99):
            latencies_ms = {
                route: median(runs, partial(latency_ms, topic=name, fraction=fraction))
                for route, runs in (("through the router", routed), ("direct", direct))
            }
            for route, ms in latencies_ms.items():
                report.add(case, f"{what}, {route}: latency p{100 * fraction:g}", ms, "ms")
            if hosts == REQUIRED_HOSTS and name == STATES.name and fraction == 0.5:
                added = latencies_ms["through the router"] - latencies_ms["direct"]
                report.require(f"{case}: median latency that the router adds to states", added, "<=", 2.0, "ms")
    for route, runs in (("through the router", routed), ("direct", direct)):
        lost = median(runs, lambda found: 100 * lost_fraction(found))
        report.add(case, f"{route}: lost", lost, "%")
        if hosts == REQUIRED_HOSTS and runs is routed:
            report.require(f"{case}: messages lost through the router", lost, "<=", 0.01, "%")
    if hosts == REQUIRED_HOSTS:
        report.require(f"{case}: CPU load of the router", cores, "<=", 1.0, "cores")


def latency_ms(found: TrafficRun, topic: str, fraction: float) -> float:
    """Return a quantile of the latencies of a topic's messages, ms."""
    return float(np.quantile(found.counted[topic].latencies_ns, fraction)) / 1e6


def lost_fraction(found: TrafficRun) -> float:
    """Return the lost messages of all topics as a fraction of the sent ones."""
    sent = sum(each.sent for each in found.counted.values())
    return 1 - sum(each.received for each in found.counted.values()) / sent


def median(runs: list[TrafficRun], value: Callable[[TrafficRun], float]) -> float:
    """Return the median over runs of a value."""
    return float(np.median([value(found) for found in runs]))


def main() -> int:
    if "--side" in sys.argv:
        run_side(tuple(sys.argv[2].split(",")))
        return 0
    return harness.run(measure, QUESTION)


if __name__ == "__main__":
    sys.exit(main())
