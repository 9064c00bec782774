"""Between the devices and the bus: the edge service, on one asyncio loop that alone touches devices.

States come on the bus's thread, which only keeps the newest of each rig; a device takes it when it is read. Events
leave at once, commands in time for their tick. A tick every 20 ms does what can wait that long.
"""

import asyncio
from contextlib import ExitStack, suppress
from functools import partial
from typing import Final

from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.control_api import answer_control, answer_impairment, answer_lease, serve_on_loop
from hilrig_modbus_edge.rig_endpoint import Seat
from hilrig_modbus_edge.server.event_loop import DirectEventLoop
from hilrig_runtime.config.lab import RigSettings
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Tick
from hilrig_runtime.timing.realtime import freeze_garbage
from hilrig_schemas import topics

TICK_NS: Final = 20_000_000
FIRST_STATE_TIMEOUT_NS: Final = 2_000_000_000
"""How long the first controllers wait for the simulation's first word; it is told by exception 04 afterwards."""

RIGS_PER_TURN: Final = 16
"""Rigs that one turn of the event loop maintains in a tick, so that no request waits for all of them: with all of 128
rigs in one turn the 99th percentile of a read is 60 % higher (`bench/ablation.py`)."""
PORTS_TRIED: Final = 100
"""For a rig that is added without one."""


def run(service: Service) -> None:
    """Serve Modbus until the service is told to stop.

    Raises:
        OperationError: a rig's address can't be had.
    """

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(Edge(service, runner.get_loop()).run())


