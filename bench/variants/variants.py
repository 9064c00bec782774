"""Variants of the services with one optimization disabled; each function installs the simple implementation."""

import contextlib
from collections.abc import Callable
from typing import Any


def no_coalescing() -> None:
    """Send each command immediately in its own message."""
    from hilrig_modbus_edge.command_scheduler import CommandScheduler

    CommandScheduler._send_time = lambda self, rig, now_ns: now_ns


def fixed_window() -> None:
    """Send the commands that arrive within 2 ms together, without a deadline."""
    from hilrig_modbus_edge import command_scheduler

    def send_time(self: Any, rig: str, now_ns: int) -> int:
        return now_ns + command_scheduler.COALESCE_WINDOW_NS

    command_scheduler.CommandScheduler._send_time = send_time


def no_write_limit() -> None:
    """Treat all commands of a rig alike, independent of the number of writes per state."""
    from hilrig_modbus_edge import command_scheduler

    command_scheduler.SEPARATE_WRITES = 1 << 30


def unsplit_edge_tick() -> None:
    """Maintain all rigs in one iteration of the event loop at the edge's tick."""
    from hilrig_modbus_edge import service

    service.RIGS_PER_TURN = 1 << 30


def no_pre_encoding() -> None:
    """Encode states at the tick."""
    from hilrig_sim.loop import Simulation

    Simulation.pre_encode = lambda self, tick_ns: None


def asyncio_readers() -> None:
    """Serve sockets from asyncio's queue: `loop.add_reader` with the same receive call."""
    from selectors import EVENT_READ, EVENT_WRITE

    from hilrig_modbus_edge.server.event_loop import SocketTransport

    def update_events(self: Any) -> None:
        events = 0
        if not self._lost:
            if self._reading_enabled and not self._closing and self._protocol is not None:
                events = EVENT_READ
            if self._send_buffer:
                events |= EVENT_WRITE
        changed, self._events = events ^ self._events, events
        if changed & EVENT_READ:
            if events & EVENT_READ:
                self._loop.add_reader(self._socket, self._on_event, EVENT_READ)
            else:
                self._loop.remove_reader(self._socket)
        if changed & EVENT_WRITE:
            if events & EVENT_WRITE:
                self._loop.add_writer(self._socket, self._on_event, EVENT_WRITE)
            else:
                self._loop.remove_writer(self._socket)

    SocketTransport._update_events = update_events


def millisecond_timers() -> None:
    """Wait in whole milliseconds, as asyncio does, and serve sockets from asyncio's queue."""
    import selectors

    from hilrig_modbus_edge.server.event_loop import DirectSelector

    asyncio_readers()
    DirectSelector.select = selectors.DefaultSelector.select


def no_priorities() -> None:
    """Use no real-time policy, no short time slices, no exact sleep and no background priority."""
    from hilrig_runtime.process import lifecycle

    lifecycle._ask_for_time = lambda name, lab: None


def no_receiver_priority() -> None:
    """Give zenoh's receiver threads the priority of the thread that opened the bus."""
    from hilrig_runtime.bus import zenoh_bus

    zenoh_bus.raise_priority = contextlib.nullcontext


def no_log_batch() -> None:
    """Send each recorded message to the recorder immediately."""
    from hilrig_runtime.messaging.recording_stream import RecordingStream
    from hilrig_runtime.timing.clock import SYSTEM_CLOCK

    append, extend = RecordingStream.append, RecordingStream.extend

    def append_and_flush(self: Any, *entry: Any) -> None:
        append(self, *entry)
        self.flush(SYSTEM_CLOCK.monotonic_ns())

    def extend_and_flush(self: Any, entries: Any) -> None:
        for entry in entries:
            extend(self, [entry])
            self.flush(SYSTEM_CLOCK.monotonic_ns())

    RecordingStream.append, RecordingStream.extend = append_and_flush, extend_and_flush


def no_state_batch() -> None:
    """Send each state of a tick to the edge in its own message."""
    from hilrig_runtime.messaging.rig_batch import BatchPublisher
    from hilrig_schemas import RigBatch

    publish = BatchPublisher.publish

    def publish_each(self: Any, payloads: Any) -> None:
        put = self._put_batch
        for rig, payload in zip(self._rigs, payloads, strict=True):
            put(RigBatch(source=self._source, rigs=[rig], messages=[payload]).SerializeToString())
        self._put_batch = lambda _: None
        publish(self, payloads)
        self._put_batch = put

    BatchPublisher.publish = publish_each


VARIANTS: dict[str, tuple[Callable[[], None], ...]] = {
    "full": (),
    "full again": (),
    "no coalescing": (no_coalescing,),
    "fixed window": (fixed_window,),
    "no limit of separate writes": (no_write_limit,),
    "no pre-encoding": (no_pre_encoding,),
    "sockets by add_reader": (asyncio_readers,),
    "add_reader, timers in ms": (millisecond_timers,),
    "edge tick in one iteration": (unsplit_edge_tick,),
    "no priorities": (no_priorities,),
    "no receiver priority": (no_receiver_priority,),
    "no batches of records": (no_log_batch,),
    "no batches of states": (no_state_batch,),
    "all": (
        no_coalescing,
        no_pre_encoding,
        millisecond_timers,
        unsplit_edge_tick,
        no_priorities,
        no_log_batch,
        no_state_batch,
    ),
}
"""Name → the functions that disable optimizations; `full again` shows the spread of the measurement."""
