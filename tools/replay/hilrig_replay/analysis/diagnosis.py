"""Diagnosis of the loop latency: rules that explain a high latency, each with its evidence.

A rule is a function from the evidence of a run to a finding, or None if it does not apply. The text of a finding gives
the measured values, the probable cause, and a fix if there is one.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.distribution import Statistics, differences, median, percentiles
from hilrig_replay.analysis.stages import CONTROLLER, EDGE, INJECTED, TICK_WAIT
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.disk_table import DiskTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_sim.arm.joints import JOINT_SCALE

MS: Final = 1e6
EDGE_STALL_THRESHOLD_NS: Final = 5_000_000
"""Minimum response time that counts as a stall: the processing of a request takes less."""
STALL_MERGE_WINDOW_NS: Final = 500_000_000
"""Late responses that are closer together than this belong to one stall."""
WINDOW_S: Final = 10.0
MAX_WINDOWS: Final = 6
"""Maximum number of windows, evenly spread over a run, whose messages are examined."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A probable cause of the latency."""

    kind: str
    text: str
    evidence: dict[str, float]
    """Measured values behind the text, by name with unit."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Measured values of a run that the rules evaluate; times in ns."""

    run: Run
    samples: DiskTable
    """Samples in the order of their states, fields as `SAMPLE_DTYPE`."""
    step_ns: int
    stalls: Stalls
    """Ticks that were late by more than one step."""
    reported_edge_stalls: Stalls
    """Stalls that the edge reported."""
    cycle_ns: float
    """Median time between two writes; 0: fewer than two writes."""
    loop_ms: Statistics | None = None
    """Statistics of the loop latency; None: no samples."""
    stages_ms: Mapping[str, Statistics] = field(default_factory=dict)
    """Statistics of the stages; empty: no samples."""
    _windows: list[Records] = field(default_factory=list)

    def windows(self) -> list[Records]:
        """Messages of up to `MAX_WINDOWS` windows, evenly spread over the run."""
        if not self._windows:
            duration = self.run.duration_s
            count = min(MAX_WINDOWS, max(1, round(duration / WINDOW_S)))
            for start in np.linspace(0, max(duration - WINDOW_S, 0), count):
                self._windows.append(self.run.between(float(start), float(start) + WINDOW_S))
        return self._windows


Floats = NDArray[np.float64]
Rule = Callable[[Evidence], Finding | None]


def diagnose(evidence: Evidence) -> Iterator[Finding]:
    """All findings that apply, in the order of `RULES`."""
    for rule in RULES:
        finding = rule(evidence)
        if finding is not None:
            yield finding


def simulation_stall(evidence: Evidence) -> Finding | None:
    """Ticks that were more than one step late."""
    stalls = evidence.stalls
    if not stalls.count:
        return None
    longest_ms, at_s = stalls.longest_ns / MS, stalls.at_ns / 1e9
    return Finding(
        "simulation_stall",
        f"the simulation stalled {_times(stalls.count)}, longest {longest_ms:.0f} ms at {at_s:.1f} s: its host was "
        "overloaded or suspended",
        {"stalls": stalls.count, "longest_ms": longest_ms, "at_s": at_s},
    )


def edge_stall(evidence: Evidence) -> Finding | None:
    """Stalls of the Modbus edge."""
    stalls = edge_stalls(evidence)
    if not stalls.count:
        return None
    longest_ms, at_s = stalls.longest_ns / MS, stalls.at_ns / 1e9
    return Finding(
        "edge_stall",
        f"the Modbus edge stalled {stalls} (at {at_s:.1f} s), and delayed the requests: its host was overloaded",
        {"stalls": stalls.count, "longest_ms": longest_ms, "at_s": at_s},
    )


def edge_stalls(evidence: Evidence) -> Stalls:
    """Stalls that the edge reported; else late responses, or writes that were published late as commands."""
    if evidence.reported_edge_stalls.count:
        return evidence.reported_edge_stalls
    run, samples = evidence.run, evidence.samples
    requests = [window.traffic for window in evidence.windows() if len(window.traffic)]

    def waits() -> Iterator[tuple[NDArray[np.int64], Rows]]:
        for rows in samples.blocks(EDGE.key, "sampled_ns", "incarnation"):
            yield rows[EDGE.key], rows
        for rows in requests:
            yield rows["answered_ns"] - rows["arrived_ns"], rows

    if not len(samples) and not requests:
        return Stalls()
    limit_ns = max(EDGE_STALL_THRESHOLD_NS, 20 * median(lambda: (waited_ns for waited_ns, _ in waits())))
    longest_ns, at_ns = limit_ns, 0
    for waited_ns, rows in waits():
        worst = int(np.argmax(waited_ns))
        if waited_ns[worst] > longest_ns:
            longest_ns, at_ns = float(waited_ns[worst]), int(run.time_ns(rows[worst : worst + 1])[0])
    if longest_ns == limit_ns:
        return Stalls()

    def late_ns() -> Iterator[NDArray[np.int64]]:
        """Times of the late samples and requests, in chronological order."""
        waits = [run.time_ns(rows)[rows["answered_ns"] - rows["arrived_ns"] > limit_ns] for rows in requests]
        others = np.sort(np.concatenate([np.empty(0, np.int64), *waits]))
        for rows in samples.blocks(EDGE.key, "sampled_ns", "incarnation"):
            time_ns = run.time_ns(rows)
            before = int(np.searchsorted(others, time_ns[-1]))
            yield np.sort(np.concatenate((time_ns[rows[EDGE.key] > limit_ns], others[:before])))
            others = others[before:]
        yield others

    count = 1 + sum(int((apart_ns > STALL_MERGE_WINDOW_NS).sum()) for apart_ns in differences(late_ns)())
    return Stalls(count, int(longest_ns), at_ns)


