"""Samples of the loop latency: the states at which a new command took effect, each with the stages of its way.

The command of a sample can stand in a recording before it or after it, so samples are found in the blocks of a run one
by one, and put in the order of their states.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.disk_table import Spool
from hilrig_replay.io.columns import COMMAND, STATE, Rows

STAGES: Final = ("register_wait", "controller", "edge", "injected", "tick_wait", "transport")
"""In the order in which a state's news goes round, `transport` last because it is the remainder."""

SAMPLE: Final = np.dtype(
    [
        ("step", "<u8"),
        ("incarnation", "<u8"),
        ("sampled_ns", "<i8"),
        ("wall_ns", "<i8"),
        ("basis_step", "<u8"),
        ("command_seq", "<u8"),
        ("loop", "<i8"),
        *((stage, "<i8") for stage in STAGES),
        ("write_arrived_ns", "<i8"),
        ("state_served_ns", "<i8"),
    ]
)
"""One row a sample: `loop` and the stages in ns, `sampled_ns` on the simulation's clock, the two last on the edge's."""

WINDOW: Final = 4096
"""So many rows before a block are still looked at, count: at 20 ms a step more than a minute."""


class Matcher:
    """Finds the command behind each sample, from blocks in which the one can come before or after the other."""

    def __init__(self) -> None:
        self._commands = np.empty(0, COMMAND)
        self._waiting = np.empty(0, STATE)
        self._given_up = 0

    @property
    def unmatched(self) -> int:
        """Samples whose command has not come, count."""
        return self._given_up + len(self._waiting)

    def add(self, states: Rows, commands: Rows) -> NDArray[np.void]:
        """Take in the next block, fields as `columns.STATE` and `columns.COMMAND`; the samples found with it."""
        effective = np.concatenate((self._waiting, states[states["basis_step"] != 0]))
        known = np.concatenate((self._commands, commands))
        rows, found = join_commands(effective, known)
        if len(known):
            found &= known["basis_step"][rows] == effective["basis_step"]
        missing = effective[~found]
        self._waiting = missing[-WINDOW:].copy()
        self._given_up += len(missing) - len(self._waiting)
        self._commands = known[-max(WINDOW, len(commands)) :].copy()
        return _stages(effective[found], known[rows[found]])


class SampleTable(Spool):
    """Samples in the order of their states; whoever adds them says when there are no more."""

    def __init__(self) -> None:
        super().__init__(SAMPLE)
        self._held = np.empty(0, SAMPLE)

    def add(self, samples: NDArray[np.void]) -> None:
        """Take in some more; the newest wait for those whose command comes late."""
        held = np.concatenate((self._held, samples))
        if len(held) > 1 and not _ordered(held):
            held = held[np.lexsort((held["sampled_ns"], held["incarnation"]))]
        whole = max(len(held) - WINDOW, 0)
        self._held = held[whole:].copy()
        super().add(held[:whole].copy())

    def end(self) -> None:
        """Nothing comes any more."""
        super().add(self._held)
        self._held = self._held[:0]


def _ordered(samples: NDArray[np.void]) -> bool:
    same = np.diff(samples["incarnation"]) == 0
    return bool((same & (np.diff(samples["sampled_ns"]) >= 0)).all())


def join_commands(states: Rows, commands: Rows) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The command in force at each state, by (session, seq): its row, and whether it is there; shapes (states,)."""
    if not len(commands):
        return np.zeros(len(states), np.intp), np.zeros(len(states), np.bool_)
    # A code has 16 bits, a sequence number far fewer than 48.
    keys = (commands["session"].astype(np.uint64) << np.uint64(48)) | commands["seq"]
    wanted = (states["session"].astype(np.uint64) << np.uint64(48)) | states["command_seq"]
    order = np.argsort(keys, kind="stable")
    rows = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
    return rows, keys[rows] == wanted


def _stages(states: Rows, commands: Rows) -> NDArray[np.void]:
    """Samples of states and their commands, row by row; the table of docs/timing.md."""
    samples = np.empty(len(states), SAMPLE)
    for name in ("step", "incarnation", "sampled_ns", "wall_ns", "basis_step", "command_seq"):
        samples[name] = states[name]
    for name in ("write_arrived_ns", "state_served_ns"):
        samples[name] = commands[name]
    served, written = commands["state_served_ns"], commands["write_arrived_ns"]
    state_injected, command_injected = commands["state_injected_ns"], commands["command_injected_ns"]
    samples["loop"] = states["loop_latency_ns"]
    samples["register_wait"] = served - commands["state_arrived_ns"] - state_injected
    samples["controller"] = written - served
    samples["edge"] = commands["sent_ns"] - written - command_injected
    samples["injected"] = state_injected + command_injected
    samples["tick_wait"] = states["sampled_ns"] - states["command_arrived_ns"]
    samples["transport"] = samples["loop"] - sum(samples[stage] for stage in STAGES[:-1])
    return samples
