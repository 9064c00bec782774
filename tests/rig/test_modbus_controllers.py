"""Tests of the example controllers, and of independent Modbus clients, with a complete lab.

The examples in Python, C and Node.js run as a student runs them; each must move the arm to two poses.
"""

import functools
import json
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from support.clients import compile_with_libmodbus, mbpoll_read, mbpoll_write, require_mbpoll
from support.edge_rig import EdgeRig, RawClient, running_edge
from support.guides import commands as commands_of
from support.guides import write_programs
from support.labs import RunningLab, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

EXAMPLES = Path(__file__).parents[2] / "examples"
LONG_LEASE = "edge.lease_timeout_ms = 60000"
"""Long enough for a command to start on a busy machine."""
SECONDS = "7.8"
"""Duration of nearly both poses: the arm is at the second one when the program ends."""
SECONDS_OF_ONE_POSE = "5"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningLab]:
    with RunningLab(write_lab(tmp_path_factory.mktemp("lab"), rigs=9, extra=LONG_LEASE)) as lab:
        yield lab


@pytest.fixture(scope="module")
def in_c(tmp_path_factory: pytest.TempPathFactory, lab: RunningLab) -> Path:
    folder = tmp_path_factory.mktemp("c")
    write_programs("c", folder, lab.lab.ports["rig9"])
    compile_with_libmodbus(folder / "first.c", folder)
    return compile_with_libmodbus(folder / "hold_position.c", folder)


