"""Data-quality checks: whether a recording is valid for latency measurements, and the reasons if it is not."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.age import LoopAge
from hilrig_replay.analysis.distribution import Statistics, median
from hilrig_replay.analysis.stages import ALL_STAGES
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.disk_table import Blocks, DiskTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Losses, Run
from hilrig_replay.io.sequence_order import Repairs
from hilrig_sim.arm.stability import ERROR_BOUND

MIN_SAMPLES: Final = 500
"""Required number of samples; with fewer, p99 depends on fewer than five samples."""
MAX_UNCONTROLLED_SHARE: Final = 0.01
"""Largest share of steps without an age."""
MAX_HELD_PERIODS: Final = 3
"""Control periods by which the p99 of the age may exceed that of the loop latency, beside one step."""
MIN_READ_SHARE: Final = 0.01
"""Smallest ratio of states that were read to samples: a controller that reads once and then only writes is no loop."""
MIN_MISSING_BASES: Final = 5
"""Number of bases before the first state that shows that the beginning is missing: a controller may have read once,
long before its first write."""
MAX_BACKLOG_NS: Final = 1_000_000_000
"""Maximum variation of the time between the sending of a state and its arrival at the recorder."""
WALL_CLOCK_STEP_NS: Final = 10_000_000
"""Change of wall clock minus monotonic clock between two states that counts as a clock step; slewing changes it by
microseconds."""
MIN_STARVED_SHARE: Final = 0.5
"""Smallest part of a stall without a processor from which the other programs of the host are its cause."""

_TICK: Final = np.dtype([("lateness_ns", "<i8")])
_WRITE: Final = np.dtype([("cycle_ns", "<i8")])


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason why a recording is not valid for latency measurements."""

    code: str
    """Machine-readable: a word that does not change."""
    text: str
    """Human-readable, with the measured values."""


NO_CONTROLLER: Final = Reason("no_controller", "no closed loop: no controller wrote commands in this session")
NO_LOOP: Final = Reason(
    "no_loop", "no closed loop: no torque was applied that a controller wrote after it had read a state"
)
NO_SAMPLES: Final = (NO_CONTROLLER, NO_LOOP)
OPEN_LOOP: Final = Reason(
    "open_loop",
    "open loop: positions were read on another connection than torques were written, and the torques do not follow "
    "these positions",
)
NO_ECHO: Final = Reason(
    "no_echo",
    "the controller has no echo register: its program is not supervised, and the latency is a lower bound, because the "
    "torques may answer older positions than those that it had",
)


@dataclass(frozen=True, slots=True)
class Lost:
    """Number of messages that are missing in a recording."""

    transport: int
    """Lost in transport to the recorder."""
    recorder: int
    """Lost in the recorder."""
    file: int = 0
    """Lost in the damaged file."""

    @property
    def total(self) -> int:
        """Sum of all losses."""
        return self.transport + self.recorder + self.file


@dataclass(frozen=True, slots=True)
class Stalls:
    """Times in which a service did nothing although it had work; of the simulation: ticks late by more than a step."""

    count: int = 0
    longest_ns: int = 0
    at_ns: int = 0
    """Time of the longest stall, from the first state of the run."""
    shortest_ns: int = 0
    """0: not known."""
    area_ns2: float = 0.0
    """Integral over time of the age that grew during the stalls: half the sum of their squared lengths."""
    run_delay_ns: int = 0
    """Part of the longest stall in which the service was ready to run and had no processor."""
    starved_area_ns2: float = 0.0
    """`area_ns2` of the stalls of which this part is at least `MIN_STARVED_SHARE`."""

    @property
    def starved(self) -> bool:
        """Whether the stalls are above all times without a processor."""
        return self.count > 0 and self.starved_area_ns2 >= 0.5 * self.area_ns2

    def __add__(self, other: "Stalls") -> "Stalls":
        """All stalls of both."""
        longest = other if other.longest_ns > self.longest_ns else self
        return replace(
            longest,
            count=self.count + other.count,
            shortest_ns=min(filter(None, (self.shortest_ns, other.shortest_ns)), default=0),
            area_ns2=self.area_ns2 + other.area_ns2,
            starved_area_ns2=self.starved_area_ns2 + other.starved_area_ns2,
        )

    def __str__(self) -> str:
        """Count and length as text."""
        if self.count == 1:
            return f"once, {self.longest_ns / 1e6:.0f} ms"
        if self.shortest_ns >= 0.75 * self.longest_ns:
            return f"{self.count} times, {self.longest_ns / 1e6:.0f} ms each"
        if self.shortest_ns:
            return f"{self.count} times, {self.shortest_ns / 1e6:.0f} to {self.longest_ns / 1e6:.0f} ms"
        return f"{self.count} times, longest {self.longest_ns / 1e6:.0f} ms"


