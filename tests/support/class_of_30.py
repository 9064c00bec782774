"""A class of thirty simulated students of the exercise "Hold joint 1": roster, gradebook export and recordings.

Each student's program is the starter with gains of its own, or with a mistake, and runs in a virtual lab whose recorder
writes the recording.
"""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.process.process_pool import process_pool
from support.virtual_lab import VirtualLab

SLOT = datetime(2026, 12, 4, 15, tzinfo=UTC)
DEADLINE = SLOT + timedelta(hours=2)
NAMES = (
    "Zoë Müller",
    "山田 太郎",
    "Анна Иванова",
    "محمد علي",
    "आरव शर्मा",
    '=HYPERLINK("http://example.org","x")',
    "O'Neill, Siobhán",
    "Ngô Thị Ánh",
)
KINDS = ("honest",) * 17 + ("slow",) * 3 + ("copied",) * 2 + ("absent",) * 3 + ("late",) * 2 + ("two",) * 2 + ("dead",)


@dataclass(frozen=True)
class SimulatedStudent:
    """A student, the kind of the student's work, and the rig."""

    number: int
    kind: str

    @property
    def id(self) -> str:
        return f"s{1001 + self.number}"

    @property
    def name(self) -> str:
        return NAMES[self.number] if self.number < len(NAMES) else f"Student {self.number + 1}"

    @property
    def rig(self) -> str:
        return f"rig{self.number + 1}"


CLASS = tuple(SimulatedStudent(number, kind) for number, kind in enumerate(KINDS))


def write_lists(folder: Path) -> None:
    """Write `roster.csv`, as a spreadsheet does in Germany, and `moodle.csv`, the export of the gradebook."""
    lines = ["id;name;group;rig", *(f"{one.id};{_quoted(one.name)};;{one.rig}" for one in CLASS)]
    (folder / "roster.csv").write_text("\ufeff" + "\r\n".join(lines) + "\r\n", encoding="utf-8")
    rows = ["Full name,ID number,Email address", *(f"{_quoted(one.name)},{one.id},{one.id}@x.example" for one in CLASS)]
    (folder / "moodle.csv").write_text("\r\n".join(rows) + "\r\n", encoding="utf-8")


def record_class(assignment: Path, recordings: Path, workers: int | None = None) -> None:
    """Run the programs of all students and write their recordings, in the folders of the recorder."""
    runs = list(_runs())
    with process_pool(len(runs), workers) as executor:
        for _ in executor.map(_record, runs, [assignment] * len(runs), [recordings] * len(runs)):
            pass
    copies = [one for one in CLASS if one.kind == "copied"]
    (recordings / "handed-in").mkdir()
    for number, one in enumerate(copies):
        (original,) = (recordings / load_lab(assignment / "lab.toml").name / CLASS[number].rig).glob("*.mcap")
        shutil.copy(original, recordings / "handed-in" / f"{one.id}.mcap")


@dataclass(frozen=True)
class _Run:
    student: SimulatedStudent
    start: datetime
    kp: float
    mistake: str = ""


def _runs() -> Iterator[_Run]:
    for one in CLASS:
        start, kp, slow = SLOT + timedelta(minutes=one.number), 0.18 + 0.005 * one.number, 0.01 + 1e-4 * one.number
        match one.kind:
            case "honest":
                yield _Run(one, start, kp)
            case "late":
                yield _Run(one, DEADLINE + timedelta(hours=5), kp)
            case "slow":
                yield _Run(one, start, slow)
            case "dead":
                yield _Run(one, start, kp, "if now > 1.0:\n            time.sleep(1000.0)\n        ")
            case "two":
                yield _Run(one, start, slow)
                yield _Run(one, start + timedelta(minutes=40), kp)


def _record(run: _Run, assignment: Path, recordings: Path) -> None:
    program = (assignment / "starter.py").read_text(encoding="utf-8")
    for name, value in (("KP", run.kp), ("KD", 0.04)):
        assert f"{name} = (0.0," in program
        program = program.replace(f"{name} = (0.0,", f"{name} = ({value:.4f},")
    program = program.replace("        # 1. Read", f"        {run.mistake}# 1. Read")
    lab = load_lab(assignment / "lab.toml")
    source = lab.source
    lab = lab.model_copy(update={"rigs": (lab.rig(run.student.rig),)})
    lab._source = source
    with TemporaryDirectory() as folder:
        path = Path(folder) / "program.py"
        path.write_text(program, encoding="utf-8")
        # A folder for each run: two attempts of a student are recorded at the same time.
        own = Path(folder) / "recordings"
        with VirtualLab(lab, own, run.start, seed=run.student.number) as virtual:
            virtual.run(path, seconds=8.0)
            recording = virtual.recording()
        target = recordings / recording.parent.relative_to(own)
        target.mkdir(parents=True, exist_ok=True)
        shutil.move(recording, target)


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"'
