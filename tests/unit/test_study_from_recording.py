"""Evaluation of controller gains under the latency of a recording."""

from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from hilrig_study.live.from_recording import evaluate_gains, recorded_ages
from hilrig_study.study_config import AxisConfig, ControllerConfig, StudyConfig
from support import recordings


def recorded(folder: Path, **script: object) -> Path:
    chosen = recordings.Script(seconds=4.0, poll_ms=20.0, **script)  # type: ignore[arg-type]
    return recordings.write(folder / "run.mcap", recordings.make(chosen), script=chosen)


def test_ages_equal_loop_latency_and_grow_for_held_command(tmp_path: Path) -> None:
    run = open_run(recorded(tmp_path, injected_command_ms=45.0))
    (ages,) = recorded_ages(measure(run))
    new = run.states[run.states["basis_step"] != 0]
    assert int(np.median(ages)) == round(float(np.median(new["loop_latency_ns"])) / 20e6)
    assert (np.diff(ages) <= 1).all()


def test_longer_latency_reduces_largest_stable_gain(tmp_path: Path) -> None:
    largest = {}
    for delay_ms in (0.0, 100.0):
        report = evaluate_gains(open_run(recorded(tmp_path, injected_command_ms=delay_ms)))
        assert [gain.gain for gain in report.gains] == sorted(gain.gain for gain in report.gains)
        stable = [gain for gain in report.gains if gain.stable]
        assert all(gain.expected_cost is not None and gain.spare_ms is not None for gain in stable)
        assert all(gain.expected_cost is None for gain in report.gains if not gain.stable)
        largest[delay_ms] = max(gain.gain for gain in stable)
    assert largest[100.0] < largest[0.0]


def test_evaluates_controllers_and_gains_of_study_file(tmp_path: Path) -> None:
    study = StudyConfig(
        x=AxisConfig(what="delay_ms", values=(0.0,)),
        y=AxisConfig(what="gain", values=(0.3, 0.6)),
        controllers=(ControllerConfig(name="ct", kind="computed_torque", omega=5.0),),
    )
    report = evaluate_gains(open_run(recorded(tmp_path)), study)
    assert [(gain.controller, gain.gain) for gain in report.gains] == [("ct", 0.3), ("ct", 0.6)]


def test_rejects_controller_file(tmp_path: Path) -> None:
    study = StudyConfig(
        x=AxisConfig(what="delay_ms", values=(0.0,)),
        y=AxisConfig(what="gain", values=(0.3,)),
        controllers=(ControllerConfig(name="mine", kind="file", file=Path("mine.py")),),
    )
    with pytest.raises(InputError, match="'mine': kind 'file' can't be linearized"):
        evaluate_gains(open_run(recorded(tmp_path)), study)


def test_rejects_recording_with_missing_states(tmp_path: Path) -> None:
    script = recordings.Script(seconds=4.0, poll_ms=20.0)
    made = recordings.make(script)
    states = [number for number, one in enumerate(made) if one.topic == "state"]
    kept = [one for number, one in enumerate(made) if number not in states[100:103]]
    with pytest.raises(InputError, match="3 states are missing after step"):
        evaluate_gains(open_run(recordings.write(tmp_path / "run.mcap", kept, script=script)))
