"""Edge service: Modbus devices of the rigs on one asyncio event loop, the only thread that accesses them.

States are received on a thread of the bus, which stores the newest one of each rig; a device fetches it when it is
read. Events are published at once, commands in time for the next tick of the simulation. Periodic work is done in an
edge tick every 20 ms.
"""

import asyncio
import logging
import platform
from contextlib import ExitStack, suppress
from functools import partial
from typing import Final

from hilrig_modbus_edge.classroom.owners import ClassOwners
from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_modbus_edge.control_api import handle_impairment_query, handle_lease_query
from hilrig_modbus_edge.rig_endpoint import RigEndpoint
from hilrig_modbus_edge.server.event_loop import DirectEventLoop
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.config.lab import RigSettings, read_rig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.control import Handlers, handle_control_request
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import freeze_gc
from hilrig_schemas import AddRig, ControlReply, Event, RemoveRig, ResetRig, RevokeClient, topics

TICK_NS: Final = 20_000_000
"""Period of the edge tick, ns."""
FIRST_STATE_TIMEOUT_NS: Final = 2_000_000_000
"""Time that the first clients wait for the first state, ns; afterwards they get exception 04."""

RIGS_PER_TURN: Final = 16
"""Number of rigs per turn of the event loop in an edge tick, so that no request waits for the work of all rigs. With
128 rigs in one turn, the 99th percentile of a read is 60 % higher (`bench/ablation.py`)."""
MAX_PORTS_TRIED: Final = 100
"""Number of ports that are tried for a rig that is added without one."""

logger = logging.getLogger(__name__)


def run(service: Service) -> None:
    """Serve Modbus until the service is stopped.

    Raises:
        OperationError: the address of a rig is unavailable.
    """

    with asyncio.Runner(loop_factory=DirectEventLoop) as runner:
        runner.run(EdgeService(service, runner.get_loop()).run())


