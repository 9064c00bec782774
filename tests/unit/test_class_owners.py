"""Owners of rigs in a class: fixed by the roster, or claimed with a code; two machines, one of them not the owner's."""

import logging
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from hilrig_modbus_edge.classroom.owners import ClassOwners
from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.protocol.exceptions import ModbusError
from hilrig_runtime.config.claim_codes import (
    CLAIM_ADDRESS,
    CODES_FILE,
    ClaimCode,
    digest_of,
    letters_of,
    new_code,
    read_codes,
    write_codes,
)
from hilrig_runtime.config.classroom import ClassroomConfig
from hilrig_runtime.errors import InputError
from hilrig_runtime.timing.guess_throttle import BURST_ATTEMPTS, RETRY_INTERVAL_NS
from hilrig_schemas import Event
from support.device_bench import Bench

CODES = {"ann": "AAAAA-22222", "bob": "BBBBB-33333", "cyd": "CCCCC-44444"}
RIG_OF = {"ann": "rig1", "bob": "", "cyd": "rig2"}
SLOT_S = 3600


@pytest.fixture
def owners(tmp_path: Path) -> Callable[[], ClassOwners]:
    """Make the owners of an edge that starts; the folder has codes of one lab slot."""
    rows = "".join(f"{one},{one},,{rig}\n" for one, rig in RIG_OF.items())
    (tmp_path / "roster.csv").write_text(f"id,name,group,rig\n{rows}", encoding="utf-8")
    ends = datetime.fromtimestamp(Bench().clock.wall_ns() / 1e9, UTC) + timedelta(seconds=SLOT_S)
    folder = tmp_path / "claims"
    write_codes(folder, [ClaimCode(one, RIG_OF[one], ends, digest_of(code)) for one, code in CODES.items()])
    config = ClassroomConfig(roster=tmp_path / "roster.csv", claims=folder)
    return lambda: ClassOwners(config, ["rig1", "rig2"])


def claim(bench: Bench, client: Client, code: str) -> None:
    letters = letters_of(code).encode()
    bench.write(client, CLAIM_ADDRESS, *(int.from_bytes(letters[at : at + 2]) for at in range(0, 10, 2)))


def refused(bench: Bench, request: Callable[[], None]) -> tuple[int, Event]:
    """Return the exception code of a refused request, and its event."""
    with pytest.raises(ModbusError) as failed:
        request()
    bench.wait(1001)
    return int(failed.value.code), [event for event in bench.events if event.kind == Event.LEASE_REFUSED][-1]


