"""`hilrig live` with a running lab."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from support.hilrig_process import HILRIG
from support.labs import RunningLab, hilrig, write_lab
from support.rrd_files import RrdFile
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig


@contextmanager
def live(config: Path, save: Path, log: Path) -> Iterator["subprocess.Popen[bytes]"]:
    with log.open("wb") as errors:
        command = [*HILRIG, "live", "--config", str(config), "--save", str(save)]
        process = subprocess.Popen(command, stderr=errors)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@pytest.mark.long("takes 15 s")
def test_live_view_survives_a_simulation_restart(tmp_path: Path) -> None:
    save, log = tmp_path / "live.rrd", tmp_path / "live.log"
    with RunningLab(write_lab(tmp_path)) as lab, live(lab.config, save, log) as process:
        eventually(lambda: save.exists() and save.stat().st_size > 400_000)
        lab_sim = lab.service_pid("sim")
        subprocess.run(["kill", "-STOP", str(lab_sim)], check=True)
        eventually(lambda: "rig1: no states received for 2 s; waiting" in log.read_text())
        subprocess.run(["kill", "-KILL", str(lab_sim)], check=True)
        eventually(lambda: "rig1: receiving states again" in log.read_text())
        size = save.stat().st_size
        eventually(lambda: save.stat().st_size > size + 100_000)
        process.send_signal(signal.SIGINT)
        assert process.wait(LONG_TIMEOUT_S) == 0, log.read_text()
    shown = RrdFile(save)
    assert shown.rows("/position") == shown.rows("/scene/joints/theta1") > 50


def test_missing_simulation_is_reported(tmp_path: Path) -> None:
    result = hilrig("live", "--config", write_lab(tmp_path), "--save", tmp_path / "live.rrd")
    assert result.returncode == 3
    assert "no reply from a simulation of rig 'rig1' in lab 'lab': is it running" in result.stderr
    assert "Traceback" not in result.stderr


def test_unknown_rig_is_rejected(tmp_path: Path) -> None:
    result = hilrig("live", "rig9", "--config", write_lab(tmp_path))
    assert result.returncode == 2
    assert "unknown rig 'rig9'; this lab has rig1" in result.stderr
