"""Reported times of the loop against a packet capture, which knows nothing of hilrig.

The controller reads the step and the applied efforts, and numbers its commands in effort 4. So the packets alone show
the basis of each command, the step on which it acts first, and the times between requests and responses.

With HILRIG_LONG in the environment also over links with a delay, and for longer.
"""

import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.io.run import Run, open_run
from hilrig_schemas import Event, ModbusTraffic, TorqueCommand, topics
from support.capture import Capture, Packet, require_capture, round_trips_ns, without_repeats
from support.delay_line import NEAR, DelayLine, require_delay_line
from support.labs import RunningLab, write_lab
from support.long_tests import LONG
from support.waiting import eventually

pytestmark = [pytest.mark.rig, pytest.mark.real_time]

CONTROLLER = Path(__file__).parents[1] / "support/witness_controller.py"
SECONDS = 20.0 if LONG else 1.5
PERIOD_MS = 10
US, MS = 1_000, 1_000_000
MessageT = TypeVar("MessageT", TorqueCommand, Event, ModbusTraffic)


@dataclass
class Write:
    """A write of torques, as the packets show it."""

    mark: int
    basis: int
    """Step in the last response that the client had received."""
    served_ns: int
    """Time of that response."""
    received_ns: int
    answered_ns: int


class Witness:
    """The loop as the packets of one connection show it; times in ns on the wall clock."""

    def __init__(self, packets: list[Packet]) -> None:
        self.packets = packets
        self.writes: list[Write] = []
        self.acting: dict[int, int] = {}
        """By step: mark of the command that acts on it."""
        basis = served_ns = 0
        for packet in without_repeats(packets):
            length, function = packet.data[5] + 6, packet.data[7]
            assert length == len(packet.data), "a packet is one request or response"
            if packet.from_edge and function == 4:
                served_ns = packet.wall_ns
                [basis] = struct.unpack_from(">I", packet.data, 9 + 2 * 2)
                [effort] = struct.unpack_from(">f", packet.data, 9 + 2 * 34)
                self.acting[basis] = round(1000 * effort)
            elif packet.from_edge:
                self.writes[-1].answered_ns = packet.wall_ns
            elif function == 16:
                [mark] = struct.unpack_from(">h", packet.data, 13 + 2 * 3)
                self.writes.append(Write(mark, basis, served_ns, packet.wall_ns, 0))

    def bases(self) -> dict[int, int]:
        """By step that the client was served: step of the basis of the command that acts on it."""
        found: dict[int, int] = {}
        # Marks repeat after 100 commands, within which a command acts or was superseded.
        written: dict[int, int] = {}
        writes = iter(self.writes)
        upcoming = next(writes, None)
        for step, mark in sorted(self.acting.items()):
            while upcoming is not None and upcoming.basis < step:
                written[upcoming.mark] = upcoming.basis
                upcoming = next(writes, None)
            # The first step may show the last command of the session before.
            if mark in written:
                found[step] = written[mark]
        return found

    def loops(self) -> dict[int, int]:
        """By the step on which a command is known to act first: the step of its basis."""
        bases = self.bases()
        return {
            step: bases[step] for step in bases if self.acting.get(step - 1, self.acting[step]) != self.acting[step]
        }


@dataclass
class Session:
    """A recording with its report and its witness."""

    run: Run
    report: LatencyReport
    witness: Witness
    stalls: list[tuple[int, int]]
    """Begin and end of each stop of the edge, ns, monotonic clock."""

    def __post_init__(self) -> None:
        written = {one.seq: one for one in self.messages(topics.COMMAND) if one.write_arrived_ns}
        names = ["basis_step", "basis_on_other_connection", "state_served_ns", "write_received_ns", "write_arrived_ns"]
        names += ["sent_ns", "wall_ns"]
        self.commands = {name: np.array([getattr(one, name) for one in written.values()]) for name in names}
        self.marks = [round(1000 * one.effort[3]) for one in written.values()]
        # The edge takes both clocks one after the other for each command.
        self.offset_ns = int(np.median(self.commands["wall_ns"] - self.commands["sent_ns"]))

    def messages(self, topic: topics.RigTopic[MessageT]) -> list[MessageT]:
        """All recorded messages of a topic."""
        return [topic.decode(payload) for *_, payload in self.run.file.messages(frozenset({topic.name}))]

    def written(self, name: str) -> np.ndarray:
        """Field of each write in the capture, times on the edge's monotonic clock."""
        values = np.array([getattr(write, name) for write in self.witness.writes])
        return values - self.offset_ns if name.endswith("_ns") else values


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    require_capture()
    extra = "edge.session_grace_ms = 100\nedge.host = '0.0.0.0'\nrecorder.preroll_s = 0.1"
    with RunningLab(write_lab(tmp_path_factory.mktemp("lab"), extra=extra)) as lab:
        yield lab


