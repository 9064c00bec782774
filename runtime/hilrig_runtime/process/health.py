"""Publishes a health report of a service once a second."""

import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from importlib.metadata import version
from typing import Final

from hilrig_runtime.bus.api import Publisher
from hilrig_runtime.counters import Counters
from hilrig_runtime.process.discovery import ClockOffset
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.realtime import RunDelay, realtime_priority
from hilrig_schemas import Health, PeerReport, RigReport

REPORT_PERIOD_NS: Final = 1_000_000_000
REJECTED_LOG_PERIOD_NS: Final = 10_000_000_000
"""Shortest time between two log messages about malformed messages, ns."""

logger = logging.getLogger(__name__)


class HealthReporter:
    """Publishes `Health` messages from the service's counters, once a second."""

    def __init__(self, publisher: Publisher, service: str, instance: str, incarnation: int, clock: Clock) -> None:
        self.counters = Counters()
        self.rig_reports: Callable[[], Iterable[RigReport]] = tuple
        """Called at each report for the reports of the service's rigs."""
        self.clock_offset: Callable[[], ClockOffset] = ClockOffset
        self.peers: Callable[[int], Iterable[PeerReport]] = lambda _: ()
        """Called at each report, with its time, for the other services."""
        self._publisher = publisher
        self._identity = {
            "service": service,
            "instance": instance,
            "incarnation": incarnation,
            "host": platform.node(),
            "software_version": version("hilrig"),
            "realtime_priority": realtime_priority(),
        }
        self._clock = clock
        self._start_ns = clock.monotonic_ns()
        self._last_ns = self._start_ns
        self._last = (0, 0)
        self._rejected_due_ns = self._start_ns
        self._run_delay, self._run_delay_ns = RunDelay(), 0

    def report_if_due(self, now_ns: int) -> None:
        """Publish a report if the last one is a second old; `now_ns`: monotonic clock."""
        if now_ns - self._last_ns >= REPORT_PERIOD_NS:
            self.report(now_ns)

    def take_run_delay(self) -> int:
        """Return the time since the last call or report in which this thread was ready and had no processor, ns.

        0: none, or unknown on this system.
        """
        taken_ns = self._run_delay.take()
        self._run_delay_ns += taken_ns
        return taken_ns

    def report(self, now_ns: int) -> None:
        """Publish a report now."""
        self.take_run_delay()
        counters = self.counters
        seconds = max(1, now_ns - self._last_ns) * 1e-9
        received, published = self._last
        latenesses, counters.latenesses_ns = sorted(counters.latenesses_ns), []
        clock = self.clock_offset()
        health = Health(
            **self._identity,  # type: ignore[arg-type]
            wall_ns=self._clock.wall_ns(),
            uptime_ns=now_ns - self._start_ns,
            cpu_ns=time.process_time_ns(),
            resident_bytes=resident_bytes(),
            received_hz=(counters.received - received) / seconds,
            published_hz=(counters.published - published) / seconds,
            lateness_p50_ns=_percentile(latenesses, 0.50),
            lateness_p99_ns=_percentile(latenesses, 0.99),
            lateness_max_ns=latenesses[-1] if latenesses else 0,
            run_delay_ns=self._run_delay_ns,
            clock_peer=clock.peer,
            clock_offset_ns=clock.offset_ns,
            clock_uncertainty_ns=clock.uncertainty_ns,
            rig_reports=self.rig_reports(),
            peers=self.peers(now_ns),
        )
        for name in _COPIED:
            value = getattr(counters, name)
            # A sum of counts that a peer invented must not end this service.
            setattr(health, name, value if isinstance(value, str) else min(value, _MAX_COUNT))
        self._last = (counters.received, counters.published)
        self._last_ns = now_ns
        self._run_delay_ns = 0
        self._publisher.put(health.SerializeToString())
        self._log_rejected(now_ns)

    def _log_rejected(self, now_ns: int) -> None:
        """Log the number of malformed messages since the last log message, and the last one."""
        counters = self.counters
        if counters.rejections and now_ns >= self._rejected_due_ns:
            self._rejected_due_ns = now_ns + REJECTED_LOG_PERIOD_NS
            count, counters.rejections = counters.rejections, 0
            logger.warning("malformed messages dropped: %d; the last one: %.300s", count, counters.rejected)


_MAX_COUNT: Final = (1 << 62) - 1
_COPIED: Final = tuple(name for name in Counters.__slots__ if name in Health.DESCRIPTOR.fields_by_name)


def _percentile(ordered: list[int], fraction: float) -> int:
    return ordered[round(fraction * (len(ordered) - 1))] if ordered else 0


def resident_bytes() -> int:
    """Resident memory of this process, bytes; 0: unknown on this system."""
    if sys.platform == "linux":
        # A process that has reached its limit of open files, all of them connections, must keep running.
        with suppress(OSError), open("/proc/self/statm", "rb") as statm:  # noqa: PTH123  # once a second on a real-time loop
            return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0
