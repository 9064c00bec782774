"""The latency of a recording under other gains."""

from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from hilrig_study.live.from_recording import judge_gains, recorded_ages
from hilrig_study.study_config import AxisConfig, ControllerConfig, StudyConfig
from support import recordings


def recorded(folder: Path, **script: object) -> Path:
    chosen = recordings.Script(seconds=4.0, poll_ms=20.0, **script)  # type: ignore[arg-type]
    return recordings.write(folder / "run.mcap", recordings.make(chosen), script=chosen)


def test_ages_are_the_recorded_loop_latency_and_grow_while_a_command_is_held(tmp_path: Path) -> None:
    run = open_run(recorded(tmp_path, injected_command_ms=45.0))
    (ages,) = recorded_ages(run)
    new = run.states[run.states["basis_step"] != 0]
    assert int(np.median(ages)) == round(float(np.median(new["loop_latency_ns"])) / 20e6)
    assert (np.diff(ages) <= 1).all()


def test_a_slower_session_would_have_borne_less_gain(tmp_path: Path) -> None:
    largest = {}
    for delay_ms in (0.0, 100.0):
        judged = judge_gains(open_run(recorded(tmp_path, injected_command_ms=delay_ms)))
        assert [gain.gain for gain in judged.gains] == sorted(gain.gain for gain in judged.gains)
        stable = [gain for gain in judged.gains if gain.stable]
        assert all(gain.expected_cost is not None and gain.spare_ms is not None for gain in stable)
        assert all(gain.expected_cost is None for gain in judged.gains if not gain.stable)
        largest[delay_ms] = max(gain.gain for gain in stable)
    assert largest[100.0] < largest[0.0]


def test_a_studys_file_says_which_controllers_and_gains(tmp_path: Path) -> None:
    study = StudyConfig(
        x=AxisConfig(what="delay_ms", values=(0.0,)),
        y=AxisConfig(what="gain", values=(0.3, 0.6)),
        controllers=(ControllerConfig(name="ct", kind="computed_torque", omega=5.0),),
    )
    judged = judge_gains(open_run(recorded(tmp_path)), study)
    assert [(gain.controller, gain.gain) for gain in judged.gains] == [("ct", 0.3), ("ct", 0.6)]


def test_a_controller_that_is_a_file_has_no_law_to_judge(tmp_path: Path) -> None:
    study = StudyConfig(
        x=AxisConfig(what="delay_ms", values=(0.0,)),
        y=AxisConfig(what="gain", values=(0.3,)),
        controllers=(ControllerConfig(name="mine", kind="file", file=Path("mine.py")),),
    )
    with pytest.raises(InputError, match="theory needs a law"):
        judge_gains(open_run(recorded(tmp_path)), study)


def test_a_recording_with_gaps_is_refused(tmp_path: Path) -> None:
    script = recordings.Script(seconds=4.0, poll_ms=20.0)
    made = recordings.make(script)
    states = [number for number, one in enumerate(made) if one.topic == "state"]
    kept = [one for number, one in enumerate(made) if number not in states[100:103]]
    with pytest.raises(InputError, match="a trace with gaps: 3 states are missing"):
        judge_gains(open_run(recordings.write(tmp_path / "run.mcap", kept, script=script)))
