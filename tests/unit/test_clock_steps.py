"""A wall clock that is set during a run changes no time axis."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hilrig_recorder.mcap_format.recover import recover
from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.export.export import export_foxglove
from hilrig_replay.export.player import Player
from hilrig_replay.io.run import Run, open_run
from support import recordings
from support.recordings import Script

RECORDED = Path(__file__).parents[1] / "data/wall-clock-steps.mcap"
TABLES = ("states", "commands", "events", "traffic", "parts")


def stepped(path: Path, *steps: tuple[float, float]) -> Path:
    """A recording in which the wall clock of all services is set by some seconds at some times, (time, seconds)."""
    made = recordings.make(Script(seconds=6.0))
    for number, one in enumerate(made):
        at_s = (one.publish_wall_ns - recordings.START_WALL_NS) / 1e9
        by_ns = round(sum(by_s for from_s, by_s in steps if at_s >= from_s) * 1e9)
        one.message.wall_ns += by_ns  # type: ignore[attr-defined]
        made[number] = recordings.TimedMessage(one.topic, one.publish_wall_ns + by_ns, one.message)
    script = Script(seconds=6.0, clock_steps=len(steps))
    return recordings.write(path, made, script=script)


def check(run: Run, duration_s: float) -> None:
    assert run.duration_s == pytest.approx(duration_s, abs=0.1)
    for name in TABLES:
        time_s = run.time_s(getattr(run, name))
        assert len(time_s)
        assert -0.5 < time_s.min() <= time_s.max() < duration_s + 0.5, name
        assert (np.diff(time_s) > -0.5).all(), name
        steps = run.timebase.steps(getattr(run, name), run.step_ns)
        assert np.ptp(steps) <= duration_s / (run.step_ns / 1e9) + 50, name


def test_recorded_steps_of_hours_are_removed(tmp_path: Path) -> None:
    run = open_run(RECORDED)
    check(run, 17.7)
    (tmp_path / "run.mcap").symlink_to(RECORDED)
    [entry] = RunIndex(tmp_path).load()
    assert entry.duration_s == pytest.approx(17.7, abs=0.1)
    offsets_s = [scheduled.offset_ns / 1e9 for scheduled in Player(run)]
    assert len(offsets_s) == sum(run.file.counts.values())
    assert offsets_s[-1] == pytest.approx(17.7, abs=0.1)
    assert (np.diff(offsets_s) < 0.5).all()
    assert len(run.between(5.0, 10.0).states) == 250


def test_steps_are_removed_without_the_end_of_a_file(tmp_path: Path) -> None:
    truncated, path = tmp_path / "run.mcap", tmp_path / "recovered.mcap"
    truncated.write_bytes(RECORDED.read_bytes()[:150_000])
    recover(truncated, path)
    run = open_run(path)
    assert run.has_clock_steps
    assert len(run.between(5.0, 10.0).states) == 250
    offsets_s = [scheduled.offset_ns / 1e9 for scheduled in Player(run)]
    assert len(offsets_s) == sum(run.file.counts.values())
    assert offsets_s[-1] == pytest.approx(run.duration_s, abs=0.2)


def test_export_for_viewers_has_no_steps(tmp_path: Path) -> None:
    path = export_foxglove(open_run(RECORDED), tmp_path / "foxglove.mcap")
    with path.open("rb") as stream:
        times_ns = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert np.ptp(times_ns) / 1e9 == pytest.approx(17.7, abs=0.1)


def test_impossible_publication_time_does_not_stop_a_player(tmp_path: Path) -> None:
    made = recordings.make(Script(seconds=1.0))
    made[40:] = [replace(one, publish_wall_ns=one.publish_wall_ns + 10**18) for one in made[40:]]
    schedule = list(Player(open_run(recordings.write(tmp_path / "run.mcap", made))))
    assert len(schedule) == len(made)
    assert schedule[-1].offset_ns < 2e9


@pytest.mark.parametrize(
    "steps", [[(2.0, 3600.0)], [(2.0, -3600.0)], [(1.5, -86_400.0), (3.0, 90_000.0)], [(2.0, 30.0), (4.0, -30.0)]]
)
def test_generated_steps_are_removed(tmp_path: Path, steps: list[tuple[float, float]]) -> None:
    run = open_run(stepped(tmp_path / "run.mcap", *steps))
    check(run, 6.0)
    expected = open_run(stepped(tmp_path / "plain.mcap"))
    for name in ("states", "commands"):
        times = [one.time_s(getattr(one, name)) for one in (run, expected)]
        assert np.abs(times[0] - times[1]).max() < 0.05, name
    offsets_s = [scheduled.offset_ns / 1e9 for scheduled in Player(run)]
    assert 0 <= offsets_s[0] <= offsets_s[-1] < 6.5


def test_without_a_step_rows_follow_the_wall_clock(tmp_path: Path) -> None:
    run = open_run(stepped(tmp_path / "run.mcap"))
    commands = run.commands
    assert (run.time_ns(commands) == commands["wall_ns"] - run.start_wall_ns).all()
