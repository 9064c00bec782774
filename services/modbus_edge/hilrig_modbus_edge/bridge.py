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
from hilrig_runtime.config import mistakes_in
from hilrig_runtime.errors import InputError
from hilrig_runtime.impairment_config import ImpairmentConfig
from hilrig_runtime.rate import Tick
from hilrig_runtime.realtime import freeze_garbage
from hilrig_runtime.service import Arrival, Service
from hilrig_schemas import Event, ImpairmentRequest, LeaseRequest, RigReport, topics

TICK_NS: Final = 20_000_000
TRAFFIC_PERIOD_NS: Final = 200_000_000
FIRST_STATE_TIMEOUT_NS: Final = 2_000_000_000
"""How long the first controllers wait for the simulation's first word; it is told by exception 04 afterwards."""

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
        commands = service.sender(topics.COMMAND, rig)
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


class Edge:
    """The rigs of one edge."""

    def __init__(self, service: Service) -> None:
        self.service = service
        lab = service.lab
        states = service.latest_of_batches(topics.STATES)
        self._wires: dict[str, _Wire] = {}
        self._servers: list[RigServer] = []
        for rig in service.rigs:
            wire = _Wire(self, rig.name)
            settings = DeviceSettings.of(lab.edge, lab.impairment_of(rig))
            wire.device = Device(rig.name, settings, service.clock, wire, partial(states.get, rig.name))
            self._wires[rig.name] = wire
            limits = Limits(
                lab.edge.max_connections,
                lab.edge.max_connections_per_host,
                round(lab.edge.idle_timeout_s * 1e9),
                rig.allow,
            )
            self._servers.append(RigServer(wire.device, limits, service.clock, service.counters))
        service.counters.rigs = len(service.rigs)
        service.health.rig_reports = self._rig_reports
        self._traffic_due_ns = 0
        self._answers: list[Handle] = []
        self.alarm: Alarm

    async def run(self) -> None:
        """Listen, serve, and close in order."""
        service = self.service
        loop = asyncio.get_running_loop()
        assert isinstance(loop, DirectLoop)
        self.alarm = Alarm(loop, service.clock)
        # Sockets listen before the first state is there: whoever connects early is served as soon as it can be done.
        sockets = self._bind()
        self.state_sessions()
        for server in self._servers:
            server.device.begin()
        try:
            self._answer_people()
            await self._first_states()
            for server, listening, policy in sockets:
                await server.listen(loop, listening, policy)
            freeze_garbage()
            service.ready()
            await self._tick()
        finally:
            self._close()
            for _, listening, _ in sockets:
                listening.close()

    def _bind(self) -> list[tuple[RigServer, socket.socket, TlsPolicy | None]]:
        edge, lab = self.service.lab.edge, self.service.lab
        policy = None if edge.tls is None else TlsPolicy(edge.tls)
        with ExitStack() as bound:
            sockets: list[tuple[RigServer, socket.socket, TlsPolicy | None]] = []
            for server in self._servers:
                rig = server.device.rig
                if edge.plain:
                    listening = bound.enter_context(bind(rig, edge.host, lab.ports[rig]))
                    sockets.append((server, listening, None))
                if policy is not None:
                    port = lab.tls_ports[rig]
                    listening = bound.enter_context(bind(rig, edge.host, port, "edge.tls.first_port"))
                    sockets.append((server, listening, policy))
            # All or none: a rig without its port must not leave the others' open.
            bound.pop_all()
            return sockets

    def state_sessions(self) -> None:
        """Tell the log stream which sessions are open."""
        open_sessions = [wire.device.session for wire in self._wires.values() if wire.device.session is not None]
        self.service.log.set_sessions([session.as_message() for session in open_sessions])

    def _answer_people(self) -> None:
        loop, bus, lab = asyncio.get_running_loop(), self.service.bus, self.service.lab
        for rig, wire in self._wires.items():
            for topic, answer in ((topics.LEASE, _answer_lease), (topics.IMPAIRMENT, _answer_impairment)):
                # Asked on a thread of the bus, answered on the loop, which alone touches devices.
                on_loop = partial(_on_loop, loop, partial(answer, wire.device))
                self._answers.append(bus.serve(topic.key(lab.name, rig), on_loop))

    async def _first_states(self) -> None:
        clock, stopping = self.service.clock, self.service.stopping
        deadline_ns = clock.monotonic_ns() + FIRST_STATE_TIMEOUT_NS
        while clock.monotonic_ns() < deadline_ns and not stopping.is_set():
            if all(wire.device.has_state for wire in self._wires.values()):
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
            deadline_ns += (missed + 1) * TICK_NS
            self._do_due(now_ns)

    def _do_due(self, now_ns: int) -> None:
        for server in self._servers:
            server.device.check(now_ns)
            if server.connections:
                server.device.look()
                server.close_idle(now_ns)
        traffic_due = now_ns >= self._traffic_due_ns
        if traffic_due:
            self._traffic_due_ns = now_ns + TRAFFIC_PERIOD_NS
        for server in self._servers:
            if server.traffic.count and (traffic_due or server.traffic.count >= MOST):
                self._send_traffic(server, now_ns)
        self.service.beat(now_ns)

    def _rig_reports(self) -> list[RigReport]:
        statuses = [wire.device.lease_status() for wire in self._wires.values()]
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

    def _send_traffic(self, server: RigServer, now_ns: int) -> None:
        message = server.traffic.take(now_ns, self.service.clock.wall_ns())
        self._wires[server.device.rig].traffic.send(message)

    def _close(self) -> None:
        now_ns = self.service.clock.monotonic_ns()
        for answer in self._answers:
            answer.close()
        self.alarm.close()
        for server in self._servers:
            server.device.shut("the edge stops")
            server.close("the edge stops")
            if server.traffic.count:
                self._send_traffic(server, now_ns)
        self.state_sessions()
        self.service.log.flush(now_ns)


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
