"""Labs whose controllers are Modbus servers: the example programs, and every evaluation of their recordings."""

import json
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import CLIENT_STAGES
from hilrig_replay.io.run import open_run
from support.clients import compile_with_libmodbus
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

EXAMPLES = Path(__file__).parents[2] / "examples"
SECONDS = "7.8"
"""Duration of nearly both poses: the arm is at the second one when the programs end."""


@dataclass(frozen=True)
class Result:
    """A finished lab: its file, the output of each program, and the recording of each rig."""

    config: Path
    outputs: list[str]
    codes: list[int]
    recordings: list[Path]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = tmp_path_factory.mktemp("lab")
    in_c = compile_with_libmodbus(EXAMPLES / "server_controller.c", folder)
    port = free_ports(2)
    config = write_lab(folder, rigs=2, extra="edge.session_grace_ms = 1000")
    text = config.read_text()
    text = text.replace('"rig1"\n', f'"rig1"\ncontroller = "127.0.0.1:{port}"\nregisters.echo = 9\n')
    text = text.replace('"rig2"\n', f'"rig2"\ncontroller = "127.0.0.1:{port + 1}"\n')
    config.write_text(text)
    commands = [
        [sys.executable, str(EXAMPLES / "server_controller.py"), "--port", str(port), "--duration", SECONDS],
        [str(in_c), "127.0.0.1", str(port + 1), SECONDS],
    ]
    with RunningLab(config) as lab:
        assert f"rig1: client of 127.0.0.1:{port}, unit 1: writes holding registers 4–8 (40005–40009)" in lab.output()
        programs = [
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
            for command in commands
        ]
        outputs = [program.communicate(timeout=60)[0] for program in programs]
        eventually(lambda: len(lab.recordings) == 2)
        codes = [program.returncode for program in programs]
        recordings = sorted(lab.recordings, key=lambda path: path.parent.name)
    return Result(config, outputs, codes, recordings)


def test_example_servers_hold_and_move_the_arm(result: Result) -> None:
    assert result.codes == [0, 0], result.outputs


def test_recordings_of_the_client_role_are_evaluated(result: Result, tmp_path: Path) -> None:
    first, second = result.recordings
    for path in (first, second):
        assert hilrig("verify", path).returncode == 0
    reports = [measure(open_run(path)) for path in (first, second)]
    for report in reports:
        assert report.samples > 250
        assert list(report.stages_ms) == [stage.key for stage in CLIENT_STAGES]
        samples = report.table
        assert np.array_equal(sum(samples[stage.key] for stage in CLIENT_STAGES), samples["loop"])
        assert all((samples[stage.key] >= 0).all() for stage in CLIENT_STAGES)
    codes = [{reason.code for reason in report.reasons} for report in reports]
    assert ["no_echo" in found for found in codes] == [False, True]
    assert [report.device_scan is None for report in reports] == [False, True]
    assert hilrig("compare", first, second).returncode == 0
    assert hilrig("report", first, "--out", tmp_path / "report.html").returncode == 0
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    [values] = re.findall(r'id="run-1-data">(.*?)</script>', page)
    assert [stage["title"] for stage in json.loads(values)["stages"]] == [stage.title for stage in CLIENT_STAGES]
    rrd = hilrig("replay", first, "--save", tmp_path / "run.rrd")
    assert rrd.returncode == 0, rrd.stderr
    latency = json.loads(hilrig("latency", first, "--json").stdout)
    assert latency["session"] == first.stem
