"""Checks of the services on the bus: reachability, completeness, alerts, real-time policy, versions, clocks."""

import platform
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Lock, Thread
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_cli.doctor import CheckResult, Level
from hilrig_cli.doctor.processes import LocalProcess, RouterState, can_list_processes, probe_router
from hilrig_cli.service_kinds import RIG_SERVICES
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import HilrigError, InputError, list_names
from hilrig_runtime.process.control import release_series
from hilrig_runtime.process.discovery import ClockOffset, query_services, worst_offset
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime
from hilrig_schemas import Health, PeerReport
from hilrig_schemas.topics import HEALTH, SERVICES, alive_key, source_of_key

COLLECT_TIMEOUT_S: Final = 2.5
"""Time to collect health reports; each service publishes one a second."""
CLOCK_TIMEOUT_S: Final = 0.5
"""Timeout of the query for the clocks; it ends early when all services have replied."""
CLOCK_WARNING_S: Final = 1.0
CLOCK_ERROR_S: Final = 60.0
_CERTIFICATE_FIX: Final = (
    "copy a command's certificate and key (viewer or operator) to this host, into the folder of ca.pem"
)
_REALTIME_FIX: Final = (
    'on Linux add "<user> - rtprio 3" to /etc/security/limits.conf and log in again, or LimitRTPRIO=3 to the systemd '
    "unit, or ulimits: {rtprio: 3} to the container; then restart the services"
)


@dataclass(slots=True)
class BusSnapshot:
    """Liveliness tokens and health reports collected from the bus."""

    alive: set[str] = field(default_factory=set)
    """ "<service>/<instance>" of each service with a liveliness token."""
    healths: dict[str, Health] = field(default_factory=dict)
    """Last report of each service."""
    clocks: list[tuple[str, ClockOffset]] = field(default_factory=list)
    """Each service that replied, as "sim/1 on host", and the offset of its wall clock from this host's."""

    @property
    def services(self) -> set[str]:
        """Kinds of service that are alive."""
        return {name.partition("/")[0] for name in self.alive}

    def peers(self) -> Iterator[PeerReport]:
        """The reports of all services about others."""
        for health in self.healths.values():
            yield from health.peers


def matches(name: str, wanted: str) -> bool:
    """Whether "<service>/<instance>" is the wanted service ("edge") or the wanted instance ("edge/1")."""
    return wanted in (name, name.partition("/")[0])


def collect(
    lab: LabConfig, identity: str = "tool", *, timeout_s: float = COLLECT_TIMEOUT_S, until: str = ""
) -> BusSnapshot:
    """Collect liveliness tokens and health reports from the lab's bus.

    Args:
        lab: the lab.
        identity: name of the certificate to use on a secured bus.
        timeout_s: time to collect.
        until: return early once this service has reported its health, see `matches`.

    Raises:
        HilrigError: the bus can't be joined.
    """
    snapshot, lock = BusSnapshot(), Lock()

    def on_health(key: str, payload: bytes) -> None:
        try:
            health = HEALTH.decode_from(key, payload)
        except DecodeError:
            return
        with lock:
            snapshot.healths[f"{health.service}/{health.instance}"] = health

    def on_alive(key: str, alive: bool) -> None:
        name = source_of_key(key)
        with lock:
            (snapshot.alive.add if alive else snapshot.alive.discard)(name)

    with (
        ZenohBus(lab.bus, identity) as bus,
        bus.subscribe(HEALTH.key(lab.name, "*", "*"), on_health),
        bus.subscribe_liveliness(alive_key(lab.name, "*", "*"), on_alive),
    ):
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            with lock:
                if until and any(matches(name, until) for name in snapshot.healths):
                    break
            time.sleep(0.02)
        if not until:
            for info, offset in query_services(bus, lab.name, "*", Counters(), CLOCK_TIMEOUT_S):
                snapshot.clocks.append((f"{info.service}/{info.instance} on {info.host}", offset))
    return snapshot


