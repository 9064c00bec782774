"""The tutorial of a lab slot with a class of thirty simulated students: each of its commands, and the results."""

import csv
import io
import json
import re
import shlex
import shutil
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from hilrig_classroom.assignment import load_assignment
from hilrig_classroom.output import GradeFolder
from hilrig_runtime.config.roster import read_roster
from support.class_of_30 import CLASS, DEADLINE, NAMES, record_class, write_lists
from support.labs import hilrig

pytestmark = [
    pytest.mark.rig,
    pytest.mark.timeout(600),
    pytest.mark.long("takes a minute"),
]
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/classroom.md"


def tutorial() -> tuple[list[str], list[str]]:
    """Commands and TOML blocks of the tutorial."""
    (section,) = re.findall(r"^## A lab slot\n(.*?)^## ", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    blocks = re.findall(r"^```console\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    commands = [re.sub(r"\s+#.*$", "", line).removeprefix("$ ") for block in blocks for line in block.splitlines()]
    return commands, re.findall(r"^```toml\n(.*?)^```", section, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def slot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder in which all commands of the tutorial have run."""
    folder = tmp_path_factory.mktemp("slot")
    commands, (settings, lab) = tutorial()
    assert len(commands) <= 6
    write_lists(folder)
    shutil.copy(ROOT / "tests/exercises/hold_joint_1.py", folder / "solution.py")
    for command in commands:
        arguments = shlex.split(command)[1:]
        if arguments[0] == "up":
            # The slot in simulated time, with the lab file of the command.
            assert hilrig("check", folder / arguments[-1]).returncode == 0
            record_class(folder / "1-hold-joint-1", folder / "recordings")
            continue
        done = hilrig(*arguments, cwd=folder, timeout_s=300)
        assert done.returncode == 0, f"{command}: {done.stderr}"
        if arguments[0] == "example":
            path = folder / "1-hold-joint-1/assignment.toml"
            settings = re.sub("^deadline = .*", f"deadline = {DEADLINE.isoformat()}", settings)
            assert settings.startswith(f"deadline = {DEADLINE.isoformat()}\n")
            path.write_text(re.sub("^# deadline .*\n", settings, path.read_text(), flags=re.MULTILINE))
            path = folder / "1-hold-joint-1/lab.toml"
            path.write_text(path.read_text() + lab)
    return folder


@pytest.fixture(scope="module")
def rows(slot: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((slot / "grades/grades.csv").read_text(encoding="utf-8"))))


def test_each_kind_of_student_gets_the_points_it_earned(rows: list[dict[str, str]]) -> None:
    points: dict[str, Counter[str]] = {}
    for one, row in zip(CLASS, rows, strict=True):
        assert row["id"] == one.id
        points.setdefault(one.kind, Counter())[row["points"]] += 1
    assert points == {
        "honest": Counter({"10": 17}),
        "slow": Counter({"0": 3}),
        "copied": Counter({"10": 2}),
        "absent": Counter({"": 3}),
        "late": Counter({"8": 2}),
        "two": Counter({"10": 2}),
        "dead": Counter({"0": 1}),
    }
    assert [row["attempts"] for one, row in zip(CLASS, rows, strict=True) if one.kind == "two"] == ["2", "2"]


def test_copies_are_groups_and_nobody_else_is(rows: list[dict[str, str]], slot: Path) -> None:
    similar = {row["id"]: row["similar"] for row in rows if row["similar"]}
    assert similar == {
        "s1001": "s1021 (the same recording)",
        "s1002": "s1022 (the same recording)",
        "s1021": "s1001 (the same recording)",
        "s1022": "s1002 (the same recording)",
    }
    assert "No conclusion is drawn" in (slot / "grades/class.html").read_text(encoding="utf-8")


def test_names_of_all_scripts_are_kept_and_no_formula_is_written(rows: list[dict[str, str]], slot: Path) -> None:
    assert [row["name"].removeprefix("'") for row in rows[: len(NAMES)]] == list(NAMES)
    assert rows[5]["name"].startswith("'=")
    filled = list(csv.DictReader(io.StringIO((slot / "grades/moodle.filled.csv").read_text(encoding="utf-8"))))
    assert [row["Full name"] for row in filled[: len(NAMES)]] == list(NAMES)
    assert [row["Hold joint 1"] for row in filled] == [row["points"] or "-" for row in rows]
    for one in CLASS:
        page = (slot / f"grades/students/{one.id}.html").read_text(encoding="utf-8")
        assert "<b>Next step:</b>" in page, one


def test_failed_goals_are_explained(slot: Path) -> None:
    by_kind = {one.kind: one for one in CLASS}
    slow = (slot / f"grades/students/{by_kind['slow'].id}.html").read_text(encoding="utf-8")
    assert "pose held: not held; closest distance" in slow
    dead = (slot / f"grades/students/{by_kind['dead'].id}.html").read_text(encoding="utf-8")
    assert "watchdog" in dead
    absent = (slot / f"grades/students/{by_kind['absent'].id}.html").read_text(encoding="utf-8")
    assert "hand in a recording of a run" in absent


def graded(slot: Path, out: Path, recordings: Path, workers: int) -> dict[str, Any]:
    roster, assignment = read_roster(slot / "roster.csv"), load_assignment(slot / "1-hold-joint-1")
    return GradeFolder(out, recordings, assignment, roster, workers=workers).grade()


def test_bytes_depend_on_the_files_only(slot: Path, tmp_path: Path) -> None:
    # Another order of creation, another number of processes.
    copied = tmp_path / "recordings"
    for path in sorted((slot / "recordings").rglob("*.mcap"), reverse=True):
        target = copied / path.relative_to(slot / "recordings")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    for workers in (1, 3):
        out = tmp_path / f"out{workers}"
        graded(slot, out, copied, workers)
        for name in ("grades.json", "grades.csv", "class.html"):
            assert (out / name).read_bytes() == (slot / "grades" / name).read_bytes(), (name, workers)


def test_ninety_attempts_are_graded_within_a_minute(slot: Path, tmp_path: Path) -> None:
    recordings, count = tmp_path / "recordings", 0
    made = sorted((slot / "recordings/1-hold-joint-1").rglob("*.mcap"))
    for one in CLASS:
        for attempt in range(3):
            folder = recordings / one.id
            folder.mkdir(parents=True, exist_ok=True)
            shutil.copy(made[count % len(made)], folder / f"{attempt}.mcap")
            count += 1
    begin_s = time.monotonic()
    done = hilrig(
        "grade",
        recordings,
        "-a",
        slot / "1-hold-joint-1",
        "-r",
        slot / "roster.csv",
        "-o",
        tmp_path / "out",
        "--json",
        timeout_s=300,
    )
    elapsed_s = time.monotonic() - begin_s
    assert done.returncode == 0, done.stderr
    assert sum(len(row["attempts"]) for row in json.loads(done.stdout)["grades"]["students"]) == 90
    assert elapsed_s < 60.0, f"{elapsed_s:.1f} s"
