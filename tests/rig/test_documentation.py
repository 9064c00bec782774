"""Every documented command runs: each line of a `console` block in the README and the pages of docs/.

The commands run in a folder with recordings of the demo's controller (RUN.mcap, OTHER.mcap) and a configuration file
(lab.toml), while a lab with that file is running. A new kind of command fails until this test defines how to run it.
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

from support.hilrig_process import HILRIG
from support.labs import RunningLab, hilrig, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUNS_UNTIL_STOPPED = ("hilrig live",)
"""Commands that run until they are stopped."""
OPENS_A_VIEWER = ("hilrig replay", "hilrig live")
"""Commands that are run with --save, because there is no display."""
TESTED_ELSEWHERE: dict[str, str] = {
    "docker compose run --rm demo": "tests/hosts/test_compose.py",
    "hilrig claim": "tests/rig/test_claims.py",
    "hilrig rig codes": "tests/rig/test_claims.py",
    "docker compose up": "tests/hosts/test_compose.py",
    "hilrig assign": "tests/unit/test_class_of_30.py",
    "hilrig console": "tests/rig/test_console.py",
    "hilrig router": "tests/hosts/test_compose.py",
    "hilrig demo": "tests/rig/test_demo.py",
    "hilrig events --config": "tests/rig/test_events_command.py",
    "hilrig grade": "tests/unit/test_class_of_30.py",
    "hilrig jitter": "tests/rig/test_jitter.py",
    "hilrig join": "tests/unit/test_join.py",
    "hilrig play": "tests/rig/test_recorder_play.py",
    "hilrig record ": "tests/rig/test_recorder_process.py",
    "hilrig study examples/": "tests/rig/test_study_live.py",
    "hilrig study --from": "tests/rig/test_study_live.py",
    "make demo": "tests/rig/test_demo.py",
    "python3 -m venv": "tests/rig/test_installation.py",
    ". .venv/bin/activate": "tests/rig/test_installation.py",
    "python examples/paper_figures.py": "tests/rig/test_sim_commands.py",
}
"""Start of a command, and the test that covers it."""


def documented() -> dict[str, str]:
    """Every documented command, with the first page that contains it."""
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
class Environment:
    """Folder and running lab in which documented commands run."""

    folder: Path
    lab: RunningLab


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    folder = tmp_path_factory.mktemp("documented")
    with RunningLab(write_lab(folder, extra="edge.session_grace_ms = 100")) as lab:
        controller = [sys.executable, str(ROOT / "examples/pick_and_place.py"), "--port", str(lab.port)]
        done = subprocess.run([*controller, "--duration", "5"], check=False, capture_output=True, timeout=60)
        assert done.returncode == 1, "5 s are too short to place every part"
        (recording,) = eventually(lambda: lab.recordings)
        for name in ("RUN.mcap", "OTHER.mcap"):
            shutil.copy(recording, folder / name)
        yield Environment(folder, lab)


@pytest.fixture(scope="module")
def cold_started() -> set[str]:
    """Commands that have already been run in a new Python process."""
    return set()


def test_front_page_contains_commands() -> None:
    assert {"hilrig demo", "hilrig up", "docker compose up --build"} <= set(COMMANDS)


def test_controller_of_the_front_page_reaches_its_goal(tmp_path: Path) -> None:
    (program,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    assert len(program.splitlines()) <= 15
    with RunningLab(write_lab(tmp_path)) as lab:
        (tmp_path / "first.py").write_text(program.replace("port=5020", f"port={lab.port}"))
        command = [sys.executable, str(tmp_path / "first.py")]
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    angle = re.fullmatch(r"joint 1 is at (\S+) degrees\n", done.stdout)
    assert angle is not None
    assert float(angle[1]) == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("make ")])
def test_documented_make_target_exists(command: str) -> None:
    subprocess.run([*command.split(), "--dry-run"], cwd=ROOT, check=True, capture_output=True, timeout=60)


@pytest.mark.parametrize("beginning", TESTED_ELSEWHERE)
def test_command_tested_elsewhere_is_documented(beginning: str) -> None:
    assert (ROOT / TESTED_ELSEWHERE[beginning]).exists()
    assert any(command.startswith(beginning) for command in COMMANDS), f"{beginning!r} is no longer documented"


@pytest.mark.parametrize(
    "command",
    [command for command in COMMANDS if not command.startswith(("make ", *TESTED_ELSEWHERE))],
    ids=lambda command: f"{COMMANDS[command]}: {command}",
)
def test_documented_command_runs(environment: Environment, command: str, cold_started: set[str]) -> None:
    arguments = shlex.split(command)
    if arguments[:2] == ["hilrig", "up"]:
        # The running lab was started by this command.
        assert environment.lab.process.poll() is None
        return
    if arguments[0] == "mbpoll":
        if shutil.which("mbpoll") is None:
            pytest.skip("needs mbpoll (Debian's package of that name)")
        arguments[arguments.index("-p") + 1] = str(environment.lab.port)
        subprocess.run(arguments, check=True, capture_output=True, timeout=20)
        return
    assert arguments[0] == "hilrig", f"define in this test how to run {arguments[0]!r}, or add it to TESTED_ELSEWHERE"
    arguments = arguments[1:]
    if command.startswith(OPENS_A_VIEWER) and "--save" not in arguments:
        arguments += ["--save", "shown.rrd"]
    needs_lab = ("hilrig live", "hilrig record", "hilrig lease", "hilrig impair", "hilrig play")
    if command.startswith(needs_lab) and "--config" not in arguments:
        arguments += ["--config", str(environment.lab.config)]
    if command.startswith(RUNS_UNTIL_STOPPED):
        _run_until_stopped([*HILRIG, *arguments], environment.folder)
        return
    if arguments[0] in cold_started:
        done = hilrig(*arguments, cwd=environment.folder, timeout_s=100)
    else:
        # Each command is started once in a new Python process; with other options, in a forked one, which is faster.
        cold_started.add(arguments[0])
        command_line = [*HILRIG, *arguments]
        done = subprocess.run(
            command_line, cwd=environment.folder, check=False, capture_output=True, text=True, timeout=100
        )
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr


def _run_until_stopped(arguments: list[str], folder: Path) -> None:
    with subprocess.Popen(
        arguments, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        try:
            shown = folder / "shown.rrd"
            eventually(lambda: process.poll() is not None or (shown.exists() and shown.stat().st_size))
            assert process.poll() is None, process.stdout and process.stdout.read()
            process.send_signal(signal.SIGINT)
            assert process.wait(LONG_TIMEOUT_S) == 0
        finally:
            process.kill()