def check_bus(lab: LabConfig, processes: Sequence[LocalProcess] = ()) -> tuple[list[CheckResult], BusSnapshot | None]:
    """Check that the bus can be joined; return the results and a snapshot, or None if it can't be joined.

    `processes`: those of the lab on this host.
    """
    where = f"router {lab.bus.router}" if lab.bus.topology == "router" else f"mesh on {lab.bus.host}"
    try:
        snapshot = collect(lab)
    except InputError as error:
        return [CheckResult.error("bus", str(error), _CERTIFICATE_FIX if lab.bus.tls else "see lab.toml")], None
    except HilrigError as error:
        return list(_explain_unreachable_bus(lab, str(error), processes)), None
    return [CheckResult.ok("bus", f"{where}: joined")], snapshot


def _explain_unreachable_bus(lab: LabConfig, error: str, processes: Sequence[LocalProcess]) -> Iterator[CheckResult]:
    """Tell a missing router, a stopped one and a cut link apart, as far as this host can prove it."""
    certificates = "" if lab.bus.tls is None else "; check the certificates below"
    if lab.bus.topology != "router":
        yield CheckResult.error("bus", error, f"see the log of the service{certificates}")
        return
    state = probe_router(lab)
    stopped = next((one for one in processes if one.service == "router" and one.is_stopped), None)
    if stopped is not None:
        fix = _continue_fix(stopped)
    elif state is RouterState.REFUSES:
        fix = (
            f"check on {lab.bus.router_host} whether the router runs; start it if it does not (hilrig router). Compare "
            "bus.router in lab.toml with its address"
        )
    elif state is RouterState.UNREACHABLE:
        fix = (
            f"check the network link of this host first, then that of {lab.bus.router_host}. A cut link needs "
            "no restart of a service"
        )
    else:
        fix = f"check on {lab.bus.router_host} whether the router is stopped or overloaded{certificates}"
    yield CheckResult.error("bus", f"{error}: {state.value}", fix)
    for process in processes:
        if process.service != "router":
            if process.is_stopped:
                yield CheckResult.error("services", _stopped_text(process), _continue_fix(process))
            else:
                text = f"{process.service} runs on this host (process {process.pid}) and waits for the router"
                yield CheckResult.warning("services", text, "do not restart it: it continues when the router answers")


def check_services(
    lab: LabConfig, snapshot: BusSnapshot, processes: Sequence[LocalProcess] = ()
) -> Iterator[CheckResult]:
    """Check that every kind of service runs, reports its health and has no alert.

    `processes`: those of the lab on this host.
    """
    if not snapshot.services & set(SERVICES) and not any(one.service in SERVICES for one in processes):
        text = f"no service of lab {lab.name!r} is running"
        yield CheckResult.warning(
            "services",
            text,
            "start the lab: hilrig up, or each service. If it runs, compare name and [bus] in the lab.toml of both",
        )
        return
    missing = [service for service in SERVICES if service not in snapshot.services]
    for service in missing:
        yield _explain_missing(lab, service, [], snapshot, processes)
    silent = sorted(
        name for name in snapshot.alive if name.partition("/")[0] in SERVICES and name not in snapshot.healths
    )
    for name in silent:
        yield _explain_silent(name, snapshot, processes)
    unserved = {
        service: rigs
        for service in RIG_SERVICES
        if service not in {name.partition("/")[0] for name in (*missing, *silent)}
        and (rigs := _unserved_rigs(lab, service, snapshot))
    }
    for service, rigs in unserved.items():
        yield _explain_missing(lab, service, rigs, snapshot, processes)
    if not missing and not silent and not unserved:
        yield CheckResult.ok("services", f"running: {', '.join(sorted(snapshot.alive))}")
    for name, health in sorted(snapshot.healths.items()):
        if health.alert:
            yield CheckResult.error("services", f"{name}: {health.alert}", "see the service's log")
        if health.lost_transport or health.lost_recorder:
            lost = health.lost_transport + health.lost_recorder
            text = f"{name}: {lost} messages lost since its start"
            yield CheckResult.warning("services", text, "see docs/sizing.md")


