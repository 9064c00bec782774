"""One rig of an edge: its device, its listening sockets and its connection to the bus, closed together."""

import asyncio
import socket
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from hilrig_modbus_edge.client.exchange import Exchange, ExchangeSettings
from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.ports import Ownership
from hilrig_modbus_edge.device.settings import MS, DeviceSettings
from hilrig_modbus_edge.request_log import MAX_REQUESTS_PER_MESSAGE
from hilrig_modbus_edge.server.admission import Limits
from hilrig_modbus_edge.server.listener import RigServer, bind
from hilrig_modbus_edge.server.tls import TlsPolicy
from hilrig_runtime.addresses import format_address, reachable_hosts
from hilrig_runtime.bus.api import Handle
from hilrig_runtime.config.lab import RigSettings
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache, TimestampedPayload
from hilrig_runtime.process.service import Service
from hilrig_schemas import Event, ExceptionCount, RigReport, topics

REQUEST_LOG_PERIOD_NS: Final = 200_000_000
"""Period at which the request log of a rig is published, ns."""
CHECK_PERIOD_NS: Final = 500_000_000
"""Period at which the connections are checked, ns."""
TCP_FIGURES_PERIOD_NS: Final = 1_000_000_000
"""Period at which the TCP figures of the connections are recorded, ns."""


class BusOutput:
    """Output port of a device: publishes its events on the bus, and runs its timers on the event loop.

    Implements `DeviceOutput`.
    """

    def __init__(self, rig: str, service: Service, sessions_changed: Callable[[], None]) -> None:
        self.emit: Callable[[Event], None] = service.emit
        self.sessions_changed = sessions_changed
        self._bus = service.bus
        self._monotonic_ns = service.clock.monotonic_ns
        self._state_key = topics.STATE.key(service.lab.name, rig)
        self._states: Handle | None = None

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> asyncio.TimerHandle:
        """See `DeviceOutput.call_at`."""
        return asyncio.get_running_loop().call_at(deadline_ns * 1e-9, callback)

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        """See `DeviceOutput.follow_states`."""
        if self._states is not None:
            self._states.close()
            self._states = None
        if arrive is not None:
            monotonic_ns = self._monotonic_ns
            self._states = self._bus.subscribe(
                self._state_key, lambda _, payload: arrive(TimestampedPayload(payload, monotonic_ns()))
            )


