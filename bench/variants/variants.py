"""Variants of the services in which one optimization is disabled: each function replaces it with the plain way."""

import contextlib
from collections.abc import Callable
from typing import Any


def no_coalescing() -> None:
    """Every command is sent at once, in a message of its own."""
    from hilrig_modbus_edge.command_scheduler import Departures

    def look(self: Any) -> None:
        self._count = 0

    Departures.look = look


def fixed_window() -> None:
    """Commands that come within 2 ms are sent together; no rule about the tick."""
    from hilrig_modbus_edge import command_scheduler as departures

    departures.Departures._waits_ns = lambda self, rig, now_ns: departures.GATHER_NS


def two_rules() -> None:
    """First command on a state: 2 ms window, none within 3 ms of the tick. Later ones: 1.5 ms before the tick."""
    from hilrig_modbus_edge import command_scheduler as departures

    def waits_ns(self: Any, rig: str, now_ns: int) -> int:
        state = self._newest_state(rig)
        state_ns = 0 if state is None else state.arrived_ns
        to_tick_ns = state_ns + self._step_ns - now_ns
        first = self._said.get(rig) != state_ns
        self._said[rig] = state_ns
        if first:
            return 0 if to_tick_ns < departures.NEAR_NS else departures.GATHER_NS
        return max(0, to_tick_ns - departures.LAST_NS)

    departures.Departures._waits_ns = waits_ns


def _throttle(window_ns: int, margin_ns: int) -> Callable[[], None]:
    def disable() -> None:
        from hilrig_modbus_edge.command_scheduler import Departures

        flush = Departures.flush

        def flush_and_note(self: Any) -> None:
            flush(self)
            self._state_count = self._monotonic_ns()

        def send(self: Any, rig: str, command: bytes) -> None:
            self._waiting[rig] = command
            now_ns = self._monotonic_ns()
            state = self._newest_state(rig)
            due_ns = getattr(self, "_state_count", 0) + window_ns
            if state is not None:
                tick_ns = state.arrived_ns + self._step_ns
                if tick_ns + self._step_ns > now_ns:
                    due_ns = min(due_ns, tick_ns - margin_ns)
            if due_ns <= now_ns:
                self.flush()
            else:
                self._leave_at(due_ns)

        Departures.send, Departures.flush, Departures.look = send, flush_and_note, lambda self: None

    return disable


def throttle_2_ms() -> None:
    """At most a message in 2 ms; nothing waits in the last 1.5 ms before the tick."""
    _throttle(2_000_000, 1_500_000)()


def throttle_1_ms() -> None:
    """At most a message in 1 ms; nothing waits in the last 1.5 ms before the tick."""
    _throttle(1_000_000, 1_500_000)()


def edge_tick_unaligned() -> None:
    """The edge's own tick is not moved behind the last command before the simulation's tick."""
    from hilrig_modbus_edge.command_scheduler import Departures

    Departures.after_last = lambda self, rig, when_ns: when_ns


def edge_tick_whole() -> None:
    """All rigs are looked after at once in the edge's tick."""
    from hilrig_modbus_edge import service as bridge

    bridge.MOST_TURNS = 1


def no_pre_encoding() -> None:
    """States are encoded at the tick."""
    from hilrig_sim.loop import Simulation

    Simulation.look_ahead = lambda self, tick_ns: None


def _passes(*parts: int) -> Callable[[], None]:
    def disable() -> None:
        from hilrig_sim import loop

        loop.AHEAD = parts

    return disable


def one_pass_early() -> None:
    """States are encoded once, a quarter of a step before the tick."""
    _passes(4)()


def one_pass_late() -> None:
    """States are encoded once, a twelfth of a step before the tick."""
    _passes(12)()


def asyncio_readers() -> None:
    """Sockets are served from asyncio's queue: `loop.add_reader` with the same receive call."""
    from selectors import EVENT_READ, EVENT_WRITE

    from hilrig_modbus_edge.server.event_loop import DirectTransport

    def want(self: Any) -> None:
        wanted = 0
        if not self._lost:
            if self._reading and not self._closing and self._protocol is not None:
                wanted = EVENT_READ
            if self._waiting:
                wanted |= EVENT_WRITE
        changed, self._wanted = wanted ^ self._wanted, wanted
        if changed & EVENT_READ:
            if wanted & EVENT_READ:
                self._loop.add_reader(self._socket, self._on_event, EVENT_READ)
            else:
                self._loop.remove_reader(self._socket)
        if changed & EVENT_WRITE:
            if wanted & EVENT_WRITE:
                self._loop.add_writer(self._socket, self._on_event, EVENT_WRITE)
            else:
                self._loop.remove_writer(self._socket)

    DirectTransport._want = want


def millisecond_timers() -> None:
    """The loop waits in whole milliseconds, as asyncio does; sockets are served from asyncio's queue too."""
    import selectors

    from hilrig_modbus_edge.server.event_loop import DirectSelector

    asyncio_readers()
    DirectSelector.select = selectors.EpollSelector.select


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


def plain_request_log() -> None:
    """The kind of each logged request is decoded anew."""
    from hilrig_modbus_edge import request_log as traffic

    def note(self: Any, pdu: bytes, arrived_ns: int, answered_ns: int, exception: int, controller: str) -> None:
        self._add_index(self._index(traffic._kind_of(pdu[:5]), exception, controller))
        self._add_arrived_ns(arrived_ns)
        self._add_answered_after_ns(answered_ns - arrived_ns)

    traffic.TrafficRecord.note = note


VARIANTS: dict[str, tuple[Callable[[], None], ...]] = {
    "full": (),
    "no coalescing": (no_coalescing,),
    "coalescing: fixed 2 ms window": (fixed_window,),
    "coalescing: two rules": (two_rules,),
    "coalescing: throttle 2 ms": (throttle_2_ms,),
    "coalescing: throttle 1 ms": (throttle_1_ms,),
    "edge tick not aligned": (edge_tick_unaligned,),
    "edge tick in one turn": (edge_tick_whole,),
    "no pre-encoding": (no_pre_encoding,),
    "one pre-encoding pass, early": (one_pass_early,),
    "one pre-encoding pass, late": (one_pass_late,),
    "sockets by add_reader": (asyncio_readers,),
    "add_reader, timers in ms": (millisecond_timers,),
    "no priorities": (no_priorities,),
    "receivers not ahead": (receivers_not_ahead,),
    "no batch of the log": (no_log_batch,),
    "no batch of states": (no_state_batch,),
    "plain request log": (plain_request_log,),
    "all but coalescing and one pass": (
        two_rules,
        edge_tick_unaligned,
        edge_tick_whole,
        one_pass_late,
        asyncio_readers,
        receivers_not_ahead,
        plain_request_log,
    ),
    "all": (
        no_coalescing,
        edge_tick_unaligned,
        edge_tick_whole,
        no_pre_encoding,
        millisecond_timers,
        no_priorities,
        no_log_batch,
        no_state_batch,
        plain_request_log,
    ),
}
