"""The service object: owns a process's bus connection, recording stream, health reports and stop request.

A service is a function `run(service)` that calls `service.ready()` once it works, and returns when `service.stopping`
is set; everything that it declared is closed afterwards, in reverse order. The service object also creates the
publishers and caches of `messaging`.
"""

import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from importlib.metadata import version
from types import MappingProxyType
from typing import Final, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus.api import Bus, Handle, Publisher
from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_runtime.errors import OperationError, list_names
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.messaging.publisher import RigPublisher
from hilrig_runtime.messaging.recording_stream import RecordingStream, batch_cache_depth
from hilrig_runtime.messaging.rig_batch import BatchPublisher
from hilrig_runtime.process.discovery import PeerRegistry
from hilrig_runtime.process.event_log import EventLog
from hilrig_runtime.process.health import HealthReporter
from hilrig_runtime.process.outage import STALL_NS
from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock
from hilrig_runtime.timing.rate_limiter import RateLimiter, repeat_suffix
from hilrig_schemas import Event, PeerReport, RigBatch, ServiceInfo
from hilrig_schemas.topics import EVENT, HEALTH, LOG, RigTopic, ServiceTopic, alive_key, source_of_key

MessageT = TypeVar("MessageT", bound=Message)
EXTRA_QUEUED_BATCHES: Final = 64
"""Capacity of the queue of received batches beyond one batch per rig."""
STALL_LOG_PERIOD_NS: Final = 10_000_000_000
"""Shortest time between two log messages about stalls, ns: on an overloaded host each second has one."""

logger = logging.getLogger(__name__)


