"""Why a loop is as slow as it is, in words, each with its evidence.

Every rule is a function from the evidence of a run to a finding, or None where it does not apply. They state what was
measured, what it looks like, and what to do about it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.columns import Rows
from hilrig_replay.run import Run

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
    samples: NDArray[np.void]
    """Shape (n,), fields as `latency.SAMPLE`."""
    step_ns: int
    lateness_ns: NDArray[np.int64]
    """Of every tick, shape (number of states,)."""
    stalls: tuple[tuple[int, int], ...]
    """(time in the run, lateness) of each tick that was late by more than a step."""
    write_ns: NDArray[np.int64]
    """Arrival of every write at the edge, shape (number of commands,)."""
    _windows: list[tuple[Rows, Rows, Rows]] = field(default_factory=list)

    @property
    def cycle_ns(self) -> float:
        """From one write to the next, median; 0: there are not two."""
        return float(np.median(np.diff(self.write_ns))) if len(self.write_ns) > 1 else 0.0

    def windows(self) -> list[tuple[Rows, Rows, Rows]]:
        """States, commands and requests of a few windows of the run, evenly spread."""
        if not self._windows:
            duration = self.run.duration_s
            count = min(WINDOWS, max(1, round(duration / WINDOW_S)))
            for start in np.linspace(0, max(duration - WINDOW_S, 0), count):
                records = self.run.between(float(start), float(start) + WINDOW_S)
                self._windows.append((records.states, records.commands, records.traffic))
        return self._windows


_SHOWN: Final = np.array([180 / np.pi, 180 / np.pi, 1000.0, 180 / np.pi])
"""From rad and m to the registers' degrees and mm."""

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
    if not evidence.stalls:
        return None
    at_ns, worst_ns = max(evidence.stalls, key=lambda stall: stall[1])
    return Finding(
        "simulation_stall",
        f"the simulation stood still {_times(len(evidence.stalls))}, longest {worst_ns / MS:.0f} ms at "
        f"{at_ns / 1e9:.1f} s: its host was too busy, or suspended",
        {"stalls": len(evidence.stalls), "longest_ms": worst_ns / MS, "at_s": at_ns / 1e9},
    )


def edge_stall(evidence: Evidence) -> Finding | None:
    """Requests that waited in the edge for their answer, or writes before they left as commands."""
    waits = [(evidence.samples["edge"], evidence.run.time_ns(evidence.samples))]
    waits += [
        (requests["answered_ns"] - requests["arrived_ns"], evidence.run.time_ns(requests))
        for _, _, requests in evidence.windows()
    ]
    waited_ns = np.concatenate([wait for wait, _ in waits])
    if not len(waited_ns):
        return None
    late = np.flatnonzero(waited_ns > max(EDGE_STALL_NS, 20 * float(np.median(waited_ns))))
    if not late.size:
        return None
    at_ns = np.concatenate([at for _, at in waits])[late]
    worst = int(np.argmax(waited_ns[late]))
    longest_ms = float(waited_ns[late][worst] / MS)
    # Whatever waited for the same stall waited at the same time.
    stalls = 1 + int((np.diff(np.sort(at_ns)) > SAME_STALL_NS).sum())
    at_s = float(at_ns[worst] / 1e9)
    return Finding(
        "edge_stall",
        f"the Modbus edge stood still {_times(stalls)}, longest {longest_ms:.0f} ms at {at_s:.1f} s: what had arrived "
        "waited there, for its host was too busy",
        {"stalls": stalls, "longest_ms": longest_ms, "at_s": at_s},
    )


def injected_delay(evidence: Evidence) -> Finding | None:
    """Delay that was configured."""
    injected = evidence.samples["injected"]
    if not len(injected) or not injected.any():
        return None
    mean = float(injected.mean() / MS)
    return Finding(
        "injected_delay",
        f"{mean:.1f} ms of the loop were added on purpose (impairment), both ways together, up to "
        f"{injected.max() / MS:.1f} ms",
        {"mean_ms": mean, "max_ms": float(injected.max() / MS)},
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
    if not len(evidence.samples):
        return None
    held, loop = float(np.median(evidence.samples["controller"])), float(np.median(evidence.samples["loop"]))
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
    waits = samples["tick_wait"].astype(np.float64)
    low, high = np.percentile(waits, (5, 95))
    if high - low < 0.5 * step:
        return None
    # Towards the nearest: a wait that falls below zero comes back a step higher.
    drift = (np.diff(waits) + step / 2) % step - step / 2
    typical = float(np.median(drift))
    if abs(typical) > 0.15 * step or np.median(np.abs(drift - typical)) > 0.05 * step or abs(typical) < 1e-4 * step:
        return None
    # Most of the way it drifts one way, and comes round at least twice.
    same_way = float(np.mean(np.sign(drift) == np.sign(typical)))
    rounds = int((np.abs(np.diff(waits)) > step / 2).sum())
    if same_way < 0.75 or rounds < 2:
        return None
    between_ns = float(np.median(np.diff(samples["write_arrived_ns"])))
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
    # Polls that saw the same state say nothing about which one was used.
    fresh = np.concatenate(([True], np.diff(commands["basis_step"].astype(np.int64)) > 0))
    commands, at = commands[fresh], at[fresh]
    read = np.round(states["position"][at] * _SHOWN, 2)
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
