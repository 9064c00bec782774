"""One contract, two transports: what a service may expect of the bus."""

import queue
import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from hilrig_runtime.bus.api import Bus
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import BusConfig
from hilrig_runtime.errors import OperationError
from hilrig_schemas.topics import Traffic
from support.waiting import PATIENT_S, eventually

OpenBus = Callable[[str], Bus]


def free_ports(count: int) -> int:
    """First of `count` neighbouring free ports on loopback."""
    while True:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            first = probe.getsockname()[1]
        try:
            for port in range(first, first + count):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return int(first)


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


def test_a_message_reaches_who_subscribed_and_no_one_else(open_bus: OpenBus) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    states: queue.Queue[tuple[str, bytes]] = queue.Queue()
    others: queue.Queue[tuple[str, bytes]] = queue.Queue()
    edge.subscribe("hil/lab/*/state", lambda *message: states.put(message))
    edge.subscribe("hil/lab/*/command", lambda *message: others.put(message))
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"x") or not states.empty())
    assert states.get(timeout=5) == ("hil/lab/rig1/state", b"x")
    assert others.empty()


def test_control_arrives_in_the_order_of_sending(open_bus: OpenBus) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    got: list[int] = []
    edge.subscribe("hil/lab/rig1/state", lambda _, payload: got.append(int(payload)))
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"0") or got)
    for number in range(1, 500):
        publisher.put(str(number).encode())
    # Under load control is dropped rather than queued; what arrives is in order all the same.
    eventually(lambda: publisher.put(b"499") or got[-1] == 499)
    assert got == sorted(got)


def test_a_reader_that_was_held_up_goes_on_with_the_newest(open_bus: OpenBus, request: pytest.FixtureRequest) -> None:
    sim, edge = open_bus("sim"), open_bus("edge")
    got: list[int] = []
    entered, go_on = threading.Event(), threading.Event()

    def held_up(_: str, payload: bytes) -> None:
        got.append(int(payload))
        if "zenoh" in request.node.name:
            entered.set()
            go_on.wait(PATIENT_S)

    subscription = edge.subscribe_newest("hil/lab/rig1/state", held_up, 2)
    publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
    eventually(lambda: publisher.put(b"0") or got)
    for number in range(1, 200):
        publisher.put(str(number).encode())
    publisher.put(b"200")
    heard = queue.Queue[bytes]()
    # The last message has gone through the link when a later one, on another key, has.
    edge.subscribe("hil/lab/rig2/state", lambda _, payload: heard.put(payload))
    marker = sim.publisher("hil/lab/rig2/state", Traffic.CONTROL)
    eventually(lambda: marker.put(b"") or not heard.empty())
    go_on.set()
    eventually(lambda: publisher.put(b"200") or got[-1] == 200)
    if "zenoh" in request.node.name:
        assert len(got) < 100, "what piled up was not worked through"
    subscription.close()
    subscription.close()


def test_a_recording_stream_gives_a_late_subscriber_what_went_before(open_bus: OpenBus) -> None:
    sim, recorder = open_bus("sim"), open_bus("recorder")
    publisher = sim.publisher("hil/lab/log/sim/1", Traffic.RECORDING)
    for number in range(50):
        publisher.put(str(number).encode())
    got: list[int] = []
    lost: list[int] = []
    recorder.subscribe_recording("hil/lab/log/**", lambda _, payload: got.append(int(payload)), lost.append)
    for number in range(50, 100):
        publisher.put(str(number).encode())
    eventually(lambda: len(got) >= 100)
    assert got == list(range(100))
    assert lost == []


def test_a_question_is_answered_by_everyone_who_serves_it(open_bus: OpenBus) -> None:
    sim, tool = open_bus("sim"), open_bus("tool")

    def refuse(_: bytes) -> bytes:
        raise OperationError("not now")

    sim.declare_queryable("hil/lab/rig1/config", lambda payload: b"one:" + payload)
    sim.declare_queryable("hil/lab/rig2/config", refuse)
    answers = eventually(lambda: len(found := tool.query("hil/lab/*/config", b"?")) == 2 and found)
    by_error = sorted((answer.error, answer.payload) for answer in answers)
    assert by_error == [("", b"one:?"), ("not now", b"")]


def test_a_question_without_a_server_gets_no_answer(open_bus: OpenBus) -> None:
    assert open_bus("tool").query("hil/lab/nobody/config", timeout_s=0.2) == []


def test_liveliness_shows_who_is_there_and_who_went(open_bus: OpenBus) -> None:
    sim, tool = open_bus("sim"), open_bus("tool")
    token = sim.declare_token("hil/lab/alive/sim/1")
    eventually(lambda: tool.get_liveliness("hil/lab/alive/*/*") == ["hil/lab/alive/sim/1"])
    changes: list[tuple[str, bool]] = []
    tool.subscribe_liveliness("hil/lab/alive/*/*", lambda *change: changes.append(change))
    eventually(lambda: changes == [("hil/lab/alive/sim/1", True)])
    token.close()
    eventually(lambda: changes[-1] == ("hil/lab/alive/sim/1", False))


def test_what_was_closed_is_silent_and_closing_twice_is_fine(open_bus: OpenBus) -> None:
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


def test_services_find_each_other_in_any_order_and_again_after_a_restart() -> None:
    config = BusConfig(first_port=free_ports(3))
    got: list[bytes] = []
    with ZenohBus(config, "recorder") as recorder, ZenohBus(config, "edge") as edge:
        for bus in (recorder, edge):
            bus.subscribe("hil/lab/rig1/state", lambda _, payload: got.append(payload))
        for life in (b"first", b"second"):
            with ZenohBus(config, "sim") as sim:
                publisher = sim.publisher("hil/lab/rig1/state", Traffic.CONTROL)
                eventually(lambda life=life, publisher=publisher: publisher.put(life) or got.count(life) >= 2)


def test_a_taken_bus_port_is_said_in_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = BusConfig(first_port=taken.getsockname()[1])
        with pytest.raises(OperationError, match=rf"can't listen on tcp/127\.0\.0\.1:{config.first_port}.*first_port"):
            ZenohBus(config, "sim")
