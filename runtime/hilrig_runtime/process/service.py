"""One object that owns a process's life: its bus, log stream, health and the wish to stop.

A service is a function `run(service)` that calls `service.ready()` once it does its work, and returns when
`service.stopping` is set; everything that it declared is closed afterwards, in reverse order. It sends and receives
through the typed ends of `messaging`, which are made here.
"""

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from types import MappingProxyType, TracebackType
from typing import Final, Self, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus.api import Bus, Handle, Publisher
from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_runtime.errors import OperationError
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.messaging.publisher import CommandSink, RigPublisher
from hilrig_runtime.messaging.recording_stream import RecordingStream, batch_cache_depth
from hilrig_runtime.messaging.rig_batch import BatchPublisher
from hilrig_runtime.process.discovery import PeerRegistry
from hilrig_runtime.process.health import HealthReporter
from hilrig_runtime.timing.clock import SYSTEM_CLOCK, Clock
from hilrig_schemas import Event, RigBatch, ServiceInfo
from hilrig_schemas.topics import EVENT, HEALTH, LOG, RigTopic, ServiceTopic, alive_key

MessageT = TypeVar("MessageT", bound=Message)
BATCHES_WAITING: Final = 64
"""Batches that may wait beyond one of each rig."""


class Service:
    """What a running service has; use it as a context manager."""

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
        """Those that this instance serves."""
        self.bus = bus
        self.clock = clock
        self.incarnation = clock.wall_ns()
        self.stopping = stopping or threading.Event()
        self._closing = ExitStack()
        self._closing.callback(bus.close)
        self._event_publishers: dict[str, RigPublisher[Event]] = {}
        self.batch_cache_depth = batch_cache_depth(len(lab.rigs), lab.sim.step_ms)
        """How far back each recording stream of the lab can be repeated."""
        log_publisher = self._closing.enter_context(
            bus.publisher(LOG.key(lab.name, name, instance), LOG.traffic, self.batch_cache_depth)
        )
        self.recording_stream = RecordingStream(log_publisher, self.source, self.incarnation)
        health_publisher = self._closing.enter_context(
            bus.publisher(HEALTH.key(lab.name, name, instance), HEALTH.traffic)
        )
        self.health = HealthReporter(health_publisher, name, instance, self.incarnation, clock)
        self.counters = self.health.counters
        self._token: Handle | None = None
        self._failure = ""
        roster = ServiceInfo(service=name, instance=instance, incarnation=self.incarnation)
        self.addresses: Callable[[str], str] = lambda _: ""
        """Where a rig is reached, for the roster; the edge sets it."""
        self._registry = PeerRegistry(bus, lab.name, roster, self._rigs_reached, clock, self.fail)
        self._closing.callback(self._registry.close)
        self.health.clock_offset = lambda: self._registry.clock_offset

    def claim(self) -> None:
        """Make sure that no other service of its kind has one of its rigs, or its name; before a word is sent.

        Raises:
            OperationError: one has.
        """
        self._registry.claim()

    def check_instance_conflict(self) -> None:
        """Look once more whether another service of its kind was there before; one that was may be found late.

        Raises:
            OperationError: as `claim`.
        """
        self._registry.recheck()

    def ready(self) -> None:
        """Say that the service does its work now: its liveliness token appears; a second call does nothing.

        Raises:
            OperationError: as `claim`, if that was not called before.
        """
        if self._token is None:
            self.claim()
            token = self.bus.declare_token(alive_key(self.lab.name, self.name, self.instance))
            self._token = self._closing.enter_context(token)

    def rig_publisher(
        self,
        topic: RigTopic[MessageT],
        rig: str,
        *,
        control_path: CommandSink | None = None,
    ) -> RigPublisher[MessageT]:
        """An end that sends on a rig's topic; `control_path` gets each encoded message before that."""
        key = topic.key(self.lab.name, rig)
        publisher = self._closing.enter_context(self.bus.publisher(key, topic.traffic))
        return RigPublisher(key, publisher, self.recording_stream, self.clock, self.counters, control_path)

    def latest_value_cache(
        self, topic: ServiceTopic[RigBatch], permitted: Mapping[str, Collection[str]] = MappingProxyType({})
    ) -> LatestValueCache:
        """The newest messages of each rig, out of the batches of everyone who sends them; see `LatestValueCache`."""
        values = LatestValueCache(self.clock, self.counters, permitted)
        key = topic.key(self.lab.name, "*", "*")
        # A batch may hold one message only: there is room for one of each rig, and some for rigs that are added.
        waiting = len(self.rigs) + BATCHES_WAITING
        self._closing.enter_context(self.bus.subscribe_newest(key, values.on_message, waiting))
        return values

    def publisher(self, topic: ServiceTopic[MessageT]) -> Publisher:
        """An end that sends encoded messages on a topic of this service; nothing of them is recorded."""
        key = topic.key(self.lab.name, self.name, self.instance)
        return self._closing.enter_context(self.bus.publisher(key, topic.traffic))

    def batch_publisher(self, topic: ServiceTopic[RigBatch]) -> BatchPublisher:
        """An end that sends messages of many rigs together; give it the rigs with `add_to_batch`."""
        return BatchPublisher(self.source, self.publisher(topic), self.recording_stream, self.clock, self.counters)

    def add_to_batch(self, batch: BatchPublisher, topic: RigTopic[MessageT], rig: str) -> None:
        """Let a batch sender send for one more rig, whose own messages go on `topic` too."""
        key = topic.key(self.lab.name, rig)
        batch.add(rig, key, self._closing.enter_context(self.bus.publisher(key, topic.traffic)))

    def emit(self, event: Event) -> None:
        """Send and record an event; source and time are filled in."""
        event.source = self.source
        event.wall_ns = self.clock.wall_ns()
        # Of the service as a whole: under its own name.
        rig = event.rig or self.name
        publisher = self._event_publishers.get(rig)
        if publisher is None:
            publisher = self._event_publishers[rig] = self.rig_publisher(EVENT, rig)
        publisher.publish(event)

    def beat(self, now_ns: int) -> None:
        """Once a tick: send the log batch and the health report when they are due; monotonic clock, ns."""
        self.recording_stream.flush_if_due(now_ns)
        self.health.report_if_due(now_ns)

    def stop(self) -> None:
        """Wish the service to end; safe from any thread and from a signal handler."""
        self.stopping.set()

    def fail(self, reason: str) -> None:
        """Wish the service to end because it can't go on; safe from any thread. See `check`."""
        self._failure = reason
        self.stopping.set()

    def check(self) -> None:
        """Nothing, if the service ended because it was told to.

        Raises:
            OperationError: it could not go on; says why.
        """
        if self._failure:
            raise OperationError(self._failure)

    def _rigs_reached(self) -> list[tuple[str, str]]:
        return [(rig.name, self.addresses(rig.name)) for rig in self.rigs]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Send what is left on the log stream, then close everything in reverse order; a second call does nothing."""
        with self._closing.pop_all():
            now_ns = self.clock.monotonic_ns()
            self.recording_stream.flush(now_ns)
            self.health.report(now_ns)
