"""The guides of docs/controllers, followed literally in an empty folder: from the installation to the arm at 30°.

Each needs minutes and packages from the network, so the tests run only if HILRIG_LONG is set. The programs of the
guides are also tested with each change, by tests/rig/test_modbus_controllers.py.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from support.clients import mbpoll_read
from support.edge_rig import RawClient
from support.guides import commands, write_programs
from support.labs import RunningLab, free_ports, write_lab
from support.waiting import eventually

pytestmark = [
    pytest.mark.rig,
    pytest.mark.long("takes minutes"),
    # Runtimes of PLCs are compiled.
    pytest.mark.timeout(1500),
]

GOAL = (30.0, -45.0, 50.0, 20.0)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[RunningLab]:
    folder = tmp_path / "lab"
    folder.mkdir()
    with RunningLab(write_lab(folder)) as lab:
        yield lab


def require(*programs: str) -> None:
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"needs {program}")


def environment() -> dict[str, str]:
    """Return the environment of a user: without this environment of Python."""
    hidden = ("PYTHONPATH", "VIRTUAL_ENV", "PYTHONHOME")
    path = [folder for folder in os.environ["PATH"].split(":") if folder != str(Path(sys.executable).parent)]
    return {name: value for name, value in os.environ.items() if name not in hidden} | {"PATH": ":".join(path)}


def shell(lines: list[str], folder: Path) -> "subprocess.CompletedProcess[str]":
    """Run command lines in one shell, which ends at the first that fails."""
    return subprocess.run(
        ["bash", "-e", "-c", "\n".join(lines)],
        cwd=folder,
        env=environment(),
        check=False,
        capture_output=True,
        text=True,
        timeout=1200,
    )


def run(lines: list[str], folder: Path) -> str:
    done = shell(lines, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def download(lines: list[str], folder: Path) -> None:
    """Run command lines that download sources; skip the test if the host can't be reached."""
    assert all(line.startswith("git clone ") for line in lines)
    done = shell(lines, folder)
    if done.returncode:
        pytest.skip(f"can't download: {done.stderr.strip().splitlines()[-1]}")


def positions(port: int) -> list[float]:
    with RawClient("127.0.0.1", port) as client:
        return [(word - 65536 if word > 32767 else word) / 100 for word in client.read(4, 4)]


def is_at_goal(port: int) -> bool:
    return max(abs(goal - position) for goal, position in zip(GOAL, positions(port), strict=True)) < 1.0


@pytest.mark.parametrize(
    ("guide", "programs"),
    [("python", ["python3"]), ("c", ["gcc", "pkg-config"]), ("nodejs", ["node", "npm"])],
)
def test_guide_is_followed_literally(lab: RunningLab, tmp_path: Path, guide: str, programs: list[str]) -> None:
    require(*programs)
    write_programs(guide, tmp_path, lab.port)
    output = run(commands(guide, lab.port), tmp_path)
    assert ("at the end" in output) == (guide != "c") or "error at the end" in output


def test_program_of_the_guide_runs_with_pymodbus_2(lab: RunningLab, tmp_path: Path) -> None:
    require("python3")
    write_programs("python", tmp_path, lab.port)
    program = (tmp_path / "hold.py").read_text(encoding="utf-8")
    new, old = "from pymodbus.client import ModbusTcpClient", "from pymodbus.client.sync import ModbusTcpClient"
    assert new in program
    (tmp_path / "hold.py").write_text(program.replace(new, old), encoding="utf-8")
    lines = ["python3 -m venv venv", ". venv/bin/activate", "pip install pymodbus==2.5.*", "python hold.py 5"]
    assert "at the end" in run(lines, tmp_path)


@pytest.mark.parametrize("flow", ["hold.json", "hold_modbustcp.json"])
def test_node_red_flow_holds_the_arm(lab: RunningLab, tmp_path: Path, flow: str) -> None:
    require("node", "npm")
    write_programs("node-red", tmp_path, lab.port)
    install, start = commands("node-red", lab.port)
    run([install], tmp_path)
    with started(start.replace("hold.json", flow).replace("1880", "0"), tmp_path):
        eventually(lambda: is_at_goal(lab.port))
        # It stays there.
        time.sleep(3)
        assert is_at_goal(lab.port)
        assert mbpoll_read(lab.port, 8, 1, kind="input") == [2]


@contextmanager
def started(command: str, folder: Path) -> Iterator[None]:
    """Run a command in the context, with all its child processes."""
    process = subprocess.Popen(
        ["bash", "-c", command],
        cwd=folder,
        env=environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize(("guide", "program"), [("octave", "octave-cli"), ("go", "go")])
def test_program_of_distribution_packages_holds_the_arm(
    lab: RunningLab, tmp_path: Path, guide: str, program: str
) -> None:
    require(program)
    write_programs(guide, tmp_path, lab.port)
    lines = commands(guide, lab.port)
    package = {"octave": ["octave-cli --eval 'pkg load instrument-control'"], "go": lines[:1]}[guide]
    if shell(package, tmp_path).returncode:
        pytest.skip("needs octave-instrument-control, or golang-github-goburrow-modbus-dev (Debian's packages)")
    assert "at the end" in run(lines, tmp_path)
    assert is_at_goal(lab.port)


def test_openplc_holds_the_arm_in_both_roles(lab: RunningLab, tmp_path: Path) -> None:
    require("git", "g++", "autoreconf", "libtoolize", "bison", "flex")
    write_programs("openplc", tmp_path, lab.port)
    clone, build, start, *as_server, start_server, start_modbus, start_rig = commands("openplc", lab.port)
    download([clone], tmp_path)
    run([build], tmp_path)
    with started(start, tmp_path):
        eventually(lambda: is_at_goal(lab.port), timeout_s=20)
    port = free_ports(1)
    assert start_rig == "hilrig up --controller 127.0.0.1:5502"
    run(as_server, tmp_path)
    (tmp_path / "rig").mkdir()
    config = write_lab(tmp_path / "rig")
    config.write_text(f'{config.read_text(encoding="utf-8")}controller = "127.0.0.1:{port}"\n', encoding="utf-8")
    with started(start_server, tmp_path):
        eventually(lambda: shell([start_modbus.replace("5502", str(port))], tmp_path).returncode == 0)
        with RunningLab(config) as rig:
            eventually(lambda: is_at_goal(rig.port), timeout_s=20)


def test_beremiz_project_holds_the_arm(lab: RunningLab, tmp_path: Path) -> None:
    require("git", "gcc", "autoreconf", "bison", "flex", "python3")
    write_programs("beremiz", tmp_path, lab.port)
    *lines, start = commands("beremiz", lab.port)
    download(lines[:3], tmp_path)
    run(lines[3:], tmp_path)
    with started(start, tmp_path):
        eventually(lambda: is_at_goal(lab.port), timeout_s=60)


def test_forte_boot_file_holds_joint_1(lab: RunningLab, tmp_path: Path) -> None:
    require("git", "cmake", "g++")
    write_programs("forte", tmp_path, lab.port)
    clone, *build, start = commands("forte", lab.port)
    download([clone], tmp_path)
    run(build, tmp_path)
    with started(start, tmp_path):
        eventually(lambda: abs(positions(lab.port)[0] - GOAL[0]) < 0.1, timeout_s=20)
        # It stays there.
        time.sleep(3)
        assert abs(positions(lab.port)[0] - GOAL[0]) < 0.1
