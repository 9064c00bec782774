"""Contract of the bus, tested for both transports: in memory and zenoh."""

import queue
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from hilrig_runtime.bus.api import Bus, Publisher
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.errors import OperationError
from hilrig_schemas.topics import Traffic
from support.labs import free_ports
from support.waiting import LONG_TIMEOUT_S, eventually

OpenBus = Callable[[str], Bus]


@pytest.fixture(params=["memory", "zenoh"])
def open_bus(request: pytest.FixtureRequest) -> Iterator[OpenBus]:
    hub = MemoryHub()
    config = BusConfig(first_port=free_ports(3))
    opened: list[Bus] = []

    def open_one(service: str) -> Bus:
        bus = MemoryBus(hub) if request.param == "memory" else ZenohBus(config, service)
        opened.append(bus)
        return bus

    yield open_one
    for bus in reversed(opened):
        bus.close()


def test_message_reaches_only_matching_subscribers(open_bus: OpenBus) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    states: queue.Queue[tuple[str, bytes]] = queue.Queue()
    others: queue.Queue[tuple[str, bytes]] = queue.Queue()
    edge.subscribe("hil/lab/*/state", lambda *message: states.put(message))
    edge.subscribe("hil/lab/*/command", lambda *message: others.put(message))
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"x") or not states.empty())
    assert states.get(timeout=5) == ("hil/lab/rig1/state", b"x")
    assert others.empty()


def test_control_messages_arrive_in_order(open_bus: OpenBus) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    got: list[int] = []
    edge.subscribe("hil/lab/rig1/state", lambda _, payload: got.append(int(payload)))
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"0") or got)
    for number in range(1, 500):
        publisher.put(str(number).encode())
    # Under load control messages are dropped instead of queued; the received messages must still be in order.
    eventually(lambda: publisher.put(b"499") or got[-1] == 499)
    assert got == sorted(got)


def test_blocked_subscriber_continues_with_newest_message(open_bus: OpenBus, request: pytest.FixtureRequest) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    got: list[int] = []
    entered, unblocked = threading.Event(), threading.Event()

    def blocked(_: str, payload: bytes) -> None:
        got.append(int(payload))
        if "zenoh" in request.node.name:
            entered.set()
            unblocked.wait(LONG_TIMEOUT_S)

    subscription = edge.subscribe_newest("hil/lab/rig1/state", blocked, 2)
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"0") or got)
    for number in range(1, 200):
        publisher.put(str(number).encode())
    publisher.put(b"200")
    later = queue.Queue[bytes]()
    # When a later message on another key has arrived, all earlier messages have passed the link.
    edge.subscribe("hil/lab/rig2/state", lambda _, payload: later.put(payload))
    marker = sim.publisher("hil/lab/rig2/state", Traffic.CONTROL)
    eventually(lambda: marker.put(b"") or not later.empty())
    unblocked.set()
    eventually(lambda: publisher.put(b"200") or got[-1] == 200)
    if "zenoh" in request.node.name:
        assert len(got) < 100, "queued messages were delivered instead of dropped"
    subscription.close()
    subscription.close()


def test_late_subscriber_receives_earlier_recording_messages(open_bus: OpenBus) -> None:
    sim, recorder = open_bus("sim"), open_bus("recorder")
    publisher = sim.publisher("hil/lab/log/sim/1", Traffic.RECORDING)
    for number in range(50):
        publisher.put(str(number).encode())
    got: list[int] = []
    recorder.subscribe_recording("hil/lab/log/**", lambda _, payload: got.append(int(payload)))
    for number in range(50, 100):
        publisher.put(str(number).encode())
    eventually(lambda: len(got) >= 100)
    assert got == list(range(100))


def test_publishers_of_one_key_have_their_own_caches(open_bus: OpenBus) -> None:
    sim, recorder = open_bus("sim"), open_bus("recorder")
    states, events = (sim.publisher("hil/lab/log/sim/1", Traffic.RECORDING, 5) for _ in range(2))
    events.put(b"event")
    for _ in range(50):
        states.put(b"state")
    got: list[bytes] = []
    recorder.subscribe_recording("hil/lab/log/**", lambda _, payload: got.append(payload), 5)
    eventually(lambda: b"event" in got)
    if isinstance(recorder, ZenohBus):
        eventually(lambda: got.count(b"state") == 5)


def test_query_is_answered_by_every_queryable(open_bus: OpenBus) -> None:
    sim, tool = open_bus("sim"), open_bus("tool")

    def refuse(_: bytes) -> bytes:
        raise OperationError("not now")

    sim.declare_queryable("hil/lab/rig1/config", lambda payload: b"one:" + payload)
    sim.declare_queryable("hil/lab/rig2/config", refuse)
    answers = eventually(lambda: len(found := tool.query("hil/lab/*/config", b"?")) == 2 and found)
    by_error = sorted((answer.error, answer.payload) for answer in answers)
    assert by_error == [("", b"one:?"), ("not now", b"")]


def test_query_without_queryable_gets_no_reply(open_bus: OpenBus) -> None:
    assert open_bus("tool").query("hil/lab/nobody/config", timeout_s=0.2) == []


def test_liveliness_reports_start_and_end(open_bus: OpenBus) -> None:
    sim, tool = open_bus("sim"), open_bus("tool")
    token = sim.declare_token("hil/lab/alive/sim/1")
    eventually(lambda: tool.get_liveliness("hil/lab/alive/*/*") == ["hil/lab/alive/sim/1"])
    changes: list[tuple[str, bool]] = []
    tool.subscribe_liveliness("hil/lab/alive/*/*", lambda *change: changes.append(change))
    eventually(lambda: changes == [("hil/lab/alive/sim/1", True)])
    token.close()
    eventually(lambda: changes[-1] == ("hil/lab/alive/sim/1", False))


def test_closed_objects_are_silent_and_can_be_closed_again(open_bus: OpenBus) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    got: list[bytes] = []
    subscription = edge.subscribe("hil/lab/rig1/state", lambda _, payload: got.append(payload))
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"1") or got)
    subscription.close()
    subscription.close()
    count = len(got)
    publisher.put(b"2")
    assert not threading.Event().wait(0.2)
    assert len(got) == count
    edge.close()
    edge.close()


def test_services_connect_in_any_order_and_after_a_restart() -> None:
    config = BusConfig(first_port=free_ports(3))
    got: list[bytes] = []

    def is_received_twice(publisher: Publisher, payload: bytes) -> bool:
        publisher.put(payload)
        return got.count(payload) >= 2

    with ZenohBus(config, "recorder") as recorder, ZenohBus(config, "edge") as edge:
        for bus in (recorder, edge):
            bus.subscribe("hil/lab/rig1/state", lambda _, payload: got.append(payload))
        for instance in (b"first", b"second"):
            with ZenohBus(config, "sim") as sim:
                eventually(partial(is_received_twice, sim.publisher("hil/lab/rig1/state", Traffic.CONTROL), instance))


def test_occupied_bus_port_is_reported_in_one_line() -> None:
    with socket.socket() as occupied:
        occupied.bind(("127.0.0.1", 0))
        occupied.listen()
        config = BusConfig(first_port=occupied.getsockname()[1])
        with pytest.raises(OperationError, match=rf"can't listen on tcp/127\.0\.0\.1:{config.first_port}.*first_port"):
            ZenohBus(config, "sim")