def _unserved_rigs(lab: LabConfig, service: str, snapshot: BusSnapshot) -> list[str]:
    """Return the rigs that no simulation steps, or no edge serves, although they have the other one."""
    found: dict[str, set[str]] = {kind: set() for kind in RIG_SERVICES}
    for health in snapshot.healths.values():
        found.setdefault(health.service, set()).update(report.rig for report in health.rig_reports)
    others = set().union(*(found[kind] for kind in RIG_SERVICES if kind != service))
    return [rig.name for rig in lab.rigs if rig.name in others - found[service]]


def _explain_missing(
    lab: LabConfig, service: str, rigs: Sequence[str], snapshot: BusSnapshot, processes: Sequence[LocalProcess]
) -> CheckResult:
    """Explain that a service has no liveliness token: it ended, or its link is down for seconds.

    `rigs`: its rigs, if other instances of its kind run.
    """
    local = [one for one in processes if one.service == service and one.name not in snapshot.alive]
    stopped = next((one for one in local if one.is_stopped), None)
    if stopped is not None:
        return CheckResult.error("services", _stopped_text(stopped), _continue_fix(stopped))
    what = f"{service} of {list_names(rigs)}" if rigs else service
    if local:
        text = f"{what} runs on this host (process {local[0].pid}), but is not on the bus"
        # In a mesh, a command without a valid certificate joins, but nobody answers.
        certificates = "; check the certificates below" if lab.bus.tls is not None else ""
        fix = f"see its log: it starts, or waits for the bus; do not restart it{certificates}"
        return CheckResult.error("services", text, fix)
    known = sorted({peer.service for peer in snapshot.peers() if peer.service.startswith(f"{service}/")})
    known = [name for name in known if name not in snapshot.alive]
    observations = "".join(f"; {_observations(name, snapshot)}" for name in known)
    start = f"hilrig {service}" + (f" --instance NAME --rigs {','.join(rigs)}" if rigs else "")
    if lab.bus.topology == "mesh" and can_list_processes():
        text = f"not running: {what}{observations}: no process on this host"
        return CheckResult.error("services", text, f"start it: {start}")
    where = _host_of(known[0], snapshot) if known else ""
    if where == platform.node() and can_list_processes():
        fix = f"start it here ({start}): it ran on this host, and has no process now"
    else:
        fix = f"{_check_there(where)}. Start it ({start}) only if no process runs there: it may be cut off"
    return CheckResult.error("services", f"not connected: {what}{observations}", fix)


def _explain_silent(name: str, snapshot: BusSnapshot, processes: Sequence[LocalProcess]) -> CheckResult:
    """Explain that a service has a liveliness token, but sends no health reports."""
    local = [one for one in processes if one.name == name]
    stopped = next((one for one in local if one.is_stopped), None)
    if stopped is not None:
        return CheckResult.error("services", _stopped_text(stopped), _continue_fix(stopped))
    text = f"{name}: alive, but sends no health reports; {_observations(name, snapshot)}"
    if local:
        fix = f"check the load of this host, and the log of process {local[0].pid}; do not restart it before"
        return CheckResult.error("services", text, fix)
    fix = f"{_check_there(_host_of(name, snapshot))}. From here, a stopped process and a cut link look the same"
    return CheckResult.error("services", text, fix)


def _check_there(host: str) -> str:
    return f"run hilrig doctor on {host or 'its host'} first: it tells whether the process runs or its link is cut"


def _host_of(name: str, snapshot: BusSnapshot) -> str:
    return next((peer.host for peer in snapshot.peers() if peer.service == name and peer.host), "")


def _observations(name: str, snapshot: BusSnapshot) -> str:
    """Return when which service received the last message of a service."""
    found = [
        f"{observer} received its last message {peer.silent_ns / 1e9:.1f} s ago"
        for observer, health in sorted(snapshot.healths.items())
        for peer in health.peers
        if peer.service == name and peer.silent_ns
    ]
    host = _host_of(name, snapshot)
    return f"{name}{f' on {host}' if host else ''}: " + (", ".join(found) or "no other service receives its messages")


