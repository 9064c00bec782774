"""Duplicate instances: the older one keeps running, the other one stops with the reason; clock offsets of hosts."""

import threading
import time

import pytest

from hilrig_runtime.bus.api import Reply
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.discovery import ClockOffset, conflict, list_services, offset_of, worst_offset
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Health, ServiceInfo
from hilrig_schemas.topics import HEALTH, SERVICE_INFO, alive_key
from support.waiting import eventually

LAB = parse_lab("[rigs]\ncount = 6\n")
SECOND = 1_000_000_000


def info(service: str = "edge", instance: str = "1", age: int = 5, rigs: tuple[str, ...] = ("rig1",)) -> ServiceInfo:
    return ServiceInfo(service=service, instance=instance, incarnation=100 - age, rigs=rigs, host="there")


def test_younger_service_with_a_common_rig_must_stop() -> None:
    own = info(instance="2", age=1, rigs=("rig1", "rig2"))
    assert conflict(own, [info()]) == "edge/1 on there already serves rig1; each rig has one edge (--rigs)"
    many = tuple(f"rig{number}" for number in range(1, 7))
    assert "rig1, rig2, rig3 and 3 more" in conflict(info(instance="2", age=1, rigs=many), [info(rigs=many)])


def test_younger_service_with_the_same_name_must_stop() -> None:
    own = info(age=1, rigs=("rig2",))
    assert conflict(own, [info()]) == "edge/1 on there has the same instance name; choose another --instance"


def test_other_services_do_not_conflict() -> None:
    own = info(age=3)
    others = [own, info("sim", age=9), info(instance="2", age=9, rigs=("rig2",)), info(instance="3", age=1)]
    assert conflict(own, others) == ""


def test_one_of_two_equally_old_services_keeps_running() -> None:
    one, other = info(instance="1"), info(instance="2")
    assert bool(conflict(one, [other])) != bool(conflict(other, [one]))


def replied(service: str, wall_ns: int, round_trip_ns: int) -> ClockOffset:
    """Offset of a service, from a reply that arrived when this host's wall clock was 1,000 s."""
    found = info(service)
    found.wall_ns = wall_ns
    arrived_ns = time.monotonic_ns() - 3 * SECOND
    reply = Reply("key", b"", arrived_ns=arrived_ns, round_trip_ns=round_trip_ns)
    # The reply is evaluated later than it arrived: the query waits for other services.
    return offset_of(found, reply, lambda: 1_000 * SECOND + time.monotonic_ns() - arrived_ns)


def test_offset_is_from_the_times_of_its_own_reply() -> None:
    exact = replied("sim", 1_000 * SECOND - 5_000_000, 10_000_000)
    assert abs(exact.offset_ns) < 1_000_000
    assert 5_000_000 <= exact.uncertainty_ns < 6_000_000
    behind = replied("sim", 999 * SECOND, 10_000_000)
    assert abs(behind.offset_ns + 995_000_000) < 1_000_000


def test_largest_clock_offset_is_reported() -> None:
    near, far = ClockOffset("sim/1", 10, 20), ClockOffset("recorder/1", -610, 10)
    assert worst_offset([near, far]) == far
    assert worst_offset([]) == ClockOffset()


def test_late_reply_does_not_hide_an_offset() -> None:
    # The reply of the simulation took 3 s: no offset beyond its uncertainty.
    late, ahead = (
        replied("sim", 1_000 * SECOND, 3 * SECOND),
        replied("recorder", 1_000 * SECOND + 80_000_000, 2_000_000),
    )
    assert late.certain_ns == 0
    assert worst_offset([late, ahead]) == ahead
    # Of several without an offset, the one that is known best.
    assert worst_offset([late, ClockOffset("edge/1", 1, 2)]).peer == "edge/1"


def service(hub: MemoryHub, instance: str, rigs: tuple[str, ...], wall_ns: int) -> Service:
    return Service("edge", LAB, MemoryBus(hub), instance=instance, rigs=rigs, clock=ManualClock(wall_ns=wall_ns))


def test_services_with_distinct_rigs_do_not_conflict() -> None:
    hub = MemoryHub()
    with service(hub, "1", ("rig1", "rig2"), 1_000) as one, service(hub, "2", ("rig3",), 2_000) as other:
        one.ready()
        other.ready()
        found = list_services(MemoryBus(hub), LAB)
        assert [(each.instance, list(each.rigs)) for each in found] == [("1", ["rig1", "rig2"]), ("2", ["rig3"])]
        assert all(each.host and each.software_version for each in found)


def test_duplicate_instance_fails_before_it_is_ready() -> None:
    hub = MemoryHub()
    with service(hub, "1", ("rig1",), 1_000) as one:
        one.ready()
        with service(hub, "2", ("rig1",), 2_000) as other, pytest.raises(OperationError, match=r"edge/1 on .* serves"):
            other.ready()
        assert MemoryBus(hub).get_liveliness(alive_key(LAB.name, "edge", "*")) == [alive_key(LAB.name, "edge", "1")]


def test_older_service_that_is_linked_late_is_found() -> None:
    hub = MemoryHub()
    bus = MemoryBus(hub)
    bus.settle_timeout_s = 2.0
    later = Service("edge", LAB, bus, instance="2", rigs=("rig1",), clock=ManualClock(wall_ns=2_000))
    elders: list[Service] = []

    def link_elder() -> None:
        elders.append(service(hub, "1", ("rig1",), 1_000))
        elders[0].ready()

    timer = threading.Timer(0.15, link_elder)
    timer.start()
    with later, pytest.raises(OperationError, match=r"edge/1 on .* already serves rig1"):
        later.ready()
    timer.join()
    elders[0].close()


