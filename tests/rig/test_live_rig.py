"""`hilrig live` beside a lab that really runs."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from support.labs import HILRIG, RunningLab, hilrig, write_lab
from support.rrd_files import RrdFile
from support.waiting import PATIENT_S, eventually

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


def test_a_rig_is_followed_through_a_restart_of_its_simulation(tmp_path: Path) -> None:
    save, log = tmp_path / "live.rrd", tmp_path / "live.log"
    with RunningLab(write_lab(tmp_path)) as lab, live(lab.config, save, log) as process:
        eventually(lambda: save.exists() and save.stat().st_size > 400_000)
        lab_sim = lab.service_pid("sim")
        subprocess.run(["kill", "-STOP", str(lab_sim)], check=True)
        eventually(lambda: "nothing comes from rig1: waiting for it" in log.read_text())
        subprocess.run(["kill", "-KILL", str(lab_sim)], check=True)
        eventually(lambda: "rig1 is back" in log.read_text())
        size = save.stat().st_size
        eventually(lambda: save.stat().st_size > size + 100_000)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENT_S) == 0, log.read_text()
    shown = RrdFile(save)
    assert shown.rows("/position") == shown.rows("/scene/joints/theta1") > 50


def test_where_nothing_runs_it_says_so(tmp_path: Path) -> None:
    result = hilrig("live", "--config", write_lab(tmp_path), "--save", tmp_path / "live.rrd")
    assert result.returncode == 3
    assert "no simulation of rig 'rig1' answers for lab 'lab': is it running" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_rig_that_the_lab_does_not_have_is_refused(tmp_path: Path) -> None:
    result = hilrig("live", "rig9", "--config", write_lab(tmp_path))
    assert result.returncode == 2
    assert "no rig is called 'rig9'; this lab has rig1" in result.stderr
