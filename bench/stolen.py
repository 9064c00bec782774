"""When the host of a virtual machine took processors away: such moments say nothing of the rig.

The kernel counts stolen time in hundredths of a second (`steal` of /proc/stat). While it is watched, each time that the
count has grown is noted; a figure that was measured near one is told apart from those that were not. On a machine of
its own nothing is ever stolen, and every figure counts.
"""

import threading
import time
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_cli.bench.jitter import steal_time_s

PERIOD_S: Final = 0.02
NEAR_NS: Final = 100_000_000
"""What happened within so long of stolen time may be due to it."""


class StolenTime:
    """Watches while it is entered."""

    def __init__(self) -> None:
        self.total_s = 0.0
        """Processor time taken away while it was watched, s."""
        self._seen_wall_ns: list[int] = []
        self._end = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="stolen time", daemon=True)

    def __enter__(self) -> Self:
        self._begin = time.monotonic()
        self._watcher.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._watcher.join()
        self.share = self.total_s / (time.monotonic() - self._begin)
        """Taken away on average, processors."""

    def undisturbed(self, wall_ns: ArrayLike) -> NDArray[np.bool_]:
        """Which of these moments, ns on the wall clock, had no stolen time near."""
        moments = np.asarray(wall_ns, np.int64)
        if not self._seen_wall_ns:
            return np.ones(moments.shape, bool)
        seen = np.array([-(2**62), *self._seen_wall_ns, 2**62])
        after = np.searchsorted(seen[1:-1], moments) + 1
        nearest: NDArray[np.int64] = np.minimum(seen[after] - moments, moments - seen[after - 1])
        return nearest > NEAR_NS

    def _watch(self) -> None:
        last_s = steal_time_s() or 0.0
        while not self._end.wait(PERIOD_S):
            now_s = steal_time_s() or 0.0
            if now_s > last_s:
                self._seen_wall_ns.append(time.time_ns())
                self.total_s += now_s - last_s
                last_s = now_s
