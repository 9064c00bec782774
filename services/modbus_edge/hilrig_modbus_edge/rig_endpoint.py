"""One rig at an edge: its device, the sockets of its controllers, and its outlet to the bus; closed as one."""

import asyncio
import socket
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Final

from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.settings import DeviceSettings
from hilrig_modbus_edge.request_log import MOST
from hilrig_modbus_edge.server.admission import Limits
from hilrig_modbus_edge.server.listener import RigServer, bind
from hilrig_modbus_edge.server.tls import TlsPolicy
from hilrig_runtime.bus.api import Handle
from hilrig_runtime.config.lab import RigSettings
from hilrig_runtime.messaging.endpoints import Arrival, LatestOfBatches
from hilrig_runtime.process.service import Service
from hilrig_schemas import Event, RigReport, topics

TRAFFIC_PERIOD_NS: Final = 200_000_000


class Wire:
    """A device's outlet: to the bus, to the log stream, and to the loop's timers."""

    def __init__(
        self, rig: str, service: Service, commands: CommandScheduler, sessions_changed: Callable[[], None]
    ) -> None:
        sender = service.sender(topics.COMMAND, rig, first=partial(commands.send, rig))
        self.send_command = sender.send
        self.repeat_command = sender.repeat
        self.emit: Callable[[Event], None] = service.emit
        self.sessions_changed = sessions_changed
        self.device: Device
        """Whose outlet it is; set once, by whoever makes both."""
        self._bus = service.bus
        self._monotonic_ns = service.clock.monotonic_ns
        self._state_key = topics.STATE.key(service.lab.name, rig)
        self._timer: asyncio.TimerHandle | None = None
        self._send_ns: int | None = None
        self._states: Handle | None = None

    def watch(self, deadline_ns: int) -> None:
        """See `DeviceOutput.watch`."""
        loop = asyncio.get_running_loop()
        if self._timer is not None:
            self._timer.cancel()
        delay_ns = deadline_ns - self._monotonic_ns()
        self._timer = loop.call_later(max(0, delay_ns) * 1e-9, self._on_deadline)

    def send_at(self, deadline_ns: int) -> None:
        """See `DeviceOutput.send_at`."""
        if self._send_ns is None or deadline_ns < self._send_ns:
            self._send_ns = deadline_ns
            asyncio.get_running_loop().call_at(deadline_ns * 1e-9, self._on_send)

    def follow_states(self, arrive: Callable[[Arrival], None] | None) -> None:
        """See `DeviceOutput.follow_states`."""
        if self._states is not None:
            self._states.close()
            self._states = None
        if arrive is not None:
            monotonic_ns = self._monotonic_ns
            self._states = self._bus.subscribe(
                self._state_key, lambda _, payload: arrive(Arrival(payload, monotonic_ns()))
            )

    def _on_send(self) -> None:
        self._send_ns = None
        self.device.send_due(self._monotonic_ns())

    def _on_deadline(self) -> None:
        self._timer = None
        self.device.check(self._monotonic_ns())
        # Writes that came meanwhile moved the deadline; they do not move the timer, for they are many.
        deadline_ns = self.device.watchdog.deadline_ns
        if deadline_ns is not None:
            self.watch(deadline_ns)


class Seat:
    """See the module."""

    def __init__(
        self,
        rig: RigSettings,
        service: Service,
        states: LatestOfBatches,
        commands: CommandScheduler,
        sessions_changed: Callable[[], None],
    ) -> None:
        lab = service.lab
        self._clock = service.clock
        self._edge = lab.edge
        self._wire = Wire(rig.name, service, commands, sessions_changed)
        settings = DeviceSettings.of(lab.edge, lab.impairment_of(rig))
        self.device = self._wire.device = Device(
            rig.name, settings, service.clock, self._wire, partial(states.get, rig.name)
        )
        limits = Limits(
            lab.edge.max_connections,
            lab.edge.max_connections_per_host,
            round(lab.edge.idle_timeout_s * 1e9),
            rig.allow,
        )
        self._server = RigServer(self.device, limits, service.clock, service.counters)
        self.closing = ExitStack()
        """What is closed with the seat."""
        self.address = ""
        """Where it listens, for people. Kept, not asked of the sockets: the roster is answered on a thread of the bus,
        also while the edge closes."""
        self._traffic = service.sender(topics.TRAFFIC, rig.name)
        self.traffic_due_ns = 0
        """When the requests that were noted are to be sent, ns, monotonic clock."""
        self._sockets: list[tuple[socket.socket, TlsPolicy | None]] = []

    def bind(self, port: int, tls_port: int | None) -> None:
        """Have the rig's addresses, so that whoever connects is served as soon as `listen` is called.

        Raises:
            OperationError: one can't be had.
        """
        edge, rig = self._edge, self.device.rig
        if edge.plain:
            self._sockets.append((self.closing.enter_context(bind(rig, edge.host, port)), None))
        if edge.tls is not None and tls_port is not None:
            listening = self.closing.enter_context(bind(rig, edge.host, tls_port, "edge.tls.first_port"))
            self._sockets.append((listening, TlsPolicy(edge.tls)))
        self.address = ", ".join(f"{edge.host}:{listening.getsockname()[1]}" for listening, _ in self._sockets)

    def bind_alone(self, port: int) -> None:
        """Have one address: without TLS, or with TLS where the lab listens in no other way. Raises as `bind`."""
        self.bind(port, None if self._edge.plain else port)

    async def listen(self) -> None:
        """Serve controllers."""
        for listening, policy in self._sockets:
            await self._server.listen(listening, policy)

    def look_after(self, now_ns: int) -> None:
        """Do what has become due, a few times a second or more; ns, monotonic clock."""
        server = self._server
        self.device.check(now_ns)
        if server.connections:
            self.device.refresh_state()
            server.close_idle(now_ns)
        if server.traffic.count and (now_ns >= self.traffic_due_ns or server.traffic.count >= MOST):
            late_ns = max(0, now_ns - self.traffic_due_ns)
            self.traffic_due_ns += TRAFFIC_PERIOD_NS * (1 + late_ns // TRAFFIC_PERIOD_NS)
            self._send_traffic()

    def report(self) -> RigReport:
        """What a health report says of the rig."""
        status = self.device.lease_status()
        return RigReport(
            rig=status.rig,
            controller=status.holder,
            session=status.session,
            watchdog_tripped=status.watchdog_tripped,
            connections=status.connections,
        )

    def shut(self, reason: str) -> None:
        """No torque, no lease, no session, no connection; `reason` is for people."""
        self.device.stop(reason)
        self._wire.follow_states(None)
        self._server.close(reason)
        if self._server.traffic.count:
            self._send_traffic()
        self.closing.close()

    def _send_traffic(self) -> None:
        clock = self._clock
        self._traffic.send(self._server.traffic.take(clock.monotonic_ns(), clock.wall_ns()))
