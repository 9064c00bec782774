"""Control requests: both sides refuse another release series with one text, and a service its unknown requests."""

import pytest

from hilrig_cli import client
from hilrig_cli.client import send_control_request
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.control import handle_control_request, release_series
from hilrig_schemas import (
    ControlReply,
    ControlRequest,
    LeaseRequest,
    LeaseStatus,
    ResetRig,
    ServiceInfo,
    StartSession,
    topics,
)
from support.foreign_requests import EXECUTED, KINDS, OWN, REFUSED, SERIES

LAB = LabConfig()


class FakeService:
    """A service that executes `reset_rig`, on a bus."""

    def __init__(self) -> None:
        self.bus = MemoryBus(MemoryHub())
        self.rigs: list[str] = []
        self.bus.declare_queryable(topics.CONTROL.key(LAB.name, "edge", "1"), self.handle)

    def handle(self, payload: bytes) -> bytes:
        return handle_control_request({"reset_rig": self._reset}, payload)

    def send(self, request: ControlRequest, software_version: str = OWN) -> ControlReply:
        info = ServiceInfo(service="edge", instance="1", host="lab-host", software_version=software_version)
        return send_control_request(self.bus, LAB, info, request)

    def _reset(self, request: ResetRig) -> ControlReply:
        self.rigs.append(request.rig)
        return ControlReply(text="done")


def reset(rig: str = "rig1") -> ControlRequest:
    return ControlRequest(reset_rig=ResetRig(rig=rig))


def test_request_is_executed_and_replied_with_the_version() -> None:
    service = FakeService()
    assert service.send(reset()) == ControlReply(software_version=OWN, text="done")
    assert service.rigs == ["rig1"]


@pytest.mark.parametrize(("payload", "error"), REFUSED)
def test_foreign_request_is_refused(payload: bytes, error: str) -> None:
    service = FakeService()
    with pytest.raises(OperationError) as refusal:
        service.handle(payload)
    assert str(refusal.value) == error
    assert service.rigs == []


def test_another_patch_version_is_accepted() -> None:
    service = FakeService()
    service.handle(ControlRequest(software_version=f"{SERIES}.99", reset_rig=ResetRig(rig="a")).SerializeToString())
    service.send(reset("b"), f"{SERIES}.99")
    assert service.rigs == ["a", "b"]


@pytest.mark.parametrize("older", ["0.0.9", "0.0", ""])
def test_command_does_not_ask_a_service_of_another_series(older: str) -> None:
    service = FakeService()
    with pytest.raises(OperationError) as refusal:
        service.send(reset(), older)
    expected = f"wrong version: services {older}, command {OWN}; install the same version on both"
    assert str(refusal.value) == expected
    assert service.rigs == []


def test_release_series_is_the_part_that_marks_incompatibility() -> None:
    assert release_series("0.2.0.dev0") == release_series("0.2.7") == ("0", "2")
    assert release_series("1.2.0") == release_series("1.9.0") == ("1",)


def test_request_of_another_service_is_refused() -> None:
    with pytest.raises(OperationError) as refusal:
        FakeService().send(ControlRequest(start_session=StartSession(rig="rig1")))
    assert str(refusal.value) == (
        "edge/1 on lab-host refused: this service does not execute start_session; it executes reset_rig"
    )


@pytest.mark.parametrize("topic", list(topics.all_topics()), ids=lambda topic: topic.name)
def test_only_queries_have_a_request_type(topic: topics.Topic) -> None:  # type: ignore[type-arg]
    without_payload = (topics.CONFIG, topics.SERVICE_INFO)
    is_query = topic.traffic is topics.Traffic.QUERY
    assert (topic.request is not None) == (is_query and topic not in without_payload)


def test_every_request_is_executed_by_a_service() -> None:
    assert {kind for kinds in EXECUTED.values() for kind in kinds} == set(KINDS)


def test_request_with_a_value_out_of_bounds_is_refused() -> None:
    service = FakeService()
    with pytest.raises(OperationError, match="rig has 5000 characters"):
        service.handle(ControlRequest(software_version=OWN, reset_rig=ResetRig(rig="x" * 5_000)).SerializeToString())
    assert service.rigs == []


EDGE = ServiceInfo(service="edge", instance="1", software_version=OWN, rigs=["rig1"])


def replying(key: str, payload: bytes) -> MemoryBus:
    bus = MemoryBus(MemoryHub())
    bus.declare_queryable(key, lambda _: payload)
    bus.declare_queryable(topics.SERVICE_INFO.key(LAB.name, "edge", "1"), lambda _: EDGE.SerializeToString())
    return bus


def test_text_of_a_reply_is_printable() -> None:
    payload = ControlReply(text="done\x1b[2J", session="s\n1").SerializeToString()
    bus = replying(topics.CONTROL.key(LAB.name, "edge", "1"), payload)
    reply = send_control_request(bus, LAB, EDGE, reset())
    assert (reply.text, reply.session) == (r"done\x1b[2J", r"s\x0a1")


@pytest.mark.parametrize("payload", [b"\xff", ControlReply(text="x" * 2_000_000).SerializeToString()])
def test_invalid_control_reply_is_an_error(payload: bytes) -> None:
    bus = replying(topics.CONTROL.key(LAB.name, "edge", "1"), payload)
    with pytest.raises(OperationError, match=r"edge/1 on .* sent an invalid reply: .*; compare the versions"):
        send_control_request(bus, LAB, EDGE, reset())


@pytest.mark.parametrize("reply", [LeaseStatus(rig="rig2"), LeaseStatus(rig="rig1", watchdog_timeout_ns=-(1 << 63))])
def test_invalid_lease_reply_is_an_error(monkeypatch: pytest.MonkeyPatch, reply: LeaseStatus) -> None:
    bus = replying(topics.LEASE.key(LAB.name, "rig1"), reply.SerializeToString())
    monkeypatch.setattr(client, "ZenohBus", lambda *_: bus)
    with pytest.raises(OperationError, match=r"an edge sent an invalid reply: (message of rig|watchdog_timeout_ns is)"):
        client.query_edges(LAB, topics.LEASE, ["rig1"], LeaseRequest())
