"""Who is on the bus: reachable at all, complete, of one version, with clocks that agree, without trouble?"""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from threading import Lock, Thread

from hilrig_cli.doctor import Finding, good, notice, wrong
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import HilrigError, InputError
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_runtime.timing.realtime import REALTIME_PRIORITIES, go_realtime
from hilrig_schemas import Health
from hilrig_schemas.topics import HEALTH, alive_key, source_of_alive_key

SERVICES = ("sim", "edge", "recorder")
LISTENING_S = 2.5
"""Each service says once a second how it is."""
CLOCK_NOTICE_S = 1.0
CLOCK_WRONG_S = 60.0
_GRANT = (
    'on Linux write "<user> - rtprio 3" into /etc/security/limits.conf and log in anew, or LimitRTPRIO=3 into the '
    "unit, or ulimits: {rtprio: 3} for the container; then start the services again"
)


@dataclass(slots=True)
class Heard:
    """What came over the bus."""

    alive: set[str] = field(default_factory=set)
    """ "<service>/<instance>" of those who show that they live."""
    healths: dict[str, tuple[Health, int]] = field(default_factory=dict)
    """The last report of each, and our wall clock when it came, ns."""

    @property
    def services(self) -> set[str]:
        """Kinds of service that live."""
        return {name.partition("/")[0] for name in self.alive}


def is_one(name: str, wanted: str) -> bool:
    """Whether "<service>/<instance>" is what is wanted: a service, or one instance of it."""
    return wanted in (name, name.partition("/")[0])


def listen(lab: LabConfig, identity: str = "tool", *, for_s: float = LISTENING_S, until: str = "") -> Heard:
    """Listen on the lab's bus as `identity`; with `until` only until that service has said how it is, see `is_one`.

    Raises:
        HilrigError: the bus can't be joined.
    """
    heard, lock = Heard(), Lock()

    def on_health(key: str, payload: bytes) -> None:
        del key
        health = HEALTH.decode(payload)
        with lock:
            heard.healths[f"{health.service}/{health.instance}"] = health, SYSTEM_CLOCK.wall_ns()

    def on_alive(key: str, alive: bool) -> None:
        name = source_of_alive_key(key)
        with lock:
            (heard.alive.add if alive else heard.alive.discard)(name)

    with (
        ZenohBus(lab.bus, identity) as bus,
        bus.subscribe(HEALTH.key(lab.name, "*", "*"), on_health),
        bus.subscribe_liveliness(alive_key(lab.name, "*", "*"), on_alive),
    ):
        deadline_s = time.monotonic() + for_s
        while time.monotonic() < deadline_s:
            with lock:
                if until and any(is_one(name, until) for name in heard.healths):
                    break
            time.sleep(0.02)
    return heard


def check_bus(lab: LabConfig) -> tuple[list[Finding], Heard | None]:
    """Whether the bus can be joined, and what is heard there; nothing can be, where it can't."""
    where = f"router {lab.bus.router}" if lab.bus.topology == "router" else f"mesh on {lab.bus.host}"
    try:
        heard = listen(lab)
    except HilrigError as error:
        return [wrong("bus", str(error), _mend_of_bus(lab, error))], None
    return [good("bus", f"{where}: joined")], heard


def _mend_of_bus(lab: LabConfig, error: HilrigError) -> str:
    if lab.bus.tls is not None and isinstance(error, InputError):
        return "give this host a command's certificate and its key (viewer, operator) beside ca.pem"
    mend = "start the router (hilrig router), and compare bus.router" if lab.bus.topology == "router" else "see its log"
    return mend if lab.bus.tls is None else f"{mend}; look at the certificates below"