def injected_delay(evidence: Evidence) -> Finding | None:
    """Delay that was injected by a configured impairment."""
    injected = evidence.stages_ms.get(INJECTED.key)
    if injected is None or not injected.max:
        return None
    return Finding(
        "injected_delay",
        f"the configured impairment adds {injected.mean:.1f} ms to the loop on average, up to {injected.max:.1f} ms "
        "(state link and command link together)",
        {"mean_ms": injected.mean, "max_ms": injected.max},
    )


def slow_polling(evidence: Evidence) -> Finding | None:
    """A controller that writes less often than the simulation steps."""
    cycle, step = evidence.cycle_ns, evidence.step_ns
    if cycle < 1.25 * step:
        return None
    return Finding(
        "slow_polling",
        f"the controller writes every {cycle / MS:.1f} ms, but the simulation steps every {step / MS:g} ms: each "
        f"torque is held for {cycle / step:.1f} steps",
        {"cycle_ms": cycle / MS, "step_ms": step / MS},
    )


def slow_controller(evidence: Evidence) -> Finding | None:
    """A controller with a long time between reading a state and writing a command."""
    if evidence.loop_ms is None or CONTROLLER.key not in evidence.stages_ms:
        # In the client role the edge itself waits between its requests.
        return None
    held, loop = evidence.stages_ms[CONTROLLER.key].p50 * MS, evidence.loop_ms.p50 * MS
    if held < max(0.4 * loop, 5 * MS):
        return None
    cycle = evidence.cycle_ns
    cause = "slow computation in the controller, or a slow network"
    if cycle and held > 0.8 * cycle and cycle > 1.25 * evidence.step_ns:
        cause = "slow computation, or the controller reads right after writing and then waits before the next write"
    return Finding(
        "slow_controller",
        f"{held / MS:.1f} ms of the loop latency of {loop / MS:.1f} ms are between reading the positions and writing "
        f"the torques: {cause}",
        {"controller_ms": held / MS, "loop_ms": loop / MS, "cycle_ms": cycle / MS},
    )


def beating(evidence: Evidence) -> Finding | None:
    """Controller and simulation at nearly the same rate: the wait for the tick drifts over the whole step."""
    samples, step = evidence.samples, evidence.step_ns
    if len(samples) < 50:
        return None
    waits = samples.column(TICK_WAIT.key)
    low, high = percentiles(waits, (5, 95))
    if high - low < 0.5 * step:
        return None
    changes = differences(waits)

    def drifts() -> Iterator[Floats]:
        # Wrapped to ± half a step: the wait jumps by one step when it passes zero.
        return ((change + step / 2) % step - step / 2 for change in changes())

    typical = median(drifts)
    if abs(typical) > 0.15 * step or abs(typical) < 1e-4 * step:
        return None
    if median(lambda: (np.abs(drift - typical) for drift in drifts())) > 0.05 * step:
        return None
    # The drift mostly has one sign, and wraps around at least twice.
    same_way = sum(int((np.sign(drift) == np.sign(typical)).sum()) for drift in drifts()) / (len(samples) - 1)
    rounds = sum(int((np.abs(change) > step / 2).sum()) for change in changes())
    if same_way < 0.75 or rounds < 2:
        return None
    between_ns = median(differences(samples.column("write_arrived_ns")))
    period_s = step / abs(typical) * between_ns / 1e9
    return Finding(
        "beating",
        f"the cycle of the controller ({evidence.cycle_ns / MS:.2f} ms) beats with the step ({step / MS:g} ms): the "
        f"wait for the tick drifts between {low / MS:.1f} and {high / MS:.1f} ms with a period of {period_s:.1f} s",
        {"cycle_ms": evidence.cycle_ns / MS, "period_s": period_s, "low_ms": low / MS, "high_ms": high / MS},
    )