def tick_lateness_ns(states: Rows, step_ns: int) -> NDArray[np.int64]:
    """Lateness of each tick against its original deadline, ns, shape (n,).

    After a stall the simulation skips the missed deadlines, and the recorded `lateness_ns` refers to the next deadline.
    """
    return np.asarray(states["lateness_ns"] + states["missed_steps"].astype(np.int64) * step_ns)


class DataQuality:
    """Data-quality checks of a recording, computed block by block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._ticks, self._writes = DiskTable(_TICK), DiskTable(_WRITE)
        self.stalls = Stalls()
        self.edge_stalls = Stalls()
        """Stalls that the edge itself reported; older versions do not report them."""
        self._edge_overruns = 0
        self.repairs = Repairs()
        self._samples = self._negative = self._written = 0
        self._gaps = 0
        self._missed = 0
        self._delay_ns: tuple[int, int] | None = None
        self._clock_steps = 0
        self._last_state: Rows | None = None
        self._last_command: Rows | None = None
        self._last_write_ns = np.empty(0, np.int64)
        self._read = dict.fromkeys(("state", "command", "event"), 0)
        self._dropped_commands = 0
        """Commands that have a number, but were not sent: the emulated network dropped them."""
        self.bases, self._last_basis = 0, -1
        """Number of different bases of the samples, and the basis of the last sample."""
        self._first_step: tuple[int, int] | None = None
        """Incarnation and step of the first state."""
        self._early_bases: set[int] = set()
        """Bases of commands before the first state; at most `MIN_MISSING_BASES`."""
        self._restarts = 0
        self._inaccurate_steps = 0
        self._largest_error = np.zeros(4)
        self._session_ended = False
        self._tripped = False
        self.watchdog_gaps = 0
        """Trips of the watchdog after which the controller wrote again."""

    def add(self, block: Records, samples: Rows) -> None:
        """Add the next block and its samples, fields as `SAMPLE_DTYPE`."""
        states, commands = block.states, block.commands
        for topic, rows in (("state", states), ("command", commands), ("event", block.events)):
            self._read[topic] += len(rows)
        if len(states):
            self._add_states(states)
        if len(commands):
            self._add_commands(commands)
        self._add_events(block.events)
        self._samples += len(samples)
        if len(samples):
            bases = samples["basis_step"].astype(np.int64)
            self.bases += int((np.diff(bases, prepend=self._last_basis) != 0).sum())
            self._last_basis = int(bases[-1])
        self._negative += sum(int((samples[stage.key] < 0).sum()) for stage in ALL_STAGES)

    def _add_commands(self, commands: Rows) -> None:
        self._gaps += _gaps(commands, self._last_command)
        followed = commands if self._last_command is None else np.concatenate((self._last_command, commands))
        numbers, sent = (np.diff(followed[name].astype(np.int64)) for name in ("seq", "sequence"))
        self._dropped_commands += int((numbers - sent)[(sent > 0) & (numbers > sent)].sum())
        self._last_command = commands[-1:].copy()
        if self._first_step is not None and len(self._early_bases) < MIN_MISSING_BASES:
            incarnation, step = self._first_step
            bases = commands["basis_step"][commands["basis_incarnation"] == incarnation]
            self._early_bases.update(bases[(bases > 0) & (bases < step)][:MIN_MISSING_BASES].tolist())
        # Internal commands of the edge were not written by a controller.
        written = commands["write_arrived_ns"][~commands["safe"]]
        self._written += len(written)
        write_ns = np.concatenate((self._last_write_ns, written))
        self._writes.add(np.diff(write_ns).view(_WRITE))
        self._last_write_ns = write_ns[-1:].copy()

    def _add_states(self, states: Rows) -> None:
        lateness = tick_lateness_ns(states, self._run.step_ns)
        self._ticks.add(lateness.view(_TICK))
        self._missed += int(states["missed_steps"].sum())
        self._add_stalls(states, lateness)
        delay = states["log_ns"] - states["wall_ns"]
        low, high = int(delay.min()), int(delay.max())
        if self._delay_ns is not None:
            low, high = min(low, self._delay_ns[0]), max(high, self._delay_ns[1])
        self._delay_ns = (low, high)
        followed = states if self._last_state is None else np.concatenate((self._last_state, states))
        if self._first_step is None:
            self._first_step = (int(states["incarnation"][0]), int(states["step"][0]))
        same = np.diff(followed["incarnation"]) == 0
        self._restarts += int((~same & self._in_session(followed[:-1])).sum())
        self._add_errors(states)
        wall_ns: NDArray[np.int64] = followed["wall_ns"]
        sampled_ns: NDArray[np.int64] = followed["sampled_ns"]
        drift = np.abs(np.diff(wall_ns - sampled_ns))
        self._clock_steps += int((drift[same] > WALL_CLOCK_STEP_NS).sum())
        self._gaps += _gaps(states, self._last_state)
        self._last_state = states[-1:].copy()

    def _in_session(self, states: Rows) -> NDArray[np.bool_]:
        if not self._run.controller:
            return np.ones(len(states), np.bool_)
        return np.asarray(states["session"] == self._run.names.code(self._run.session))

    def _add_errors(self, states: Rows) -> None:
        error = np.abs(states["integration_error"])
        self._inaccurate_steps += int((error > ERROR_BOUND).any(axis=1).sum())
        self._largest_error = np.maximum(self._largest_error, error.max(axis=0))

    def _add_events(self, events: Rows) -> None:
        for event in events:
            message = event["message"]
            if event["kind"] == "SESSION_END":
                self._session_ended |= message.session == self._run.session
            elif event["kind"] == "WATCHDOG_TRIP":
                self._tripped = message.session == self._run.session
            elif event["kind"] == "WATCHDOG_REARM":
                self.watchdog_gaps += self._tripped
                self._tripped = False
            elif event["kind"] == "OVERRUN" and event["source"].startswith("edge/"):
                data, stalled_ns = message.overrun_data, message.overrun_data.lateness_ns
                at_ns = int(event["wall_ns"]) - self._run.start_wall_ns - stalled_ns
                # Stalls within a second are one event.
                count = max(1, data.stalls)
                area_ns2 = count * float(stalled_ns) ** 2 / 2
                starved_area_ns2 = area_ns2 * (data.run_delay_ns >= MIN_STARVED_SHARE * stalled_ns)
                self.edge_stalls += Stalls(
                    count, stalled_ns, at_ns, stalled_ns, area_ns2, data.run_delay_ns, starved_area_ns2
                )
                self._edge_overruns += 1

    def _add_stalls(self, states: Rows, lateness: NDArray[np.int64]) -> None:
        late = lateness > self._run.step_ns
        if not late.any():
            return
        worst = int(np.argmax(lateness))
        areas_ns2 = lateness[late].astype(np.float64) ** 2 / 2
        starved = states["run_delay_ns"][late] >= MIN_STARVED_SHARE * lateness[late]
        self.stalls += Stalls(
            int(late.sum()),
            int(lateness[worst]),
            int(self._run.time_ns(states[worst : worst + 1])[0]),
            area_ns2=float(areas_ns2.sum()),
            run_delay_ns=int(states["run_delay_ns"][worst]),
            starved_area_ns2=float(areas_ns2[starved].sum()),
        )

    @property
    def latenesses_ns(self) -> Blocks:
        """Lateness of all ticks, ns."""
        return self._ticks.column("lateness_ns")

    def cycle_ns(self) -> float:
        """Median time between two writes of a controller at the edge, ns; 0: fewer than two writes."""
        return median(self._writes.column("cycle_ns")) if len(self._writes) else 0.0

    def lost(self) -> Lost:
        """Lost messages: those that the recording counts, and those that gaps in the sequence numbers show."""
        counted = self._run.losses or Losses(0, 0)
        file = counted.file + self._unreadable()
        uncounted = max(0, self._gaps - counted.transport - counted.recorder - file)
        if self._run.damaged:
            return Lost(counted.transport, counted.recorder, file + uncounted)
        return Lost(counted.transport + uncounted, counted.recorder, file)

    def _unreadable(self) -> int:
        """Messages that the file's own statistics count, but that were not found in it."""
        counts, duplicates = self._run.file.counts, self.repairs.duplicates
        return max(0, sum(counts[topic] - count for topic, count in self._read.items()) - duplicates)

    def reasons(
        self, unmatched: int, loop_ms: Statistics | None, age: LoopAge | None, edge_stalls: Stalls
    ) -> Iterator[Reason]:
        """Reasons why the recording is not valid for latency measurements; empty if it is valid.

        Args:
            unmatched: number of samples whose command is not in the recording.
            loop_ms: loop latency; None: no samples.
            age: age of the loop; None: no command of a controller had a basis.
            edge_stalls: stalls of the edge, reported by it or found in the request log.
        """
        yield from self._incomplete()
        yield from self._disturbed(edge_stalls)
        if unmatched:
            text = f"the commands of {_count(unmatched, 'sample')} are not in the recording"
            yield Reason("missing_commands", text)
        if self._negative:
            text = f"{_count(self._negative, 'negative stage duration')}: the timestamps contradict each other"
            yield Reason("negative_stages", text)
        if loop_ms is not None and age is not None:
            yield from self._omitted(loop_ms, age)
        if self.bases < MIN_READ_SHARE * self._samples:
            read = _count(self.bases, "state")
            text = f"{_count(self._samples, 'command')} are based on {read}: the controller writes without reading"
            yield Reason("few_reads", text)
        if not self._samples and not unmatched:
            yield NO_LOOP if self._written else NO_CONTROLLER
        elif self._samples < MIN_SAMPLES:
            text = f"only {_count(self._samples, 'sample')}: {MIN_SAMPLES} are required for a 99th percentile"
            if age is not None:
                period_ms = age.control_period_ms
                needed_s = math.ceil(MIN_SAMPLES * period_ms / 1e3)
                text += f": record {needed_s} s or longer at your {period_ms:.0f} ms period"
            yield Reason("too_few_samples", text)

    def _incomplete(self) -> Iterator[Reason]:
        """Reasons why messages are missing."""
        run, lost = self._run, self.lost()
        if lost.transport:
            yield Reason("lost_transport", f"{_count(lost.transport, 'message')} lost in transport to the recorder")
        if lost.recorder:
            yield Reason("lost_recorder", f"{_count(lost.recorder, 'message')} lost in the recorder")
        if lost.file and run.damaged:
            yield Reason("lost_file", f"{_count(lost.file, 'message')} lost in the damaged file")
        elif lost.file:
            text = f"{_count(lost.file, 'message')} missing in the file: it counts more than it contains"
            yield Reason("missing_messages", text)
        if run.losses is None:
            text = "unknown number of lost messages: the recording was not closed properly"
            yield Reason("not_closed", text)
        if run.truncated:
            yield Reason("truncated", "the file was truncated: messages at its end are missing, or can be")
        elif run.metadata.get("hilrig.summary", {}).get("ended") == "ended" and not self._session_ended:
            yield Reason("missing_end", "the end of the session is missing: the file does not contain its event")
        if len(self._early_bases) >= MIN_MISSING_BASES:
            text = "the beginning is missing: commands are based on states before the first one of the file"
            yield Reason("missing_beginning", text)

    def _disturbed(self, edge_stalls: Stalls) -> Iterator[Reason]:
        """Reasons why the services did not run undisturbed."""
        run = self._run
        yield from self._restarted()
        # The recorder counts the events of all services.
        overruns = max(self.stalls.count, (run.number("summary", "overruns") or 0) - self._edge_overruns)
        if overruns:
            steps = f"{_count(self._missed, 'step')} missed, at most {self.stalls.longest_ns / 1e6:.0f} ms late"
            yield Reason("simulation_stall", f"{_count(overruns, 'overrun')} of the simulation, {steps}")
        if edge_stalls.longest_ns > run.step_ns:
            yield Reason("edge_stall", f"edge stalled {edge_stalls}")
        if self._delay_ns is not None and self._delay_ns[1] - self._delay_ns[0] > MAX_BACKLOG_NS:
            backlog_s = (self._delay_ns[1] - self._delay_ns[0]) / 1e9
            yield Reason("recorder_stall", f"the recorder lagged by up to {backlog_s:.1f} s")
        clock_steps = max(self._clock_steps, run.number("summary", "clock_steps") or 0)
        if clock_steps:
            yield Reason("clock_step", f"{_count(clock_steps, 'step')} of the wall clock during the run")
        if self._inaccurate_steps:
            joint = int(np.argmax(self._largest_error / ERROR_BOUND))
            error, unit = self._largest_error[joint], "mm" if joint == 2 else "°"
            largest = error * 1e3 if joint == 2 else np.degrees(error)
            text = f"{_count(self._inaccurate_steps, 'step')} with an integration error above 0.1° or 0.1 mm"
            yield Reason("integration_error", f"{text}, up to {largest:.2f} {unit} (joint {joint + 1})")

    def _restarted(self) -> Iterator[Reason]:
        """Reasons for the services that were started during the session."""
        run = self._run
        session_ns = run.number("session", "start_wall_ns") or 0
        incarnations: dict[str, list[int]] = {}
        for name, source in run.metadata.items():
            if name.startswith("hilrig.source"):
                # The incarnation of a service is the wall clock at its start.
                started_ns = run.number(name.removeprefix("hilrig."), "incarnation") or 0
                incarnations.setdefault(source.get("source", ""), []).append(started_ns)
        restarts = {
            name: (sum(started_ns > session_ns for started_ns in found), len(found))
            for name, found in incarnations.items()
            if session_ns
        }
        if self._restarts and not any(count for name, (count, _) in restarts.items() if name.startswith("sim/")):
            restarts["the simulation"] = (self._restarts, self._restarts + 1)
        for name, (count, total) in restarts.items():
            if count:
                verb = "restarted" if total > 1 else "started"
                times = f" ({count} times)" if count > 1 else ""
                yield Reason("restart", f"{name} was {verb} during the session{times}")

    def _omitted(self, loop_ms: Statistics, age: LoopAge) -> Iterator[Reason]:
        """Reasons why the samples do not represent the run."""
        if age.uncontrolled_share > MAX_UNCONTROLLED_SHARE:
            text = f"no command with a basis acted on {age.uncontrolled_share:.1%} of the steps"
            yield Reason("uncontrolled", text)
        expected_ms = loop_ms.p99 + MAX_HELD_PERIODS * age.control_period_ms + self._run.step_ns / 1e6
        # Emulated losses are pauses on purpose.
        if age.age_ms.p99 > expected_ms and not self._dropped_commands:
            text = (
                f"the age of the acting torque (p99 {age.age_ms.p99:.0f} ms) does not follow from the loop latency "
                f"(p99 {loop_ms.p99:.0f} ms) and the control period of {age.control_period_ms:.0f} ms: pauses, the "
                f"longest {age.longest_hold_ms:.0f} ms"
            )
            yield Reason("age_inconsistent", text)


def _gaps(rows: Rows, last: Rows | None) -> int:
    """Number of messages missing in the sequence numbers; a restart of the numbering is a restart of the sender."""
    sequence = (rows if last is None else np.concatenate((last, rows)))["sequence"].astype(np.int64)
    steps = np.diff(sequence)
    return int((steps[steps > 1] - 1).sum())


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
