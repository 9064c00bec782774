"""The table of latency stages equals the pages, and is shown complete in plot, viewer and command output."""

from pathlib import Path

import pyarrow as pa
import pytest

from hilrig_cli.commands.latency import print_report
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import ALL_STAGES, CLIENT_STAGES, LOOP_STAGES, STAGES, TRANSPORT
from hilrig_replay.export.delay_trace import TRACE_STAGES
from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.latency_plot import latency_figure
from hilrig_replay.rerun_view.view import save_rrd
from support.recordings import Script, record
from support.rrd_files import RrdFile

DOCS = Path(__file__).parents[2] / "docs"
TITLES = [stage.title for stage in LOOP_STAGES]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return open_run(record(tmp_path_factory.mktemp("stages") / "run.mcap", Script(seconds=2.0)))


def test_stage_names_and_colors_are_unique() -> None:
    for stages in (LOOP_STAGES, CLIENT_STAGES):
        assert len({stage.color for stage in stages}) == len(stages)
    for values in ([stage.key for stage in ALL_STAGES], [stage.title for stage in ALL_STAGES]):
        assert len(set(values)) == len(ALL_STAGES)


def test_only_the_last_stage_is_the_remainder() -> None:
    for stages in (LOOP_STAGES, CLIENT_STAGES):
        assert [bool(stage.added) for stage in stages] == [True] * (len(stages) - 1) + [False]


def test_stages_sum_fields_of_one_message_type() -> None:
    for stage in ALL_STAGES:
        fields = {*stage.added, *stage.subtracted}
        assert fields <= set(STATE_DTYPE.names or ()) or fields <= set(COMMAND_DTYPE.names or ()), stage.key


def test_timing_page_has_the_table_of_stages() -> None:
    page = (DOCS / "timing.md").read_text(encoding="utf-8")
    _, *sections = page.split("| stage | from, to | clock |\n")
    rows = [section.partition("\n\n")[0].splitlines()[1:] for section in sections]
    of_the_client = [stage for stage in CLIENT_STAGES if stage not in LOOP_STAGES]
    assert rows == [
        [f"| {stage.title} | {stage.span} | {stage.clock} |" for stage in stages]
        for stages in (LOOP_STAGES, of_the_client)
    ]


def test_export_page_has_the_formulas_of_the_stages() -> None:
    text = " ".join((DOCS / "export.md").read_text(encoding="utf-8").split())
    for stage in {*LOOP_STAGES, *CLIENT_STAGES} - {TRANSPORT}:
        assert f"{stage.title} `{stage.formula}`" in text
    assert f"{TITLES[-1]} the remainder of the loop latency" in text


def test_delay_trace_decides_about_each_stage() -> None:
    added_by_the_impaired_rig = {"register_wait", "edge", "tick_wait", "transport"}
    assert {*(stage.key for stage in TRACE_STAGES), *added_by_the_impaired_rig} == set(STAGES)


def test_plot_shows_each_stage(run: Run) -> None:
    axes = latency_figure(measure(run), run).axes[1]
    assert [label.get_text() for label in axes.get_yticklabels()] == TITLES


def test_viewer_shows_each_stage(run: Run, tmp_path: Path) -> None:
    save_rrd(run, tmp_path / "run.rrd")
    tables = [
        table for table in RrdFile(tmp_path / "run.rrd").tables["/stages"] if "SeriesLines:names" in table.schema.names
    ]
    (names,) = pa.Table.from_batches(tables)["SeriesLines:names"].to_pylist()
    assert names[1:] == [*(f"+ {title}" for title in TITLES[:-1]), f"+ {TITLES[-1]} = loop"]


def test_command_prints_each_stage(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    print_report(measure(run))
    printed = [line.partition("  ")[2][:20] for line in capsys.readouterr().out.splitlines() if line.startswith("   ")]
    assert [title for title in TITLES if not any(line.strip().startswith(title) for line in printed)] == []
