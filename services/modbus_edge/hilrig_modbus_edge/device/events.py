"""Events of a rig: each has the session and the simulation step; those that may occur in bursts are rate-limited."""

from typing import Final

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.ports import DeviceOutput, Refusal
from hilrig_modbus_edge.device.session import SessionState
from hilrig_modbus_edge.device.settings import MS
from hilrig_modbus_edge.registers.image import StateImage
from hilrig_runtime.process.outage import Outage, describe_outage
from hilrig_runtime.timing.rate_limiter import RateLimiter, RepeatReporter, repeat_suffix
from hilrig_schemas import Event

LEASE_EVENT_PERIOD_NS: Final = 1_000 * MS
"""Shortest time between two lease events of one kind and host, ns."""
STATE_TIMEOUT_NS: Final = 500 * MS
"""Time without a state after which the states are lost, ns."""
STALL_EVENT_PERIOD_NS: Final = 1_000 * MS
"""Shortest time between two events about stalls of the edge, ns."""


class EventEmitter:
    """Emits the events of one rig."""

    def __init__(self, rig: str, output: DeviceOutput, session: SessionState, image: StateImage) -> None:
        self._rig = rig
        self._output = output
        self._session = session
        self._image = image

    def event(self, kind: Event.Kind, severity: Event.Severity, text: str) -> Event:
        """Return a new event, to be completed and emitted."""
        session, step = self._session.id, self._image.step
        return Event(rig=self._rig, session=session, kind=kind, severity=severity, text=text, step=step)

    def emit(self, event: Event) -> None:
        """Publish an event."""
        self._output.emit(event)

    def emit_for_controller(
        self,
        kind: Event.Kind,
        severity: Event.Severity,
        text: str,
        controller: str,
        *,
        certificate: str = "",
        reason: str = "",
        holder: str = "",
        student: str = "",
    ) -> None:
        """Publish an event about a controller, "host:port".

        `holder`: the lease holder, if that is another client; `student`: the owner of the rig, if the event is about
        that.
        """
        event = self.event(kind, severity, text)
        event.controller_data.controller = controller
        event.controller_data.certificate = certificate
        event.controller_data.reason = reason
        event.controller_data.holder = holder
        event.controller_data.student = student
        self.emit(event)

    def emit_state_outage(self, outage: Outage, wall_offset_ns: int) -> None:
        """Publish that states stopped or arrive again; `wall_offset_ns`: wall clock minus monotonic clock."""
        text = describe_outage("states", outage, wall_offset_ns)
        if outage.has_ended:
            event = self.event(Event.STATE_BACK, Event.INFO, text)
        else:
            text += ": controllers read the last one; is the simulation running, and its link up (hilrig doctor)?"
            event = self.event(Event.STATE_LOST, Event.WARNING, text)
        event.watchdog_data.silent_ns, event.watchdog_data.timeout_ns = outage.silent_ns, STATE_TIMEOUT_NS
        self.emit(event)


