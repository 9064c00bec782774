"""Why a loop is as slow as it is, in words, each with its evidence.

Every rule is a function from the evidence of a run to a finding, or None where it does not apply. They state what was
measured, what it looks like, and what to do about it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.disk_table import Spool
from hilrig_replay.analysis.distribution import Statistics, differences, median, percentiles
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.run import Run
from hilrig_sim.arm.model import JOINT_SCALE

MS: Final = 1e6
EDGE_STALL_NS: Final = 5_000_000
"""An answer that takes longer is not its own work any more."""
SAME_STALL_NS: Final = 500_000_000
WINDOW_S: Final = 10.0
WINDOWS: Final = 6
"""What needs the content of messages looks at so many windows of a run, evenly spread, whatever its length."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that explains where the time goes."""

    kind: str
    text: str
    evidence: dict[str, float]
    """The figures that the text rests on, by name with the unit."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the rules look at; times in ns."""

    run: Run
    samples: Spool
    """In their order, fields as `samples.SAMPLE`."""
    loop_ms: Statistics | None
    """Of the samples; None: there are none."""
    stages_ms: Mapping[str, Statistics]
    """Of the samples' stages; none where there are no samples."""
    step_ns: int
    stalls: Stalls
    """Ticks that were late by more than a step."""
    cycle_ns: float
    """From one write to the next, median; 0: there are not two."""
    _windows: list[tuple[Rows, Rows, Rows]] = field(default_factory=list)

    def windows(self) -> list[tuple[Rows, Rows, Rows]]:
        """States, commands and requests of a few windows of the run, evenly spread."""
        if not self._windows:
            duration = self.run.duration_s
            count = min(WINDOWS, max(1, round(duration / WINDOW_S)))
            for start in np.linspace(0, max(duration - WINDOW_S, 0), count):
                records = self.run.between(float(start), float(start) + WINDOW_S)
                self._windows.append((records.states, records.commands, records.traffic))
        return self._windows


Floats = NDArray[np.float64]
Rule = Callable[[Evidence], Finding | None]


def diagnose(evidence: Evidence) -> Iterator[Finding]:
    """Every finding that applies, the most telling first."""
    for rule in RULES:
        finding = rule(evidence)
        if finding is not None:
            yield finding


def simulation_stall(evidence: Evidence) -> Finding | None:
    """Ticks that came more than a step late."""
    stalls = evidence.stalls
    if not stalls.count:
        return None
    longest_ms, at_s = stalls.longest_ns / MS, stalls.at_ns / 1e9
    return Finding(
        "simulation_stall",
        f"the simulation stood still {_times(stalls.count)}, longest {longest_ms:.0f} ms at {at_s:.1f} s: its host "
        "was too busy, or suspended",
        {"stalls": stalls.count, "longest_ms": longest_ms, "at_s": at_s},
    )


