"""Between the devices and the bus: the edge service, on one asyncio loop that alone touches devices.

States come on the bus's thread, which only keeps the newest of each rig; a device takes it when it is read. Commands
and events leave at once. A tick every 20 ms does what can wait that long.
"""

import asyncio
import socket
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from functools import partial
from typing import Final

from pydantic import ValidationError

from hilrig_modbus_edge.alarm import Alarm
from hilrig_modbus_edge.device import Device
from hilrig_modbus_edge.server import Limits, RigServer, bind
from hilrig_modbus_edge.settings import DeviceSettings
from hilrig_modbus_edge.tls import TlsPolicy
from hilrig_modbus_edge.traffic import MOST
from hilrig_modbus_edge.transport import DirectLoop
from hilrig_runtime.bus import Handle
from hilrig_runtime.config import RigSettings, mistakes_in, read_rig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.impairment_config import ImpairmentConfig
from hilrig_runtime.rate import Tick
from hilrig_runtime.realtime import freeze_garbage
from hilrig_runtime.service import Arrival, Service
from hilrig_schemas import Event, ImpairmentRequest, LeaseRequest, RigReport, topics

TICK_NS: Final = 20_000_000
TRAFFIC_PERIOD_NS: Final = 200_000_000
FIRST_STATE_TIMEOUT_NS: Final = 2_000_000_000
"""How long the first controllers wait for the simulation's first word; it is told by exception 04 afterwards."""

GATHER_S: Final = 0.002
"""For so long commands wait for each other where many rigs are commanded, if the next tick is far enough."""
MANY: Final = 16
"""Rigs that are looked after at once; more than that in turns, so that no request waits for all of them."""
MOST_TURNS: Final = 4
"""In which every rig is looked after once in a tick."""
ANSWER_TIMEOUT_S: Final = 1.0


def run(service: Service) -> None:
    """Serve Modbus until the service is told to stop.

    Raises:
        OperationError: a rig's address can't be had.
    """
    with asyncio.Runner(loop_factory=DirectLoop) as runner:
        runner.run(Edge(service).run())


class _Wire:
    """A device's outlet: to the bus, to the log stream, and to the loop's timers."""

    def __init__(self, edge: "Edge", rig: str) -> None:
        service = edge.service
        commands = service.sender(topics.COMMAND, rig, first=partial(edge.commands.add, rig))
        self.send_command = commands.send
        self.repeat_command = commands.repeat
        self.traffic = service.sender(topics.TRAFFIC, rig)
        self._edge = edge
        self._timer: asyncio.TimerHandle | None = None
        self._send_ns: int | None = None
        self._states: Handle | None = None
        self._key = topics.STATE.key(service.lab.name, rig)
        self.device: Device

    def emit(self, event: Event) -> None:
        self._edge.service.emit(event)

    def sessions_changed(self) -> None:
        self._edge.state_sessions()

    def watch(self, deadline_ns: int) -> None:
        loop = asyncio.get_running_loop()
        if self._timer is not None:
            self._timer.cancel()
        delay_ns = deadline_ns - self._edge.service.clock.monotonic_ns()
        self._timer = loop.call_later(max(0, delay_ns) * 1e-9, self._on_deadline)

    def send_at(self, deadline_ns: int) -> None:
        if self._send_ns is None or deadline_ns < self._send_ns:
            self._send_ns = deadline_ns
            self._edge.alarm.call_at(deadline_ns, self._on_send)

    def _on_send(self) -> None:
        self._send_ns = None
        self.device.send_due(self._edge.service.clock.monotonic_ns())

    def follow_states(self, arrive: Callable[[Arrival], None] | None) -> None:
        if self._states is not None:
            self._states.close()
            self._states = None
        if arrive is not None:
            monotonic_ns = self._edge.service.clock.monotonic_ns
            self._states = self._edge.service.bus.subscribe(
                self._key, lambda _, payload: arrive(Arrival(payload, monotonic_ns()))
            )

    def _on_deadline(self) -> None:
        self._timer = None
        self.device.check(self._edge.service.clock.monotonic_ns())
        # Writes that came meanwhile moved the deadline; they do not move the timer, for they are many.
        deadline_ns = self.device.watchdog.deadline_ns
        if deadline_ns is not None:
            self.watch(deadline_ns)