def observe(
    lab: RunningLab, seconds: float, *, think_ms: float = 0.0, stall_ms: float = 0.0, line: DelayLine | None = None
) -> Session:
    """Run the controller under capture; stop the edge for `stall_ms` twice a second."""
    known = set(lab.recordings)
    host, interface = (NEAR, line.interface) if line is not None else ("127.0.0.1", "lo")
    command = [sys.executable, str(CONTROLLER), host, str(lab.port), str(seconds), str(PERIOD_MS), str(think_ms)]
    stalls = []
    with Capture(interface, lab.port) as capture:
        controller = subprocess.Popen(command if line is None else line.command(command))
        edge = lab.service_pid("edge")
        end_s = time.monotonic() + seconds - 0.3
        time.sleep(0.5)  # the program connects and moves the arm before it is disturbed
        while stall_ms and time.monotonic() < end_s:
            begin_ns = time.monotonic_ns()
            os.kill(edge, signal.SIGSTOP)
            try:
                time.sleep(stall_ms / 1e3)  # the duration of the stop is under test
            finally:
                os.kill(edge, signal.SIGCONT)
            stalls.append((begin_ns, time.monotonic_ns()))
            time.sleep(0.5 - stall_ms / 1e3)  # undisturbed time between two stops
        assert controller.wait(seconds + 30) == 0
    recording = eventually(lambda: next((path for path in lab.recordings if path not in known), None))
    run = open_run(recording)
    return Session(run, measure(run), Witness(capture.packets), stalls)


def check_against_capture(session: Session) -> None:
    """Compare basis, loop latency and the stages *controller* and *edge* of each command with the packets."""
    witness, commands = session.witness, session.commands
    assert len(witness.writes) > 50
    assert session.marks == [write.mark for write in witness.writes]

    # The basis of a command is the state in the last response before its write.
    assert list(commands["basis_step"]) == [write.basis for write in witness.writes]

    # Kernel's stamp of the write: the packet itself, on the loopback the same buffer of the kernel.
    received_ns = commands["write_received_ns"]
    assert (received_ns > 0).all()
    assert (received_ns < commands["write_arrived_ns"]).all()
    difference_ns = np.abs(received_ns - session.written("received_ns"))
    assert difference_ns.max() < 200 * US
    assert np.median(difference_ns) < 20 * US

    # *Controller* is longer than between the packets by the time from the service to the response: no stall is in it.
    controller_ns = received_ns - commands["state_served_ns"]
    between_ns = session.written("received_ns") - session.written("served_ns")
    assert (controller_ns - between_ns >= -US).all()
    assert np.percentile(controller_ns - between_ns, 95) < 2 * MS
    # *Edge* ends between the request and its response.
    edge_ns = commands["sent_ns"] - received_ns
    answered_ns = session.written("answered_ns") - session.written("received_ns")
    assert (edge_ns <= answered_ns + US).all()
    assert np.percentile(answered_ns - edge_ns, 95) < 2 * MS

    states = session.run.states
    steps, times_ns = states["step"].tolist(), states["sampled_ns"].tolist()
    sampled_ns = dict(zip(steps, times_ns, strict=True))
    # Age, at each step that the client was served.
    assert session.report.ages is not None
    ages_ns = {
        int(row["step"]): int(row["age_ns"]) for block in session.report.ages.rows("step", "age_ns") for row in block
    }
    bases = witness.bases()
    assert len(bases) > 25
    for step, basis in bases.items():
        assert ages_ns[step] == sampled_ns[step] - sampled_ns[basis]

    # Loop latency, of each step on which a new command was seen to act.
    loops = witness.loops()
    samples = session.report.table["step"], session.report.table["basis_step"], session.report.table["loop"]
    reported = {int(step): (int(basis), int(loop)) for step, basis, loop in zip(*samples, strict=True)}
    checked = 0
    for step, basis in loops.items():
        if step in reported:
            assert reported[step] == (basis, sampled_ns[step] - sampled_ns[basis])
            checked += 1
    assert checked > 0.9 * len(loops) > 25


