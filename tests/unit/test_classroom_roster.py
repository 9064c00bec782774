"""Roster of a class: encodings, separators, names of any script, and errors with their lines."""

import csv
import io
import re
import time
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrig_classroom.attempts import owner_of
from hilrig_runtime.config.roster import Student, check_rigs, read_roster
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
    assert "occurs twice, first in line 5" in lines[3]


_names = st.text(st.characters(exclude_categories=("Cc", "Cs", "Cf", "Zl", "Zp", "Zs")), min_size=1, max_size=12)


@settings(max_examples=60, deadline=None)
@given(
    names=st.lists(_names, min_size=1, max_size=8),
    delimiter=st.sampled_from(",;\t"),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
    quoting=st.sampled_from([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]),
    bom=st.booleans(),
    gaps=st.booleans(),
)
def test_every_written_name_is_read_again(
    tmp_path_factory: pytest.TempPathFactory,
    names: list[str],
    delimiter: str,
    newline: str,
    quoting: int,
    bom: bool,
    gaps: bool,
) -> None:
    text = io.StringIO()
    table = csv.writer(text, delimiter=delimiter, lineterminator=newline, quoting=quoting)  # type: ignore[arg-type]
    table.writerow(["id", "name", "rig"])
    for number, name in enumerate(names):
        table.writerow([f"s{number}", f"={name}", f"rig{number}"])
        if gaps:
            text.write(newline + delimiter * 2 + newline)
    path = tmp_path_factory.mktemp("roster") / "r.csv"
    students = read_roster(roster_file(path, text.getvalue(), "utf-8-sig" if bom else "utf-8")).students
    assert [unicodedata.normalize("NFC", f"={name}") for name in names] == [student.name for student in students]
    assert [student.line for student in students] == [2 + (3 * n if gaps else n) for n in range(len(names))]


def test_roster_of_ten_thousand_students_is_read_quickly(tmp_path: Path) -> None:
    rows = "".join(f"s{number},Name {number},,rig{number}\n" for number in range(10_000))
    path = roster_file(tmp_path / "r.csv", f"id,name,group,rig\n{rows}")
    start = time.process_time()
    roster = read_roster(path)
    check_rigs(path, roster, {f"rig{number}" for number in range(10_000)}, claimed=False)
    # A comparison of each student with all others takes ten times as long.
    assert time.process_time() - start < 2
    assert len(roster.students) == 10_000
    with pytest.raises(InputError, match="at most 10000"):
        read_roster(roster_file(path, f"id,name,group,rig\n{rows}one-more,Name,,\n"))


def test_cell_with_line_breaks_does_not_shift_lines(tmp_path: Path) -> None:
    text = 'id,name\na,"Ann\nMarie"\nb c,Bob\nd,"x\n'
    path = roster_file(tmp_path / "r.csv", text)
    with pytest.raises(InputError, match="line 5: no CSV table"):
        read_roster(path)
    with pytest.raises(InputError, match="line 4: id 'b c'"):
        read_roster(roster_file(path, text.replace('"x', "Dan")))
    assert read_roster(roster_file(path, text[:22])).students == (Student("a", "Ann Marie"),)


def test_unquoted_separator_in_a_name_is_a_mistake(tmp_path: Path) -> None:
    path = roster_file(tmp_path / "r.csv", "id,name,group,rig\na,Doe, Jane,A,rig1\nb,Bob,A,rig1,,\n")
    with pytest.raises(InputError, match="line 2: 5 cells, the header has 4: put quotation marks") as failed:
        read_roster(path)
    assert "line 3" not in str(failed.value)
    with pytest.raises(InputError, match="column 'rig' occurs twice"):
        read_roster(roster_file(path, "id,name,rig,Rig\na,Ann,rig1,rig2\n"))


def test_separators_within_quotation_marks_do_not_count(tmp_path: Path) -> None:
    text = 'id;name;"first, second, third, fourth"\ns1;"Doe, Jane";x\n'
    assert read_roster(roster_file(tmp_path / "r.csv", text)).students == (Student("s1", "Doe, Jane"),)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "cp1252"])
def test_other_encodings_are_named(tmp_path: Path, encoding: str) -> None:
    with pytest.raises(InputError, match="it is not UTF-8 text; save it as UTF-8"):
        read_roster(roster_file(tmp_path / "r.csv", "id,name\na,Zoë\n", encoding))


def test_rigs_of_a_roster_are_those_of_the_lab(tmp_path: Path) -> None:
    text = (
        "id,name,group,rig\na,Ann,A,rig1\nb,Bob,A,rig1\nc,Cy,B,rig1\nd,Dan,,rig9\ne,Eve,,rig2\nf,Fay,,rig2\ng,Gil,,\n"
    )
    path = roster_file(tmp_path / "r.csv", text)
    with pytest.raises(InputError) as failed:
        check_rigs(path, read_roster(path), ["rig1", "rig2"], claimed=False)
    lines = [line.split(": ", 2)[1:] for line in str(failed.value).splitlines()]
    assert [line for line, _ in lines] == ["line 4", "line 5", "line 7"]
    assert "rig1 of c is also the rig of a (line 2)" in lines[0][1]
    assert "unknown rig 'rig9' of d; the lab has rig1, rig2" in lines[1][1]
    with pytest.raises(InputError) as failed:
        check_rigs(path, read_roster(path), ["rig1", "rig2"], claimed=True)
    assert "line 4" not in str(failed.value)


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


@pytest.mark.parametrize(
    ("file", "recorded", "owner", "problem"),
    [
        ("20261130T141219Z-rig1-c-ab12.mcap", ["c"], "c", ""),
        ("d.mcap", ["c"], "", "recorded for c, but named after d: ask both"),
        ("b.mcap", ["a"], "b", ""),
        ("x.mcap", ["a", "b"], "", r"recorded for a group \(a, b\): name the file after one of them"),
        ("b.mcap", ["a", "b"], "b", ""),
        ("d.mcap", ["unknown"], "d", ""),
    ],
)
def test_recorded_student_owns_a_recording(
    tmp_path: Path, file: str, recorded: list[str], owner: str, problem: str
) -> None:
    text = "id,name,group,rig\na,A,team,rig1\nb,B,team,rig1\nc,C,,rig2\nd,D,,rig3\n"
    roster = read_roster(roster_file(tmp_path / "r.csv", text))
    found = owner_of(Path(file), "rig3", roster, recorded)
    assert (found.student.id if found.student else "") == owner
    assert re.fullmatch(problem, found.problem)


def test_recording_without_a_student_has_a_reason(tmp_path: Path) -> None:
    roster = read_roster(roster_file(tmp_path / "r.csv", "id,name,rig\nc,C,rig2\nd,D,rig2\n"))
    assert "rig rig2 has several students (c, d)" in owner_of(Path("x.mcap"), "rig2", roster).problem
    assert "neither its name nor its rig rig7" in owner_of(Path("x.mcap"), "rig7", roster).problem