def edge_stall(evidence: Evidence) -> Finding | None:
    """Requests that waited in the edge for their answer, or writes before they left as commands."""
    run, samples = evidence.run, evidence.samples
    requests = [requests for _, _, requests in evidence.windows() if len(requests)]

    def waits() -> Iterator[tuple[NDArray[np.int64], Rows]]:
        for rows in samples.blocks("edge", "sampled_ns", "incarnation"):
            yield rows["edge"], rows
        for rows in requests:
            yield rows["answered_ns"] - rows["arrived_ns"], rows

    if not len(samples) and not requests:
        return None
    limit_ns = max(EDGE_STALL_NS, 20 * median(lambda: (waited_ns for waited_ns, _ in waits())))
    longest_ns, at_ns = limit_ns, 0
    for waited_ns, rows in waits():
        worst = int(np.argmax(waited_ns))
        if waited_ns[worst] > longest_ns:
            longest_ns, at_ns = float(waited_ns[worst]), int(run.time_ns(rows[worst : worst + 1])[0])
    if longest_ns == limit_ns:
        return None

    def late_ns() -> Iterator[NDArray[np.int64]]:
        """When something waited, samples and requests together in the order of their time."""
        waits = [run.time_ns(rows)[rows["answered_ns"] - rows["arrived_ns"] > limit_ns] for rows in requests]
        others = np.sort(np.concatenate([np.empty(0, np.int64), *waits]))
        for rows in samples.blocks("edge", "sampled_ns", "incarnation"):
            time_ns = run.time_ns(rows)
            before = int(np.searchsorted(others, time_ns[-1]))
            yield np.sort(np.concatenate((time_ns[rows["edge"] > limit_ns], others[:before])))
            others = others[before:]
        yield others

    # Whatever waited for the same stall waited at the same time.
    stalls = 1 + sum(int((apart_ns > SAME_STALL_NS).sum()) for apart_ns in differences(late_ns)())
    longest_ms, at_s = longest_ns / MS, at_ns / 1e9
    return Finding(
        "edge_stall",
        f"the Modbus edge stood still {_times(stalls)}, longest {longest_ms:.0f} ms at {at_s:.1f} s: what had arrived "
        "waited there, for its host was too busy",
        {"stalls": stalls, "longest_ms": longest_ms, "at_s": at_s},
    )


def injected_delay(evidence: Evidence) -> Finding | None:
    """Delay that was configured."""
    injected = evidence.stages_ms.get("injected")
    if injected is None or not injected.max:
        return None
    return Finding(
        "injected_delay",
        f"{injected.mean:.1f} ms of the loop were added on purpose (impairment), both ways together, up to "
        f"{injected.max:.1f} ms",
        {"mean_ms": injected.mean, "max_ms": injected.max},
    )


def slow_polling(evidence: Evidence) -> Finding | None:
    """A controller that writes less often than the simulation steps."""
    cycle, step = evidence.cycle_ns, evidence.step_ns
    if cycle < 1.25 * step:
        return None
    return Finding(
        "slow_polling",
        f"the controller writes every {cycle / MS:.1f} ms, the simulation steps every {step / MS:g} ms: each torque is "
        f"held for {cycle / step:.1f} steps, and in between nothing reacts",
        {"cycle_ms": cycle / MS, "step_ms": step / MS},
    )


def slow_controller(evidence: Evidence) -> Finding | None:
    """A controller that keeps a state for a long time before it writes."""
    if evidence.loop_ms is None:
        return None
    held, loop = evidence.stages_ms["controller"].p50 * MS, evidence.loop_ms.p50 * MS
    if held < max(0.4 * loop, 5 * MS):
        return None
    cycle = evidence.cycle_ns
    why = "it computes for so long, or its network is slow"
    if cycle and held > 0.8 * cycle and cycle > 1.25 * evidence.step_ns:
        why = "it computes for so long, or reads right after writing and waits before the next write"
    return Finding(
        "slow_controller",
        f"{held / MS:.1f} ms of the loop's {loop / MS:.1f} ms pass between reading the positions and writing the "
        f"torques: {why}",
        {"controller_ms": held / MS, "loop_ms": loop / MS, "cycle_ms": cycle / MS},
    )


def beating(evidence: Evidence) -> Finding | None:
    """Controller and simulation at nearly the same rate: the wait for the tick drifts through the whole step."""
    samples, step = evidence.samples, evidence.step_ns
    if len(samples) < 50:
        return None
    waits = samples.column("tick_wait")
    low, high = percentiles(waits, (5, 95))
    if high - low < 0.5 * step:
        return None
    changes = differences(waits)

    def drifts() -> Iterator[Floats]:
        # Towards the nearest: a wait that falls below zero comes back a step higher.
        return ((change + step / 2) % step - step / 2 for change in changes())

    typical = median(drifts)
    if abs(typical) > 0.15 * step or abs(typical) < 1e-4 * step:
        return None
    if median(lambda: (np.abs(drift - typical) for drift in drifts())) > 0.05 * step:
        return None
    # Most of the way it drifts one way, and comes round at least twice.
    same_way = sum(int((np.sign(drift) == np.sign(typical)).sum()) for drift in drifts()) / (len(samples) - 1)
    rounds = sum(int((np.abs(change) > step / 2).sum()) for change in changes())
    if same_way < 0.75 or rounds < 2:
        return None
    between_ns = median(differences(samples.column("write_arrived_ns")))
    period_s = step / abs(typical) * between_ns / 1e9
    return Finding(
        "beating",
        f"the controller's cycle ({evidence.cycle_ns / MS:.2f} ms) beats with the step ({step / MS:g} ms): the wait "
        f"for the tick drifts from {low / MS:.1f} to {high / MS:.1f} ms, once in {period_s:.1f} s",
        {"cycle_ms": evidence.cycle_ns / MS, "period_s": period_s, "low_ms": low / MS, "high_ms": high / MS},
    )


