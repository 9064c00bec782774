"""Exports contain the recorded data, and the drawn arm agrees with the states."""

import errno
import json
import re
import threading
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest
from google.protobuf.wrappers_pb2 import BytesValue
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilrig_recorder.mcap_format.file_names import recovering_path
from hilrig_recorder.mcap_format.records import COPY_SUFFIX
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.analysis.latency import measure
from hilrig_replay.export.export import export_foxglove, export_tables
from hilrig_replay.export.player import Player, publish_recording
from hilrig_replay.geometry.quaternion import rotate
from hilrig_replay.geometry.urdf_geometry import VisualShape, visual_shapes
from hilrig_replay.io.frames.tables import TABLES, table
from hilrig_replay.io.run import open_run
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_sim.arm.kinematics import forward
from hilrig_sim.arm.model import ArmParameters
from support import recordings
from support.labs import hilrig

PAGE = Path(__file__).parents[2] / "docs/export.md"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recordings.record(tmp_path_factory.mktemp("export") / "run.mcap", recordings.Script(seconds=2))


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_tables_contain_all_rows_and_values(recording: Path, tmp_path: Path, kind: str) -> None:
    run = open_run(recording)
    paths = export_tables(run, tmp_path / "tables", kind)
    assert [path.name for path in paths] == [f"{name}.{kind}" for name in TABLES]
    read = pyarrow.csv.read_csv if kind == "csv" else pyarrow.parquet.read_table
    states = read(paths[0])
    assert states.num_rows == len(run.states) == 100
    assert states["step"].to_pylist() == run.states["step"].tolist()
    np.testing.assert_array_equal(states["position_d3"].to_numpy(), run.states["position"][:, 2])
    np.testing.assert_array_equal(states["time_s"].to_numpy(), run.time_s(run.states))
    assert set(states["session"].to_pylist()) == {run.session}
    events = read(paths[2])
    assert events["kind"].to_pylist()[0] == "SESSION_START"
    assert read(paths[1]).num_rows == len(run.commands)
    assert read(paths[3]).num_rows == len(run.traffic)


def test_interned_columns_are_exported_as_text(recording: Path) -> None:
    run = open_run(recording)
    states = table(run, run.states)
    assert {str(states.schema.field(name).type) for name in ("session", "held_part")} == {"string"}


def test_documentation_lists_exactly_the_columns(recording: Path, tmp_path: Path) -> None:
    documented: dict[str, set[str]] = {name: set() for name in TABLES}
    for line in PAGE.read_text(encoding="utf-8").split("## Columns of the tables")[1].splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 5 and "`" in cells[1]:
            for name in cells[0].split(", "):
                documented[name] |= set(re.findall(r"`(\w+\*?)`", cells[1]))
    for path in export_tables(open_run(recording), tmp_path / "tables", "csv"):
        columns = set(pyarrow.csv.read_csv(path).column_names)
        assert {re.sub("_(theta1|theta2|d3|theta4)$", "_*", column) for column in columns} == documented[path.stem]


def test_documented_stage_formulas_give_the_stages(recording: Path, tmp_path: Path) -> None:
    run = open_run(recording)
    samples = measure(run).table
    state_path, command_path, *_ = export_tables(run, tmp_path / "tables", "csv")
    states, commands = pyarrow.csv.read_csv(state_path).to_pylist(), pyarrow.csv.read_csv(command_path).to_pylist()
    by_seq = {command["seq"]: command for command in commands}
    effective = [(state, by_seq[state["command_seq"]]) for state in states if state["loop_latency_ns"] > 0]
    assert len(effective) == len(samples) > 50
    by_formula = {
        "loop": [s["loop_latency_ns"] for s, _ in effective],
        "register_wait": [c["state_served_ns"] - c["state_arrived_ns"] - c["state_injected_ns"] for _, c in effective],
        "controller": [c["write_arrived_ns"] - c["state_served_ns"] for _, c in effective],
        "edge": [c["sent_ns"] - c["write_arrived_ns"] - c["command_injected_ns"] for _, c in effective],
        "injected": [c["state_injected_ns"] + c["command_injected_ns"] for _, c in effective],
        "tick_wait": [s["sampled_ns"] - s["command_arrived_ns"] for s, _ in effective],
    }
    for stage, expected in by_formula.items():
        assert [int(value) for value in samples[stage]] == expected, stage


def test_leftover_of_a_killed_export_is_replaced(recording: Path, tmp_path: Path) -> None:
    recovering_path(tmp_path / "fox.mcap").write_bytes(b"incomplete")
    out = export_foxglove(open_run(recording), tmp_path / "fox.mcap")
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