PYTHON_LIBRARIES = {
    "pymodbus==3.0.*": ("hold.py", "rig5"),
    "pyModbusTCP": ("hold_pymodbustcp.py", "rig6"),
}
"""Libraries of another version or project: their program of the guide, and its rig."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Path]]:
    """Install the foreign libraries, all at once; returns a function that waits for one and returns its folder."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--no-deps", "--target", "."]
    npm = ["npm", "install", "--omit=optional", "--no-audit", "--no-fund", "--loglevel=error"]
    commands = {library: [*pip, library] for library in PYTHON_LIBRARIES}
    if shutil.which("node") is not None and shutil.which("npm") is not None:
        commands["node"] = [*npm, "jsmodbus"]
    folders = {library: tmp_path_factory.mktemp("library") for library in commands}
    if "node" in commands:
        shutil.copy(EXAMPLES / "package.json", folders["node"])
    running = {
        library: subprocess.Popen(
            command, cwd=folders[library], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        for library, command in commands.items()
    }

    def wait(library: str) -> Path:
        if library not in running:
            pytest.skip("needs node and npm (Debian's packages nodejs and npm)")
        output, _ = running[library].communicate(timeout=120)
        if running[library].returncode:
            pytest.skip(f"{commands[library][0]} can't install {library} here: {output.strip().splitlines()[-1:]}")
        return folders[library]

    yield functools.cache(wait)
    for process in running.values():
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def in_node(lab: RunningLab, installed: Callable[[str], Path]) -> Path:
    folder = installed("node")
    write_programs("nodejs", folder, lab.lab.ports["rig4"])
    return folder / "hold_position.js"


@pytest.fixture(scope="module")
def in_python(lab: RunningLab, installed: Callable[[str], Path]) -> dict[str, Path]:
    """By library: its program of the guide, in the folder where it is installed."""
    found = {}
    for library, (name, rig) in PYTHON_LIBRARIES.items():
        folder = installed(library)
        write_programs("python", folder, lab.lab.ports[rig])
        found[library] = folder / name
    return found


def test_examples_hold_and_move_the_arm(
    installed: Callable[[str], Path], lab: RunningLab, in_c: Path, in_node: Path, in_python: dict[str, Path]
) -> None:
    """The examples and the programs of the guides run at once, each on its own rig."""
    port = {rig.name: str(lab.lab.ports[rig.name]) for rig in lab.lab.rigs}
    commands: dict[str, list[str | Path]] = {
        "Python": [sys.executable, EXAMPLES / "hold_position.py", "--port", port["rig1"], "--duration", SECONDS],
        "C": [in_c, "127.0.0.1", port["rig2"], SECONDS],
        "Node.js": ["node", in_node, "127.0.0.1", port["rig3"], SECONDS],
        "jsmodbus": ["node", in_node.with_name("hold_jsmodbus.js"), SECONDS_OF_ONE_POSE],
        "one part": [sys.executable, EXAMPLES / "pick_one_part.py", "--port", port["rig7"]],
    }
    last_line = dict.fromkeys(commands, "error at the end") | {"jsmodbus": "at the end: ", "one part": "done"}
    for library, program in in_python.items():
        # The library beside the program is found before that of this environment.
        commands[library] = [sys.executable, program, SECONDS_OF_ONE_POSE]
        last_line[library] = "at the end: "
    running = {
        name: subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name, command in commands.items()
    }
    outputs = {name: process.communicate(timeout=60)[0] for name, process in running.items()}
    for name, process in running.items():
        assert process.returncode == 0, f"{name}: {outputs[name]}"
        assert last_line[name] in outputs[name].splitlines()[-1]


def test_first_program_of_each_guide_moves_the_arm(lab: RunningLab, in_c: Path, tmp_path: Path) -> None:
    write_programs("python", tmp_path, lab.lab.ports["rig8"])
    programs: list[list[str | Path]] = [[sys.executable, tmp_path / "first.py"], [in_c.with_name("first")]]
    running = [subprocess.Popen(program, stdout=subprocess.PIPE, text=True) for program in programs]
    python, c = (process.communicate(timeout=30)[0] for process in running)
    assert [process.returncode for process in running] == [0, 0]
    begin, end = (int(line.split("[")[1].split(",")[0]) for line in python.splitlines())
    assert begin == 0
    assert 1000 < end < 10_000
    assert 10 < float(c.split()[-2]) < 100


@pytest.mark.parametrize("name", ["Python", "C", "Node.js"])
def test_example_reports_a_missing_rig(name: str, request: pytest.FixtureRequest) -> None:
    commands = {
        "Python": lambda: [sys.executable, EXAMPLES / "hold_position.py", "--port", "1"],
        "C": lambda: [request.getfixturevalue("in_c"), "127.0.0.1", "1"],
        "Node.js": lambda: ["node", request.getfixturevalue("in_node"), "127.0.0.1", "1"],
    }
    done = subprocess.run(commands[name](), check=False, capture_output=True, text=True, timeout=30)
    assert done.returncode == 3
    assert "rig" in done.stderr
    assert "Traceback" not in done.stderr


def test_operator_lists_and_revokes_leases(lab: RunningLab, monkeypatch: pytest.MonkeyPatch) -> None:
    # No cell of a table is wrapped.
    monkeypatch.setenv("COLUMNS", "200")

    def ask(*arguments: str) -> subprocess.CompletedProcess[str]:
        return hilrig("lease", *arguments, "--config", lab.config)

    with RawClient("127.0.0.1", lab.lab.ports["rig2"]) as holder:
        holder.write(0, 0)
        everyone = json.loads(ask("--json").stdout)
        assert [status["rig"] for status in everyone] == [rig.name for rig in lab.lab.rigs]
        assert everyone[1]["holder"] == holder.address
        assert everyone[1]["connections"] == 1
        assert holder.address in ask("rig2").stdout
        taken = ask("rig2", "--release", "--json")
        assert (taken.returncode, json.loads(taken.stdout)["released"]) == (0, holder.address)
        assert ask("rig2", "--release").returncode == 1
        assert holder.write(0, 0).hex() == "9006"


def test_lease_command_reports_errors(lab: RunningLab, tmp_path: Path) -> None:
    unknown = hilrig("lease", "rig10", "--config", lab.config)
    assert unknown.returncode == 2
    assert "rig1, rig2, rig3" in unknown.stderr
    assert hilrig("lease", "--release", "--config", lab.config).returncode == 2
    nobody = hilrig("lease", "--config", write_lab(tmp_path))
    assert nobody.returncode == 3
    assert "no edge answers" in nobody.stderr
    assert "Traceback" not in nobody.stderr


def test_libmodbus_holds_the_lease_and_mbpoll_is_denied(in_c: Path) -> None:
    """libmodbus holds the lease; mbpoll may read, and its writes are denied."""
    require_mbpoll()
    with running_edge() as rig, moving(rig):
        with subprocess.Popen(
            [in_c, "127.0.0.1", str(rig.port), "60"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as holder:
            eventually(lambda: "LEASE_GRANTED" in rig.kinds())
            assert len(mbpoll_read(rig.port, 5, 4)) == 4
            with pytest.raises(subprocess.CalledProcessError) as refusal:
                mbpoll_write(rig.port, 1, 1000)
            assert "busy" in refusal.value.stderr.lower()
            assert all(command.controller == rig.commands[1].controller for command in rig.commands[1:])
            assert holder.poll() is None
            holder.terminate()
        # It has disconnected: mbpoll acquires the lease.
        eventually(lambda: rig.kinds().count("LEASE_GRANTED") == rig.kinds().count("LEASE_LOST"))
        mbpoll_write(rig.port, 1, 1000)
        assert rig.commands[-1].effort[0] == 1.0
        mbpoll_write(rig.port, 1, 1, kind="coil")
        assert rig.commands[-1].magnet


def test_documented_mbpoll_commands_reach_the_rig() -> None:
    require_mbpoll()
    with running_edge() as rig:
        read, torques, magnet = (line.split() for line in commands_of("other-devices", rig.port))
        done = subprocess.run(read, check=True, capture_output=True, text=True, timeout=10)
        assert "[5]:" in done.stdout
        subprocess.run(torques, check=True, capture_output=True, timeout=10)
        assert list(rig.commands[-1].effort) == [-0.5, 0.0, 0.0, 0.0]
        subprocess.run(magnet, check=True, capture_output=True, timeout=10)
        assert rig.commands[-1].magnet


@contextmanager
def moving(rig: EdgeRig) -> Iterator[None]:
    """Publish states at 50 Hz in the context."""
    done = threading.Event()

    def send_states() -> None:
        while not done.wait(0.02):
            rig.state()

    thread = threading.Thread(target=send_states)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_plc_project_uses_existing_registers() -> None:
    """OpenPLC is not started; its files are compared with the register map."""
    config = dict(
        re.findall(r'^device0\.(\w+) = "([^"]*)"', (EXAMPLES / "openplc/mbconfig.cfg").read_text(), re.MULTILINE)
    )
    program = (EXAMPLES / "openplc/hold_position.st").read_text()
    with running_edge() as rig, rig.client() as client:
        read, count = int(config["Holding_Registers_Read_Start"]), int(config["Holding_Registers_Read_Size"])
        assert (read, count) == (4, 4)
        assert len(client.read(read, count)) == count == len(re.findall(r"AT %IW10[0-3] : INT;", program))
        write, count = int(config["Holding_Registers_Start"]), int(config["Holding_Registers_Size"])
        assert (write, count) == (0, 4)
        assert client.write(write, *range(count)).hex() == "1000000004"
        assert count == len(re.findall(r"AT %QW10[0-3] : INT;", program))
        assert client.ask("0F 00 00 00 01 01 01").hex() == "0f00000001"
        assert config["Coils_Size"] == "1" and "AT %QX100.0 : BOOL;" in program  # noqa: PT018
    [period] = re.findall(r'Polling_Period = "(\d+)"', (EXAMPLES / "openplc/mbconfig.cfg").read_text())
    assert 10 <= int(period) <= 20