class Edge:
    """The rigs of one edge."""

    def __init__(self, service: Service, loop: asyncio.AbstractEventLoop) -> None:
        self._service = service
        self._loop = loop
        self._states = service.latest_of_batches(topics.STATES)
        self._commands = CommandScheduler(
            service.source,
            service.publisher(topics.COMMANDS).put,
            self._states.get,
            service.lab.sim.step_ns,
            service.clock,
            loop.call_at,
        )
        self._seats: dict[str, Seat] = {rig.name: self._seat(rig) for rig in service.rigs}
        now_ns = service.clock.monotonic_ns()
        for number, seat in enumerate(self._seats.values()):
            # Apart from each other: to encode the requests of all rigs at once would hold the next one up.
            seat.traffic_due_ns = now_ns + number * TICK_NS
        service.counters.rigs = len(service.rigs)
        service.health.rig_reports = lambda: [seat.report() for seat in self._seats.values()]
        service.addresses = self._address_of
        self._closing = ExitStack()

    def _seat(self, rig: RigSettings) -> Seat:
        return Seat(rig, self._service, self._states, self._commands, self._state_sessions)

    async def run(self) -> None:
        """Listen, serve, and close in order."""
        service, lab = self._service, self._service.lab
        # Before the first word: another edge's controllers must not feel it.
        service.claim()
        try:
            # Sockets listen before the first state is there: whoever connects early is served as soon as it can be
            # done. All or none: a rig without its port must not leave the others' open.
            try:
                ports, tls_ports = lab.ports, lab.tls_ports
                for rig, seat in self._seats.items():
                    seat.bind(ports[rig], tls_ports.get(rig))
            except OperationError:
                # Who has the port may be another edge of the lab, with which the bus was not linked yet.
                service.look_for_elders()
                raise
            self._state_sessions()
            for seat in self._seats.values():
                seat.device.begin()
                self._answer_people(seat)
            answer = partial(answer_control, self, service.emit)
            key = topics.CONTROL.key(lab.name, service.name, service.instance)
            self._closing.enter_context(serve_on_loop(service.bus, key, self._loop, answer))
            await self._first_states()
            for seat in self._seats.values():
                await seat.listen()
            freeze_garbage()
            service.ready()
            await self._tick()
        finally:
            self._close()

    # -- rigs come and go

    def add(self, rig: RigSettings) -> str:
        """Serve one more rig, without a port of its own at the next free one; what was done, for people.

        Raises:
            OperationError: it is served already, or its address can't be had.
        """
        if rig.name in self._seats:
            raise OperationError(f"{rig.name!r} is served already")
        seat = self._seat(rig)
        with ExitStack() as undo:
            undo.callback(seat.closing.close)
            if rig.port is None:
                self._bind_behind_the_others(seat)
            else:
                seat.bind_alone(rig.port)
            undo.pop_all()
        self._seats[rig.name] = seat
        self._answer_people(seat)
        seat.device.begin()
        listening = self._loop.create_task(seat.listen())
        seat.closing.callback(listening.cancel)
        self._changed((*self._service.rigs, rig))
        return f"{rig.name} is at {seat.address}"

    def remove(self, rig: str) -> str:
        """Serve a rig no more; what was done, for people.

        Raises:
            OperationError: it is not served here.
        """
        self._seat_of(rig).shut("the rig was taken away")
        del self._seats[rig]
        self._state_sessions()
        self._changed(tuple(other for other in self._service.rigs if other.name != rig))
        return f"{rig} is served no more"

    def reset(self, rig: str) -> str:
        """Put a rig back to its start pose; what was done, for people.

        Raises:
            OperationError: it is not served here.
        """
        self._seat_of(rig).device.reset()
        return f"{rig} goes back to its start pose"

    def _bind_behind_the_others(self, seat: Seat) -> None:
        """Take the first port behind all that the lab's file gives, which nobody has: neither a rig that was added
        before, at whichever edge, nor a stranger."""
        lab = self._service.lab
        first = max([*lab.ports.values(), *lab.tls_ports.values()]) + 1
        last = min(first + PORTS_TRIED, 0x10000) - 1
        for port in range(first, last + 1):
            with suppress(OperationError):
                seat.bind_alone(port)
                return
        raise OperationError(f"no port from {first} to {last} is free: give one with --port")

    def _seat_of(self, rig: str) -> Seat:
        if rig not in self._seats:
            raise OperationError(f"{rig!r} is not served here")
        return self._seats[rig]

    def _changed(self, rigs: tuple[RigSettings, ...]) -> None:
        self._service.rigs = rigs
        self._service.counters.rigs = len(rigs)

    # -- what others ask

    def _address_of(self, rig: str) -> str:
        seat = self._seats.get(rig)
        return seat.address if seat else ""

    def _answer_people(self, seat: Seat) -> None:
        bus, lab, device = self._service.bus, self._service.lab, seat.device
        for topic, answer in ((topics.LEASE, answer_lease), (topics.IMPAIRMENT, answer_impairment)):
            key = topic.key(lab.name, device.rig)
            seat.closing.enter_context(serve_on_loop(bus, key, self._loop, partial(answer, device)))

    def _state_sessions(self) -> None:
        """Tell the log stream which sessions are open."""
        sessions = [session for seat in self._seats.values() if (session := seat.device.session) is not None]
        self._service.log.set_sessions([session.as_message() for session in sessions])

    # -- time

    async def _first_states(self) -> None:
        clock, stopping = self._service.clock, self._service.stopping
        deadline_ns = clock.monotonic_ns() + FIRST_STATE_TIMEOUT_NS
        while clock.monotonic_ns() < deadline_ns and not stopping.is_set():
            if all(seat.device.has_state for seat in self._seats.values()):
                return
            self._service.beat(clock.monotonic_ns())
            await asyncio.sleep(TICK_NS * 1e-9)

    async def _tick(self) -> None:
        service, counters = self._service, self._service.counters
        monotonic_ns = service.clock.monotonic_ns
        deadline_ns = monotonic_ns() + TICK_NS
        while not service.stopping.is_set():
            await asyncio.sleep((deadline_ns - monotonic_ns()) * 1e-9)
            now_ns = monotonic_ns()
            missed = max(0, (now_ns - deadline_ns) // TICK_NS)
            counters.count_tick(Tick(deadline_ns, max(0, now_ns - deadline_ns), missed), TICK_NS)
            for number, seat in enumerate(list(self._seats.values())):
                if number and number % RIGS_PER_TURN == 0:
                    await asyncio.sleep(0)
                seat.look_after(monotonic_ns())
            service.beat(monotonic_ns())
            deadline_ns += (missed + 1) * TICK_NS

    def _close(self) -> None:
        self._closing.close()
        for seat in self._seats.values():
            seat.shut("the edge stops")
        self._commands.flush()
        self._state_sessions()
        self._service.log.flush(self._service.clock.monotonic_ns())