class LeaseEventReporter:
    """Reports acquired, released and denied leases as events, rate-limited per host.

    A client may open a new connection for every request, dozens of times a second. Per host, the first acquisition of
    a second is reported and the others are counted. A holder that keeps the lease for a second is always reported.
    Denied writes are counted per host, cause and session. Time is passed in.
    """

    def __init__(self, rig: str, events: EventEmitter) -> None:
        self._rig = rig
        self._events = events
        self._acquisitions: RateLimiter[str] = RateLimiter(LEASE_EVENT_PERIOD_NS)
        self._denials: RepeatReporter[tuple[str, str], tuple[Client, Refusal]] = RepeatReporter(
            LEASE_EVENT_PERIOD_NS, self._emit_denied
        )
        self._pending_acquire: tuple[Client, int] | None = None
        """Connection of the lease holder and time of the acquisition (ns), if it was suppressed."""

    def lease_acquired(self, client: Client, now_ns: int) -> None:
        """Report that a client acquired the lease; ns, monotonic clock."""
        count = self._acquisitions.record(client.host, now_ns)
        self._pending_acquire = None if count else (client, now_ns)
        if count:
            self._emit_acquired(client, count)

    def lease_released(self, client: Client, reason: str, *, disconnected: bool) -> None:
        """Report that the holder has no lease any more; `disconnected`: its last writing connection was closed."""
        if self._pending_acquire is not None:
            self._pending_acquire = None
            if disconnected:
                return
            self._emit_acquired(client)
        verb = "released" if disconnected else "lost"
        text = f"{client.label} {verb} the lease of {self._rig}: {reason}"
        self._events.emit_for_controller(
            Event.LEASE_LOST, Event.INFO, text, client.address, certificate=client.certificate, reason=reason
        )

    def lease_denied(self, client: Client, refusal: Refusal, now_ns: int) -> None:
        """Report a denied write; ns, monotonic clock."""
        self._denials.record((client.host, refusal.cause), (client, refusal), now_ns)

    def flush_denials(self) -> None:
        """Report the denied writes that were not reported, because a session starts or ends."""
        self._denials.flush()

    def check(self, now_ns: int) -> None:
        """Do everything that is due: report denied writes that were suppressed, and a suppressed acquisition.

        Its holder has kept the lease for `LEASE_EVENT_PERIOD_NS`.
        """
        self._denials.check(now_ns)
        if self._pending_acquire is not None and now_ns - self._pending_acquire[1] >= LEASE_EVENT_PERIOD_NS:
            client, self._pending_acquire = self._pending_acquire[0], None
            self._emit_acquired(client)

    def _emit_denied(self, denied: tuple[Client, Refusal], count: int) -> None:
        client, refusal = denied
        text = f"{client.label}: write to {self._rig} denied: {refusal.reason}{repeat_suffix(count)}"
        self._events.emit_for_controller(
            Event.LEASE_REFUSED,
            Event.WARNING,
            text,
            client.address,
            certificate=client.certificate,
            reason=refusal.reason,
            holder=refusal.holder,
            student=refusal.student,
        )

    def _emit_acquired(self, client: Client, count: int = 1) -> None:
        text = f"{client.label} acquired the lease of {self._rig}{repeat_suffix(count)}"
        self._events.emit_for_controller(
            Event.LEASE_GRANTED, Event.INFO, text, client.address, certificate=client.certificate
        )


class StallReporter:
    """Reports stalls of the edge within a session as events, rate-limited, with their number and the longest.

    A stall is a tick of the edge that is late by more than its period. Time is passed in.
    """

    def __init__(self, events: EventEmitter) -> None:
        self._events = events
        self._rate_limiter: RateLimiter[None] = RateLimiter(STALL_EVENT_PERIOD_NS)
        self._count = self._longest_ns = 0
        """Of the stalls that were not reported yet."""

    def record(self, late_ns: int, now_ns: int) -> None:
        """Record a stall, and report it if that is due; ns, monotonic clock."""
        self._count += 1
        self._longest_ns = max(self._longest_ns, late_ns)
        if self._rate_limiter.record(None, now_ns):
            self.flush()

    def check(self, now_ns: int) -> None:
        """Report the stalls whose period has ended; ns, monotonic clock."""
        if self._count and list(self._rate_limiter.pop_remainders(now_ns)):
            self.flush()

    def flush(self) -> None:
        """Report the stalls that were not reported, because the session ends or their period has ended."""
        if not self._count:
            return
        times = "once" if self._count == 1 else f"{self._count} times, at most"
        text = (
            f"the edge stalled {times} for {self._longest_ns / MS:.0f} ms: its host was overloaded, or it was stopped"
        )
        event = self._events.event(Event.OVERRUN, Event.WARNING, text)
        event.overrun_data.lateness_ns = self._longest_ns
        event.overrun_data.stalls = self._count
        self._events.emit(event)
        self._count = self._longest_ns = 0
