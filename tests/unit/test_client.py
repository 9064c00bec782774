"""A rig that a lab does not have is refused as soon as that is certain, with the names of those that it has."""

import pytest

from hilrig_cli import client as asking
from hilrig_cli.client import check_rig
from hilrig_runtime.bus.api import Reply
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.errors import InputError
from hilrig_schemas import ServiceInfo
from hilrig_schemas.topics import SERVICE_INFO

LAB = parse_lab("[rigs]\ncount = 3\n")


class CountingBus(MemoryBus):
    """Knows how often it was asked; services that come later come before the second time."""

    def __init__(self, *early: ServiceInfo, late: tuple[ServiceInfo, ...] = ()) -> None:
        super().__init__(MemoryHub())
        self.asked = 0
        self._late = late
        self._serve(early)

    def _serve(self, infos: tuple[ServiceInfo, ...]) -> None:
        for one in infos:
            answer = one.SerializeToString()
            self.declare_queryable(
                SERVICE_INFO.key(LAB.name, one.service, one.instance), lambda _, answer=answer: answer
            )

    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:
        self.asked += 1
        if self.asked == 2:
            self._serve(self._late)
        return super().query(key_expr, payload, timeout_s=timeout_s)


def info(service: str, instance: str, *rigs: str) -> ServiceInfo:
    return ServiceInfo(service=service, instance=instance, rigs=rigs)


SIM = info("sim", "1", "rig1", "rig2", "rig3", "guest")
FIRST, SECOND = info("edge", "1", "rig1", "rig2"), info("edge", "2", "rig3", "guest")


def test_a_rig_of_the_file_is_not_asked_for() -> None:
    bus = CountingBus()
    check_rig(bus, LAB, "rig2")
    assert bus.asked == 0


def test_a_rig_that_was_added_is_known_from_the_first_who_has_it() -> None:
    bus = CountingBus(SECOND)
    check_rig(bus, LAB, "guest")
    assert bus.asked == 1


def test_once_every_rig_of_the_file_is_served_another_name_is_refused_at_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bus = CountingBus(SIM, FIRST, SECOND)
    with pytest.raises(InputError, match=r"^no rig is called 'gest'; this lab has rig1, rig2, rig3, guest$"):
        check_rig(bus, LAB, "gest")
    assert bus.asked == 1
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("missing", [SIM, SECOND], ids=["sim", "edge"])
def test_a_service_that_is_not_linked_yet_is_waited_for(missing: ServiceInfo) -> None:
    there = [one for one in (info("sim", "2", "rig1"), FIRST, SIM, SECOND) if one is not missing]
    bus = CountingBus(*there, late=(missing, info("edge", "3", "late")))
    check_rig(bus, LAB, "late")
    assert bus.asked == 2


def test_where_a_service_stays_away_it_is_said_what_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(asking, "ANSWER_WITHIN_S", 0.2)
    monkeypatch.setattr(asking, "PATIENCE_S", 0.0)
    with pytest.raises(InputError, match="no rig is called 'gest'; this lab has rig1, rig2, rig3"):
        check_rig(CountingBus(FIRST), LAB, "gest")
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "'gest' is not in lab.toml: looking for a service that it was added to, for up to 0.2 s" in said


def test_of_many_rigs_some_are_named() -> None:
    lab = parse_lab("[rigs]\ncount = 128\n")
    rigs = [rig.name for rig in lab.rigs]
    bus = CountingBus(info("sim", "1", *rigs), info("edge", "1", *rigs))
    with pytest.raises(InputError, match=r"rig1, .* and 112 more \(hilrig rig list\)$"):
        check_rig(bus, lab, "rig129")
