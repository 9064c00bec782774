"""Roster of a class: encodings, separators, names of any script, and errors with their lines."""

from pathlib import Path

import pytest

from hilrig_classroom.attempts import owner_of
from hilrig_classroom.roster import Student, read_roster
from hilrig_runtime.errors import InputError

NAMES = ["Zoë Müller", "Νίκος Παπάς", "山田 太郎", "عمر حسن", "=HYPERLINK(1)"]


def roster_file(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_roster_of_any_spreadsheet_is_read(tmp_path: Path, encoding: str, delimiter: str, newline: str) -> None:
    rows = [["id", "name", "group", "rig"], *([f"s{n}", name, "", f"rig{n}"] for n, name in enumerate(NAMES))]
    text = newline.join(delimiter.join(row) for row in rows) + newline
    students = read_roster(roster_file(tmp_path / "roster.csv", text, encoding)).students
    assert [student.name for student in students] == NAMES
    assert students[2] == Student("s2", NAMES[2], "", "rig2")


def test_columns_may_be_in_any_order_and_missing(tmp_path: Path) -> None:
    (student,) = read_roster(roster_file(tmp_path / "r.csv", 'Name,ID\n"Doe, Jane",a1\n\n')).students
    assert student == Student("a1", "Doe, Jane")


def test_every_invalid_row_is_named_with_its_line(tmp_path: Path) -> None:
    text = "id,name,rig\na b,Ann,\n,Bob,\nc,,\nd,Dan,\nD,Doe,\ne,Eve,ri/g\n"
    with pytest.raises(InputError) as failed:
        read_roster(roster_file(tmp_path / "r.csv", text))
    lines = str(failed.value).splitlines()
    assert [line.split(": ")[1] for line in lines] == ["line 2", "line 3", "line 4", "line 6", "line 7"]
    assert "expected 1 to 63 letters" in lines[0]
    assert "occurs twice" in lines[3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("name,rig\nAnn,rig1\n", "column 'id' is missing"),
        ("id,name\n", "no students"),
        ('id,name\na,"Ann\n', "no CSV table"),
    ],
)
def test_files_that_are_no_roster_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_roster(roster_file(tmp_path / "r.csv", text))


@pytest.mark.parametrize(
    ("file", "rig", "owner"),
    [
        ("anna.mcap", "rig9", "anna"),
        ("Anna-2.mcap", "", "anna"),
        ("anna2.mcap", "rig1", "bob"),
        ("an-na.mcap", "", "an-na"),
        ("week 1/anna/20261130T141219Z-rig2.mcap", "rig2", "anna"),
        ("20261130T141219Z-rig1-ab12.mcap", "rig1", "bob"),
    ],
)
def test_owner_of_a_recording(tmp_path: Path, file: str, rig: str, owner: str) -> None:
    text = "id,name,rig\nan,An,\nan-na,Anna B,\nanna,Anna A,\nbob,Bob,rig1\nc,C,rig2\nd,D,rig2\n"
    roster = read_roster(roster_file(tmp_path / "r.csv", text))
    found = owner_of(Path(file), rig, roster)
    assert found.student is not None
    assert found.student.id == owner


def test_recording_without_a_student_has_a_reason(tmp_path: Path) -> None:
    roster = read_roster(roster_file(tmp_path / "r.csv", "id,name,rig\nc,C,rig2\nd,D,rig2\n"))
    assert "rig rig2 has several students (c, d)" in owner_of(Path("x.mcap"), "rig2", roster).problem
    assert "neither its name nor its rig rig7" in owner_of(Path("x.mcap"), "rig7", roster).problem