class EdgeService:
    """Endpoints of the rigs of one edge."""

    def __init__(self, service: Service, loop: asyncio.AbstractEventLoop) -> None:
        self._service = service
        self._loop = loop
        self._tls = service.lab.edge.tls
        """Settings in use: its `clients` are those of the file when it was last read."""
        # A query arrives on a thread of the bus and is handled on the event loop.
        self._executor = OwnerThreadExecutor(loop.call_soon_threadsafe)
        self._states = service.latest_value_cache(topics.STATES)
        self._scheduler = CommandScheduler(
            service.source,
            service.publisher(topics.COMMANDS),
            self._states,
            service.lab.sim.step_ns,
            service.clock,
            loop.call_at,
        )
        self._owners = ClassOwners(service.lab.classroom, [rig.name for rig in service.lab.rigs])
        self._endpoints: dict[str, RigEndpoint] = {rig.name: self._new_endpoint(rig) for rig in service.rigs}
        now_ns = service.clock.monotonic_ns()
        for number, endpoint in enumerate(self._endpoints.values()):
            # Staggered: encoding the request logs of all rigs in one tick would delay requests.
            endpoint.request_log_due_ns = now_ns + number * TICK_NS
        service.counters.rigs = len(service.rigs)
        service.health.rig_reports = lambda: [endpoint.report() for endpoint in self._endpoints.values()]
        service.addresses = self._address_of
        self._closing = ExitStack()
        self._notify_exchanges()

    def _notify_exchanges(self) -> None:
        """Let the bus wake the event loop when states arrive, if a rig is a client of its controller."""
        if any(endpoint.exchange is not None for endpoint in self._endpoints.values()):
            self._states.notify = partial(self._loop.call_soon_threadsafe, self._on_states)

    def _on_states(self) -> None:
        for endpoint in self._endpoints.values():
            if endpoint.exchange is not None:
                endpoint.exchange.on_states()

    def _new_endpoint(self, rig: RigSettings) -> RigEndpoint:
        endpoint = RigEndpoint(
            rig, self._service, self._states, self._scheduler, self._announce_sessions, self._owners.of(rig.name)
        )
        self._permit(endpoint)
        return endpoint

    async def run(self) -> None:
        """Listen, serve, and close in order."""
        service, lab = self._service, self._service.lab
        # Before the first command: the clients of another edge must not be affected.
        service.claim()
        try:
            # Sockets are bound before the first state arrives: early clients are served as soon as possible. All or
            # none: if the port of one rig is unavailable, the others must not stay open.
            try:
                ports, tls_ports = lab.ports, lab.tls_ports
                for rig, endpoint in self._endpoints.items():
                    endpoint.bind(ports[rig], tls_ports.get(rig))
            except OperationError:
                # The port may be used by another edge of the lab that was not connected to the bus yet.
                service.check_instance_conflict()
                raise
            self._announce_sessions()
            for endpoint in self._endpoints.values():
                endpoint.device.start()
                self._declare_queries(endpoint)
            handlers: Handlers = {
                "add_rig": self._add_rig,
                "remove_rig": self._remove_rig,
                "reset_rig": self._reset_rig,
                "revoke_client": self._revoke_client,
            }
            service.reload = self._reload
            key = topics.CONTROL.key(lab.name, service.name, service.instance)
            handler = partial(handle_control_request, handlers)
            self._closing.enter_context(self._executor.serve(service.bus, key, handler))
            await self._wait_for_first_states()
            for endpoint in self._endpoints.values():
                await endpoint.listen()
            freeze_gc()
            service.ready()
            await self._run_ticks()
        finally:
            self._close()

    # -- control requests

    def _add_rig(self, request: AddRig) -> ControlReply:
        """Start to serve a rig, at the next free port if it has none.

        Raises:
            HilrigError: its settings are invalid, it is already served, or its address is unavailable.
        """
        rig = read_rig(request.settings_json)
        if rig.name in self._endpoints:
            raise OperationError(f"rig {rig.name!r} is already served by this edge; choose another name")
        endpoint = self._new_endpoint(rig)
        with ExitStack() as undo:
            undo.callback(endpoint.closing.close)
            if rig.port is None:
                self._bind_next_free_port(endpoint)
            else:
                endpoint.bind_single(rig.port)
            undo.pop_all()
        self._endpoints[rig.name] = endpoint
        self._notify_exchanges()
        self._declare_queries(endpoint)
        endpoint.device.start()
        listening = self._loop.create_task(endpoint.listen())
        endpoint.closing.callback(listening.cancel)
        self._service.set_rigs((*self._service.rigs, rig))
        return self._emit_result(Event.RIG_ADDED, rig.name, f"{rig.name} is served at {endpoint.address}")

    def _remove_rig(self, request: RemoveRig) -> ControlReply:
        """Stop serving a rig.

        Raises:
            OperationError: it is not served by this edge.
        """
        rig = request.rig
        self._endpoint_of(rig).stop("rig removed")
        del self._endpoints[rig]
        self._owners.remove(rig)
        self._announce_sessions()
        self._service.set_rigs(tuple(other for other in self._service.rigs if other.name != rig))
        return self._emit_result(Event.RIG_REMOVED, rig, f"{rig} is no longer served")

    def _reset_rig(self, request: ResetRig) -> ControlReply:
        """Move a rig to its start pose; the simulation emits the event when it has executed the reset.

        Raises:
            OperationError: it is not served by this edge.
        """
        self._endpoint_of(request.rig).device.reset()
        return ControlReply(text=f"{request.rig} is reset to its start pose")

    def _revoke_client(self, request: RevokeClient) -> ControlReply:
        """Read lab.toml again, and close the connections of a client that it does not list any more.

        Raises:
            HilrigError: the file is invalid, still lists the client, or permits every client to write.
        """
        name, lab = request.name, self._service.lab.read_again()
        if lab.edge.tls is None:
            raise OperationError(f"{lab.path} has no [edge.tls], so every client may write")
        lab.edge.tls.check_revoked(name, f"{lab.path} on {platform.node()}")
        self._use(lab.edge.tls)
        reason = f"the certificate of {name} was revoked (hilrig certs --revoke)"
        closed = sum(endpoint.close_certificate(name, reason) for endpoint in self._endpoints.values())
        logger.info("%s may only read, by order of an operator; connections closed: %d", name, closed)
        return ControlReply(text=f"{name} may only read; connections closed: {closed}")

    def _reload(self) -> None:
        """Read [edge.tls.clients] again, because of SIGHUP; in another thread, because a large file takes a while."""
        try:
            tls = self._service.lab.read_again().edge.tls
        except InputError as error:
            logger.error("[edge.tls.clients] not read again, the previous one stays in force: %s", error)
            return
        # The event loop may be closed already.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._use, tls)
            logger.info("[edge.tls.clients] read again; other changes of lab.toml take effect at the next start")

    def _use(self, tls: TlsConfig | None) -> None:
        self._tls = tls
        for endpoint in self._endpoints.values():
            self._permit(endpoint)

    def _permit(self, endpoint: RigEndpoint) -> None:
        device = endpoint.device
        device.permit(None if self._tls is None else self._tls.writers_of(device.rig))

    def _emit_result(self, kind: Event.Kind, rig: str, text: str) -> ControlReply:
        self._service.emit(Event(kind=kind, severity=Event.INFO, rig=rig, text=text))
        return ControlReply(text=text)

    def _bind_next_free_port(self, endpoint: RigEndpoint) -> None:
        """Bind the first free port above all ports of lab.toml.

        It may be used by a rig that was added before, at any edge, or by another program.

        Raises:
            OperationError: none of the ports is free.
        """
        lab = self._service.lab
        first = max([*lab.ports.values(), *lab.tls_ports.values()]) + 1
        last = min(first + MAX_PORTS_TRIED, 0x10000) - 1
        for port in range(first, last + 1):
            with suppress(OperationError):
                endpoint.bind_single(port)
                return
        raise OperationError(f"no port from {first} to {last} is free; choose another one with --port")

    def _endpoint_of(self, rig: str) -> RigEndpoint:
        if rig not in self._endpoints:
            raise OperationError(f"rig {rig!r} is not served by this edge; hilrig rig list shows all rigs")
        return self._endpoints[rig]

    # -- queries

    def _address_of(self, rig: str) -> str:
        endpoint = self._endpoints.get(rig)
        return endpoint.address if endpoint else ""

    def _declare_queries(self, endpoint: RigEndpoint) -> None:
        bus, lab, device = self._service.bus, self._service.lab, endpoint.device
        for topic, handler in ((topics.LEASE, handle_lease_query), (topics.IMPAIRMENT, handle_impairment_query)):
            key = topic.key(lab.name, device.rig)
            endpoint.closing.enter_context(self._executor.serve(bus, key, partial(handler, device)))

    def _announce_sessions(self) -> None:
        """Announce the open sessions to the recorder."""
        sessions = [
            session for endpoint in self._endpoints.values() if (session := endpoint.device.session) is not None
        ]
        self._service.recording_stream.set_sessions([session.as_message() for session in sessions])

    # -- time

    async def _wait_for_first_states(self) -> None:
        clock, stopping = self._service.clock, self._service.stopping
        deadline_ns = clock.monotonic_ns() + FIRST_STATE_TIMEOUT_NS
        while clock.monotonic_ns() < deadline_ns and not stopping.is_set():
            if all(endpoint.device.has_state for endpoint in self._endpoints.values()):
                return
            self._service.beat(clock.monotonic_ns())
            await asyncio.sleep(TICK_NS * 1e-9)

    async def _run_ticks(self) -> None:
        service, rate = self._service, Rate(TICK_NS, self._service.clock)
        monotonic_ns = service.clock.monotonic_ns
        while not service.stopping.is_set():
            await asyncio.sleep(rate.remaining_s)
            tick = rate.tick(monotonic_ns())
            service.counters.count_tick(tick, TICK_NS)
            # Lateness against the original deadline: `lateness_ns` is against the one after the skipped periods.
            late_ns = tick.lateness_ns + tick.missed_steps * TICK_NS
            if late_ns > TICK_NS:
                for endpoint in self._endpoints.values():
                    endpoint.device.report_stall(late_ns, monotonic_ns())
            for number, endpoint in enumerate(list(self._endpoints.values())):
                if number and number % RIGS_PER_TURN == 0:
                    await asyncio.sleep(0)
                endpoint.on_tick(monotonic_ns())
            service.beat(monotonic_ns())
            rate.next_ns = self._middle_of_step(rate.next_ns)

    def _middle_of_step(self, deadline_ns: int) -> int:
        """Return the time nearest to a deadline that is half a step after a state arrived, ns, monotonic clock.

        A tick of many rigs takes milliseconds: it must not coincide with the arrival of states or the deadline of
        commands. Without states the deadline stays.
        """
        step_ns = self._service.lab.sim.step_ns
        state = next((state for rig in self._endpoints if (state := self._states.get(rig)) is not None), None)
        if state is None or step_ns > TICK_NS:
            return deadline_ns
        return deadline_ns + (state.arrived_ns - deadline_ns) % step_ns - step_ns // 2

    def _close(self) -> None:
        self._states.notify = None
        self._closing.close()
        for endpoint in self._endpoints.values():
            endpoint.stop("edge stopped")
        self._owners.close()
        self._scheduler.flush()
        self._announce_sessions()
        self._service.recording_stream.flush(self._service.clock.monotonic_ns())
