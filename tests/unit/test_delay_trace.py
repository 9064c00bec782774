"""Delay traces from recordings: delays outside the rig, and rejection of incomplete recordings."""

from pathlib import Path

import pytest

from hilrig_replay.export.delay_trace import delay_trace
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from support.recordings import Script, TimedMessage, make, record, write


def trace_ms(folder: Path, script: Script) -> tuple[float, ...]:
    return delay_trace(open_run(record(folder / "run.mcap", script))).delays_ms


def test_trace_contains_the_delay_of_each_sample_in_order(tmp_path: Path) -> None:
    script = Script(seconds=8.0, poll_ms=40.0, delay_ms=22.0, injected_command_ms=7.0)
    delays_ms = trace_ms(tmp_path, script)
    assert len(delays_ms) > 150
    # Both network directions, the controller and the injected delay; not the tick wait, which the impaired rig adds.
    expected = pytest.approx(22.0 + 7.0 + 2 * script.network_ms, abs=1.0)
    assert all(delay == expected for delay in delays_ms)


def test_too_few_samples_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"run\.mcap: unusable as a delay trace: \d\d loop latency samples, at least 100 are"
    ):
        trace_ms(tmp_path, Script(seconds=1.0, poll_ms=20.0))


@pytest.mark.parametrize("script", [Script(seconds=8.0, lost_transport=3), Script(seconds=8.0, lost_recorder=3)])
def test_recording_with_losses_is_rejected(tmp_path: Path, script: Script) -> None:
    with pytest.raises(InputError, match=r"unusable as a delay trace: gaps, 3 messages are missing"):
        trace_ms(tmp_path, script)


def test_recording_with_missing_commands_is_rejected(tmp_path: Path) -> None:
    made: list[TimedMessage] = make(Script(seconds=8.0, poll_ms=20.0))
    commands = [each for each in made if each.topic == "command"]
    removed = {id(each) for each in commands[100:110]}
    path = write(tmp_path / "run.mcap", [each for each in made if id(each) not in removed], script=Script(seconds=8.0))
    with pytest.raises(InputError, match=r"gaps, \d+ messages are missing"):
        delay_trace(open_run(path))


def test_pause_of_the_controller_is_a_gap(tmp_path: Path) -> None:
    made = make(Script(seconds=8.0, poll_ms=20.0))
    commands = [each.message for each in made if each.topic == "command"]
    commands[200].state_arrived_ns -= 12_000_000_000  # type: ignore[attr-defined]
    commands[200].state_served_ns -= 12_000_000_000  # type: ignore[attr-defined]
    path = write(tmp_path / "run.mcap", made, script=Script(seconds=8.0))
    with pytest.raises(InputError, match=r"gaps, the controller was silent for 12 s before sample \d+ of \d+"):
        delay_trace(open_run(path))


def test_recording_without_commands_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="0 loop latency samples"):
        trace_ms(tmp_path, Script(seconds=2.0, controllers=False))