def check_services(lab: LabConfig, heard: Heard) -> Iterator[Finding]:
    """Whether all that a lab needs is there."""
    if not heard.services & set(SERVICES):
        yield notice("services", f"nothing of lab {lab.name!r} runs", "start it: hilrig up, or service by service")
        return
    missing = [service for service in SERVICES if service not in heard.services]
    if missing:
        yield wrong("services", f"no {' and no '.join(missing)} runs", f"start it: hilrig {missing[0]}")
    silent = sorted(name for name in heard.alive if name.partition("/")[0] in SERVICES and name not in heard.healths)
    if silent:
        yield wrong("services", f"{', '.join(silent)} shows that it lives, but says nothing", "start it again")
    if not missing and not silent:
        yield good("services", f"{', '.join(sorted(heard.alive))} live")
    for name, (health, _) in sorted(heard.healths.items()):
        if health.alert:
            yield wrong("services", f"{name}: {health.alert}", "see what it says, and its log")
        if health.lost_transport or health.lost_recorder:
            lost = health.lost_transport + health.lost_recorder
            yield notice("services", f"{name}: {lost} messages lost since it started", "see the sizing in the docs")


def check_realtime(lab: LabConfig, heard: Heard) -> Iterator[Finding]:
    """What closes the loop runs under the real-time policy; where nothing runs yet: whether this host grants it."""
    if not lab.realtime:
        yield good("real-time", "not asked for (realtime = false): other programs may hold the loop up")
        return
    reports = [health for health, _ in heard.healths.values() if health.service in REALTIME_PRIORITIES]
    if not reports:
        if _is_granted_here():
            yield good("real-time", "this host grants the policy")
        else:
            yield notice(
                "real-time", "this host does not grant the policy: other programs may hold the loop up", _GRANT
            )
        return
    ordinary = [health for health in reports if not health.realtime_priority]
    for health in ordinary:
        host = f" on {health.host}" if health.host else ""
        yield notice(
            "real-time",
            f"{health.service}/{health.instance}{host} was not granted the policy: other programs may hold it up",
            _GRANT,
        )
    if not ordinary:
        names = (f"{health.service}/{health.instance} (priority {health.realtime_priority})" for health in reports)
        yield good("real-time", f"granted to {', '.join(sorted(names))}")


def check_versions(healths: Iterable[Health], own: str) -> Iterator[Finding]:
    """All services are of the version that this command is of."""
    versions: dict[str, list[str]] = {}
    for health in healths:
        versions.setdefault(health.software_version or "an older version", []).append(
            f"{health.service}/{health.instance}"
        )
    others = {version: names for version, names in versions.items() if version != own}
    for version, names in sorted(others.items()):
        say = notice if _series(version) == _series(own) else wrong
        yield say(
            "versions",
            f"{', '.join(sorted(names))} of {version}; this command is {own}",
            "install the same version everywhere; services can be exchanged one by one",
        )
    if versions and not others:
        yield good("versions", f"all of {own}")


def check_clocks(reports: Sequence[tuple[Health, int]]) -> Iterator[Finding]:
    """Hosts' wall clocks agree; no figure depends on that, but people compare dates. Each report with our clock, ns."""
    if not reports:
        return
    offsets = {
        f"{health.service}/{health.instance}" + (f" on {health.host}" if health.host else ""): (
            (health.wall_ns - heard_ns) / 1e9
        )
        for health, heard_ns in reports
    }
    name, offset_s = max(offsets.items(), key=lambda item: abs(item[1]))
    if abs(offset_s) < CLOCK_NOTICE_S:
        yield good("time", f"all clocks within {abs(offset_s) * 1e3:.0f} ms of this host's")
        return
    say = wrong if abs(offset_s) >= CLOCK_WRONG_S else notice
    ahead = "ahead of" if offset_s > 0 else "behind"
    yield say(
        "time",
        f"the clock of {name} is {abs(offset_s):.1f} s {ahead} this host's; it dates recordings",
        "synchronise the hosts' clocks (NTP); latencies do not depend on them",
    )


def _is_granted_here() -> bool:
    """Whether this user may go real-time on this host: tried, on a thread that ends with the trial."""
    granted: list[bool] = []
    trial = Thread(target=lambda: granted.append(go_realtime(max(REALTIME_PRIORITIES.values()))))
    trial.start()
    trial.join()
    return granted == [True]


def _series(version: str) -> tuple[str, ...]:
    """What must be equal for two versions to be compatible: before 1.0 the second number too."""
    parts = version.split(".")
    return tuple(parts[:2] if parts[0] == "0" else parts[:1])
