"""The segments of one session are one run in every command; they are found by their content, not by their names."""

import json
from pathlib import Path
from shutil import copyfile

import pyarrow.csv
import pytest

from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.analysis.latency import measure
from hilrig_replay.export.join import join
from hilrig_replay.export.player import Player
from hilrig_replay.io.paths import find_each_run, find_run, find_runs
from hilrig_replay.io.run import open_run
from support.labs import hilrig
from support.recordings import Script, record
from support.segments import contents, split

SHARES = [(0, 0.4), (0.4, 0.7), (0.7, 1)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("whole") / "whole.mcap", Script(seconds=8.0))


@pytest.fixture
def renamed(whole: Path, tmp_path: Path) -> list[Path]:
    """Segments of one session, whose names are in another order."""
    paths = split(whole, tmp_path, SHARES)
    return [path.rename(tmp_path / name) for path, name in zip(paths, ("m.mcap", "z.mcap", "a.mcap"), strict=True)]


def test_segments_are_one_run_in_the_order_of_their_content(whole: Path, tmp_path: Path, renamed: list[Path]) -> None:
    expected = tuple(renamed)
    assert find_runs([tmp_path]) == [expected]
    for path in renamed:
        assert find_run(path) == expected
    assert find_runs(reversed(renamed)) == [expected]
    run, before = open_run(expected), open_run(whole)
    assert contents(run) == contents(before)
    assert run.file.counts == before.file.counts
    assert run.duration_s == before.duration_s
    assert measure(run).loop_ms == measure(before).loop_ms
    assert len(run.between(2.0, 6.0).states) == len(before.between(2.0, 6.0).states)
    assert len(list(Player(run))) == len(list(Player(before)))


def test_repeated_messages_are_read_and_counted_once(whole: Path, tmp_path: Path) -> None:
    paths = split(whole, tmp_path, [(0, 0.5), (0.4, 0.8), (0.75, 1)])
    run, before = open_run(paths), open_run(whole)
    assert contents(run) == contents(before)
    assert run.file.counts == before.file.counts
    assert run.losses is not None
    assert (run.losses.transport, run.losses.file) == (3, 0)


def test_copies_are_runs_of_their_own(whole: Path, tmp_path: Path) -> None:
    mine, yours = tmp_path / "mine", tmp_path / "yours"
    for folder in (mine, yours):
        folder.mkdir()
    paths = split(whole, mine, SHARES)
    copies = [Path(copyfile(path, yours / f"{number}.mcap")) for path, number in zip(paths, (2, 1, 3), strict=True)]
    assert find_runs([tmp_path]) == [tuple(paths), tuple(copies)]
    join(paths, mine / "all.mcap")
    assert find_runs([mine]) == [(mine / "all.mcap",), tuple(paths)]
    assert find_run(mine / "all.mcap") == (mine / "all.mcap",)
    assert find_run(paths[1]) == tuple(paths)


def test_number_that_is_used_again_is_another_segment(whole: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    # The folder was replaced between two starts of the recorder: the numbers begin again.
    early = split(whole, first, [(0, 0.4), (0.4, 0.7)])
    empty, late = split(whole, second, [(0, 0), (0.7, 1)])
    empty.unlink()
    assert find_runs([late, *early])[0] == (*early, late)


def test_index_lists_one_run_and_measures_it_once(
    whole: Path, tmp_path: Path, renamed: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    index = RunIndex(tmp_path)
    [entry] = index.measure(index.load())
    expected = measure(open_run(whole))
    assert entry.segments == tuple(path.name for path in renamed)
    assert (entry.size, entry.ended) == (sum(path.stat().st_size for path in renamed), "ended")
    assert (entry.duration_s, entry.lost_transport) == (open_run(whole).duration_s, 3)
    assert expected.loop_ms is not None
    assert entry.loop_p50_ms == round(expected.loop_ms.p50, 6)
    index.save()
    monkeypatch.setattr("hilrig_replay.analysis.index.open_segments", lambda *_: pytest.fail("was read again"))
    monkeypatch.setattr("hilrig_replay.analysis.index.measure_entry", lambda *_: pytest.fail("was measured again"))
    again = RunIndex(tmp_path)
    assert again.measure(again.load()) == [entry]
    renamed[1].unlink()
    monkeypatch.undo()
    [shorter] = RunIndex(tmp_path).load()
    assert shorter.segments == (renamed[0].name, renamed[2].name)


def test_run_of_an_unfinished_segment_is_in_progress(whole: Path, tmp_path: Path) -> None:
    paths = split(whole, tmp_path, SHARES)
    paths[2].rename(tmp_path / "x.mcap.part")
    [entry] = RunIndex(tmp_path).load()
    assert (entry.ended, len(entry.segments)) == ("recording", 3)
    assert find_runs([tmp_path]) == [tuple(paths[:2])]


def test_missing_segment_is_counted_as_lost(whole: Path, tmp_path: Path) -> None:
    paths = split(whole, tmp_path, SHARES)
    lost = open_run(paths[1]).file.counts
    paths[1].unlink()
    report = measure(open_run(find_run(paths[0])))
    assert report.lost.total >= lost["state"] + lost["command"]
    assert not report.fit


def test_commands_show_one_run(whole: Path, tmp_path: Path, renamed: list[Path]) -> None:
    first, second, third = renamed
    [listed] = json.loads(hilrig("runs", tmp_path, "--json").stdout)["runs"]
    assert listed["path"] == str(first)
    assert listed["segments"] == [str(path) for path in renamed]
    assert json.loads(hilrig("latency", tmp_path, "--json").stdout)["samples"] == measure(open_run(whole)).samples
    report = json.loads(hilrig("report", third, second, "-o", tmp_path / "r.html", "--json").stdout)
    assert len(report["runs"]) == 1
    for given in (first, third):
        assert hilrig("export", given, "--csv", tmp_path / "tables").returncode == 0
        assert len(pyarrow.csv.read_csv(tmp_path / "tables" / "state.csv")) == len(open_run(whole).states)
    assert hilrig("export", second, "--foxglove", tmp_path / "drawn.mcap").returncode == 0
    drawn = open_run(tmp_path / "drawn.mcap")
    assert contents(drawn) == contents(open_run(whole))
    assert find_each_run([whole, first, whole, third]) == [(whole,), tuple(renamed), (whole,)]
    refused = hilrig("compare", first, second)
    assert (refused.returncode, "at least two runs, got one" in refused.stderr) == (2, True)
    assert "got one" not in hilrig("compare", first, whole).stderr
    verified = json.loads(hilrig("verify", tmp_path / "z.mcap", "--json").stdout)
    assert verified == json.loads(hilrig("verify", whole, "--json").stdout)