ACK_DELAYS_MS: Final = ((39.0, 46.0), (195.0, 215.0))
"""Ranges of TCP's delayed-acknowledgment timeout: 40 ms on Linux, 200 ms on Windows and many controllers."""
SLOW_NETWORK_SHARE: Final = 0.9
"""Share of delayed requests from which a slow network is a possible cause, too."""


def delayed_acknowledgement(evidence: Evidence) -> Finding | None:
    """Requests that wait for an acknowledgment, because the client delays small segments (Nagle's algorithm)."""
    gaps = []
    for requests in (window.traffic for window in evidence.windows()):
        for controller in np.unique(requests["controller"]):
            mine = requests[requests["controller"] == controller]
            gaps.append((mine["arrived_ns"][1:] - mine["answered_ns"][:-1]) / MS)
    if not gaps:
        return None
    gaps_ms = np.concatenate(gaps)
    for low, high in ACK_DELAYS_MS:
        waited = gaps_ms[(gaps_ms > low) & (gaps_ms < high)]
        if len(waited) < max(10, 0.1 * len(gaps_ms)) or waited.std() > 2.0:
            continue
        share = len(waited) / len(gaps_ms)
        or_network = "" if share < SLOW_NETWORK_SHARE else "; or the network has this round-trip time"
        return Finding(
            "delayed_acknowledgement",
            f"{share:.0%} of the requests arrived {np.median(waited):.1f} ms after the previous response, which is "
            "TCP's delayed-acknowledgment timeout: set TCP_NODELAY in the controller, and send each request with one "
            f"call{or_network}",
            {"share": share, "wait_ms": float(np.median(waited))},
        )
    return None


def previous_poll(evidence: Evidence) -> Finding | None:
    """Torques that are computed from the state of the previous poll: a pipeline delay of one cycle."""
    found = [residuals for window in evidence.windows() for residuals in _residuals(window.states, window.commands)]
    if len(found) < 3:
        return None
    newest, previous = np.median(np.array(found), axis=0)
    ratio = float(np.median([just_read / max(before, 1e-12) for just_read, before in found]))
    if previous > 0.05 or ratio < 3:
        return None
    cycle = evidence.cycle_ns
    return Finding(
        "previous_poll",
        f"the torques fit the positions of the previous poll {ratio:.0f} times better than the positions just read: "
        f"the controller is one cycle behind, which adds {cycle / MS:.1f} ms to the measured latency",
        {
            "unexplained_previous": float(previous),
            "unexplained_newest": float(newest),
            "ratio": ratio,
            "added_ms": cycle / MS,
        },
    )


def _residuals(states: Rows, commands: Rows, length: int = 24) -> list[tuple[float, float]]:
    """Unexplained share of the torques for a linear control law on the newest poll, and on the previous poll.

    The law of a joint uses its positions at two polls (and so a derivative) and a slow trend, and is fitted to each
    block of `length` commands. Positions are rounded like the registers: the quantization noise is in the torques of
    the controller and shows which poll they were computed from.
    """
    commands = commands[(commands["basis_step"] > 0) & ~commands["safe"]]
    if len(commands) < length or not len(states):
        return []
    at = np.minimum(np.searchsorted(states["step"], commands["basis_step"]), len(states) - 1)
    known = states["step"][at] == commands["basis_step"]
    commands, at = commands[known], at[known]
    if len(commands) < length:
        return []
    # Polls that returned the same state can't be distinguished.
    fresh = np.concatenate(([True], np.diff(commands["basis_step"].astype(np.int64)) > 0))
    commands, at = commands[fresh], at[fresh]
    read = np.round(states["position"][at] * JOINT_SCALE, 2)
    slow = np.vander(np.linspace(-1, 1, length), 4)
    found = []
    for start in range(2, len(commands) - length + 1, length):
        rows = np.arange(start, start + length)
        torques = commands["effort"][rows]
        spread = ((torques - torques.mean(axis=0)) ** 2).sum()
        if spread < 1e-9:
            continue
        unexplained = [
            sum(_unexplained(read[rows - lag, j], read[rows - lag - 1, j], slow, torques[:, j]) for j in range(4))
            / spread
            for lag in (0, 1)
        ]
        found.append((unexplained[0], unexplained[1]))
    return found


def _unexplained(newer: Floats, older: Floats, slow: Floats, torque: Floats) -> float:
    """Residual sum of squares of a joint's torque for the best linear law."""
    law = np.column_stack((newer - newer.mean(), newer - older, slow))
    fitted, *_ = np.linalg.lstsq(law, torque, rcond=None)
    return float(((torque - law @ fitted) ** 2).sum())


RULES: Final[tuple[Rule, ...]] = (
    simulation_stall,
    edge_stall,
    injected_delay,
    previous_poll,
    slow_controller,
    slow_polling,
    beating,
    delayed_acknowledgement,
)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