def test_export_on_a_full_disk_leaves_no_file(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append = RecordingWriter._append

    def full(writer: RecordingWriter, data: bytes) -> None:
        if writer.size + len(data) > 200_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(writer, data)

    monkeypatch.setattr(RecordingWriter, "_append", full)
    with pytest.raises(OperationError, match=r"fox\.mcap: can't be written: [Nn]o space"):
        export_foxglove(open_run(recording), tmp_path / "fox.mcap")
    assert list(tmp_path.iterdir()) == []


def test_export_contains_every_message_unchanged(recording: Path, tmp_path: Path) -> None:
    out = export_foxglove(open_run(recording), tmp_path / "fox.mcap")
    topics = ["/state", "/command", "/event", "/traffic"]

    def messages(path: Path) -> list[tuple[str, int, int, int, bytes]]:
        with path.open("rb") as stream:
            return [
                (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
                for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages(topics=topics)
            ]

    assert messages(out) == messages(recording)
    with recording.open("rb") as before, out.open("rb") as after:
        one, two = make_reader(before), make_reader(after)
        assert [item.name for item in one.iter_attachments()] == [item.name for item in two.iter_attachments()]
        copied = [item.metadata for item in two.iter_metadata() if not item.name.endswith(COPY_SUFFIX)]
        assert [item.metadata for item in one.iter_metadata()] == copied


def test_frames_lead_to_the_tool_position(recording: Path, tmp_path: Path) -> None:
    run = open_run(recording)
    out = export_foxglove(run, tmp_path / "fox.mcap")
    poses = {}
    with out.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        frames = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/tf"])]
    assert len(frames) == len(run.states)
    arm = ArmParameters()
    for state, message in zip(run.states, frames, strict=True):
        for transform in message.transforms:
            t, r = transform.translation, transform.rotation
            poses[transform.child_frame_id] = (
                transform.parent_frame_id,
                np.array([t.x, t.y, t.z]),
                np.array([r.x, r.y, r.z, r.w]),
            )
        point, frame = np.zeros(3), "tool"
        while frame != "world":
            frame, translation, rotation = poses[frame]
            point = rotate(rotation, point) + translation
        expected = forward(arm, state["position"].reshape(4, 1))[:3, 0]
        np.testing.assert_allclose(point, expected, atol=1e-9)


def test_export_has_shapes_and_points_of_every_link(recording: Path, tmp_path: Path) -> None:
    run = open_run(recording)
    out = export_foxglove(run, tmp_path / "fox.mcap")
    links = {shape.link for shape in visual_shapes(run.urdf)}
    with out.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages())
        summary = reader.get_summary()
    scene = next(message for _, channel, _, message in found if channel.topic == "/scene")
    assert {entity.frame_id for entity in scene.entities} == links
    clouds = {channel.topic: message for _, channel, _, message in found if channel.topic.startswith("/points/")}
    assert set(clouds) == {f"/points/{link}" for link in links}
    for cloud in clouds.values():
        assert len(cloud.data) % cloud.point_stride == 0
        assert len(cloud.data) > 100 * cloud.point_stride
    logs = [message.message for _, channel, _, message in found if channel.topic == "/log"]
    assert len(logs) == len(run.events)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(found)


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.3, 0.2, 0.1)), ("cylinder", (0.2, 0.2, 0.3)), ("sphere", (0.2, 0.2, 0.2))]
)
def test_points_lie_on_the_surface(kind: str, size: tuple[float, float, float]) -> None:
    center, identity = np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0])
    points = VisualShape("link", kind, size, center, identity, (1, 1, 1, 1)).points() - center
    half = np.array(size) / 2
    np.testing.assert_allclose(np.abs(points).max(axis=0), half, atol=2e-3)
    if kind == "sphere":
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), half[0], atol=2e-3)
    if kind == "box":
        assert np.isclose(np.abs(points), half).any(axis=1).all()


def test_quarter_turn_about_z_swaps_the_sides_of_a_box() -> None:
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    points = VisualShape("link", "box", (0.4, 0.2, 0.1), np.zeros(3), quarter, (1, 1, 1, 1)).points()
    np.testing.assert_allclose(np.abs(points).max(axis=0), [0.1, 0.2, 0.05], atol=1e-12)


def test_recording_without_urdf_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = recordings.record(tmp_path / "run.mcap", recordings.Script(seconds=1))
    run = open_run(path)
    monkeypatch.setattr(type(run), "urdf", "")
    with pytest.raises(InputError, match="no URDF"):
        export_foxglove(run, tmp_path / "fox.mcap")


def test_message_that_cannot_be_decoded_is_damage(tmp_path: Path) -> None:
    made = recordings.make(recordings.Script(seconds=1))
    # Not UTF-8 in a text field.
    made[50:50] = [recordings.TimedMessage("event", made[50].publish_wall_ns, BytesValue(value=b"\xff"))]
    run = open_run(recordings.write(tmp_path / "run.mcap", made))
    with pytest.raises(InputError, match=r"damaged \(a message can't be decoded"):
        export_foxglove(run, tmp_path / "fox.mcap")
    assert list(tmp_path.iterdir()) == [run.path]
    bus, clock = MemoryBus(), SYSTEM_CLOCK
    with pytest.raises(InputError, match="hilrig recover"):
        publish_recording(bus, "lab", Player(run, speed=100.0), clock, threading.Event(), rename="rig9")


def test_command_prints_paths_and_does_not_overwrite(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "fox.mcap"
    answer = hilrig("export", recording, "--foxglove", out, "--csv", tmp_path / "csv")
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout.split() == [str(out), *(str(tmp_path / "csv" / f"{name}.csv") for name in TABLES)]
    again = hilrig("export", recording, "--foxglove", out)
    assert again.returncode == 2
    assert "exists" in again.stderr
    nothing = hilrig("export", recording)
    assert nothing.returncode == 2
    assert "no output given" in nothing.stderr


def test_runs_json_lists_existing_paths(recording: Path) -> None:
    answer = json.loads(hilrig("runs", recording.parent, "--json").stdout)
    assert [Path(run["path"]).exists() for run in answer["runs"]] == [True]
