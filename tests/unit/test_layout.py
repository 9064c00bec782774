"""The layout of the viewer shows every written entity, and names no others."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb

from hilrig_replay.io.run import Run, open_run
from hilrig_replay.rerun_view import entity_paths as paths
from hilrig_replay.rerun_view.layout import layout
from hilrig_replay.rerun_view.value_axes import MIN_LABEL_SHARE, ValueRanges, labeled_range
from hilrig_replay.rerun_view.view import root_names, save_rrd
from support.recordings import Script, make, write
from support.rrd_files import RrdFile

TASK = """
[[task.poses]]
name = "there"
position_mm = [300, 100, 100]
yaw_deg = 0
[task.path]
points_mm = [[300, 0, 100], [300, 100, 100]]
"""
DATA = Path(__file__).parents[1] / "data"
HIDDEN = {1: "/loop", 2: "/{root}/stages"}
"""Written, but not shown, by number of runs: stages are shown for one run, the loop of several runs in one plot."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    folder, script = tmp_path_factory.mktemp("runs"), Script(seconds=2.0, stalls={20: 130.0})
    names = ("one", "two")
    return [
        open_run(write(folder / f"{name}.mcap", make(script), script=script, session=name, lab_toml=TASK))
        for name in names
    ]


def views(container: rrb.Container) -> Iterator[rrb.View]:
    for child in container.contents:
        if isinstance(child, rrb.View):
            yield child
        else:
            yield from views(child)


def entities_of(view: rrb.View) -> list[str]:
    assert isinstance(view.contents, list)
    return [str(line) for line in view.contents]


def has_legend(view: rrb.View) -> bool:
    legend = view.properties["PlotLegend"]
    assert isinstance(legend, rrb.archetypes.PlotLegend)
    assert legend.visible is not None
    return bool(legend.visible.as_arrow_array().to_pylist() != [False])


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("live", [False, True])
def test_views_show_exactly_the_written_entities(runs: list[Run], tmp_path: Path, count: int, live: bool) -> None:
    runs = runs[:count]
    save_rrd(runs, tmp_path / "run.rrd")
    written = {path for path in RrdFile(tmp_path / "run.rrd").tables if not path.startswith("/__")}
    shown = [
        line.removeprefix("+ ").removesuffix("/**")
        for view in views(layout(root_names(runs), live=live).root_container)
        for line in entities_of(view)
    ]

    def below(path: str, roots: list[str]) -> bool:
        return any(f"{path}/".startswith(f"{root}/") for root in roots)

    assert [root for root in shown if not any(below(path, [root]) for path in written)] == []
    assert {path for path in written if not below(path, shown)} == {
        HIDDEN[count].format(root=run.session) for run in runs
    }


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (-8.4, 4.2, [-10, 0]),
        (-100.0, 931.0, [0, 1000]),
        (-104.0, 199.0, [-100, 0, 100, 200]),
        (0.0, 0.31, [0, 0.1, 0.2, 0.3, 0.4]),
        (-3.2, -3.1, [-4, -3, -2, -1, 0]),
    ],
)
def test_range_of_an_axis_contains_values_and_two_labels(low: float, high: float, labels: list[float]) -> None:
    bottom, top = labeled_range(low, high)
    assert bottom <= low
    assert high <= top
    step = labels[1] - labels[0]
    assert step / (top - bottom) > 0.9 * MIN_LABEL_SHARE
    found = [number * step for number in range(-20, 20) if bottom <= number * step <= top]
    assert found == pytest.approx(labels)


def test_axes_of_a_run_have_the_ranges_of_its_values(runs: list[Run]) -> None:
    ranges = ValueRanges()
    for block in runs[0].blocks():
        ranges.add(block)
    states, commands = runs[0].states, runs[0].commands
    low, high = ranges.ranges()[paths.EFFORT]
    assert low <= min(states["effort"].min(), commands["effort"].min()) < 0
    assert high >= max(states["effort"].max(), commands["effort"].max()) > 0
    plots = {view.name: view for view in views(layout(ranges=ranges.ranges()).root_container)}
    with_range = [
        str(name).partition(":")[0].partition(" ")[0] for name, view in plots.items() if "ScalarAxis" in view.properties
    ]
    assert with_range == ["Positions", "Velocities", "Efforts"]


def test_legends_are_in_titles_and_cover_no_curve() -> None:
    plots = [view for view in views(layout().root_container) if isinstance(view, rrb.TimeSeriesView)]
    assert [plot.name for plot in plots if has_legend(plot)] == ["Modbus requests per second"]
    assert plots[0].name == "Positions: θ1 blue, θ2 orange, d3 green, θ4 purple (°; d3 mm)"


@pytest.mark.parametrize(
    ("name", "stage"), [("client-role", "position write yellow"), ("limit-cycle", "controller orange")]
)
def test_title_names_the_stages_of_the_role(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, stage: str
) -> None:
    shown: list[rrb.Blueprint] = []
    monkeypatch.setattr(rr.RecordingStream, "send_blueprint", lambda _, blueprint: shown.append(blueprint))
    save_rrd(open_run(DATA / f"{name}.mcap"), tmp_path / "run.rrd")
    plots = {str(view.name): view for view in views(shown[-1].root_container)}
    # An age that hardly changes would have one number.
    assert "ScalarAxis" in plots["Age of the acting torque, ms"].properties
    titles = list(plots)
    assert [title for title in titles if title.startswith("Latency, ms: register wait blue, ") and stage in title]
