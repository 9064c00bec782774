"""Order of the states and commands of a run: by the sequence numbers of their sender, each message once.

A recorder writes them in this order. Files that other programs wrote, merged or edited can contain a message twice or
at another place. A message is put in its place if it is at most one block away from it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows
from hilrig_replay.io.records import Records


@dataclass(slots=True)
class Repairs:
    """Number of messages that were repaired while a run was read."""

    duplicates: int = 0
    """Messages that were dropped because they are in the recording twice."""
    reordered: int = 0
    """Messages that were not at the place of their sequence number."""


def in_sequence(blocks: Iterable[Records], repairs: Repairs) -> Iterator[Records]:
    """Iterate over blocks with their states and commands in the order of their sender, and count the repairs."""
    held: Records | None = None
    for block in blocks:
        last = block if held is None else held
        states_before, states = _merge(last.states[: None if held else 0], block.states, repairs)
        commands_before, commands = _merge(last.commands[: None if held else 0], block.commands, repairs)
        if held is not None:
            yield replace(held, states=states_before, commands=commands_before)
        parts = block.parts
        if states is not block.states:
            # The poses of the parts are those of the states.
            parts = parts[np.argsort(parts["wall_ns"], kind="stable")]
        held = replace(block, states=states, commands=commands, parts=parts)
    if held is not None:
        yield held


def _merge(before: Rows, after: Rows, repairs: Repairs) -> tuple[Rows, Rows]:
    """Order the rows of two consecutive blocks, of which the first is in order."""
    rows = np.concatenate((before[-1:], after))
    if not _misplaced(rows).any():
        return before, after
    rows = np.concatenate((before, after))
    sequence = rows["sequence"].astype(np.int64)
    misplaced = _misplaced(rows)
    # A lower number that is not misplaced is the first one of a restarted sender.
    restarts = (np.diff(sequence, prepend=sequence[:1]) < 0) & ~misplaced
    run = np.cumsum(restarts)
    order = np.lexsort((sequence, run))
    rows, sequence, run = rows[order], sequence[order], run[order]
    repeated = np.zeros(len(rows), np.bool_)
    repeated[1:] = (np.diff(sequence) == 0) & (np.diff(run) == 0) & (np.diff(rows["wall_ns"]) == 0)
    repairs.duplicates += int(repeated.sum())
    repairs.reordered += max(int(misplaced.sum()) - int(repeated.sum()), 0)
    rows = rows[~repeated]
    return rows[: len(before)], rows[len(before) :]


def _misplaced(rows: Rows) -> NDArray[np.bool_]:
    """Rows with a number and a time that are not later than those of the row before.

    The sequence numbers of a restarted sender begin again, but at a later time.
    """
    found = np.zeros(len(rows), np.bool_)
    sequence: NDArray[np.int64] = rows["sequence"].astype(np.int64)
    wall_ns: NDArray[np.int64] = rows["wall_ns"]
    found[1:] = (np.diff(sequence) <= 0) & (np.diff(wall_ns) <= 0)
    return found