ACK_DELAYS_MS: Final = ((39.0, 46.0), (195.0, 215.0))
"""After so long TCP acknowledges on its own: 40 ms on Linux, 200 ms on Windows and many controllers."""
ALL_LATE: Final = 0.9


def delayed_acknowledgement(evidence: Evidence) -> Finding | None:
    """Requests that wait for an acknowledgement, because the client holds small segments back (Nagle's algorithm)."""
    gaps = []
    for _, _, requests in evidence.windows():
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
        # Where every request comes so late, the way itself may be that long.
        or_far = "" if share < ALL_LATE else "; or else its network is that slow, both ways together"
        return Finding(
            "delayed_acknowledgement",
            f"{share:.0%} of the requests came {np.median(waited):.1f} ms after the answer before them, the time after "
            "which TCP acknowledges on its own: set TCP_NODELAY in the controller, and send each request in one piece"
            + or_far,
            {"share": share, "wait_ms": float(np.median(waited))},
        )
    return None


def previous_poll(evidence: Evidence) -> Finding | None:
    """Torques that follow the state of the poll before the one just served: a pipeline of one cycle."""
    found = [residuals for states, commands, _ in evidence.windows() for residuals in _residuals(states, commands)]
    if len(found) < 3:
        return None
    newest, previous = np.median(np.array(found), axis=0)
    ratio = float(np.median([just_read / max(before, 1e-12) for just_read, before in found]))
    if previous > 0.05 or ratio < 3:
        return None
    cycle = evidence.cycle_ns
    return Finding(
        "previous_poll",
        f"the torques follow the positions of the poll before, which explain them {ratio:.0f} times better than those "
        f"just read: the controller works a cycle behind, which adds {cycle / MS:.1f} ms to what is measured here",
        {
            "unexplained_previous": float(previous),
            "unexplained_newest": float(newest),
            "ratio": ratio,
            "added_ms": cycle / MS,
        },
    )


def _residuals(states: Rows, commands: Rows, length: int = 24) -> list[tuple[float, float]]:
    """What a linear law leaves unexplained of the torques, given the positions just read, and those of a poll before.

    The law of a joint has its positions of two polls (so a derivative is in it) and a slow change in time, and is
    fitted anew over every `length` commands. Positions are rounded as the registers round them: that noise is in the
    controller's torques, and tells which poll they came from.
    """
    commands = commands[(commands["basis_step"] > 0) & ~commands["safe"]]
    if len(commands) < length or not len(states):
        return []
    at = np.minimum(np.searchsorted(states["step"], commands["basis_step"]), len(states) - 1)
    known = states["step"][at] == commands["basis_step"]
    commands, at = commands[known], at[known]
    if len(commands) < length:
        return []
    # Polls that saw the same state say nothing about which one was used.
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
        left = [
            sum(_unexplained(read[rows - lag, j], read[rows - lag - 1, j], slow, torques[:, j]) for j in range(4))
            / spread
            for lag in (0, 1)
        ]
        found.append((left[0], left[1]))
    return found


def _unexplained(newer: Floats, older: Floats, slow: Floats, torque: Floats) -> float:
    """Sum of squares that the best law leaves of a joint's torque."""
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
