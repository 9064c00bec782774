"""Grades of a class: attempts, penalties, overrides, gradebooks, similar runs; the same files give the same bytes."""

import csv
import io
import json
import shutil
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from hilrig_classroom.assignment import Assignment, AssignmentConfig, Measure, load_assignment
from hilrig_classroom.evaluation import Attempt
from hilrig_classroom.gradebook import fill_export, grades_csv, similar_text
from hilrig_classroom.grades import attempt_that_counts
from hilrig_classroom.output import GradeFolder
from hilrig_classroom.pages import similar_groups
from hilrig_runtime.config.roster import Roster, Student, read_roster
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import InputError
from support.labs import hilrig
from support.recordings import Script, make, write

TASK = "[task]\ntitle = 'There'\n[[task.poses]]\nname = 'near'\nposition_mm = [400, 100, 50]\ntolerance_mm = 300\n"
FAR = "[[task.poses]]\nname = 'far'\nposition_mm = [-300, 300, 60]\n"
SETTINGS = "title = 'Week 1'\n[rubric]\npoints = 20\n[rubric.latency_ms]\nweight = 0.25\nfull = 45\nzero = 100\n"
ROSTER = "id,name,group,rig\nzoe,Zoë Müller,,\ntaro,山田 太郎,,\neve,=HYPERLINK(1),,\nbob,Bob,g1,\nabsent,Ann,,\n"


