"""One service a rig: of two the elder goes on and the other ends with the reason; hosts' clocks are compared."""

import threading

import pytest

from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.discovery import ClockOffset, conflict, list_services, worst_offset
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Health, ServiceInfo
from hilrig_schemas.topics import HEALTH, alive_key
from support.waiting import eventually

LAB = parse_lab("[rigs]\ncount = 6\n")


def info(service: str = "edge", instance: str = "1", age: int = 5, rigs: tuple[str, ...] = ("rig1",)) -> ServiceInfo:
    return ServiceInfo(service=service, instance=instance, incarnation=100 - age, rigs=rigs, host="there")


def test_an_elder_with_one_of_the_rigs_is_given_way_to() -> None:
    own = info(instance="2", age=1, rigs=("rig1", "rig2"))
    assert conflict(own, [info()]) == "edge/1 on there already serves rig1; each rig has one edge (--rigs)"
    many = tuple(f"rig{number}" for number in range(1, 7))
    assert "rig1, rig2, rig3 and 3 more" in conflict(info(instance="2", age=1, rigs=many), [info(rigs=many)])


def test_an_elder_of_the_same_name_is_given_way_to() -> None:
    own = info(age=1, rigs=("rig2",))
    assert conflict(own, [info()]) == "edge/1 on there has the same instance name; choose another --instance"


def test_nobody_else_is() -> None:
    own = info(age=3)
    others = [own, info("sim", age=9), info(instance="2", age=9, rigs=("rig2",)), info(instance="3", age=1)]
    assert conflict(own, others) == ""


def test_of_two_of_the_same_age_exactly_one_goes_on() -> None:
    one, other = info(instance="1"), info(instance="2")
    assert bool(conflict(one, [other])) != bool(conflict(other, [one]))


def test_the_clock_that_differs_most_is_the_one_that_is_told() -> None:
    near, far = info("sim"), info("recorder")
    near.wall_ns, far.wall_ns = 1_010, 400
    assert worst_offset([near, far], 1, 1_000, 1_020) == ClockOffset("recorder/1", -610, 10)
    assert worst_offset([near], near.incarnation, 1_000, 1_020) == ClockOffset()


def service(hub: MemoryHub, instance: str, rigs: tuple[str, ...], wall_ns: int) -> Service:
    return Service("edge", LAB, MemoryBus(hub), instance=instance, rigs=rigs, clock=ManualClock(wall_ns=wall_ns))


def test_services_with_rigs_of_their_own_run_side_by_side() -> None:
    hub = MemoryHub()
    with service(hub, "1", ("rig1", "rig2"), 1_000) as one, service(hub, "2", ("rig3",), 2_000) as other:
        one.ready()
        other.ready()
        found = list_services(MemoryBus(hub), LAB.name)
        assert [(each.instance, list(each.rigs)) for each in found] == [("1", ["rig1", "rig2"]), ("2", ["rig3"])]
        assert all(each.host and each.software_version for each in found)


def test_the_second_of_two_refuses_before_it_is_there() -> None:
    hub = MemoryHub()
    with service(hub, "1", ("rig1",), 1_000) as one:
        one.ready()
        with service(hub, "2", ("rig1",), 2_000) as other, pytest.raises(OperationError, match=r"edge/1 on .* serves"):
            other.ready()
        assert MemoryBus(hub).get_liveliness(alive_key(LAB.name, "edge", "*")) == [alive_key(LAB.name, "edge", "1")]


def test_an_elder_that_is_linked_a_moment_later_is_found_before_a_word_is_said() -> None:
    hub = MemoryHub()
    bus = MemoryBus(hub)
    bus.settle_timeout_s = 2.0
    later = Service("edge", LAB, bus, instance="2", rigs=("rig1",), clock=ManualClock(wall_ns=2_000))
    elders: list[Service] = []
    timer = threading.Timer(0.15, lambda: elders.append(service(hub, "1", ("rig1",), 1_000)))
    timer.start()
    with later, pytest.raises(OperationError, match=r"edge/1 on .* already serves rig1"):
        later.ready()
    timer.join()
    elders[0].close()


def test_one_that_is_found_later_to_be_the_younger_ends_with_the_reason() -> None:
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


def test_health_says_how_far_clocks_are_apart() -> None:
    hub, heard = MemoryHub(), []
    MemoryBus(hub).subscribe(
        HEALTH.key(LAB.name, "*", "*"), lambda _, payload: heard.append(Health.FromString(payload))
    )
    with service(hub, "1", ("rig1",), 1_000) as one, service(hub, "2", ("rig2",), 700_000_001_000) as other:
        one.ready()
        other.ready()
        other.health.report(0)
    assert (heard[0].clock_peer, heard[0].clock_offset_ns) == ("edge/1", -700_000_000_000)


def test_who_goes_and_comes_back_stands_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
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


def test_a_rig_that_the_lab_does_not_have_is_refused() -> None:
    with pytest.raises(InputError, match="unknown rig 'rig9'"):
        service(MemoryHub(), "1", ("rig9",), 1_000)
