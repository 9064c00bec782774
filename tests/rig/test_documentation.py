"""Every documented command runs: each line of a `console` block in the README and the pages of docs/.

They run in one folder that holds a recording (RUN.mcap, of the demo's controller) and a lab's file (lab.toml), beside a
running lab of that file. A new kind of command fails here until somebody says how it is run.
"""

import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from support.labs import HILRIG, RunningLab, hilrig, write_lab
from support.waiting import PATIENT_S, eventually

pytestmark = pytest.mark.rig

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FOLLOWS = ("hilrig live",)
"""Run until they are ended."""
OPENS_A_WINDOW = ("hilrig replay", "hilrig live")
"""Run with --save, for there is no screen."""
TESTED_ELSEWHERE: dict[str, str] = {
    "docker compose up": "tests/hosts/test_compose.py",
    "hilrig console": "tests/rig/test_console.py",
    "hilrig router": "tests/hosts/test_compose.py",
    "hilrig demo": "tests/rig/test_demo.py",
    "hilrig jitter": "tests/rig/test_jitter.py",
    "hilrig play": "tests/rig/test_recorder_play.py",
    "hilrig record ": "tests/rig/test_recorder_process.py",
    "hilrig study examples/": "tests/rig/test_study_live.py",
    "make demo": "tests/rig/test_demo.py",
}
"""Beginning of a command, and the test that runs what it does."""


def documented() -> dict[str, str]:
    """Every documented command, and the page that it stands on first."""
    commands: dict[str, str] = {}
    for page in PAGES:
        for block in re.findall(r"^```console\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.sub(r"\s+#.*$", "", line).removeprefix("$ ").strip()
                if command:
                    commands.setdefault(" ".join(command.split()), page.name)
    return commands


COMMANDS = documented()


@dataclass
class Place:
    """Where documented commands run."""

    folder: Path
    lab: RunningLab


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("documented")
    with RunningLab(write_lab(folder, extra="edge.session_grace_ms = 100")) as lab:
        controller = [sys.executable, str(ROOT / "examples/pick_and_place.py"), "--port", str(lab.port)]
        done = subprocess.run([*controller, "--duration", "5"], check=False, capture_output=True, timeout=60)
        assert done.returncode == 1, "not every part is placed so soon"
        (recording,) = eventually(lambda: lab.recordings)
        for name in ("RUN.mcap", "OTHER.mcap"):
            shutil.copy(recording, folder / name)
        yield Place(folder, lab)


@pytest.fixture(scope="module")
def started_from_nothing() -> set[str]:
    return set()


def test_there_are_commands_on_the_front_page() -> None:
    assert {"make demo", "make test", "hilrig up"} <= set(COMMANDS)


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("make ")])
def test_every_make_target_is_there(command: str) -> None:
    subprocess.run([*command.split(), "--dry-run"], cwd=ROOT, check=True, capture_output=True, timeout=60)


@pytest.mark.parametrize("beginning", TESTED_ELSEWHERE)
def test_what_is_tested_elsewhere_is(beginning: str) -> None:
    assert (ROOT / TESTED_ELSEWHERE[beginning]).exists()
    assert any(command.startswith(beginning) for command in COMMANDS), f"{beginning!r} is documented nowhere any more"


@pytest.mark.parametrize(
    "command",
    [command for command in COMMANDS if not command.startswith(("make ", *TESTED_ELSEWHERE))],
    ids=lambda command: f"{COMMANDS[command]}: {command}",
)
def test_a_documented_command_runs(place: Place, command: str, started_from_nothing: set[str]) -> None:
    words = shlex.split(command)
    if words[:2] == ["hilrig", "up"]:
        # The lab beside us runs by that very command.
        assert place.lab.process.poll() is None
        return
    if words[0] == "mbpoll":
        if shutil.which("mbpoll") is None:
            pytest.skip("needs mbpoll (Debian's package of that name)")
        words[words.index("-p") + 1] = str(place.lab.port)
        subprocess.run(words, check=True, capture_output=True, timeout=20)
        return
    assert words[0] == "hilrig", f"say in this test how {words[0]!r} is run, or in TESTED_ELSEWHERE which test runs it"
    words = words[1:]
    if command.startswith(OPENS_A_WINDOW) and "--save" not in words:
        words += ["--save", "shown.rrd"]
    of_a_lab = ("hilrig live", "hilrig record", "hilrig lease", "hilrig impair", "hilrig play")
    if command.startswith(of_a_lab) and "--config" not in words:
        words += ["--config", str(place.lab.config)]
    if command.startswith(FOLLOWS):
        _follow([*HILRIG, *words], place.folder)
        return
    if words[0] in started_from_nothing:
        done = hilrig(*words, cwd=place.folder, timeout_s=100)
    else:
        # Each command once as a user starts it; another time with other options it is spared Python's start.
        started_from_nothing.add(words[0])
        whole = [*HILRIG, *words]
        done = subprocess.run(whole, cwd=place.folder, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr


def _follow(words: list[str], folder: Path) -> None:
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            shown = folder / "shown.rrd"
            eventually(lambda: process.poll() is not None or (shown.exists() and shown.stat().st_size))
            assert process.poll() is None, process.stdout and process.stdout.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENT_S) == 0
        finally:
            process.kill()