def test_only_the_claiming_machine_may_write(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    mine, other = bench.connect("10.0.0.1", 1000), bench.connect("10.0.0.2", 1000)
    bench.state(1)
    code, event = refused(bench, lambda: bench.write(mine, 0, 5))
    assert (code, event.kind, event.controller_data.student) == (6, Event.LEASE_REFUSED, "")
    assert "rig1 is not claimed: claim it with your code (hilrig claim CODE" in event.text
    claim(bench, mine, "aaaaa 22222")
    assert (bench.events[-1].kind, bench.events[-1].controller_data.student) == (Event.CLAIM, "ann")
    assert bench.events[-1].text == "rig1 claimed by ann from 10.0.0.1"
    bench.write(mine, 0, 5)
    bench.write(bench.connect("10.0.0.1", 1001), 100, 7)
    code, event = refused(bench, lambda: bench.write(other, 0, 6))
    assert (code, event.kind, event.controller_data.student) == (6, Event.LEASE_REFUSED, "ann")
    assert event.text.startswith("10.0.0.2:1000: write to rig1 denied: rig1 is claimed by ann from 10.0.0.1")
    assert len(bench.read(other, 0, 8)) == 8
    status = bench.device.lease_status()
    assert (status.student, status.claimed_from, status.holder) == ("ann", "10.0.0.1", "10.0.0.1:1001")


def test_session_has_the_id_of_the_student(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    claim(bench, client, CODES["ann"])
    bench.write(client, 0, 5)
    session = bench.device.session
    assert session is not None
    assert session.as_message().student == session.student == "ann"
    assert "-rig1-ann-" in session.id
    start = next(event for event in bench.events if event.kind == Event.SESSION_START)
    assert start.session_data.student == "ann"


@pytest.mark.parametrize(
    ("code", "exception", "reason"),
    [
        ("AAAAA-22223", 4, "claim refused: unknown code"),
        ("CCCCC-44444", 4, "claim refused: the code of cyd is for rig2"),
        ("\0\0\0\0\0\0\0\0\0\0", 4, "claim refused: unknown code"),
    ],
)
def test_code_of_another_rig_is_refused(
    owners: Callable[[], ClassOwners], code: str, exception: int, reason: str
) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    found, event = refused(bench, lambda: claim(bench, client, code))
    assert found == exception
    assert reason in event.text
    assert bench.device.lease_status().student == ""


def test_claimed_rig_is_refused_to_other_students(owners: Callable[[], ClassOwners]) -> None:
    both = owners()
    bench, second = Bench(both.of("rig1")), Bench(both.of("rig2"))
    bob, ann = bench.connect("10.0.0.2"), bench.connect("10.0.0.1")
    claim(bench, bob, CODES["bob"])
    code, event = refused(bench, lambda: claim(bench, ann, CODES["ann"]))
    assert (code, event.controller_data.student) == (6, "bob")
    assert "to end it, run: hilrig lease rig1 --end-claim" in event.text
    code, event = refused(second, lambda: claim(second, second.connect("10.0.0.2"), CODES["bob"]))
    assert code == 6
    assert "bob has claimed rig1; to end that, run: hilrig lease rig1 --end-claim" in event.text


def test_claim_moves_only_while_the_old_machine_is_idle(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    old, new = bench.connect("10.0.0.1"), bench.connect("10.0.0.2")
    claim(bench, old, CODES["ann"])
    bench.write(old, 0, 5)
    code, event = refused(bench, lambda: claim(bench, new, CODES["ann"]))
    assert code == 6
    assert "ann writes from 10.0.0.1; stop that program first" in event.text
    claim(bench, old, CODES["ann"])
    bench.device.disconnect(old, "closed")
    claim(bench, new, CODES["ann"])
    bench.write(new, 0, 6)
    assert refused(bench, lambda: bench.write(bench.connect("10.0.0.1"), 0, 5))[0] == 6


def test_claim_with_a_certificate_is_bound_to_its_name(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    claim(bench, bench.connect("10.0.0.1", certificate="plc7"), CODES["ann"])
    bench.write(bench.connect("10.0.0.9", certificate="plc7"), 0, 5)
    assert bench.device.lease_status().claimed_from == "CN=plc7"
    for client in (bench.connect("10.0.0.1"), bench.connect("10.0.0.1", certificate="plc8")):
        assert refused(bench, lambda client=client: bench.write(client, 0, 5))[0] == 6  # type: ignore[misc]


def test_claim_ends_with_the_lab_slot(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    claim(bench, client, CODES["ann"])
    bench.write(client, 0, 5)
    for _ in range(SLOT_S - 1):
        bench.wait(999)
        bench.write(client, 0, 5)
    assert bench.device.session is not None
    for _ in range(5):
        bench.wait(999)
    assert bench.commands[-1].effort[0] == 0
    assert bench.device.session is None
    ended = next(event for event in bench.events if event.kind == Event.CLAIM and "ended" in event.text)
    assert ended.text == "claim of rig1 by ann has ended: the lab slot has ended"
    code, event = refused(bench, lambda: claim(bench, client, CODES["ann"]))
    assert code == 4
    assert "the lab slot of ann's code ended at" in event.text


def test_ended_claim_ends_lease_and_session_at_once(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    claim(bench, client, CODES["ann"])
    bench.write(client, 0, 500)
    assert bench.device.end_claim("by order") == "ann"
    assert bench.device.lease.holder is None
    assert bench.device.session is None
    assert list(bench.commands[-1].effort) == [0, 0, 0, 0]
    assert refused(bench, lambda: bench.write(client, 0, 500))[0] == 6
    assert bench.device.end_claim("again") == ""


def test_next_student_on_the_same_machine_has_a_new_session(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    claim(bench, client, CODES["ann"])
    bench.write(client, 0, 5)
    bench.device.end_claim("by order")
    claim(bench, client, CODES["bob"])
    bench.write(client, 0, 5)
    starts = [event.session_data.student for event in bench.events if event.kind == Event.SESSION_START]
    assert starts == ["ann", "bob"]


def test_claim_survives_a_restart_of_the_edge(owners: Callable[[], ClassOwners], tmp_path: Path) -> None:
    first = owners()
    bench = Bench(first.of("rig1"))
    claim(bench, bench.connect(), CODES["ann"])
    first.close()
    assert (tmp_path / "claims/rig1.json").stat().st_mode & 0o777 == 0o600
    again = owners()
    bench = Bench(again.of("rig1"))
    bench.write(bench.connect(), 0, 5)
    assert refused(bench, lambda: bench.write(bench.connect("10.0.0.2"), 0, 5))[0] == 6
    bench.device.end_claim("by order")
    again.close()
    assert Bench(owners().of("rig1")).device.lease_status().student == ""


@pytest.mark.parametrize("content", [b"", b"{", b'{"student": "a/b", "host": "h", "ends_wall_ns": 1}', b"\xff"])
def test_damaged_claim_is_no_claim(
    owners: Callable[[], ClassOwners], tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "claims/rig1.json").write_bytes(content)
    bench = Bench(owners().of("rig1"))
    assert refused(bench, lambda: bench.write(bench.connect(), 0, 5))[0] == 6
    assert "rig1 must be claimed again" in caplog.text


def test_guessing_is_limited_for_each_machine(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    guesser, other = bench.connect("10.0.0.2"), bench.connect("10.0.0.1")
    for _ in range(BURST_ATTEMPTS):
        with pytest.raises(ModbusError, match="04"):
            claim(bench, guesser, new_code())
    with pytest.raises(ModbusError, match="06"):
        claim(bench, guesser, CODES["ann"])
    claim(bench, other, CODES["bob"])
    bench.device.end_claim("by order")
    bench.wait(RETRY_INTERVAL_NS / 1e6)
    claim(bench, guesser, CODES["ann"])


def test_new_codes_are_read_at_the_next_claim(
    owners: Callable[[], ClassOwners], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    bench = Bench(owners().of("rig1"))
    client, folder = bench.connect(), tmp_path / "claims"
    codes = read_codes(folder)
    write_codes(folder, [ClaimCode("dan", "", codes[0].ends, digest_of("DDDDD-55555")), *codes[1:]])
    assert refused(bench, lambda: claim(bench, client, CODES["ann"]))[0] == 4
    claim(bench, client, "DDDDD-55555")
    assert bench.device.lease_status().student == "dan"
    (folder / CODES_FILE).write_text("student,rig,ends,sha256\nx,y,never,z\n", encoding="utf-8")
    bench.device.end_claim("by order")
    claim(bench, client, "DDDDD-55555")
    assert "line 2: not a code; make the codes again with hilrig rig codes; the codes that were read" in caplog.text
    (folder / CODES_FILE).unlink()
    bench.device.end_claim("by order")
    assert refused(bench, lambda: claim(bench, client, "DDDDD-55555"))[0] == 4
    assert "no rig can be claimed; make codes with hilrig rig codes" in caplog.text


def test_rig_of_the_roster_has_its_students(tmp_path: Path) -> None:
    path = tmp_path / "roster.csv"
    path.write_text("id,name,group,rig\nann,Ann,A,rig1\nbob,Bob,A,rig1\ncyd,Cyd,,rig2\n", encoding="utf-8")
    class_owners = ClassOwners(ClassroomConfig(roster=path), ["rig1", "rig2", "rig3"])
    bench = Bench(class_owners.of("rig1"))
    bench.write(bench.connect(), 0, 5)
    assert bench.device.session is not None
    assert bench.device.session.student == "ann,bob"
    assert "ann" not in bench.device.session.id, "a rig of several students"
    bench.device.release("test")
    bench.write(bench.connect("10.0.0.2", certificate="bob"), 0, 5)
    bench.device.release("test")
    code, event = refused(bench, lambda: bench.write(bench.connect("10.0.0.3", certificate="cyd"), 0, 5))
    assert (code, event.controller_data.student) == (6, "ann,bob")
    assert "rig1 belongs to ann,bob by the roster, the certificate to cyd" in event.text
    assert Bench(class_owners.of("rig3")).device.lease_status().student == ""
    with pytest.raises(InputError, match="unknown rig 'rig2' of cyd"):
        ClassOwners(ClassroomConfig(roster=path), ["rig1"])


def test_rig_without_claims_has_no_registers_for_codes() -> None:
    bench = Bench(ClassOwners(None, ["rig1"]).of("rig1"))
    client = bench.connect()
    with pytest.raises(ModbusError, match="02"):
        claim(bench, client, CODES["ann"])
    bench.write(client, 0, 5)
    session = bench.device.session
    assert session is not None
    known = {"rig", "session", "controller", "start_wall_ns"}
    assert {field.name for field, _ in session.as_message().ListFields()} == known
    assert not [event for event in bench.events if "student" in str(event)]
    assert "student" not in str(bench.device.lease_status())
    assert session.id.count("-") == 2


def test_claim_is_one_write_of_all_letters(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    client = bench.connect()
    for address, values in ((CLAIM_ADDRESS, [0x4141] * 4), (CLAIM_ADDRESS + 1, [0x4141] * 5), (CLAIM_ADDRESS, [1] * 6)):
        with pytest.raises(ModbusError, match="02"):
            bench.write(client, address, *values)
    with pytest.raises(ModbusError, match="02"):
        bench.read(client, CLAIM_ADDRESS, 5)


def test_controller_of_a_reserved_rig_writes_for_its_claimer(owners: Callable[[], ClassOwners]) -> None:
    bench = Bench(owners().of("rig1"))
    plc = bench.device.reserve("192.168.7.5", 502, "")
    assert "rig1 is not claimed" in bench.device.owner_denial(plc)
    claim(bench, bench.connect("10.0.0.1"), CODES["ann"])
    assert bench.device.owner_denial(plc) == ""
    bench.write(plc, 0, 5)
    assert bench.device.session is not None
    assert bench.device.session.student == "ann"
    assert refused(bench, lambda: bench.write(bench.connect("10.0.0.1"), 0, 5))[0] == 6


def test_codes_are_long_and_stored_as_hashes(owners: Callable[[], ClassOwners], tmp_path: Path) -> None:
    owners()
    codes = {new_code() for _ in range(1000)}
    assert len(codes) == 1000
    assert {len(letters_of(code)) for code in codes} == {10}
    text = (tmp_path / "claims" / CODES_FILE).read_text()
    assert "22222" not in text
    assert (tmp_path / "claims" / CODES_FILE).stat().st_mode & 0o777 == 0o600
