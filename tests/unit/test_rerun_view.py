"""Rerun files contain the data of the recording; read back with rerun's own reader."""

from pathlib import Path

import numpy as np
import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import STAGES
from hilrig_replay.geometry.scene import tool_positions
from hilrig_replay.io.run import open_run
from hilrig_replay.rerun_view.view import root_names, save_rrd
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas import ModbusTraffic
from support.recordings import PARAMETERS, Script, make, record, write
from support.rrd_files import RrdFile


def test_time_series_are_states_in_degrees_and_millimeters(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=3.0)))
    save_rrd(run, tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    scale = np.array([180 / np.pi, 180 / np.pi, 1000, 180 / np.pi])
    assert np.allclose(shown.column("/position", "scalars"), run.states["position"] * scale)
    assert np.allclose(shown.column("/velocity", "scalars"), run.states["velocity"] * scale)
    assert np.allclose(shown.column("/effort/applied", "scalars"), run.states["effort"])
    assert np.allclose(shown.column("/effort/commanded", "scalars"), run.commands["effort"])
    assert {"sim_time", "wall", "step"} <= shown.timelines


def test_stages_sum_to_the_loop_latency(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=3.0)))
    save_rrd(run, tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    ends = shown.column("/stages", "scalars")
    loops = measure(run).table["loop"] / 1e6
    assert ends.shape == (len(loops), 1 + len(STAGES))
    assert np.allclose(ends[:, -1], loops)
    assert (np.diff(ends, axis=1) >= 0).all()


def test_trail_ends_at_the_tool(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=2.0)))
    save_rrd(run, tmp_path / "run.rrd")
    strips = RrdFile(tmp_path / "run.rrd").column("/scene/trail", "strips")
    assert np.allclose(strips[:, 0, 1], tool_positions(PARAMETERS.arm, run.states["position"]), atol=1e-6)
    assert np.allclose(strips[1:, 0, 0], strips[:-1, 0, 1])


def test_file_has_arm_parts_events_and_requests(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=4.0)))
    save_rrd(run, tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    for joint in ("theta1", "theta2", "d3", "theta4"):
        assert shown.rows(f"/scene/joints/{joint}") == len(run.states)
    for part in ("red", "blue", "green", "yellow"):
        assert shown.rows(f"/scene/parts/{part}") == 4
    assert shown.column("/events", "text").ravel().tolist() == [
        f"{kind.replace('_', ' ').lower()}: {text}"
        for kind, text in zip(run.events["kind"], run.events["text"], strict=True)
    ]
    reads = shown.column("/modbus/192.0.2.7_40001/reads", "scalars")
    assert reads.sum() / 10 == pytest.approx((run.traffic["function"] == 3).sum())


def test_requests_panel_has_reads_writes_and_errors(tmp_path: Path) -> None:
    made = list(make(Script(seconds=2.0)))
    batches = [one.message for one in made if isinstance(one.message, ModbusTraffic)]
    # The first batch is from a controller that is refused the lease.
    batches[0].kinds[1].exception = 6
    run = open_run(write(tmp_path / "run.mcap", made, script=Script(seconds=2.0)))
    save_rrd(run, tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    errors, writes = run.traffic["exception"] > 0, run.traffic["function"] == 16
    assert errors.any()
    for kind, count in (("reads", (~writes).sum()), ("writes", (writes & ~errors).sum()), ("errors", errors.sum())):
        assert shown.column(f"/modbus/192.0.2.7_40001/{kind}", "scalars").sum() / 10 == pytest.approx(count)


def test_state_timelines_contain_changes_only(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=8.0)))
    save_rrd(run, tmp_path / "run.rrd")
    shown = RrdFile(tmp_path / "run.rrd")
    magnet = run.states["magnet"]
    assert shown.column("/states/magnet", "state").ravel().tolist() == [
        "on" if on else "off" for on in magnet[np.concatenate(([True], np.diff(magnet)))]
    ]
    assert shown.column("/states/torque", "state").ravel().tolist() == ["no controller", "192.0.2.7:40001"]


def test_several_runs_have_separate_root_paths(tmp_path: Path) -> None:
    script = Script(seconds=1.0)
    paths = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    runs = [open_run(write(path, make(script), script=script, session=f"session-{path.stem}")) for path in paths]
    save_rrd(runs, tmp_path / "both.rrd")
    shown = RrdFile(tmp_path / "both.rrd")
    for run in runs:
        assert shown.rows(f"/{run.session}/position") == 50
    assert len(set(root_names([runs[0], runs[0]]))) == 2


def test_recording_without_configuration_uses_defaults(tmp_path: Path) -> None:
    script = Script(seconds=1.0)
    run = open_run(write(tmp_path / "run.mcap", make(script), script=script, configured=False))
    assert (run.urdf, run.parameters_json, run.step_ns) == ("", "", 20_000_000)
    save_rrd(run, tmp_path / "run.rrd")
    assert RrdFile(tmp_path / "run.rrd").rows("/scene/joints/theta1") == 50


def test_unwritable_path_raises(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=0.5)))
    with pytest.raises(InputError, match=r"folder .* does not exist"):
        save_rrd(run, tmp_path / "nowhere" / "run.rrd")
    with pytest.raises(InputError, match="is a folder; expected the name of a file"):
        save_rrd(run, tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full exists on Linux only")
def test_reports_a_full_disk(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=2.0)))
    (tmp_path / "run.rrd").symlink_to("/dev/full")
    with pytest.raises(OperationError, match=r"run\.rrd: can't be written: .*No space left on device"):
        save_rrd(run, tmp_path / "run.rrd")