class Service(Handle):
    """The resources of a running service; a context manager."""

    def __init__(
        self,
        name: str,
        lab: LabConfig,
        bus: Bus,
        *,
        instance: str = "1",
        rigs: Sequence[str] | None = None,
        clock: Clock = SYSTEM_CLOCK,
        stopping: threading.Event | None = None,
    ) -> None:
        self.name = name
        self.instance = instance
        self.source = f"{name}/{instance}"
        self.lab = lab
        self.rigs: tuple[RigSettings, ...] = lab.rigs if rigs is None else tuple(lab.rig(rig) for rig in rigs)
        """Rigs that this instance serves."""
        self.bus = bus
        self.clock = clock
        self.incarnation = clock.wall_ns()
        self.stopping = stopping or threading.Event()
        self._closing = ExitStack()
        self._closing.callback(bus.close)
        self._event_publishers: dict[str, RigPublisher[Event]] = {}
        self.batch_cache_depth = batch_cache_depth(len(lab.rigs), lab.sim.step_ms)
        """Cache depth of each recording stream of the lab, batches."""
        # Two publishers of one key: each has its own cache.
        messages, events = (
            self._closing.enter_context(
                bus.publisher(LOG.key(lab.name, name, instance), LOG.traffic, self.batch_cache_depth)
            )
            for _ in range(2)
        )
        self.recording_stream = RecordingStream(messages, events, self.source, self.incarnation)
        self.health = HealthReporter(self.publisher(HEALTH), name, instance, self.incarnation, clock)
        self.counters = self.health.counters
        self._event_log = EventLog()
        self._closing.callback(self._event_log.flush)
        self._beat_ns = clock.monotonic_ns()
        self._stalls: RateLimiter[None] = RateLimiter(STALL_LOG_PERIOD_NS)
        self._token: Handle | None = None
        self._failure = ""
        info = ServiceInfo(service=name, instance=instance, incarnation=self.incarnation)
        self.reload: Callable[[], object] = lambda: logger.info("nothing to read again on SIGHUP")
        """Called on SIGHUP, in any thread; set by the edge."""
        self.addresses: Callable[[str], str] = lambda _: ""
        """Returns the address of a rig for the service info; set by the edge."""
        self.last_received: Callable[[], Mapping[str, int]] = dict
        """Returns the arrival of the last message of each other service, monotonic clock, ns; set by the services."""
        self._registry = PeerRegistry(
            bus,
            lab.name,
            info,
            self._rigs_reached,
            clock,
            self.fail,
            self.counters,
            lab.bus.may_serve,
            received=lambda: sorted(self.last_received()),
        )
        self._closing.callback(self._registry.close)
        self.health.clock_offset = lambda: self._registry.clock_offset
        self.health.peers = self._peer_reports

    def claim(self) -> None:
        """Check, before anything is published, that no other service of its kind has one of its rigs or its name.

        Raises:
            OperationError: another service has one of its rigs or its name.
        """
        self._registry.claim()

    def check_instance_conflict(self) -> None:
        """Check again for an older service of its kind, which may have been discovered late.

        Raises:
            OperationError: as `claim`.
        """
        self._registry.recheck()

    def ready(self) -> None:
        """Declare the liveliness token: the service works now; a second call does nothing.

        Raises:
            OperationError: as `claim`, if it was not called before.
        """
        if self._token is None:
            self.claim()
            token = self.bus.declare_token(alive_key(self.lab.name, self.name, self.instance))
            self._token = self._closing.enter_context(token)
            rigs = [
                f"{rig.name} at {address}" if (address := self.addresses(rig.name)) else rig.name for rig in self.rigs
            ]
            logger.info("ready: hilrig %s, lab %s, %s", version("hilrig"), self.lab.name, list_names(rigs) or "no rig")

    def set_rigs(self, rigs: tuple[RigSettings, ...]) -> None:
        """Replace the rigs of this service, because one was added or removed."""
        self.rigs = rigs
        self.counters.rigs = len(rigs)

    def rig_publisher(self, topic: RigTopic[MessageT], rig: str) -> RigPublisher[MessageT]:
        """Create a publisher of a rig's topic."""
        key = topic.key(self.lab.name, rig)
        publisher = self._closing.enter_context(self.bus.publisher(key, topic.traffic))
        recording_stream = self.recording_stream.events if topic is EVENT else self.recording_stream
        return RigPublisher(key, publisher, recording_stream, self.clock, self.counters)

    def latest_value_cache(
        self, topic: ServiceTopic[RigBatch], permitted: Mapping[str, Collection[str]] = MappingProxyType({})
    ) -> LatestValueCache:
        """Create a cache of each rig's newest message, from the batches of all publishers; see `LatestValueCache`."""
        cache = LatestValueCache(self.clock, self.counters, permitted)
        key = topic.key(self.lab.name, "*", "*")
        # A batch may contain one message only: room for one batch per rig, and for rigs that are added later.
        depth = len(self.rigs) + EXTRA_QUEUED_BATCHES
        self._closing.enter_context(self.bus.subscribe_newest(key, cache.on_message, depth))
        self.last_received = lambda: {source_of_key(key): ns for key, ns in cache.last_ns.copy().items()}
        return cache

    def publisher(self, topic: ServiceTopic[MessageT]) -> Publisher:
        """Create a publisher of encoded messages on a topic of this service; they are not recorded."""
        key = topic.key(self.lab.name, self.name, self.instance)
        return self._closing.enter_context(self.bus.publisher(key, topic.traffic))

    def batch_publisher(self, topic: ServiceTopic[RigBatch]) -> BatchPublisher:
        """Create a publisher of batches of messages of many rigs; add the rigs with `add_to_batch`."""
        return BatchPublisher(self.source, self.publisher(topic), self.recording_stream, self.clock, self.counters)

    def add_to_batch(self, batch: BatchPublisher, topic: RigTopic[MessageT], rig: str) -> None:
        """Add a rig to a batch publisher; its messages are also published on the rig's key of `topic`."""
        key = topic.key(self.lab.name, rig)
        batch.add(rig, key, self._closing.enter_context(self.bus.publisher(key, topic.traffic)))

    def emit(self, event: Event) -> None:
        """Publish and record an event; sets its source and time."""
        event.source = self.source
        event.wall_ns = self.clock.wall_ns()
        # An event without a rig concerns the service and is published under its name.
        rig = event.rig or self.name
        publisher = self._event_publishers.get(rig)
        if publisher is None:
            publisher = self._event_publishers[rig] = self.rig_publisher(EVENT, rig)
        publisher.publish(event)
        self._event_log.record(event, self.clock.monotonic_ns())

    def beat(self, now_ns: int) -> None:
        """Once per tick: publish the recording batch and the health report if due; `now_ns`: monotonic clock."""
        if self._token is not None and now_ns - self._beat_ns > STALL_NS:
            count = self._stalls.record(None, now_ns)
            if count:
                text = "stalled for %.1f s until now: this process was stopped, or its host was overloaded%s"
                logger.warning(text, (now_ns - self._beat_ns) / 1e9, repeat_suffix(count))
        self._beat_ns = now_ns
        self._event_log.flush_if_due(now_ns)
        self.recording_stream.flush_if_due(now_ns)
        self.health.report_if_due(now_ns)

    def stop(self) -> None:
        """Request a stop; safe from any thread and from a signal handler."""
        self.stopping.set()

    def fail(self, reason: str) -> None:
        """Request a stop because of a failure; safe from any thread. See `check`."""
        self._failure = reason
        self.stopping.set()

    def check(self) -> None:
        """Raise the error of a service that failed.

        Raises:
            OperationError: the service could not continue; contains the reason.
        """
        if self._failure:
            raise OperationError(self._failure)

    def _peer_reports(self, now_ns: int) -> list[PeerReport]:
        hosts, received = self._registry.hosts, self.last_received()
        return [
            PeerReport(
                service=name,
                host=hosts.get(name, ""),
                silent_ns=max(1, now_ns - received[name]) if name in received else 0,
            )
            for name in sorted((hosts.keys() | received.keys()) - {self.source})
        ]

    def _rigs_reached(self) -> list[tuple[str, str]]:
        return [(rig.name, self.addresses(rig.name)) for rig in self.rigs]

    def close(self) -> None:
        """Flush the recording stream, then close everything in reverse order; a second call does nothing."""
        with self._closing.pop_all():
            now_ns = self.clock.monotonic_ns()
            self.recording_stream.flush(now_ns)
            self.health.report(now_ns)
