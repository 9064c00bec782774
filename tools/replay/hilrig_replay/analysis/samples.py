"""Samples of the loop latency: the states at which a new command took effect, with the duration of each stage.

The command of a sample can be before or after its state in a recording. Samples are therefore matched block by block
and then sorted in the order of their states.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.stages import ALL_STAGES, LOOP_STAGES, fill_stages
from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE, Rows
from hilrig_replay.io.disk_table import DiskTable

SAMPLE_DTYPE: Final = np.dtype(
    [
        ("step", "<u8"),
        ("incarnation", "<u8"),
        ("sampled_ns", "<i8"),
        ("wall_ns", "<i8"),
        ("basis_step", "<u8"),
        ("command_seq", "<u8"),
        ("loop", "<i8"),
        *((stage.key, "<i8") for stage in ALL_STAGES),
        ("write_arrived_ns", "<i8"),
        ("write_received_ns", "<i8"),
        ("state_served_ns", "<i8"),
        ("basis_on_other_connection", "|b1"),
        ("polled", "|b1"),
        ("basis_is_bound", "|b1"),
    ]
)
"""One row per sample: `loop` and the stages in ns, `sampled_ns` on the clock of the simulation, `write_arrived_ns`,
`write_received_ns` and `state_served_ns` on the clock of the edge. `polled`: the edge was the client of the
controller."""

MATCH_WINDOW_ROWS: Final = 4096
"""Rows of previous blocks that are searched for a match: more than a minute at a step of 20 ms."""


class CommandMatcher:
    """Finds the command of each sample; the command can be in an earlier or later block than the state."""

    def __init__(self) -> None:
        self._commands = np.empty(0, COMMAND_DTYPE)
        self._waiting = np.empty(0, STATE_DTYPE)
        self._dropped = 0

    @property
    def unmatched(self) -> int:
        """Number of samples whose command was not found."""
        return self._dropped + len(self._waiting)

    def add(self, states: Rows, commands: Rows) -> NDArray[np.void]:
        """Add the next block, fields as `STATE_DTYPE` and `COMMAND_DTYPE`; returns the samples that it completes."""
        based: Rows = states[states["basis_step"] != 0]
        effective = np.concatenate((self._waiting, based))
        known = np.concatenate((self._commands, commands))
        rows, found = join_commands(effective, known)
        if len(known):
            found &= known["basis_step"][rows] == effective["basis_step"]
        missing = effective[~found]
        self._waiting = missing[-MATCH_WINDOW_ROWS:].copy()
        self._dropped += len(missing) - len(self._waiting)
        self._commands = known[-max(MATCH_WINDOW_ROWS, len(commands)) :].copy()
        return _samples(effective[found], known[rows[found]])


class SampleTable(DiskTable):
    """Samples in the order of their states; call `finish` after the last `add`."""

    def __init__(self) -> None:
        super().__init__(SAMPLE_DTYPE)
        self._held = np.empty(0, SAMPLE_DTYPE)

    def add(self, samples: NDArray[np.void]) -> None:
        """Add samples; the newest are held back, because samples with a late command can precede them."""
        held = np.concatenate((self._held, samples))
        if len(held) > 1 and not _ordered(held):
            held = held[np.lexsort((held["sampled_ns"], held["incarnation"]))]
        complete = max(len(held) - MATCH_WINDOW_ROWS, 0)
        self._held = held[complete:].copy()
        super().add(held[:complete].copy())

    def finish(self) -> None:
        """Add the samples that are still held back."""
        super().add(self._held)
        self._held = self._held[:0]


def _ordered(samples: NDArray[np.void]) -> bool:
    same = np.diff(samples["incarnation"]) == 0
    return bool((same & (np.diff(samples["sampled_ns"]) >= 0)).all())


def join_commands(states: Rows, commands: Rows) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The command that acts at each state, by (session, seq): its row, and whether it was found; shapes (states,)."""
    if not len(commands):
        return np.zeros(len(states), np.intp), np.zeros(len(states), np.bool_)
    # A session code has 16 bits, a sequence number less than 48.
    keys = (commands["session"].astype(np.uint64) << np.uint64(48)) | commands["seq"]
    wanted = (states["session"].astype(np.uint64) << np.uint64(48)) | states["command_seq"]
    order = np.argsort(keys, kind="stable")
    rows = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
    return rows, keys[rows] == wanted


def _samples(states: Rows, commands: Rows) -> NDArray[np.void]:
    """Compute the samples of states and their commands, row by row, as defined in docs/timing.md."""
    samples = np.empty(len(states), SAMPLE_DTYPE)
    for name in ("step", "incarnation", "sampled_ns", "wall_ns", "basis_step", "command_seq"):
        samples[name] = states[name]
    for name in (
        "write_arrived_ns",
        "write_received_ns",
        "state_served_ns",
        "basis_on_other_connection",
        "basis_is_bound",
    ):
        samples[name] = commands[name]
    samples["polled"] = commands["read_sent_ns"] > 0
    samples["loop"] = states["loop_latency_ns"]
    fill_stages(samples, LOOP_STAGES, states, commands)
    return samples
