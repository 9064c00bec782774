"""Discovery of the running services of a lab, and detection of duplicate instances.

Two simulations or two edges of one rig would contradict each other. So a service queries the others of its kind before
it starts, again whenever one appears, and every few seconds: during a network partition both may have started. Of two
services with a common rig or the same name, the one that started later stops and reports why. The same replies give
the offsets between the hosts' wall clocks, which are only reported. Lost peers are only logged, so that an operator
finds the time at which a link failed.
"""

import logging
import platform
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from itertools import zip_longest
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Bus, Handle, Reply
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import OperationError, list_names
from hilrig_runtime.process.liveliness import PeerDownTracker
from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock
from hilrig_schemas import ServiceInfo
from hilrig_schemas.topics import SERVICE_INFO, alive_key, source_of_key

RECHECK_PERIOD_NS: Final = 10_000_000_000
MAX_HOSTS: Final = 256
"""Maximum number of services with a remembered host."""
RETRY_INTERVAL_S: Final = 0.1
QUERY_TIMEOUT_S: Final = 0.5
CLAIM_TIMEOUT_S: Final = 3.0
"""Query timeout for the check of conflicts, s; it ends early when all services have replied."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How far another service's wall clock is ahead of this one's."""

    peer: str = ""
    """The service, "<service>/<instance>"; empty: no service replied."""
    offset_ns: int = 0
    uncertainty_ns: int = 0
    """Half of the round-trip time of its own reply, ns."""

    @property
    def certain_ns(self) -> int:
        """Part of the offset that the uncertainty does not explain, ns; not negative."""
        return max(0, abs(self.offset_ns) - self.uncertainty_ns)


def conflict(own: ServiceInfo, others: Iterable[ServiceInfo]) -> str:
    """Return why a service must stop, human-readable; empty: it may run.

    It must stop if an older service of its kind has its instance name or one of its rigs. If both started in the same
    nanosecond, the name decides, so that exactly one keeps running.
    """
    taken = []
    for other in sorted(others, key=lambda info: (info.instance, info.incarnation)):
        if other.service != own.service or (other.incarnation, other.instance) >= (own.incarnation, own.instance):
            continue
        where = f"{other.service}/{other.instance} on {other.host}"
        if other.instance == own.instance:
            return f"{where} has the same instance name; choose another --instance"
        if shared := sorted(set(own.rigs) & set(other.rigs)):
            taken.append(f"{where} already serves {list_names(shared)}")
    return f"{'; '.join(taken)}; each rig has one {own.service} (--rigs)" if taken else ""


def worst_offset(offsets: Iterable[ClockOffset]) -> ClockOffset:
    """Return the offset that is largest without its uncertainty; of several within it, the one that is known best."""
    return max(offsets, key=lambda offset: (offset.certain_ns, -offset.uncertainty_ns), default=ClockOffset())


def offset_of(info: ServiceInfo, reply: Reply, wall_ns: Callable[[], int]) -> ClockOffset:
    """Return the clock offset of a service that replied, from the times of its own reply.

    The service read its clock between the query and the arrival of its reply: in the middle, or at most half of the
    round-trip time earlier or later. `wall_ns` reads this host's wall clock.
    """
    before_ns = time.monotonic_ns()
    now_wall_ns = wall_ns()
    # This process may have been stopped between the two clocks.
    half_ns = reply.round_trip_ns // 2 + time.monotonic_ns() - before_ns
    middle_wall_ns = now_wall_ns - (before_ns - reply.arrived_ns) - reply.round_trip_ns // 2
    return ClockOffset(f"{info.service}/{info.instance}", info.wall_ns - middle_wall_ns, half_ns)


def list_services(bus: Bus, lab: LabConfig, service: str = "*") -> list[ServiceInfo]:
    """Query the running services of a lab, of one kind or of all; sorted by service and instance."""
    replies = query_services(bus, lab.name, service, Counters(), QUERY_TIMEOUT_S, may_serve=lab.bus.may_serve)
    found = [info for info, _ in replies]
    return sorted(found, key=lambda info: (info.service, info.instance, info.incarnation))


def query_services(
    bus: Bus,
    lab: str,
    service: str,
    counters: Counters,
    timeout_s: float,
    wall_ns: Callable[[], int] = SYSTEM_CLOCK.wall_ns,
    may_serve: Callable[[str, str], bool] = lambda _source, _rig: True,
) -> Iterator[tuple[ServiceInfo, ClockOffset]]:
    """Query the running services of a lab; yield each with the offset of its clock from this host's, `wall_ns`.

    `may_serve` returns whether a service may serve a rig according to its certificate: its other rigs are removed.
    """
    for reply in bus.query(SERVICE_INFO.key(lab, service, "*"), timeout_s=timeout_s):
        try:
            if not reply.error:
                info = SERVICE_INFO.decode_from(reply.key, reply.payload)
                source = source_of_key(reply.key)
                rows = list(zip_longest(info.rigs, info.addresses[: len(info.rigs)], fillvalue=""))
                allowed = [row for row in rows if may_serve(source, row[0])]
                if len(allowed) < len(rows):
                    counters.reject(reply.key, "rigs that its certificate excludes")
                    info.rigs[:], info.addresses[:] = [rig for rig, _ in allowed], [address for _, address in allowed]
                yield info, offset_of(info, reply, wall_ns)
        except DecodeError as error:
            counters.reject(reply.key, error)