def test_younger_service_stops_after_healed_partition() -> None:
    hub = MemoryHub()
    with service(hub, "2", ("rig1",), 2_000) as younger:
        younger.ready()
        # The network was in two halves, and now it is one.
        with service(hub, "1", ("rig1",), 1_000) as elder:
            elder.ready()
            eventually(younger.stopping.is_set)
            with pytest.raises(OperationError, match="already serves rig1"):
                younger.check()
            assert not elder.stopping.is_set()
            elder.check()


def answer(hub: MemoryHub, key: str, reply: ServiceInfo, token: str) -> None:
    """Answer as another service on `key`, with a liveliness token of `token`."""
    bus = MemoryBus(hub)
    bus.declare_queryable(key, lambda _: reply.SerializeToString())
    bus.declare_token(alive_key(LAB.name, *token.split("/")))


def test_reply_that_contradicts_its_key_is_dropped() -> None:
    hub = MemoryHub()
    forged = info("edge", "1", age=99)
    answer(hub, SERVICE_INFO.key(LAB.name, "edge", "west"), forged, "edge/west")
    with service(hub, "1", ("rig1",), 2_000) as victim:
        victim.ready()
        assert not victim.stopping.is_set()
        assert victim.counters.malformed >= 1
        assert "edge/west: message of 'edge/1'" in victim.counters.rejected
    assert list_services(MemoryBus(hub), LAB) == []


def test_conflict_needs_a_liveliness_token() -> None:
    hub = MemoryHub()
    answer(hub, SERVICE_INFO.key(LAB.name, "edge", "2"), info("edge", "2", age=99), "edge/3")
    with service(hub, "1", ("rig1",), 2_000) as running:
        running.ready()
        assert not running.stopping.is_set()


def test_claimed_rigs_of_another_certificate_are_ignored() -> None:
    hub = MemoryHub()
    lab = LAB.model_copy(update={"bus": BusConfig(tls=BusTlsConfig(edges={"east": ("rig1",), "west": ("rig3",)}))})
    answer(hub, SERVICE_INFO.key(LAB.name, "edge", "west"), info("edge", "west", age=99), "edge/west")
    with Service("edge", lab, MemoryBus(hub), instance="east", rigs=("rig1",), clock=ManualClock(wall_ns=2_000)) as own:
        own.ready()
        assert not own.stopping.is_set()
        assert own.counters.malformed >= 1


def test_addresses_of_rigs_of_another_certificate_are_ignored() -> None:
    """A command or the console would show the address of the wrong edge."""
    hub = MemoryHub()
    lab = LAB.model_copy(update={"bus": BusConfig(tls=BusTlsConfig(edges={"east": ("rig1",), "west": ("rig3",)}))})
    claimed = info("edge", "west", rigs=("rig1", "rig3", "rig2"))
    claimed.addresses.extend(["10.0.0.9:502", "10.0.0.3:502"])
    answer(hub, SERVICE_INFO.key(LAB.name, "edge", "west"), claimed, "edge/west")
    [found] = list_services(MemoryBus(hub), lab)
    assert (list(found.rigs), list(found.addresses)) == (["rig3"], ["10.0.0.3:502"])


def test_wall_clock_at_a_limit_of_int64_is_dropped() -> None:
    # A health report can't contain its difference to this clock.
    hub = MemoryHub()
    bad = info("sim", "1")
    bad.wall_ns = -(1 << 63)
    answer(hub, SERVICE_INFO.key(LAB.name, "sim", "1"), bad, "sim/1")
    with service(hub, "1", ("rig1",), 2_000) as running:
        running.ready()
        running.health.report(0)
        assert running.counters.malformed >= 1
        assert running.health.clock_offset().peer == ""


def test_health_report_contains_clock_offset() -> None:
    hub, heard = MemoryHub(), []
    MemoryBus(hub).subscribe(
        HEALTH.key(LAB.name, "*", "*"), lambda _, payload: heard.append(Health.FromString(payload))
    )
    with service(hub, "1", ("rig1",), 1_000) as one, service(hub, "2", ("rig2",), 700_000_001_000) as other:
        one.ready()
        other.ready()
        other.health.report(0)
    assert heard[0].clock_peer == "edge/1"
    assert abs(heard[0].clock_offset_ns + 700_000_000_000) < 1_000_000_000
    assert heard[0].clock_uncertainty_ns > 0


def test_lost_and_returned_peers_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "hilrig_runtime.process.discovery")
    hub = MemoryHub()
    with Service("recorder", LAB, MemoryBus(hub)) as recorder:
        recorder.ready()
        with Service("sim", LAB, MemoryBus(hub)) as sim:
            sim.ready()
        eventually(lambda: "lost contact with sim/1 (" in caplog.text)
        with Service("sim", LAB, MemoryBus(hub)) as sim:
            sim.ready()
            eventually(lambda: "contact with sim/1 restored" in caplog.text)
    assert "recorder/1" not in caplog.text


def test_unknown_rig_is_rejected() -> None:
    with pytest.raises(InputError, match="unknown rig 'rig9'"):
        service(MemoryHub(), "1", ("rig9",), 1_000)
