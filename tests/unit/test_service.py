"""Publishers and caches of a service: published bytes are recorded unchanged, and only the newest value is cached."""

import platform

import pytest

from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event, Health, JointState, LogBatch, RigBatch
from hilrig_schemas.topics import EVENT, HEALTH, LOG, STATE, STATES, alive_key


def make_service(hub: MemoryHub, clock: ManualClock, name: str = "sim") -> Service:
    return Service(name, LabConfig(), MemoryBus(hub), clock=clock)


def test_published_and_recorded_bytes_are_equal() -> None:
    hub, clock = MemoryHub(), ManualClock()
    seen: list[bytes] = []
    batches: list[bytes] = []
    witness = MemoryBus(hub)
    witness.subscribe(STATE.key("lab", "*"), lambda _, payload: seen.append(payload))
    witness.subscribe(LOG.key("lab", "*", "*"), lambda _, payload: batches.append(payload))
    with make_service(hub, clock) as service:
        sender = service.rig_publisher(STATE, "rig1")
        for step in (1, 2):
            sender.publish(JointState(rig="rig1", step=step))
        service.beat(clock.monotonic_ns())
    batch = LogBatch.FromString(batches[0])
    assert list(batch.payloads) == seen
    assert list(batch.sequences) == [1, 2]
    assert set(batch.publish_wall_ns) == {clock.wall_ns()}


def test_republished_message_is_not_recorded() -> None:
    hub = MemoryHub()
    seen: list[bytes] = []
    MemoryBus(hub).subscribe(STATE.key("lab", "*"), lambda _, payload: seen.append(payload))
    with make_service(hub, ManualClock()) as service:
        service.rig_publisher(STATE, "rig1").republish_encoded(b"state")
    assert len(seen) == 1
    assert not [key for key in hub.history if LogBatch.FromString(hub.history[key][0]).keys]


def test_cache_keeps_newest_value_and_arrival_time() -> None:
    hub, clock = MemoryHub(), ManualClock()
    with make_service(hub, clock, "edge") as edge, make_service(hub, clock, "sim") as sim:
        latest = edge.latest_value_cache(STATES)
        assert latest.get("rig1") is None
        sender = sim.batch_publisher(STATES)
        sim.add_to_batch(sender, STATE, "rig1")
        for step in (1, 2):
            clock.advance(1_000)
            sender.publish([JointState(step=step).SerializeToString()])
        arrival = latest.get("rig1")
        assert arrival is not None
        assert STATE.decode(arrival.payload).step == 2
        assert arrival.arrived_ns == clock.monotonic_ns()
        assert edge.counters.received == 2


def test_event_has_source_and_time() -> None:
    hub, clock = MemoryHub(), ManualClock()
    seen: list[Event] = []
    MemoryBus(hub).subscribe(EVENT.key("lab", "rig1"), lambda _, payload: seen.append(EVENT.decode(payload)))
    with make_service(hub, clock) as service:
        service.emit(Event(rig="rig1", kind=Event.OVERRUN, text="late"))
    assert (seen[0].source, seen[0].wall_ns, seen[0].text) == ("sim/1", clock.wall_ns(), "late")


def test_service_token_exists_from_ready_to_close() -> None:
    hub = MemoryHub()
    witness = MemoryBus(hub)
    service = make_service(hub, ManualClock())
    latest = service.latest_value_cache(STATES)
    assert witness.get_liveliness(alive_key("lab", "*", "*")) == []
    service.ready()
    service.ready()
    assert witness.get_liveliness(alive_key("lab", "*", "*")) == [alive_key("lab", "sim", "1")]
    service.close()
    service.close()
    assert witness.get_liveliness(alive_key("lab", "*", "*")) == []
    late = RigBatch(rigs=["rig1"], messages=[b""]).SerializeToString()
    witness.publisher(STATES.key("lab", "sim", "1"), STATES.traffic).put(late)
    assert latest.get("rig1") is None
    assert hub.subscribers == []


def test_health_report_is_published_once_a_second() -> None:
    hub, clock = MemoryHub(), ManualClock()
    seen: list[Health] = []
    MemoryBus(hub).subscribe(HEALTH.key("lab", "*", "*"), lambda _, payload: seen.append(HEALTH.decode(payload)))
    with make_service(hub, clock) as service:
        service.counters.requests = 3
        service.counters.published = 500
        service.counters.latenesses_ns += range(101)
        for _ in range(30):
            clock.advance(100_000_000)
            service.beat(clock.monotonic_ns())
        assert [health.requests for health in seen] == [3, 3, 3]
        assert (seen[0].lateness_p50_ns, seen[0].lateness_p99_ns, seen[0].lateness_max_ns) == (50, 99, 100)
        assert seen[1].lateness_max_ns == 0
        # Rates are of the last second, counts since the start.
        assert [health.published_hz for health in seen] == pytest.approx([500, 0, 0], rel=0.01)
        assert (seen[0].service, seen[0].instance, seen[0].incarnation) == ("sim", "1", service.incarnation)


def test_health_report_has_the_last_messages_of_others() -> None:
    hub, clock = MemoryHub(), ManualClock()
    seen: list[Health] = []
    MemoryBus(hub).subscribe(HEALTH.key("lab", "edge", "*"), lambda _, payload: seen.append(HEALTH.decode(payload)))
    with make_service(hub, clock) as sim, make_service(hub, clock, "edge") as edge:
        edge.latest_value_cache(STATES)
        sim.ready()
        edge.ready()
        sender = sim.batch_publisher(STATES)
        sim.add_to_batch(sender, STATE, "rig1")
        sender.publish([JointState(step=1).SerializeToString()])
        clock.advance(3_000_000_000)
        edge.health.report(clock.monotonic_ns())
    [peer] = seen[0].peers
    assert (peer.service, peer.host, peer.silent_ns) == ("sim/1", platform.node(), 3_000_000_000)


def test_repeated_stalls_are_logged_every_ten_seconds(caplog: pytest.LogCaptureFixture) -> None:
    clock = ManualClock()
    with make_service(MemoryHub(), clock) as service:
        service.ready()
        for _ in range(25):
            clock.advance(1_000_000_000)
            service.beat(clock.monotonic_ns())
    assert len(caplog.messages) == 3
    assert caplog.messages[1].endswith("overloaded (10 times)")


def test_stall_of_a_service_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    clock = ManualClock()
    with make_service(MemoryHub(), clock) as service:
        service.ready()
        for gap_ms in (20, 400, 14_000, 20):
            clock.advance(gap_ms * 1_000_000)
            service.beat(clock.monotonic_ns())
    assert [text.partition(" until")[0] for text in caplog.messages] == ["stalled for 14.0 s"]
