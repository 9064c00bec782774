"""Monitors CPU steal: the time during which the hypervisor ran other virtual machines on this machine's CPUs.

The kernel counts steal time in hundredths of a second (`steal` in /proc/stat). The monitor stores the times at which
the counter increased, so that samples measured near such a time can be separated from the others. A physical machine
has no steal time, and all its samples are undisturbed.
"""

import threading
import time
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hilrig_cli.bench.jitter import steal_time_s

PERIOD_S: Final = 0.02
VICINITY_NS: Final = 100_000_000
"""A sample at most this far from a steal time counts as disturbed, ns."""


class StealMonitor:
    """Monitors the steal time while its context is entered."""

    def __init__(self) -> None:
        self.total_s = 0.0
        """Steal time while the monitor ran, s."""
        self._steal_wall_ns: list[int] = []
        self._end = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="steal monitor", daemon=True)

    def __enter__(self) -> Self:
        self._begin = time.monotonic()
        self._watcher.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end.set()
        self._watcher.join()
        self.mean_cpus = self.total_s / (time.monotonic() - self._begin)
        """Mean steal time, CPUs."""

    def undisturbed(self, wall_ns: ArrayLike) -> NDArray[np.bool_]:
        """Return for each time, ns on the wall clock, whether there was no CPU steal nearby."""
        times_ns = np.asarray(wall_ns, np.int64)
        if not self._steal_wall_ns:
            return np.ones(times_ns.shape, bool)
        steal_ns = np.array([-(2**62), *self._steal_wall_ns, 2**62])
        after = np.searchsorted(steal_ns[1:-1], times_ns) + 1
        nearest: NDArray[np.int64] = np.minimum(steal_ns[after] - times_ns, times_ns - steal_ns[after - 1])
        return nearest > VICINITY_NS

    def _watch(self) -> None:
        last_s = steal_time_s() or 0.0
        while not self._end.wait(PERIOD_S):
            now_s = steal_time_s() or 0.0
            if now_s > last_s:
                self._steal_wall_ns.append(time.time_ns())
                self.total_s += now_s - last_s
                last_s = now_s