class RigEndpoint:
    """Device, server and bus connection of one rig."""

    def __init__(
        self,
        rig: RigSettings,
        service: Service,
        states: LatestValueCache,
        scheduler: CommandScheduler,
        sessions_changed: Callable[[], None],
        ownership: Ownership | None = None,
    ) -> None:
        lab = service.lab
        self._clock = service.clock
        self._edge = lab.edge
        self._host = lab.host_of(rig)
        self._output = BusOutput(rig.name, service, sessions_changed)
        settings = DeviceSettings.of(lab.edge, lab.impairment_of(rig))
        if rig.controller is not None:
            settings = settings.of_reserved_rig(round(rig.client.timeout_ms * MS))
        publisher = service.rig_publisher(topics.COMMAND, rig.name)
        sender = CommandSender(rig.name, scheduler, publisher, service.clock, settings.repeat_ns)
        self.device = Device(rig.name, settings, service.clock, self._output, states, sender, ownership=ownership)
        limits = Limits(
            lab.edge.max_connections,
            lab.edge.max_connections_per_host,
            round(lab.edge.idle_timeout_s * 1e9),
            rig.allow,
        )
        self._server = RigServer(self.device, limits, service.clock, service.counters)
        self.exchange: Exchange | None = None
        """Exchange with the controller, if that is a server; None: the rig is a server only."""
        if rig.controller is not None:
            exchange_settings = ExchangeSettings.of(rig, lab.sim.step_ns)
            request_log = self._server.request_log
            self.exchange = Exchange(exchange_settings, self.device, states, service.clock, request_log)
        self.closing = ExitStack()
        """Resources that are closed with the endpoint."""
        self.address = ""
        """Addresses that reach the rig, human-readable. Stored: a thread of the bus reads it while the edge closes."""
        self._request_log = service.rig_publisher(topics.TRAFFIC, rig.name)
        self.request_log_due_ns = 0
        """Time at which the request log is published next, ns, monotonic clock."""
        self._tcp_figures_due_ns = 0
        self._check_due_ns = 0
        self._sockets: list[tuple[socket.socket, TlsPolicy | None]] = []

    def bind(self, port: int, tls_port: int | None) -> None:
        """Bind the addresses of the rig; connections wait in the backlog until `listen` is called.

        Raises:
            OperationError: an address is unavailable.
        """
        edge, rig = self._edge, self.device.rig
        if edge.plain:
            self._sockets.append((self.closing.enter_context(bind(rig, self._host, port)), None))
        if edge.tls is not None and tls_port is not None:
            listening = self.closing.enter_context(bind(rig, self._host, tls_port, "edge.tls.first_port"))
            self._sockets.append((listening, TlsPolicy(edge.tls)))
        ports = [listening.getsockname()[1] for listening, _ in self._sockets]
        addresses = [format_address(host, port) for port in ports for host in reachable_hosts(self._host)]
        if self.exchange is not None:
            addresses.append(f"client of {self.exchange.address}")
        self.address = ", ".join(addresses)

    def bind_single(self, port: int) -> None:
        """Bind one address: without TLS, or with TLS if the lab has no plain connections. Raises as `bind`."""
        self.bind(port, None if self._edge.plain else port)

    async def listen(self) -> None:
        """Serve clients, and start the exchange with the controller if that is a server."""
        for listening, policy in self._sockets:
            await self._server.listen(listening, policy)
        if self.exchange is not None:
            self.exchange.start()

    def on_tick(self, now_ns: int) -> None:
        """Do the periodic work: device, connections, request log; ns, monotonic clock."""
        server = self._server
        self.device.check(now_ns)
        if server.connections:
            self.device.refresh_state()
        if now_ns >= self._check_due_ns:
            self._check_due_ns = now_ns + CHECK_PERIOD_NS
            server.check(now_ns)
            server.close_expired(self._clock.wall_ns())
        count = server.request_log.count
        if count and (now_ns >= self.request_log_due_ns or count >= MAX_REQUESTS_PER_MESSAGE):
            late_ns = max(0, now_ns - self.request_log_due_ns)
            self.request_log_due_ns += REQUEST_LOG_PERIOD_NS * (1 + late_ns // REQUEST_LOG_PERIOD_NS)
            if now_ns >= self._tcp_figures_due_ns:
                self._tcp_figures_due_ns = now_ns + TCP_FIGURES_PERIOD_NS
                server.log_tcp_figures()
            self._publish_request_log()

    def close_certificate(self, name: str, reason: str) -> int:
        """Close the connections of clients with a certificate; see `RigServer.close_certificate`."""
        return self._server.close_certificate(name, reason)

    def report(self) -> RigReport:
        """Return the part of the health report that describes the rig."""
        status, server = self.device.lease_status(), self._server
        return RigReport(
            rig=status.rig,
            controller=status.holder,
            session=status.session,
            watchdog_tripped=status.watchdog_tripped,
            connections=status.connections,
            exceptions=[
                ExceptionCount(host=host, function=function, code=code, count=count)
                for host, function, code, count in server.exceptions.counts()
            ],
            alert=server.alert(),
            student=status.student,
        )

    def stop(self, reason: str) -> None:
        """Set the torque to zero, end lease and session, and close all connections; `reason` is human-readable."""
        if self.exchange is not None:
            self.exchange.stop()
        self.device.stop(reason)
        self._output.follow_states(None)
        self._server.close(reason)
        if self._server.request_log.count:
            self._publish_request_log()
        self.closing.close()

    def _publish_request_log(self) -> None:
        clock, server = self._clock, self._server
        server.counters.requests += server.request_log.count
        self._request_log.publish(server.request_log.drain(clock.monotonic_ns(), clock.wall_ns()))
