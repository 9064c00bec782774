"""Age of the loop: at each step of the simulation, the age t_k − t_b of the state that the acting command answers.

A loop latency is measured once per command. While a command is held, its basis gets older, but no sample shows it, so
a controller or an edge that stops produces few bad samples (coordinated omission). The age is measured at every step
and contains held commands (Age of Loop, arXiv 2106.00415). It runs from the first command of the session's controller
to the end of its use of the rig: the watchdog's trip, the loss of the lease, or the end of the session. A step on which
a watchdog's zero torque, a command without basis or no command acts has no age; it is *uncontrolled*.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.distribution import Statistics, median
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.disk_table import Blocks, DiskTable
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run

NO_AGE: Final = 0
"""Value of `age_ns` at a step whose acting command has no basis, or is not of a controller."""
UNKNOWN: Final = -1
"""Value of `age_ns` at a step whose acting command took effect at a step that is not in the recording."""
AGE_DTYPE: Final = np.dtype(
    [
        ("sampled_ns", "<i8"),
        ("incarnation", "<u8"),
        ("step", "<u8"),
        ("command_seq", "<u8"),
        ("basis_step", "<u8"),
        ("age_ns", "<i8"),
        ("effect_ns", "<i8"),
    ]
)
"""One row per step of a session; times on the clock of the simulation. `command_seq`: number of the acting command, 0:
none; `basis_step`: step of its basis, 0: none; `age_ns`: age, or `NO_AGE` or `UNKNOWN`; `effect_ns`: tick at which the
command took effect."""
OLD_STEPS: Final = (1, 2, 5)
"""Ages, steps, for which the share of older steps is reported."""
MAX_PERIOD_RATIO: Final = 3.0
"""A hold that is longer than the median by more than this factor is a pause, and not part of the control period."""

_HOLD: Final = np.dtype([("ns", "<i8")])


@dataclass(frozen=True, slots=True)
class LoopAge:
    """Age of the loop and holding times of the commands of one run."""

    age_ms: Statistics
    """Over all steps that have an age."""
    control_period_ms: float
    """Mean time from a command's effect to that of the next command, without pauses (`MAX_PERIOD_RATIO`)."""
    longest_hold_ms: float
    """Longest time that one command acted."""
    uncontrolled_share: float
    """Share of the steps without an age, 0 to 1."""
    older_than_steps: dict[str, float]
    """Share of the aged steps whose age exceeds a number of steps, by this number (`OLD_STEPS`)."""


class AgeTracker:
    """Computes the ages of consecutive states."""

    def __init__(self) -> None:
        self._last_state: Rows | None = None
        self._last_row = np.zeros(1, AGE_DTYPE)
        self._basis_ns = UNKNOWN
        """Tick of the basis of the command that acts at the last state, or `NO_AGE` or `UNKNOWN`."""

    def add(self, states: Rows) -> NDArray[np.void]:
        """Ages of the next states, fields as `STATE_DTYPE`, at least one; one row each, fields as `AGE_DTYPE`."""
        changed, hidden = self._changes(states)
        based = states["basis_step"] != 0
        own_ns = np.where(hidden, UNKNOWN, NO_AGE)
        sampled_ns, latency_ns = states["sampled_ns"], states["loop_latency_ns"]
        own_ns[based] = (sampled_ns - latency_ns)[based]
        # Row of the state at which the acting command took effect, from 1; 0: a state of the previous blocks.
        effect = np.maximum.accumulate(np.where(changed, np.arange(1, len(states) + 1), 0))
        basis_ns = np.concatenate(([self._basis_ns], own_ns))[effect]
        rows = np.empty(len(states), AGE_DTYPE)
        for name in ("sampled_ns", "incarnation", "step", "command_seq", "basis_step"):
            rows[name] = states[name]
        rows["effect_ns"] = states["sampled_ns"]
        for name in ("basis_step", "effect_ns"):
            rows[name] = np.concatenate((self._last_row[name], rows[name]))[effect]
        rows["age_ns"] = np.where(basis_ns > 0, states["sampled_ns"] - basis_ns, basis_ns)
        rows["age_ns"][states["safe"]] = NO_AGE
        rows["command_seq"][states["safe"]] = 0
        self._basis_ns = int(basis_ns[-1])
        self._last_state, self._last_row = states[-1:].copy(), rows[-1:].copy()
        return rows

    def _changes(self, states: Rows) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """States whose command is another one than that of the state before, and those where states are missing.

        At a missing state, a command may have taken effect whose basis is not known.
        """
        first = self._last_state is None
        followed = states if self._last_state is None else np.concatenate((self._last_state, states))
        changed = np.zeros(len(followed), np.bool_)
        for name in ("incarnation", "session", "command_seq"):
            changed[1:] |= np.diff(followed[name]) != 0
        hidden = np.zeros(len(followed), np.bool_)
        hidden[1:] = np.diff(followed["sequence"].astype(np.int64)) > 1
        hidden[1:] &= np.diff(followed["incarnation"]) == 0
        if first:
            changed[0], hidden[0] = True, followed["command_seq"][0] > 0
            return changed, hidden
        return changed[1:], hidden[1:]


