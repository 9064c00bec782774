"""The layout of the viewer shows every written entity, and names no others."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun.blueprint as rrb

from hilrig_replay.io.run import Run, open_run
from hilrig_replay.rerun_view import view
from hilrig_replay.rerun_view.layout import layout
from hilrig_replay.rerun_view.view import root_names, save_rrd, send_runs
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


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("live", [False, True])
def test_views_show_exactly_the_written_entities(runs: list[Run], tmp_path: Path, count: int, live: bool) -> None:
    runs = runs[:count]
    save_rrd(runs, tmp_path / "run.rrd")
    written = {path for path in RrdFile(tmp_path / "run.rrd").tables if not path.startswith("/__")}
    shown = [
        line.removeprefix("+ ").removesuffix("/**")
        for view in views(layout(root_names(runs), live=live).root_container)
        for line in view.contents
    ]

    def below(path: str, roots: list[str]) -> bool:
        return any(f"{path}/".startswith(f"{root}/") for root in roots)

    assert [root for root in shown if not any(below(path, [root]) for path in written)] == []
    assert {path for path in written if not below(path, shown)} == {
        HIDDEN[count].format(root=run.session) for run in runs
    }


@pytest.mark.parametrize(
    ("name", "stage"), [("client-role", "position write yellow"), ("limit-cycle", "controller orange")]
)
def test_title_names_the_stages_of_the_role(monkeypatch: pytest.MonkeyPatch, name: str, stage: str) -> None:
    shown: list[rrb.Blueprint] = []
    monkeypatch.setattr(view, "to_viewer", lambda _port, _name, blueprint: shown.append(blueprint))
    monkeypatch.setattr(view, "_write", lambda *_: None)
    send_runs([open_run(DATA / f"{name}.mcap")], 0, lambda: True)
    titles = [str(each.name) for each in views(shown[0].root_container)]
    assert [title for title in titles if title.startswith("Latency, ms: register wait blue, ") and stage in title]