class PeerRegistry:
    """Announces one service, and detects conflicting instances and lost peers.

    `rigs` returns the name and address of each of its rigs; `on_conflict` gets the reason why the service must stop.
    `may_serve` returns whether a service may serve a rig according to its certificate: other claims are ignored.
    `received` returns the services from which it has received messages, in any thread.
    """

    def __init__(
        self,
        bus: Bus,
        lab: str,
        own: ServiceInfo,
        rigs: Callable[[], Sequence[tuple[str, str]]],
        clock: Clock,
        on_conflict: Callable[[str], None],
        counters: Counters,
        may_serve: Callable[[str, str], bool] = lambda _source, _rig: True,
        received: Callable[[], Iterable[str]] = tuple,
    ) -> None:
        self.clock_offset = ClockOffset()
        self.hosts: dict[str, str] = {}
        """Host of each service that replied once, "<service>/<instance>"."""
        self._bus = bus
        self._lab = lab
        self._own = own
        self._own.host = platform.node()
        self._own.software_version = version("hilrig")
        self._rigs = rigs
        self._clock = clock
        self._on_conflict = on_conflict
        self._counters = counters
        self._may_serve = may_serve
        self._received = received
        self._claimed = False
        self._closing = False
        self._peers_down = PeerDownTracker()
        self._changes: SimpleQueue[tuple[str, bool]] = SimpleQueue()
        """Peers that appeared (True) or disappeared, "<service>/<instance>"; an empty name ends the thread."""
        self._declared: list[Handle] = [
            bus.declare_queryable(SERVICE_INFO.key(lab, own.service, own.instance), self._handle_query)
        ]

    def claim(self) -> None:
        """Check that no other service has these rigs, and keep monitoring; a second call does nothing.

        Raises:
            OperationError: an older service has one of them.
        """
        if self._claimed:
            return
        self.recheck()
        self._claimed = True
        watched = alive_key(self._lab, "*", "*")
        self._declared.append(
            self._bus.subscribe_liveliness(watched, lambda key, alive: self._changes.put((source_of_key(key), alive)))
        )
        threading.Thread(target=self._watch, name="discovery", daemon=True).start()

    def recheck(self) -> None:
        """Check for older instances, until the bus has had time to link all peers.

        Raises:
            OperationError: an older service has one of these rigs, or the name.
        """
        reason = self._find_conflict()
        waited_s = 0.0
        while not reason and waited_s < self._bus.settle_timeout_s:
            time.sleep(RETRY_INTERVAL_S)
            waited_s += RETRY_INTERVAL_S
            reason = self._find_conflict()
        if reason:
            raise OperationError(reason)

    def close(self) -> None:
        """Stop the announcement and the monitoring."""
        self._closing = True
        self._changes.put(("", False))
        while self._declared:
            self._declared.pop().close()

    def _info(self) -> ServiceInfo:
        own = ServiceInfo()
        own.CopyFrom(self._own)
        for rig, address in self._rigs():
            own.rigs.append(rig)
            own.addresses.append(address)
        own.received.extend(self._received())
        own.wall_ns = self._clock.wall_ns()
        return own

    def _handle_query(self, payload: bytes) -> bytes:
        del payload
        return self._info().SerializeToString()

    def _find_conflict(self) -> str:
        bus, lab, clock = self._bus, self._lab, self._clock
        replies = list(
            query_services(bus, lab, "*", self._counters, CLAIM_TIMEOUT_S, clock.wall_ns, may_serve=self._may_serve)
        )
        # The service itself replies too.
        self.clock_offset = worst_offset(
            offset for other, offset in replies if other.incarnation != self._own.incarnation
        )
        others = [other for other, _ in replies]
        # Replaced, not changed: the thread of the health reports reads it.
        self.hosts = dict(
            [*self.hosts.items(), *((f"{other.service}/{other.instance}", other.host) for other in others)][-MAX_HOSTS:]
        )
        reason = conflict(self._info(), others)
        if not reason:
            return ""
        # A service that works has a token. A reply without one is of a service that is starting or ending.
        alive = self._bus.get_liveliness(alive_key(self._lab, self._own.service, "*"))
        alive_names = {source_of_key(key) for key in alive}
        return conflict(self._info(), [o for o in others if f"{o.service}/{o.instance}" in alive_names])

    def _watch(self) -> None:
        monotonic_ns = self._clock.monotonic_ns
        recheck_ns = monotonic_ns() + RECHECK_PERIOD_NS
        while not self._closing:
            due_ns = self._peers_down.due_ns
            next_ns = recheck_ns if due_ns is None else min(recheck_ns, due_ns)
            with suppress(Empty):
                peer, is_up = self._changes.get(timeout=max(0, next_ns - monotonic_ns()) * 1e-9)
                if self._closing:
                    return
                if is_up and peer.startswith(f"{self._own.service}/"):
                    recheck_ns = monotonic_ns()
                self._track(peer, is_up, monotonic_ns())
            self._log_lost_peers(monotonic_ns())
            if monotonic_ns() < recheck_ns:
                continue
            recheck_ns = monotonic_ns() + RECHECK_PERIOD_NS
            try:
                reason = self._find_conflict()
            except OperationError:
                # The bus is being closed.
                return
            if reason:
                self._on_conflict(reason)
                return

    def _track(self, peer: str, is_up: bool, now_ns: int) -> None:
        # With a router a service also receives its own token.
        if peer == f"{self._own.service}/{self._own.instance}":
            return
        if not is_up:
            self._peers_down.mark_down(peer, now_ns)
        elif self._peers_down.mark_up(peer):
            logger.info("contact with %s restored", peer)

    def _log_lost_peers(self, now_ns: int) -> None:
        lost = self._peers_down.overdue(now_ns)
        if lost:
            logger.warning("lost contact with %s (stopped, or network failure)", list_names(lost, 8))
