"""Codes of a lab slot: choice of the students, end of the slot, and codes that are kept."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from hilrig_classroom.slot_codes import codes_csv, issue_codes, parse_end, select_students
from hilrig_runtime.config.claim_codes import digest_of, read_codes
from hilrig_runtime.config.roster import Roster, Student
from hilrig_runtime.errors import InputError

NOW = datetime(2026, 11, 30, 10, 15, tzinfo=timezone(timedelta(hours=1)))
ROSTER = Roster(
    tuple(Student(f"s{n}", name, group) for n, (name, group) in enumerate([("A", "X"), ("B", "X"), ("C", "Y")]))
)


@pytest.mark.parametrize(
    ("text", "end"),
    [
        ("11:30", datetime(2026, 11, 30, 10, 30, tzinfo=UTC)),
        ("08:00", datetime(2026, 12, 1, 7, 0, tzinfo=UTC)),
        ("2026-12-02 08:00", datetime(2026, 12, 2, 7, 0, tzinfo=UTC)),
        ("2026-12-02T08:00+00:00", datetime(2026, 12, 2, 8, 0, tzinfo=UTC)),
    ],
)
def test_end_of_a_slot_is_in_the_future(text: str, end: datetime) -> None:
    assert parse_end(text, NOW) == end


@pytest.mark.parametrize(
    ("text", "message"), [("noon", 'expected "HH:MM"'), ("25:00", 'expected "HH:MM"'), ("2026-11-29 08:00", "passed")]
)
def test_wrong_ends_are_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_end(text, NOW)


def test_students_of_a_slot() -> None:
    assert [one.id for one in select_students(ROSTER, "X", [])] == ["s0", "s1"]
    assert [one.id for one in select_students(ROSTER, "", ["s2"])] == ["s2"]
    with pytest.raises(InputError, match="no such students; the roster has the groups X, Y"):
        select_students(ROSTER, "Z", [])
    with pytest.raises(InputError, match="s9: not in the roster"):
        select_students(ROSTER, "", ["s9"])


def test_new_codes_replace_those_of_the_same_students(tmp_path: Path) -> None:
    soon, later = NOW + timedelta(minutes=5), NOW + timedelta(hours=2)
    first = issue_codes(tmp_path, ROSTER.students, soon, NOW)
    second = issue_codes(tmp_path, ROSTER.students[:1], later, NOW)
    expected = {digest_of(first["s1"]), digest_of(first["s2"]), digest_of(second["s0"])}
    assert {code.digest for code in read_codes(tmp_path)} == expected
    issue_codes(tmp_path, ROSTER.students[1:2], later, soon)
    assert [code.student for code in read_codes(tmp_path)] == ["s0", "s1"], "the code of s2 has ended"


def test_exported_codes_contain_no_formula() -> None:
    table = codes_csv([Student("s1", "=1+1", "X", "rig1")], {"s1": "AAAAA-22222"}, NOW)
    assert table == "id,name,group,rig,code,until\ns1,'=1+1,X,rig1,AAAAA-22222,2026-11-30 10:15\n"
