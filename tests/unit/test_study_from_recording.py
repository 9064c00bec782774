"""Evaluation of controller gains under the latency of a recording."""

from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from hilrig_study.live.from_recording import MAX_RECORDED_AGE_STEPS, evaluate_gains, recorded_ages
from hilrig_study.study_config import AxisConfig, ControllerConfig, StudyConfig
from hilrig_study.theory.expected_cost import age_chain
from support import recordings

DATA = Path(__file__).parents[1] / "data"
ONE_GAIN = StudyConfig(x=AxisConfig(what="delay_ms", values=(0.0,)), y=AxisConfig(what="gain", values=(0.3,)))


def recorded(folder: Path, **script: object) -> Path:
    chosen = recordings.Script(seconds=4.0, poll_ms=20.0, **script)  # type: ignore[arg-type]
    return recordings.write(folder / "run.mcap", recordings.make(chosen), script=chosen)


def test_ages_equal_loop_latency_and_grow_for_held_command(tmp_path: Path) -> None:
    run = open_run(recorded(tmp_path, injected_command_ms=45.0))
    (ages,) = recorded_ages(measure(run))
    new = run.states[run.states["basis_step"] != 0]
    assert int(np.median(ages)) == round(float(np.median(new["loop_latency_ns"])) / 20e6)
    assert (np.diff(ages) <= 1).all()


@pytest.mark.parametrize("name", ["simulation-restarted.mcap", "before-columns-of-requests.mcap"])
def test_ages_are_those_of_the_latency_report(name: str) -> None:
    run = open_run(DATA / name)
    latency, gains = measure(run), evaluate_gains(run, ONE_GAIN)
    assert gains.as_dict()["age_ms"] == latency.as_dict()["age_ms"]
    assert latency.ages is not None
    ages = np.concatenate(list(latency.ages.ages_ns()))
    recorded = np.concatenate(recorded_ages(latency))
    assert len(recorded) == len(ages)
    assert np.array_equal(recorded, np.clip(np.rint(ages / run.step_ns), 1, MAX_RECORDED_AGE_STEPS))


@pytest.mark.parametrize("name", ["simulation-restarted.mcap", "before-columns-of-requests.mcap"])
def test_markov_chain_has_the_recorded_distribution_of_ages(name: str) -> None:
    sequences = recorded_ages(measure(open_run(DATA / name)))
    chain, recorded = age_chain(sequences), np.concatenate(sequences)
    values, vectors = np.linalg.eig(chain.transition.T)
    stationary = vectors[:, np.argmin(np.abs(values - 1))].real
    stationary /= stationary.sum()
    for age, share in zip(chain.ages, stationary, strict=True):
        measured = float((recorded == age).mean())
        # Successive ages are correlated: about one independent value in two steps.
        error = np.sqrt(2 * share * (1 - share) / len(recorded))
        assert share == pytest.approx(measured, abs=3 * error + 1 / len(recorded)), age


def test_open_loop_has_no_ages(tmp_path: Path) -> None:
    script = recordings.Script(seconds=4.0, controllers=False)
    run = open_run(recordings.write(tmp_path / "run.mcap", recordings.make(script), script=script))
    with pytest.raises(InputError, match="no loop latency: no closed loop: no controller wrote commands"):
        evaluate_gains(run)


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
