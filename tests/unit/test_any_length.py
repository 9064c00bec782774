"""Memory of the commands does not depend on the length of a run: they process it in blocks, which are small here.

Measured is the peak of Python and numpy allocations; `tests/rig/test_ten_hours.py` measures processes.
"""

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from hilrig_replay.analysis import compare, distribution, samples, summary, verify
from hilrig_replay.analysis.diagnosis import evidence
from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.analysis.latency import measure
from hilrig_replay.export import export
from hilrig_replay.io import disk_table
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots import latency_plot
from hilrig_replay.plots.latency_plot import latency_figure
from hilrig_replay.rerun_view import view as rerun_view
from support.recordings import Script, record

SHORT_S, TIMES = 8.0, 3
ROWS = 160


def drawn(path: Path) -> None:
    run = open_run(path)
    latency_figure(measure(run), run)


COMMANDS: dict[str, Callable[[Path], object]] = {
    "latency": lambda path: measure(open_run(path)),
    "latency --plot": drawn,
    # Without plots, whose memory depends on the number of points: both trajectories are downsampled to the same number.
    "report": lambda path: summary.summarize(open_run(path)),
    "compare": lambda path: compare.compare([open_run(path), open_run(path)]),
    "compare --align": lambda path: compare.find_origin(open_run(path), "SESSION_END"),
    "replay --save": lambda path: rerun_view.save_rrd(open_run(path), path.with_suffix(".rrd")),
    "verify": verify.verify,
    "export --csv": lambda path: export.export_tables(open_run(path), path.parent / path.stem, "csv"),
    "export --parquet": lambda path: export.export_tables(open_run(path), path.parent / path.stem, "parquet"),
    "runs --loop": lambda path: RunIndex(path.parent).measure(RunIndex(path.parent).load()),
}
SLOW = ("compare", "latency --plot", "replay --save", "verify")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    def made(name: str, seconds: float) -> Path:
        return record(tmp_path_factory.mktemp(name) / "run.mcap", Script(seconds=seconds, poll_ms=20.0, delay_ms=3.0))

    return made("short", SHORT_S), made("long", TIMES * SHORT_S)


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    for function, name in (
        (Run.blocks, "rows"),
        (disk_table.DiskTable.__init__, "block"),
        (distribution.percentiles, "max_sorted"),
    ):
        assert function.__kwdefaults__ is not None
        monkeypatch.setitem(function.__kwdefaults__, name, ROWS)
    monkeypatch.setattr(samples, "MATCH_WINDOW_ROWS", ROWS)
    for name in ("BLOCK_STATES", "COMMAND_WINDOW_ROWS", "TIME_WINDOW_ROWS"):
        monkeypatch.setattr(verify, name, ROWS)
    # Many intervals at once, as in a large block: a step of them takes as long as a step of one.
    monkeypatch.setattr(verify, "MIN_INTERVAL_STEPS", 5)
    monkeypatch.setattr(export, "BLOCK_ROWS", ROWS)
    monkeypatch.setattr(summary, "TRAJECTORY_POINTS", ROWS)
    monkeypatch.setattr(latency_plot, "_MAX_HISTORY_POINTS", ROWS)
    monkeypatch.setattr(evidence, "WINDOW_S", 1.0)


def peak(command: Callable[[Path], object], path: Path) -> int:
    gc.collect()
    tracemalloc.start()
    try:
        command(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "command", [pytest.param(name, marks=pytest.mark.long("takes 5 s") if name in SLOW else ()) for name in COMMANDS]
)
def test_memory_does_not_depend_on_the_length(command: str, runs: tuple[Path, Path]) -> None:
    # The first call excludes imports and caches of libraries.
    COMMANDS[command](runs[0])
    short, long = (peak(COMMANDS[command], path) for path in runs)
    print(f"{command}: {short / 1e6:.2f} MB, {TIMES} times as long {long / 1e6:.2f} MB")
    assert long < 1.1 * short + 100_000


def test_detects_a_run_held_in_memory(runs: tuple[Path, Path]) -> None:
    short, long = (peak(lambda path: open_run(path).states, path) for path in runs)
    assert long > 1.5 * short
