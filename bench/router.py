"""How many hosts' worth of traffic does one router carry, and what does it add to a message's way?

A *host's worth* is what a lab of 64 rigs sends, each with a controller at 50 Hz, everything recorded. That is taken
from the real thing: such a lab runs for a few seconds, and how often each service sends on each topic, and how much,
is counted. Then 4, 16 and 40 such labs are played through `hilrig router`: two processes hold the bus sessions of their
simulations, edges and recorders and send messages of those sizes at those rates, on the real topics, with the real
priorities. The peer is the same traffic over direct links, as in the mesh of one host.

All processes share this machine, and its clock: a message's way is from its put to the callback at its reader.
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

from hilrig_cli.local.demo import free_ports
from hilrig_cli.local.local_lab import running_lab
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_schemas.topics import COMMANDS, HEALTH, LOG, STATES, ServiceTopic

QUESTION = "How many hosts' worth of traffic does one router carry, and what does it add to a message's way?"
HOSTS = tuple(map(int, os.environ.get("HILRIG_BENCH_HOSTS", "4,16,40").split(",")))
PROMISED = 16
RIGS = 64
STEP_MS = 20.0
SETTLE_S = 2.0
ARREARS_NS = 50_000_000
"""What a side that is too busy makes up for; the rest it leaves out, and that shows in what was sent."""
READERS = {STATES.name: "edge", COMMANDS.name: "sim", LOG.name: "recorder", HEALTH.name: "recorder"}
"""Who takes what a service sends on a topic. Reports go to tools, too; here one reader stands for them."""
SIDES = (("sim",), ("edge", "recorder"))
"""Services that a process holds of all labs."""


@dataclass(frozen=True, slots=True)
class Flow:
    """What one service sends on one topic."""

    topic: str
    service: str
    hz: float
    size: int
    """Mean, bytes."""

    @property
    def key(self) -> str:
        return f"{self.topic}/{self.service}/1"


TOPICS: dict[str, ServiceTopic[Any]] = {topic.name: topic for topic in (STATES, COMMANDS, LOG, HEALTH)}


# -- what a host sends -----------------------------------------------------------------------------------------------


def one_hosts_worth(seconds: float) -> list[Flow]:
    """Run a lab of `RIGS` rigs with as many controllers, and count what its services send."""
    load = build_c("scale_load.c", library="")
    heard: dict[tuple[str, str], list[int]] = {}
    counting = threading.Event()

    def count(sample: zenoh.Sample) -> None:
        if counting.is_set():
            _, _, topic, service, _ = str(sample.key_expr).split("/")
            heard.setdefault((topic, service), []).append(len(sample.payload))

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
        for (topic, service), sizes in sorted(heard.items())
    ]


# -- the traffic, in two processes of its own ------------------------------------------------------------------------


@dataclass
class Counted:
    """Of one topic."""

    sent: int = 0
    received: int = 0
    bytes: int = 0
    ways_ns: list[int] = field(default_factory=list)


class Side:
    """The services of some kinds of all labs."""

    def __init__(self, plan: dict[str, Any], services: tuple[str, ...]) -> None:
        self._flows = [Flow(**flow) for flow in plan["flows"]]
        self._hosts: int = plan["hosts"]
        self._begin_ns = self._end_ns = 0
        self.counted = {name: Counted() for name in TOPICS}
        self._closing = ExitStack()
        sends: list[tuple[float, float, Callable[[bytes], None], bytes, Counted]] = []
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
                    if READERS[flow.topic] == service:
                        key = TOPICS[flow.topic].key(lab, flow.service, "1")
                        bus.session.declare_subscriber(key, self._reader(self.counted[flow.topic]))
                    if flow.service == service:
                        key = TOPICS[flow.topic].key(lab, service, "1")
                        # Phases are spread, as between hosts that know nothing of each other.
                        phase = (host + 0.37 * len(sends)) / self._hosts % 1.0
                        put = _publisher(bus, TOPICS[flow.topic], key)
                        sends.append((1 / flow.hz, phase / flow.hz, put, bytes(flow.size), self.counted[flow.topic]))
        self._sends = sends

    def _reader(self, counted: Counted) -> Callable[[zenoh.Sample], None]:
        def read(sample: zenoh.Sample) -> None:
            now_ns = time.monotonic_ns()
            payload = sample.payload.to_bytes()
            sent_ns = int.from_bytes(payload[:8], "little")
            if self._begin_ns <= sent_ns < self._end_ns:
                counted.received += 1
                counted.bytes += len(payload)
                counted.ways_ns.append(now_ns - sent_ns)

        return read

    def run(self, begin_ns: int, end_ns: int) -> None:
        """Send until the time is over; what is sent from `begin_ns` on counts."""
        self._begin_ns, self._end_ns = begin_ns, end_ns
        start_ns = time.monotonic_ns()
        due = [(start_ns + round(phase * 1e9), number) for number, (_, phase, *_) in enumerate(self._sends)]
        periods_ns = [round(period * 1e9) for period, *_ in self._sends]
        due.sort()
        while True:
            # All that is due goes at once, once a millisecond: nobody has a wake-up for each.
            now_ns = time.monotonic_ns()
            if now_ns >= end_ns:
                return
            later = []
            for due_ns, number in due:
                next_ns = max(due_ns, now_ns - ARREARS_NS)
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
        self._closing.close()


def _publisher(bus: ZenohBus, topic: ServiceTopic[Any], key: str) -> Callable[[bytes], None]:
    if topic is not LOG:
        return bus.publisher(key, topic.traffic).put
    # A recording stream without its cache: that would be a gigabyte of this process, and is no traffic.
    return bus.session.declare_publisher(
        key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW
    ).put


def play(services: tuple[str, ...]) -> None:
    """One side: its plan and its times come on standard input, what it counted goes to standard output."""
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
class Found:
    """What one run gave."""

    counted: dict[str, Counted]
    router_cpu: float = 0.0
    """Cores."""
    router_mib: float = 0.0
    others_cpu: float = 0.0


def carry(flows: list[Flow], hosts: int, routed: bool, seconds: float) -> Found:
    """Play the traffic of some hosts, through a router or directly."""
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
            tell(side, json.dumps(plan))
            sides.append(side)
        for side in sides:
            read_line(side)
        # All are linked, and have heard of each other's subscriptions.
        time.sleep(SETTLE_S)
        begin_ns = time.monotonic_ns() + round(SETTLE_S * 1e9)
        end_ns = begin_ns + round(seconds * 1e9)
        for side in sides:
            tell(side, f"{begin_ns} {end_ns}")
        time.sleep(max(0.0, (begin_ns - time.monotonic_ns()) * 1e-9))
        before_s = cpu_s(router)
        time.sleep(max(0.0, (end_ns - time.monotonic_ns()) * 1e-9))
        found = Found({name: Counted() for name in TOPICS}, (cpu_s(router) - before_s) / seconds, resident_mib(router))
        for side in sides:
            said = json.loads(read_line(side))
            found.others_cpu += said["cpu_s"] / (seconds + SETTLE_S)
            for name, counted in said["counted"].items():
                total = found.counted[name]
                total.sent += counted["sent"]
                total.received += counted["received"]
                total.bytes += counted["bytes"]
                total.ways_ns += counted["ways_ns"]
    return found


def child(command: list[str]) -> subprocess.Popen[str]:
    """A process that ends with its standard input."""
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def tell(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    print(line, file=process.stdin, flush=True)


def read_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"{process.args!r} ended too soon")
    return line


def cpu_s(process: subprocess.Popen[str] | None) -> float:
    if process is None:
        return 0.0
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mib(process: subprocess.Popen[str] | None) -> float:
    if process is None:
        return 0.0
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def flow_as_dict(flow: Flow) -> dict[str, Any]:
    return {"topic": flow.topic, "service": flow.service, "hz": flow.hz, "size": flow.size}


def measure(report: Report, quick: bool) -> None:
    progress("a lab runs, to see what it sends")
    flows = one_hosts_worth(3.0 if quick else 8.0)
    for flow in flows:
        report.add(f"what {RIGS} rigs send", f"{flow.topic} of {flow.service}: messages", flow.hz, "1/s")
        report.add(f"what {RIGS} rigs send", f"{flow.topic} of {flow.service}: mean size", flow.size, "bytes")
    messages_hz = sum(flow.hz for flow in flows)
    bytes_hz = sum(flow.hz * flow.size for flow in flows)
    report.add(f"what {RIGS} rigs send", "together: messages", messages_hz, "1/s")
    report.add(f"what {RIGS} rigs send", "together: bytes", bytes_hz / 1e6, "MB/s")
    runs = 1 if quick else 3
    seconds = 3.0 if quick else 6.0
    for hosts in HOSTS:
        routed, direct = [], []
        # In turn, so that what disturbs the machine disturbs both.
        for number in range(runs):
            progress(f"{hosts} hosts, run {number + 1}: through a router, and directly")
            routed.append(carry(flows, hosts, True, seconds))
            direct.append(carry(flows, hosts, False, seconds))
        add(report, hosts, routed, direct, seconds, messages_hz)


def add(
    report: Report, hosts: int, routed: list[Found], direct: list[Found], seconds: float, messages_hz: float
) -> None:
    case = f"{hosts} hosts"
    cores = median(routed, lambda found: found.router_cpu)
    messages = median(routed, lambda found: sum(each.received for each in found.counted.values()) / seconds)
    megabytes = median(routed, lambda found: sum(each.bytes for each in found.counted.values()) / seconds / 1e6)
    report.add(case, "through the router: messages", messages, "1/s")
    report.add(case, "through the router: of those meant", 100 * messages / (hosts * messages_hz), "%")
    report.add(case, "through the router: bytes", megabytes, "MB/s")
    report.add(case, "router: processor", 100 * cores, "% of a core")
    report.add(case, "router: processor a message", 1e6 * cores / messages, "µs")
    report.add(case, "router: processor a host", 100 * cores / hosts, "% of a core")
    report.add(case, "router: memory", median(routed, lambda found: found.router_mib), "MiB")
    report.add(case, "senders and readers: processor", 100 * median(routed, lambda f: f.others_cpu), "% of a core")
    for name, what in ((STATES.name, "states"), (COMMANDS.name, "commands"), (LOG.name, "records")):
        for share in (0.5, 0.99):
            ways_ms = {
                how: median(founds, partial(way_ms, topic=name, share=share))
                for how, founds in (("through the router", routed), ("direct", direct))
            }
            for how, ms in ways_ms.items():
                report.add(case, f"{what}, {how}: way p{100 * share:g}", ms, "ms")
            if hosts == PROMISED and name == STATES.name and share == 0.5:
                added = ways_ms["through the router"] - ways_ms["direct"]
                report.bar(f"{case}: median way that the router adds to states", added, "<=", 2.0, "ms")
    for how, founds in (("through the router", routed), ("direct", direct)):
        lost = median(founds, lambda found: 100 * lost_share(found))
        report.add(case, f"{how}: lost", lost, "%")
        if hosts == PROMISED and founds is routed:
            report.bar(f"{case}: messages that did not come through the router", lost, "<=", 0.01, "%")
    if hosts == PROMISED:
        report.bar(f"{case}: processor of the router", cores, "<=", 1.0, "cores")


def way_ms(found: Found, topic: str, share: float) -> float:
    """A quantile of the ways of a topic's messages."""
    return float(np.quantile(found.counted[topic].ways_ns, share)) / 1e6


def lost_share(found: Found) -> float:
    sent = sum(each.sent for each in found.counted.values())
    return 1 - sum(each.received for each in found.counted.values()) / sent


def median(founds: list[Found], value: Callable[[Found], float]) -> float:
    return float(np.median([value(found) for found in founds]))


def main() -> int:
    if "--side" in sys.argv:
        play(tuple(sys.argv[2].split(",")))
        return 0
    return harness.run(measure, QUESTION)


if __name__ == "__main__":
    sys.exit(main())