def check_network_bound(session: Session, low_ms: float) -> None:
    """Compare the smallest round-trip time of TCP with the packets; it is at least that of the link."""
    figures = [one for traffic in session.messages(topics.TRAFFIC) for one in traffic.connections]
    packets = [packet for packet in session.witness.packets if packet.from_edge and packet.data]
    repeated = len(packets) - len(without_repeats(packets))
    assert all(one.retransmissions <= repeated for one in figures)
    bounds_us = [one.min_rtt_us for one in figures]
    smallest_us = min(round_trips_ns(session.witness.packets)) / 1e3
    assert bounds_us
    assert low_ms * 1e3 <= min(bounds_us) <= smallest_us + 500


def overruns(session: Session) -> list[tuple[int, float]]:
    """Number and longest, in ms, of the stalls in each event of the edge."""
    events = [event for event in session.messages(topics.EVENT) if event.kind == Event.OVERRUN]
    data = [event.overrun_data for event in events if event.source.startswith("edge/")]
    return [(one.stalls, one.lateness_ns / MS) for one in data]


def test_times_equal_a_packet_capture(lab: RunningLab) -> None:
    session = observe(lab, SECONDS)
    check_against_capture(session)
    check_network_bound(session, 0.0)
    assert not session.commands["basis_on_other_connection"].any()


@pytest.mark.parametrize("stall_ms", [60.0, 200.0] if LONG else [60.0])
def test_stalls_of_the_edge_are_time_of_the_edge(lab: RunningLab, stall_ms: float) -> None:
    """The controller computes for most of its period, so that most stalls begin before its write."""
    session = observe(lab, SECONDS + 0.5, think_ms=8, stall_ms=stall_ms)
    check_against_capture(session)
    commands = session.commands
    edge_ms = (commands["sent_ns"] - commands["write_received_ns"]) / MS
    controller_ms = (commands["write_received_ns"] - commands["state_served_ns"]) / MS
    waiting = sum(bool(begin <= t <= end) for begin, end in session.stalls for t in commands["write_received_ns"])
    assert waiting >= len(session.stalls) / 2
    assert (edge_ms > stall_ms / 2).sum() >= waiting / 3
    # The stop itself is in no time of the controller.
    assert np.percentile(controller_ms, 98) < stall_ms / 2
    # Commands are held while the edge is stopped.
    assert session.report.age_ms is not None
    assert session.report.age_ms.max > stall_ms
    assert "edge_stall" in {reason.code for reason in session.report.reasons}
    stalls = overruns(session)
    # A loaded host may stall the edge once more.
    assert len(session.stalls) <= sum(count for count, _ in stalls) <= len(session.stalls) + 2
    assert stall_ms - 25 <= max(longest_ms for _, longest_ms in stalls) < stall_ms + 40


@pytest.mark.long("takes minutes")
@pytest.mark.parametrize(("low_ms", "high_ms"), [(1.0, 1.0), (4.0, 4.0), (2.0, 8.0)])
def test_network_bound_holds_over_a_delay_line(lab: RunningLab, low_ms: float, high_ms: float) -> None:
    require_delay_line()
    with DelayLine(low_ms / 1e3, high_ms / 1e3) as line:
        session = observe(lab, SECONDS, line=line)
        check_against_capture(session)
        check_network_bound(session, 2 * low_ms)
