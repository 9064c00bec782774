"""Installations: hilrig with one extra alone, in a new environment, runs the commands of that extra."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.extras import COMMANDS, DATA, PROJECT, ROOT
from support.labs import free_ports, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = [
    pytest.mark.rig,
    pytest.mark.skipif("HILRIG_LONG" not in os.environ, reason="takes minutes: make test-long"),
]
STARTED = {"rig": ("up", "rig1"), "console": ("console", "http://")}
"""Command of an extra that runs until it is stopped, and a part of its output after the start."""


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, cwd=cwd, check=False, capture_output=True, text=True, timeout=500)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("extra", COMMANDS)
def test_extra_alone_runs_its_commands(extra: str, tmp_path: Path) -> None:
    assert run(sys.executable, "-m", "venv", "venv", cwd=tmp_path).returncode == 0
    folder = f"{ROOT}[{extra}]" if extra else str(ROOT)
    options = ("--quiet", "--no-compile", "--constraint", ROOT / "constraints.txt")
    installed = run(tmp_path / "venv/bin/pip", "install", *options, folder, cwd=tmp_path)
    assert installed.returncode == 0, installed.stderr
    hilrig = tmp_path / "venv/bin/hilrig"
    assert run(hilrig, "--version", cwd=tmp_path).stdout == f"hilrig {PROJECT['version']}\n"
    (tmp_path / "out").mkdir()
    places = {"root": ROOT, "data": shutil.copytree(DATA, tmp_path / "data"), "out": tmp_path / "out"}
    for command in COMMANDS[extra]:
        done = run(hilrig, *command.format_map(places).split(), cwd=tmp_path)
        assert done.returncode in (0, 1), f"hilrig {command}: {done.stderr}"
        assert "Traceback" not in done.stderr
    if extra in STARTED:
        command, printed = STARTED[extra]
        config = write_lab(tmp_path)
        log = tmp_path / "log"
        listen = ["--listen", f"127.0.0.1:{free_ports(1)}"] if extra == "console" else []
        with log.open("w") as output:
            process = subprocess.Popen(
                [hilrig, command, "--config", config, *listen], stdout=output, stderr=subprocess.STDOUT
            )
        try:
            eventually(lambda: printed in log.read_text() or process.poll() is not None)
            assert process.poll() is None, log.read_text()
            process.send_signal(signal.SIGINT)
            assert process.wait(LONG_TIMEOUT_S) == 0
        finally:
            process.kill()
            process.wait()
