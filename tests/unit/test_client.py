"""`check_rig`: an unknown rig is rejected as soon as all services have replied, with the names of the lab's rigs."""

from functools import partial

import pytest

from hilrig_cli import client
from hilrig_cli.client import check_rig
from hilrig_runtime.bus.api import Reply
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas import LeaseRequest, ServiceInfo
from hilrig_schemas.topics import LEASE, SERVICE_INFO

LAB = parse_lab("[rigs]\ncount = 3\n")


class CountingBus(MemoryBus):
    """Bus that counts its queries; the services of `late` appear before the second query."""

    def __init__(self, *early: ServiceInfo, late: tuple[ServiceInfo, ...] = ()) -> None:
        super().__init__(MemoryHub())
        self.queries = 0
        self._late = late
        self._serve(early)

    def _serve(self, list_services: tuple[ServiceInfo, ...]) -> None:
        for one in list_services:
            reply = one.SerializeToString()
            self.declare_queryable(SERVICE_INFO.key(LAB.name, one.service, one.instance), partial(self._reply, reply))

    @staticmethod
    def _reply(service_info: bytes, _: bytes) -> bytes:
        return service_info

    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:
        self.queries += 1
        if self.queries == 2:
            self._serve(self._late)
        return super().query(key_expr, payload, timeout_s=timeout_s)


def info(service: str, instance: str, *rigs: str) -> ServiceInfo:
    return ServiceInfo(service=service, instance=instance, rigs=rigs)


SIM = info("sim", "1", "rig1", "rig2", "rig3", "guest")
FIRST, SECOND = info("edge", "1", "rig1", "rig2"), info("edge", "2", "rig3", "guest")


def test_rig_of_the_file_needs_no_query() -> None:
    bus = CountingBus()
    check_rig(bus, LAB, "rig2")
    assert bus.queries == 0


def test_added_rig_is_found_at_the_first_service_that_has_it() -> None:
    bus = CountingBus(SECOND)
    check_rig(bus, LAB, "guest")
    assert bus.queries == 1


def test_unknown_rig_is_rejected_once_all_services_reply(capsys: pytest.CaptureFixture[str]) -> None:
    bus = CountingBus(SIM, FIRST, SECOND)
    with pytest.raises(InputError, match=r"^unknown rig 'gest'; this lab has rig1, rig2, rig3, guest$"):
        check_rig(bus, LAB, "gest")
    assert bus.queries == 1
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("missing", [SIM, SECOND], ids=["sim", "edge"])
def test_waits_for_services_that_are_not_linked_yet(missing: ServiceInfo) -> None:
    linked = [one for one in (info("sim", "2", "rig1"), FIRST, SIM, SECOND) if one is not missing]
    bus = CountingBus(*linked, late=(missing, info("edge", "3", "late")))
    check_rig(bus, LAB, "late")
    assert bus.queries == 2


def test_prints_a_message_while_waiting_for_a_service(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(client, "QUERY_TIMEOUT_S", 0.2)
    monkeypatch.setattr(client, "WAIT_MESSAGE_AFTER_S", 0.0)
    with pytest.raises(InputError, match="unknown rig 'gest'; this lab has rig1, rig2, rig3"):
        check_rig(CountingBus(FIRST), LAB, "gest")
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "rig 'gest' is not in lab.toml; waiting up to 0.2 s for a service that it was added to" in message


def test_error_lists_some_of_many_rigs() -> None:
    lab = parse_lab("[rigs]\ncount = 128\n")
    rigs = [rig.name for rig in lab.rigs]
    bus = CountingBus(info("sim", "1", *rigs), info("edge", "1", *rigs))
    with pytest.raises(InputError, match=r"rig1, .* and 112 more \(hilrig rig list\)$"):
        check_rig(bus, lab, "rig129")


def test_unanswered_command_names_the_certificates(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mesh looks empty to a command whose certificate has expired."""
    monkeypatch.setattr(client, "QUERY_TIMEOUT_S", 0.0)
    monkeypatch.setattr(client, "ZenohBus", lambda *_: MemoryBus(MemoryHub()))
    monkeypatch.setattr(client, "check_permission", lambda *_: None)
    for text, expected in (("", "with this lab.toml?"), ("[bus.tls]\n", "valid certificates in .*bus?")):
        with pytest.raises(OperationError, match=f"no edge answers .*{expected}.* See hilrig doctor"):
            client.query_edges(parse_lab(text), LEASE, [], LeaseRequest())
