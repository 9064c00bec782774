"""Stalls of the Modbus edge: those that it reported, else late responses or writes that were published late."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.distribution import differences, median
from hilrig_replay.analysis.stages import EDGE
from hilrig_replay.io.columns import Rows
from hilrig_replay.io.disk_table import DiskTable
from hilrig_replay.io.records import Records

EDGE_STALL_THRESHOLD_NS: Final = 5_000_000
"""Minimum response time that counts as a stall: the processing of a request takes less."""
STALL_MERGE_WINDOW_NS: Final = 500_000_000
"""Late responses that are closer together than this belong to one stall."""


def edge_stalls(
    reported: Stalls, samples: DiskTable, windows: Sequence[Records], time_ns: Callable[[Rows], NDArray[np.int64]]
) -> Stalls:
    """Stalls that the edge reported; else late responses, or writes that were published late as commands.

    Args:
        reported: stalls in the events of the edge.
        samples: fields as `SAMPLE_DTYPE`.
        windows: parts of the run whose requests are examined.
        time_ns: times of rows from the first state, as `Run.time_ns`.
    """
    if reported.count:
        return reported
    requests = [window.traffic for window in windows if len(window.traffic)]

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
            longest_ns, at_ns = float(waited_ns[worst]), int(time_ns(rows[worst : worst + 1])[0])
    if longest_ns == limit_ns:
        return Stalls()

    def late_ns() -> Iterator[NDArray[np.int64]]:
        """Times of the late samples and requests, in chronological order."""
        waits = [np.empty(0, np.int64)]
        for rows in requests:
            answered_ns, arrived_ns = rows["answered_ns"], rows["arrived_ns"]
            waits.append(time_ns(rows)[answered_ns - arrived_ns > limit_ns])
        others = np.sort(np.concatenate(waits))
        for rows in samples.blocks(EDGE.key, "sampled_ns", "incarnation"):
            at_ns = time_ns(rows)
            before = int(np.searchsorted(others, at_ns[-1]))
            late: NDArray[np.bool_] = rows[EDGE.key] > limit_ns
            yield np.sort(np.concatenate((at_ns[late], others[:before])))
            others = others[before:]
        yield others

    count = 1 + sum(int((apart_ns > STALL_MERGE_WINDOW_NS).sum()) for apart_ns in differences(late_ns)())
    return replace(Stalls(count, int(longest_ns), at_ns), area_ns2=count * longest_ns**2 / 2)