def _stopped_text(process: LocalProcess) -> str:
    name = process.service if process.instance == "1" else process.name
    return f"{name} on this host is stopped (process {process.pid}): it does nothing until it is continued"


def _continue_fix(process: LocalProcess) -> str:
    return f"continue it: kill -CONT {process.pid}"


def check_realtime(lab: LabConfig, snapshot: BusSnapshot) -> Iterator[CheckResult]:
    """Check that simulation and edge run under the real-time policy; without services, that this host grants it."""
    if not lab.realtime:
        text = "not requested (realtime = false): other programs can delay the loop"
        yield CheckResult.ok("real-time", text)
        return
    reports = [health for health in snapshot.healths.values() if health.service in REALTIME_PRIORITIES]
    if not reports:
        if _is_granted_here():
            yield CheckResult.ok("real-time", "this host grants the real-time policy")
        else:
            text = "this host does not grant the real-time policy: other programs can delay the loop"
            yield CheckResult.warning("real-time", text, _REALTIME_FIX)
        return
    ordinary = [health for health in reports if not health.realtime_priority]
    for health in ordinary:
        host = f" on {health.host}" if health.host else ""
        yield CheckResult.warning(
            "real-time",
            f"{health.service}/{health.instance}{host}: real-time policy not granted; other programs can delay it",
            _REALTIME_FIX,
        )
    if not ordinary:
        names = (f"{health.service}/{health.instance} (priority {health.realtime_priority})" for health in reports)
        yield CheckResult.ok("real-time", f"granted to {', '.join(sorted(names))}")


def check_versions(healths: Iterable[Health], own: str) -> Iterator[CheckResult]:
    """Check that all services have the version of this command."""
    versions: dict[str, list[str]] = {}
    for health in healths:
        versions.setdefault(health.software_version or "unknown (older)", []).append(
            f"{health.service}/{health.instance}"
        )
    others = {version: names for version, names in versions.items() if version != own}
    for version, names in sorted(others.items()):
        yield CheckResult(
            "versions",
            Level.WARNING if release_series(version) == release_series(own) else Level.ERROR,
            f"{', '.join(sorted(names))}: version {version}; this command: {own}",
            "install the same version everywhere; services can be upgraded one by one",
        )
    if versions and not others:
        yield CheckResult.ok("versions", f"all services: {own}")


def check_clocks(clocks: Sequence[tuple[str, ClockOffset]]) -> Iterator[CheckResult]:
    """Check that the hosts' wall clocks agree. No latency depends on them; they date the recordings.

    Args:
        clocks: each service with its host, and the offset of its clock from this host's.
    """
    if not clocks:
        return
    worst = worst_offset(offset for _, offset in clocks)
    name = next(name for name, offset in clocks if offset is worst)
    certain_s = worst.certain_ns / 1e9
    if certain_s < CLOCK_WARNING_S:
        text = f"all clocks agree with this host's: {name} by {_milliseconds(worst)}, the others are nearer"
        yield CheckResult.ok("time", text)
        return
    ahead = "ahead of" if worst.offset_ns > 0 else "behind"
    yield CheckResult(
        "time",
        Level.ERROR if certain_s >= CLOCK_ERROR_S else Level.WARNING,
        f"the clock of {name} is {abs(worst.offset_ns) / 1e9:.1f} ± {worst.uncertainty_ns / 1e9:.1f} s {ahead} this "
        "host's; recordings are dated by it",
        "synchronize the hosts' clocks (NTP); latencies do not depend on them",
    )


def _milliseconds(offset: ClockOffset) -> str:
    return f"{offset.offset_ns / 1e6:.1f} ± {offset.uncertainty_ns / 1e6:.1f} ms"


def _is_granted_here() -> bool:
    """Whether this host grants the real-time policy to this user; tried on a thread that ends with the trial."""
    granted: list[bool] = []
    trial = Thread(target=lambda: granted.append(go_realtime(max(REALTIME_PRIORITIES.values()))))
    trial.start()
    trial.join()
    return granted == [True]