class _Seat:
    """One rig at this edge, with all that is closed when it is taken away."""

    def __init__(self, wire: _Wire, server: RigServer) -> None:
        self.wire = wire
        self.server = server
        self.closing = ExitStack()
        self.sockets: list[tuple[socket.socket, TlsPolicy | None]] = []
        self.address = ""
        """Where it listens, for people."""
        self.traffic_due_ns = 0


class Edge:
    """The rigs of one edge."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self._states = service.latest_of_batches(topics.STATES)
        self.commands = service.gatherer(topics.COMMANDS, self._soon, self._tick_is_near)
        self._seats: dict[str, _Seat] = {rig.name: self._seat(rig) for rig in service.rigs}
        now_ns = service.clock.monotonic_ns()
        for number, seat in enumerate(self._seats.values()):
            # Apart from each other: to encode the requests of all rigs at once would hold the next one up.
            seat.traffic_due_ns = now_ns + number * TICK_NS
        service.counters.rigs = len(service.rigs)
        service.health.rig_reports = self._rig_reports
        service.addresses = self._address_of
        self._control: Handle | None = None
        self.alarm: Alarm

    def _seat(self, rig: RigSettings) -> _Seat:
        service, lab = self.service, self.service.lab
        wire = _Wire(self, rig.name)
        settings = DeviceSettings.of(lab.edge, lab.impairment_of(rig))
        wire.device = Device(rig.name, settings, service.clock, wire, partial(self._states.get, rig.name))
        limits = Limits(
            lab.edge.max_connections,
            lab.edge.max_connections_per_host,
            round(lab.edge.idle_timeout_s * 1e9),
            rig.allow,
        )
        return _Seat(wire, RigServer(wire.device, limits, service.clock, service.counters))

    async def run(self) -> None:
        """Listen, serve, and close in order."""
        service, lab = self.service, self.service.lab
        # Before the first word: another edge's controllers must not feel it.
        service.claim()
        self.alarm = Alarm(asyncio.get_running_loop(), service.clock)
        try:
            # Sockets listen before the first state is there: whoever connects early is served as soon as it can be
            # done. All or none: a rig without its port must not leave the others' open.
            for rig, seat in self._seats.items():
                self._bind(seat, lab.ports[rig], lab.tls_ports.get(rig))
            self.state_sessions()
            for seat in self._seats.values():
                seat.wire.device.begin()
                self._answer_people(seat)
            loop = asyncio.get_running_loop()
            key = topics.CONTROL.key(lab.name, service.name, service.instance)
            self._control = service.bus.serve(key, partial(_on_loop, loop, self._answer_control))
            await self._first_states()
            for seat in self._seats.values():
                await self._listen(seat)
            freeze_garbage()
            service.ready()
            await self._tick()
        finally:
            self._close()

    def _bind(self, seat: _Seat, port: int, tls_port: int | None) -> None:
        edge, rig = self.service.lab.edge, seat.wire.device.rig
        if edge.plain:
            seat.sockets.append((seat.closing.enter_context(bind(rig, edge.host, port)), None))
        if edge.tls is not None and tls_port is not None:
            listening = seat.closing.enter_context(bind(rig, edge.host, tls_port, "edge.tls.first_port"))
            seat.sockets.append((listening, TlsPolicy(edge.tls)))
        seat.address = ", ".join(f"{edge.host}:{listening.getsockname()[1]}" for listening, _ in seat.sockets)

    async def _listen(self, seat: _Seat) -> None:
        for listening, policy in seat.sockets:
            await seat.server.listen(listening, policy)

    def _address_of(self, rig: str) -> str:
        # Kept, not asked of the sockets: the roster is answered on a thread of the bus, also while the edge closes.
        seat = self._seats.get(rig)
        return seat.address if seat else ""

    def state_sessions(self) -> None:
        """Tell the log stream which sessions are open."""
        sessions = [session for seat in self._seats.values() if (session := seat.wire.device.session) is not None]
        self.service.log.set_sessions([session.as_message() for session in sessions])

    def _answer_people(self, seat: _Seat) -> None:
        loop, bus, lab = asyncio.get_running_loop(), self.service.bus, self.service.lab
        device = seat.wire.device
        for topic, answer in ((topics.LEASE, _answer_lease), (topics.IMPAIRMENT, _answer_impairment)):
            # Asked on a thread of the bus, answered on the loop, which alone touches devices.
            on_loop = partial(_on_loop, loop, partial(answer, device))
            seat.closing.enter_context(bus.serve(topic.key(lab.name, device.rig), on_loop))

    def _answer_control(self, payload: bytes) -> bytes:
        """Add, take away or reset a rig; on the loop."""
        request = Event.FromString(payload)
        if request.kind == Event.RIG_ADDED:
            text = self._add(read_rig(request.configuration_data.text))
        elif request.kind == Event.RIG_REMOVED:
            text = self._remove(request.rig)
        elif request.kind == Event.RESET:
            self._seat_of(request.rig).wire.device.reset()
            text = f"{request.rig} goes back to its start pose"
        else:
            raise OperationError("a request that the edge does not know")
        answer = Event(kind=request.kind, severity=Event.INFO, rig=request.rig, text=text)
        if request.kind != Event.RESET:
            # Of a reset the simulation tells, when it is done.
            self.service.emit(answer)
        return answer.SerializeToString()

    def _seat_of(self, rig: str) -> _Seat:
        if rig not in self._seats:
            raise OperationError(f"{rig!r} is not served here")
        return self._seats[rig]

    def _add(self, rig: RigSettings) -> str:
        if rig.name in self._seats:
            raise OperationError(f"{rig.name!r} is served already")
        if rig.port is None:
            raise OperationError(f"{rig.name!r} needs a port of its own")
        seat = self._seat(rig)
        with ExitStack() as undo:
            undo.callback(seat.closing.close)
            self._bind(seat, rig.port, None)
            undo.pop_all()
        self._seats[rig.name] = seat
        self._answer_people(seat)
        seat.wire.device.begin()
        listening = asyncio.get_running_loop().create_task(self._listen(seat))
        seat.closing.callback(listening.cancel)
        self._changed((*self.service.rigs, rig))
        return f"{rig.name} is at {self._address_of(rig.name)}"

    def _remove(self, rig: str) -> str:
        seat = self._seat_of(rig)
        self._shut(seat, "the rig was taken away")
        del self._seats[rig]
        self.state_sessions()
        self._changed(tuple(other for other in self.service.rigs if other.name != rig))
        return f"{rig} is served no more"

    def _changed(self, rigs: tuple[RigSettings, ...]) -> None:
        self.service.rigs = rigs
        self.service.counters.rigs = len(rigs)

    async def _first_states(self) -> None:
        clock, stopping = self.service.clock, self.service.stopping
        deadline_ns = clock.monotonic_ns() + FIRST_STATE_TIMEOUT_NS
        while clock.monotonic_ns() < deadline_ns and not stopping.is_set():
            if all(seat.wire.device.has_state for seat in self._seats.values()):
                return
            self.service.beat(clock.monotonic_ns())
            await asyncio.sleep(TICK_NS * 1e-9)

    async def _tick(self) -> None:
        service, counters = self.service, self.service.counters
        monotonic_ns = service.clock.monotonic_ns
        deadline_ns = monotonic_ns() + TICK_NS
        while not service.stopping.is_set():
            await asyncio.sleep((deadline_ns - monotonic_ns()) * 1e-9)
            now_ns = monotonic_ns()
            missed = max(0, (now_ns - deadline_ns) // TICK_NS)
            counters.count_tick(Tick(deadline_ns, max(0, now_ns - deadline_ns), missed), TICK_NS)
            seats = list(self._seats.values())
            turns = min(MOST_TURNS, 1 + len(seats) // MANY)
            for turn in range(turns):
                if turn:
                    turn_ns = deadline_ns + turn * TICK_NS // turns
                    await asyncio.sleep(max(0, turn_ns - monotonic_ns()) * 1e-9)
                self._look_after(seats[turn::turns], monotonic_ns())
            self.commands.look()
            service.beat(monotonic_ns())
            deadline_ns += (missed + 1) * TICK_NS

    def _look_after(self, seats: list[_Seat], now_ns: int) -> None:
        for seat in seats:
            server = seat.server
            server.device.check(now_ns)
            if server.connections:
                server.device.look()
                server.close_idle(now_ns)
            if server.traffic.count and (now_ns >= seat.traffic_due_ns or server.traffic.count >= MOST):
                seat.traffic_due_ns += TRAFFIC_PERIOD_NS * (
                    1 + max(0, now_ns - seat.traffic_due_ns) // TRAFFIC_PERIOD_NS
                )
                self._send_traffic(seat, now_ns)

    @staticmethod
    def _soon(call: Callable[[], None]) -> None:
        asyncio.get_running_loop().call_later(GATHER_S, call)

    def _tick_is_near(self) -> bool:
        """Whether a command that waits now could miss the simulation's next tick."""
        step_ns = self.service.lab.sim.step_ns
        since_ns = self.service.clock.monotonic_ns() - self._states.arrived_ns
        return since_ns > step_ns - step_ns // 4

    def _rig_reports(self) -> list[RigReport]:
        statuses = [seat.wire.device.lease_status() for seat in self._seats.values()]
        return [
            RigReport(
                rig=status.rig,
                controller=status.holder,
                session=status.session,
                watchdog_tripped=status.watchdog_tripped,
                connections=status.connections,
            )
            for status in statuses
        ]

    def _send_traffic(self, seat: _Seat, now_ns: int) -> None:
        seat.wire.traffic.send(seat.server.traffic.take(now_ns, self.service.clock.wall_ns()))

    def _shut(self, seat: _Seat, reason: str) -> None:
        seat.wire.device.shut(reason)
        seat.wire.follow_states(None)
        seat.server.close(reason)
        if seat.server.traffic.count:
            self._send_traffic(seat, self.service.clock.monotonic_ns())
        seat.closing.close()

    def _close(self) -> None:
        if self._control is not None:
            self._control.close()
        self.alarm.close()
        for seat in self._seats.values():
            self._shut(seat, "the edge stops")
        self.commands.flush()
        self.state_sessions()
        self.service.log.flush(self.service.clock.monotonic_ns())


def _answer_lease(device: Device, payload: bytes) -> bytes:
    request = LeaseRequest.FromString(payload)
    released = device.release("released by hand") if request.release else ""
    status = device.lease_status()
    status.released = released
    return status.SerializeToString()


def _answer_impairment(device: Device, payload: bytes) -> bytes:
    request = ImpairmentRequest.FromString(payload)
    if request.set_json:
        try:
            device.impaired.set(ImpairmentConfig.model_validate_json(request.set_json))
        except ValidationError as error:
            raise InputError("; ".join(mistakes_in(error))) from error
    elif request.as_lab:
        device.impaired.set(None)
    return device.impaired.status().SerializeToString()


def _on_loop(loop: asyncio.AbstractEventLoop, answer: Callable[[bytes], bytes], payload: bytes) -> bytes:
    done: Future[bytes] = Future()

    def call() -> None:
        try:
            done.set_result(answer(payload))
        except Exception as error:
            done.set_exception(error)

    loop.call_soon_threadsafe(call)
    return done.result(ANSWER_TIMEOUT_S)