class AgeTable:
    """Ages of a run, collected block by block; call `finish` after the last block."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._table = DiskTable(AGE_DTYPE)
        self._tracker = AgeTracker()
        self._written: tuple[int, int] | None = None
        """Numbers of the first and the last command that the controller of the session wrote."""
        self._last_written_ns = self._lease_lost_ns = 0
        """Times of the last command and of the last loss of the lease, wall clock of the edge."""
        self._session_ended = False
        self._begin = self._end = 0

    def add(self, block: Records) -> None:
        """Add the states, commands and events of the next block."""
        for event in block.events[np.isin(block.events["kind"], ("LEASE_LOST", "SESSION_END"))]:
            if event["kind"] == "LEASE_LOST":
                self._lease_lost_ns = int(event["wall_ns"])
            elif event["message"].session == self._run.session:
                self._session_ended = True
        written = block.commands[(block.commands["write_arrived_ns"] > 0) & self._in_session(block.commands)]
        if len(written):
            first, last = int(written["seq"].min()), int(written["seq"].max())
            self._written = (first, last) if self._written is None else (min(first, self._written[0]), last)
            self._last_written_ns = int(written["wall_ns"][-1])
        if len(block.states):
            self._table.add(self._tracker.add(block.states)[self._in_use(block.states)])

    def _in_session(self, rows: Rows) -> NDArray[np.bool_]:
        # A manual recording can contain sessions of several controllers.
        if not self._run.controller:
            return np.asarray(rows["session"] != 0)
        return np.asarray(rows["session"] == self._run.names.code(self._run.session))

    def _in_use(self, states: Rows) -> NDArray[np.bool_]:
        # A restarted simulation does not know the session until it receives a command.
        return np.asarray(self._in_session(states) | ((states["session"] == 0) & bool(self._run.controller)))

    def finish(self) -> None:
        """Find the first and the last step of the controller."""
        position, last, begun = 0, np.zeros(1, AGE_DTYPE), False
        first_seq, last_seq = self._written or (1, 0)
        for rows in self._table.blocks(*(AGE_DTYPE.names or ())):
            # Not the zero torque of the edge's watchdog, whose number is higher at the end.
            written = (rows["command_seq"] >= first_seq) & (rows["command_seq"] <= last_seq)
            used = np.flatnonzero((rows["age_ns"] > 0) | (written & (rows["age_ns"] == NO_AGE)))
            if len(used):
                if not begun:
                    begun, self._begin = True, position + int(used[0])
                self._end, last = position + int(used[-1]) + 1, rows[used[-1] :][:1].copy()
            position += len(rows)
        silent_ns = self._silent_ns()
        if silent_ns is None or not self._end:
            return
        limit_ns, excess = int(last["effect_ns"][0]) + silent_ns, 0
        for rows in self.rows("sampled_ns", "incarnation"):
            after = (rows["incarnation"] == last["incarnation"]) & (rows["sampled_ns"] > limit_ns)
            excess += int(after.sum())
        self._end -= excess

    def _silent_ns(self) -> int | None:
        """Time from the last command to the end of the controller's use of the rig; None: the end is not recorded."""
        if self._lease_lost_ns >= self._last_written_ns:
            return self._lease_lost_ns - self._last_written_ns
        # The event of a lease that was lost soon after others is not emitted.
        return 0 if self._session_ended else None

    def rows(self, *names: str) -> Iterator[Rows]:
        """Blocks of the steps from the first command to the end, with the given fields of `AGE_DTYPE`."""
        position = 0
        for rows in self._table.blocks(*names):
            chosen = rows[max(self._begin - position, 0) : max(self._end - position, 0)]
            if len(chosen):
                yield chosen
            position += len(rows)

    def ages_ns(self) -> Iterator[NDArray[np.int64]]:
        """Blocks of the ages of all steps that have one, ns."""
        for rows in self.rows("age_ns"):
            ages = rows["age_ns"][rows["age_ns"] > 0]
            if len(ages):
                yield ages

    def statistics(self) -> LoopAge | None:
        """Age and holding times; None: no command of a controller that is based on a state took effect."""
        aged = uncontrolled = 0
        older = np.zeros(len(OLD_STEPS), np.int64)
        # Ticks are late by some microseconds: half a step of tolerance.
        limits_ns = (np.array(OLD_STEPS) + 0.5) * self._run.step_ns
        for rows in self.rows("age_ns"):
            ages = rows["age_ns"][rows["age_ns"] > 0]
            aged += len(ages)
            uncontrolled += int((rows["age_ns"] == NO_AGE).sum())
            older += (ages[:, np.newaxis] > limits_ns).sum(axis=0)
        if not aged:
            return None
        holds, last_hold_ns = self._holds()
        period_ns, longest_ns = float(self._run.step_ns), last_hold_ns
        if len(holds):
            limit_ns = MAX_PERIOD_RATIO * median(holds.column("ns"))
            regular = np.array([(held.sum(), len(held)) for held in _up_to(limit_ns, holds.column("ns"))])
            # Impossible timestamps of a forged recording leave no regular period.
            if regular[:, 1].sum():
                period_ns = float(regular[:, 0].sum() / regular[:, 1].sum())
            longest_ns = max(longest_ns, *(int(held.max()) for held in holds.column("ns")()))
        return LoopAge(
            age_ms=Statistics.of(self.ages_ns),
            control_period_ms=period_ns / 1e6,
            longest_hold_ms=longest_ns / 1e6,
            uncontrolled_share=uncontrolled / (aged + uncontrolled),
            older_than_steps={str(steps): int(count) / aged for steps, count in zip(OLD_STEPS, older, strict=True)},
        )

    def _holds(self) -> tuple[DiskTable, int]:
        """Times from the effect of each command to its replacement, and the hold of the last command, ns."""
        holds, last = DiskTable(_HOLD), None
        for rows in self.rows("sampled_ns", "incarnation", "age_ns", "effect_ns"):
            followed = rows if last is None else np.concatenate((last, rows))
            age_ns: NDArray[np.int64] = followed["age_ns"]
            effect_ns: NDArray[np.int64] = followed["effect_ns"]
            sampled_ns: NDArray[np.int64] = followed["sampled_ns"]
            aged = age_ns > 0
            replaced = aged[:-1] & (~aged[1:] | (np.diff(effect_ns) != 0))
            replaced &= (np.diff(followed["incarnation"]) == 0) & (age_ns[1:] != UNKNOWN)
            held_ns = sampled_ns[1:] - effect_ns[:-1]
            holds.add(held_ns[replaced].view(_HOLD))
            last = followed[-1:].copy()
        return holds, 0 if last is None else int(last["sampled_ns"][0] - last["effect_ns"][0])


def _up_to(limit_ns: float, blocks: Blocks) -> Iterator[NDArray[np.int64]]:
    return (values[values <= limit_ns] for values in blocks())
