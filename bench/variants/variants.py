"""Variants of the services in which one optimization is disabled: each function replaces it with the plain way."""

import contextlib
from collections.abc import Callable
from typing import Any


def no_coalescing() -> None:
    """Every command is sent at once, in a message of its own."""
    from hilrig_modbus_edge.command_scheduler import CommandScheduler

    CommandScheduler._send_time = lambda self, rig, now_ns: now_ns


def fixed_window() -> None:
    """Commands that arrive within 2 ms are sent together; no deadline."""
    from hilrig_modbus_edge import command_scheduler

    def send_time(self: Any, rig: str, now_ns: int) -> int:
        return now_ns + command_scheduler.COALESCE_WINDOW_NS

    command_scheduler.CommandScheduler._send_time = send_time


def no_further_writes() -> None:
    """All commands of a rig are prompt, however often its controller writes."""
    from hilrig_modbus_edge import command_scheduler

    command_scheduler.SEPARATE_WRITES = 1 << 30


def edge_tick_whole() -> None:
    """One turn of the event loop maintains all rigs in the edge's tick."""
    from hilrig_modbus_edge import service

    service.RIGS_PER_TURN = 1 << 30


def no_pre_encoding() -> None:
    """States are encoded at the tick."""
    from hilrig_sim.loop import Simulation

    Simulation.pre_encode = lambda self, tick_ns: None


def asyncio_readers() -> None:
    """Sockets are served from asyncio's queue: `loop.add_reader` with the same receive call."""
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
    """The loop waits in whole milliseconds, as asyncio does; sockets are served from asyncio's queue too."""
    import selectors

    from hilrig_modbus_edge.server.event_loop import DirectSelector

    asyncio_readers()
    DirectSelector.select = selectors.DefaultSelector.select


def no_priorities() -> None:
    """No real-time policy, no short slices, no exact sleep, no background priority."""
    from hilrig_runtime.process import lifecycle

    lifecycle._ask_for_time = lambda name, lab: None


def receivers_not_ahead() -> None:
    """zenoh's receiving threads have the priority of the thread that opened the bus."""
    from hilrig_runtime.bus import zenoh_bus

    zenoh_bus.raise_priority = contextlib.nullcontext


def no_log_batch() -> None:
    """Every recorded message is sent to the recorder at once."""
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
    """The states of a tick go to the edge in a message each."""
    from hilrig_runtime.messaging.rig_batch import BatchPublisher
    from hilrig_schemas import RigBatch

    send = BatchPublisher.send

    def send_each(self: Any, payloads: Any) -> None:
        put = self._put_together
        for rig, payload in zip(self._rigs, payloads, strict=True):
            put(RigBatch(source=self._source, rigs=[rig], messages=[payload]).SerializeToString())
        self._put_together = lambda _: None
        send(self, payloads)
        self._put_together = put

    BatchPublisher.send = send_each


VARIANTS: dict[str, tuple[Callable[[], None], ...]] = {
    "full": (),
    "full again": (),
    "no coalescing": (no_coalescing,),
    "fixed window": (fixed_window,),
    "no rule for further writes": (no_further_writes,),
    "no pre-encoding": (no_pre_encoding,),
    "sockets by add_reader": (asyncio_readers,),
    "add_reader, timers in ms": (millisecond_timers,),
    "edge tick in one turn": (edge_tick_whole,),
    "no priorities": (no_priorities,),
    "receivers not ahead": (receivers_not_ahead,),
    "no batch of the log": (no_log_batch,),
    "no batch of states": (no_state_batch,),
    "all": (
        no_coalescing,
        no_pre_encoding,
        millisecond_timers,
        edge_tick_whole,
        no_priorities,
        no_log_batch,
        no_state_batch,
    ),
}
"""Name → the functions that disable something; `full again` shows the spread of the measurement."""