@pytest.fixture(scope="module")
def classroom(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an assignment, a roster and recordings."""
    folder = tmp_path_factory.mktemp("class")
    (folder / "a").mkdir()
    (folder / "a/assignment.toml").write_text(SETTINGS)
    (folder / "a/lab.toml").write_text(TASK + FAR)
    (folder / "a/handout.md").write_text("Move to both poses.\n")
    (folder / "roster.csv").write_text(ROSTER)
    runs = folder / "runs"
    (runs / "bob").mkdir(parents=True)
    quick, slow = Script(seconds=4.0), Script(seconds=4.0, delay_ms=60.0, seed=3)
    write(runs / "zoe.mcap", make(quick, session="one"), script=quick, session="one")
    write(runs / "taro-1.mcap", make(slow, session="two"), script=slow, session="two")
    shutil.copy(runs / "zoe.mcap", runs / "eve.mcap")
    (runs / "bob/run.mcap").write_bytes(b"no recording")
    (runs / "stranger.mcap").write_bytes((runs / "taro-1.mcap").read_bytes())
    return folder


def grade(classroom: Path, out: Path, student: str = "") -> dict[str, Any]:
    roster = read_roster(classroom / "roster.csv")
    return GradeFolder(out, classroom / "runs", load_assignment(classroom / "a"), roster, workers=1).grade(student)


@pytest.fixture(scope="module")
def graded(classroom: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("grades")
    return out, grade(classroom, out)


def rows_of(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in document["students"]}


def test_points_follow_the_rubric(graded: tuple[Path, dict[str, Any]]) -> None:
    rows = rows_of(graded[1])
    used = rows["zoe"]["attempts"][0]
    assert [goal["reached"] for goal in used["goals"]] == [True, False]
    # Half of the goals, weight 0.75; all points for the latency, weight 0.25, if it is valid.
    expected = 20 * (0.75 * 0.5 + (0.25 if not used["data_quality"] else 0.0))
    assert rows["zoe"]["points"] == pytest.approx(expected, abs=0.01)
    assert rows["absent"]["points"] is None
    assert rows["bob"]["points"] is None
    assert "not an MCAP file" in rows["bob"]["attempts"][0]["problem"]
    assert [each["file"] for each in graded[1]["unassigned"]] == ["stranger.mcap"]


def test_copies_are_listed_on_both_sides_without_a_verdict(graded: tuple[Path, dict[str, Any]]) -> None:
    rows = rows_of(graded[1])
    same = {"share": 1.0, "same_recording": True}
    assert rows["zoe"]["similar"] == [{"file": "zoe.mcap", "student": "eve", "other_file": "eve.mcap", **same}]
    assert rows["eve"]["similar"] == [{"file": "eve.mcap", "student": "zoe", "other_file": "zoe.mcap", **same}]
    assert rows["taro"]["similar"] == []
    assert similar_groups(graded[1]) == ["eve: eve.mcap; zoe: zoe.mcap: the same recording"]
    assert rows["zoe"]["points"] == rows["eve"]["points"]


def test_many_similar_students_are_one_group_and_a_short_cell() -> None:
    names = [f"s{number}" for number in range(8)]

    def run(student: str, share: float) -> dict[str, Any]:
        return {
            "file": "a",
            "student": student,
            "other_file": f"{student}.mcap",
            "share": share,
            "same_recording": False,
        }

    rows: list[dict[str, Any]] = [
        {"id": name, "similar": [run(other, 0.6) for other in names if other != name]} for name in names
    ]
    rows[0]["similar"][6]["share"] = 0.91
    pair = [{"id": "x", "similar": [run("y", 0.7)]}, {"id": "y", "similar": [run("x", 0.7)]}]
    document = {"students": [*rows, *pair, {"id": "alone", "similar": []}]}
    files = "; ".join(f"{name}: {name}.mcap" for name in names)
    assert similar_groups(document) == [
        f"{files}: 60 to 91 % same torques",
        "x: x.mcap; y: y.mcap: 70 % same torques",
    ]
    assert similar_text(rows[0]).startswith("s7 (91 % same torques), s1 (60 % same torques), ")
    assert similar_text(rows[0]).endswith(" and 2 more")


def test_same_files_give_the_same_bytes(classroom: Path, graded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    grade(classroom, tmp_path)
    for name in ("grades.json", "grades.csv", "class.html"):
        assert (tmp_path / name).read_bytes() == (graded[0] / name).read_bytes(), name


def test_overrides_survive_and_one_student_is_graded_alone(classroom: Path, tmp_path: Path) -> None:
    first = grade(classroom, tmp_path)
    (tmp_path / "overrides.csv").write_text("id;points;reason\ntaro;17,5;oral exam\nabsent;0;\n")
    again = rows_of(grade(classroom, tmp_path))
    assert (again["taro"]["points"], again["absent"]["points"]) == (17.5, 0.0)
    assert again["taro"]["override"] == {"points": 17.5, "reason": "oral exam"}
    (tmp_path / "overrides.csv").write_text("id,points,reason\nzoe,3,\n")
    alone = rows_of(grade(classroom, tmp_path, "zoe"))
    assert alone["zoe"]["points"] == 3.0
    assert alone["zoe"]["similar"] == rows_of(first)["zoe"]["similar"]
    # The others keep their grades.
    assert alone["taro"] == again["taro"]


def test_table_has_no_formula(graded: tuple[Path, dict[str, Any]], classroom: Path) -> None:
    text = (graded[0] / "grades.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["name"] for row in rows] == ["Zoë Müller", "山田 太郎", "'=HYPERLINK(1)", "Bob", "Ann"]
    assert (rows[0]["goal: pose near"], rows[0]["goal: pose far"], rows[0]["max"]) == ("yes", "no", "20")
    assert rows[4]["points"] == ""


def test_page_names_keep_the_marks_of_all_scripts(classroom: Path, tmp_path: Path) -> None:
    roster = Roster((Student("s1", "आरव शर्मा"), Student("s2", "สมชาย ใจดี"), Student("s3", "../..")))
    target = GradeFolder(tmp_path, classroom / "runs", load_assignment(classroom / "a"), roster, names=True)
    target.write_pages({"students": [row_without_attempts(one.id) for one in roster.students], "assignment": "A"})
    assert {path.stem for path in (tmp_path / "students").iterdir()} == {"s1-आरव_शर्मा", "s2-สมชาย_ใจดี", "s3"}


def row_without_attempts(name: str) -> dict[str, Any]:
    return {"id": name, "points": None, "override": None, "used": None, "attempts": [], "similar": []}


def roster_of(classroom: Path) -> Roster:
    return read_roster(classroom / "roster.csv")


def test_moodle_export_is_filled(classroom: Path, graded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    export = tmp_path / "moodle.csv"
    text = '\ufeff"First name";"ID number";"Email address";"Week 1"\r\n'
    text += "Zoë;zoe;z@x;\r\n=Eve;EVE;e@x;\r\nAnn;absent;a@x;5\r\nNew;new;n@x;\r\n"
    export.write_bytes(text.encode())
    filled = fill_export(export, graded[1], roster_of(classroom))
    assert (filled.system, filled.filled, filled.unknown) == ("Moodle", 2, ("new",))
    assert filled.absent == ("taro", "bob")
    assert filled.text.startswith("\ufeff")
    rows = list(csv.DictReader(io.StringIO(filled.text.removeprefix("\ufeff")), delimiter=";"))
    # Columns of the other program are unchanged; no grade is "-", never 0, and has feedback too.
    assert [row["First name"] for row in rows] == ["Zoë", "=Eve", "Ann", "New"]
    assert float(rows[0]["Week 1"]) == rows_of(graded[1])["zoe"]["points"]
    assert rows[2]["Week 1"] == "-"
    assert "missed: pose far" in rows[0]["Week 1 (feedback)"]
    assert rows[2]["Week 1 (feedback)"] == "No run that can be graded."


def test_canvas_export_is_filled(classroom: Path, graded: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    export = tmp_path / "canvas.csv"
    header = "Student,ID,SIS User ID,SIS Login ID,Section,Week 1 (4711)"
    export.write_text(f'{header}\n    Points Possible,,,,,10\n"Müller, Zoë",1,x,zoe@uni.example,A,\nT,2,y,taro,A,\n')
    filled = fill_export(export, graded[1], roster_of(classroom))
    rows = list(csv.reader(io.StringIO(filled.text)))
    assert rows[0] == header.split(",")
    assert rows[1][-1] == "20"
    assert [row[-1] for row in rows[2:]] == [f"{rows_of(graded[1])[name]['points']:g}" for name in ("zoe", "taro")]


@pytest.mark.parametrize(
    ("text", "system", "filled"),
    [
        ('Vorname;ID-Nummer;"Aufgabe: a, b, c (Punkte)"\nZ;zoe;-\nT;taro;8\nN;new;-\n', "Moodle", 2),
        ("Prénom,Identifiant,Note\nZ,zoe,-\n", "Moodle", 1),
        ("LastName,FirstName,ID,SIS User ID,SIS Login ID,Section\nM,Zoë,1,x,zoe@x.example,A\n", "Canvas", 1),
        ("Étudiant,ID,Identifiant SIS,Section,Week 1 (4711)\nM,1,ZOE,A,\n", "Canvas", 1),
    ],
)
def test_export_of_another_language_or_form_is_filled(
    classroom: Path, graded: tuple[Path, dict[str, Any]], tmp_path: Path, text: str, system: str, filled: int
) -> None:
    (tmp_path / "x.csv").write_text(text, encoding="utf-8")
    export = fill_export(tmp_path / "x.csv", graded[1], roster_of(classroom))
    assert (export.system, export.filled) == (system, filled)
    assert f"{rows_of(graded[1])['zoe']['points']:g}" in export.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("a,b\n1,2\n", "no column with an id"),
        ("Name,Points\nA,zoe\nB,zoe\nC,taro\n", "no column with an id"),
        ("First name,ID number\nX,zoe,5,\n", "row 2 has 4 cells, the header 2"),
        ("First name,ID number\nX,unknown\n", "no id of the roster in ID number"),
    ],
)
def test_other_tables_are_not_filled(
    classroom: Path, graded: tuple[Path, dict[str, Any]], tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        fill_export(tmp_path / "x.csv", graded[1], roster_of(classroom))


def assignment(**settings: Any) -> Assignment:
    config = AssignmentConfig.model_validate({"title": "A", **settings})
    return Assignment(Path(), config, TaskConfig.model_validate({"place": {}}))


DEADLINE = datetime(2026, 12, 1, 12, tzinfo=timezone(timedelta(hours=1)))


@pytest.mark.parametrize(
    ("late", "penalty"),
    [(-1, 0.0), (299, 0.0), (301, 0.2), (86_399, 0.2), (86_401, 0.4), (2 * 86_400, 0.4), (2 * 86_400 + 1, None)],
)
def test_penalty_of_a_late_attempt(late: int, penalty: float | None) -> None:
    rule = {"percent_per_day": 20.0, "last_day": 2.0}
    task = assignment(deadline=DEADLINE, grace_minutes=5.0, late=rule)
    assert task.penalty(DEADLINE.astimezone(UTC) + timedelta(seconds=late)) == penalty


ATTEMPTS = [
    Attempt(("a",), "", "rig1", "", raw=4.0),
    Attempt(("b",), "", "rig1", "", raw=9.0),
    Attempt(("c",), "", "rig1", "", raw=9.0, penalty=0.2),
    Attempt(("broken",), "", "rig1", "", problem="not an MCAP file"),
    Attempt(("d",), "", "rig1", "", raw=10.0, penalty=None),
]


@pytest.mark.parametrize(
    ("settings", "file"),
    [
        ({"attempts": "best"}, "b"),
        ({"attempts": "last"}, "c"),
        ({"attempts": "best", "max_attempts": 1}, "a"),
        ({"attempts": "last", "max_attempts": 2}, "b"),
        # "broken" is one of the first four.
        ({"attempts": "last", "max_attempts": 4}, "c"),
    ],
)
def test_best_or_last_attempt_counts_unless_it_is_too_late(settings: dict[str, Any], file: str) -> None:
    used = attempt_that_counts(ATTEMPTS, assignment(**settings).config)
    assert used is not None
    assert used.file == file


def test_attempt_that_is_too_late_counts_if_it_is_the_only_one() -> None:
    config = assignment().config
    assert attempt_that_counts(ATTEMPTS[3:], config) is ATTEMPTS[4]
    assert attempt_that_counts(ATTEMPTS[3:4], config) is None


def test_points_of_a_measure_are_linear_between_its_bounds() -> None:
    measure = Measure(weight=0.5, full=20.0, zero=60.0)
    assert [measure.share(value) for value in (None, 10.0, 20.0, 40.0, 60.0, 90.0)] == [0.0, 1.0, 1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ("deadline = 2026-12-01T12:00:00\n", "deadline: Input should have timezone"),
        ("points = 3\n", "points: unknown key"),
        (
            "[rubric]\nenergy_j = {weight = 0.7, full = 1, zero = 2}\n"
            "latency_ms = {weight = 0.7, full = 1, zero = 2}\n",
            "weights must add up to 1 at most, got 1.4",
        ),
        ("[rubric.energy_j]\nweight = 0.7\nfull = 3\nzero = 2\n", "full must be smaller than zero"),
    ],
)
def test_invalid_settings_are_named(tmp_path: Path, settings: str, message: str) -> None:
    (tmp_path / "assignment.toml").write_text("title = 'A'\n" + settings)
    (tmp_path / "lab.toml").write_text("x = 1\n")
    with pytest.raises(InputError, match=message) as failed:
        load_assignment(tmp_path)
    # All mistakes are named, those of the other files too.
    assert "unknown key" in str(failed.value)
    assert "handout.md: missing" in str(failed.value)


def test_grade_command_writes_pages_and_filled_exports(classroom: Path, tmp_path: Path) -> None:
    export = tmp_path / "moodle.csv"
    export.write_text("Name,Username\nZ,zoe\nA,new1\nB,new2\n")
    out = tmp_path / "out"
    result = hilrig(
        "grade",
        classroom / "runs",
        "-a",
        classroom / "a",
        "-r",
        classroom / "roster.csv",
        "-o",
        out,
        "--fill",
        export,
        "--names",
        "--json",
    )
    assert result.returncode == 1, result.stderr
    assert "stranger.mcap: no student" in result.stderr
    assert "bob/run.mcap: " in result.stderr
    assert "moodle.filled.csv: 2 students not in the roster, rows unchanged: new1, new2\n" in result.stderr
    assert "moodle.filled.csv: 4 students without a row: taro, eve, bob, absent\n" in result.stderr
    reply = json.loads(result.stdout)
    assert reply["exports"] == [str(out / "moodle.filled.csv")]
    assert reply["grades"] == json.loads((out / "grades.json").read_text())
    pages = {path.name for path in (out / "students").iterdir()}
    assert pages == {
        "zoe-Zoë_Müller.html",
        "taro-山田_太郎.html",
        "eve-HYPERLINK_1.html",
        "bob-Bob.html",
        "absent-Ann.html",
    }
    page = (out / "students/zoe-Zoë_Müller.html").read_text()
    assert "<b>Next step:</b> pose far" in page
    assert 'class="player"' in page
    assert "hand in a recording" in (out / "students/absent-Ann.html").read_text()
    overview = (out / "class.html").read_text()
    assert 'href="students/taro-山田_太郎.html"' in overview
    assert "No conclusion is drawn" in overview


def test_names_are_in_no_file_but_pages_and_tables(graded: tuple[Path, dict[str, Any]], classroom: Path) -> None:
    assert "Müller" not in (graded[0] / "grades.json").read_text(encoding="utf-8")
    assert "Müller" in grades_csv(graded[1], roster_of(classroom))
