"""A recording for other tools: an MCAP that draws itself in Foxglove and rerun, tables for pandas and MATLAB."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from google.protobuf.message import Message
from mcap.reader import SeekingReader
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hilrig_recorder.mcap_format.channels import encode_message, file_descriptor_set
from hilrig_recorder.mcap_format.writer import RunWriter
from hilrig_replay.export import foxglove_messages as foxglove
from hilrig_replay.export.urdf_geometry import Solid, fixed_joints, solids_of
from hilrig_replay.io.columns import Rows, StringTable
from hilrig_replay.io.recording_file import RawMessage
from hilrig_replay.io.records import Decoder, Records, concatenate_records, enum_name
from hilrig_replay.io.run import ALL_TOPICS, BLOCK_ROWS, Run
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.rerun_view.scene import ArmPicture, read_arm
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas import Event

WORLD: Final = "world"
_STILL_PERIOD: Final = 500
"""What does not move is said again every so many states, for players that start in the middle."""
_VECTOR_NAMES: Final = ("theta1", "theta2", "d3", "theta4")

TABLES: Final[dict[str, Callable[[Records], Rows]]] = {
    "state": lambda records: records.states,
    "command": lambda records: records.commands,
    "event": lambda records: records.events,
    "traffic": lambda records: records.traffic,
}
"""Tables of a recording, by name."""
_TEXT_CODES: Final = frozenset({"session", "held_part", "controller", "part"})


# -- tables ---------------------------------------------------------------------------------------------------------
DRAFT_SUFFIX: Final = ".exporting"
"""What an export is called until it is whole."""


def table(run: Run, rows: Rows) -> pa.Table:
    """Rows of one of `TABLES` with a column a number: SI units as in the schemas, `time_s` from the run's first state.

    A joint vector becomes four columns, named after the joints.
    """
    columns: dict[str, Any] = {"time_s": run.time_s(rows)}
    for field in rows.dtype.names or ():
        values = rows[field]
        if field == "message":
            continue
        if field in _TEXT_CODES:
            columns[field] = pa.array(run.names.texts(values).tolist(), pa.string())
        elif values.ndim == 2:
            for number, joint in enumerate(_VECTOR_NAMES):
                columns[f"{field}_{joint}"] = np.ascontiguousarray(values[:, number])
        elif values.dtype == object:
            columns[field] = pa.array(values.tolist(), pa.string())
        else:
            columns[field] = np.ascontiguousarray(values)
    return pa.table(columns)


def export_tables(run: Run, folder: Path, kind: str) -> list[Path]:
    """Write `state`, `command`, `event` and `traffic` tables as `csv` or `parquet` into a folder.

    Raises:
        OperationError: the folder can't be written.
    """
    paths = {name: folder / f"{name}.{kind}" for name in TABLES}
    nothing = concatenate_records([])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as closing:
            writers: dict[str, Any] = {}
            for name, rows_of in TABLES.items():
                schema = table(run, rows_of(nothing)).schema
                to = pyarrow.csv.CSVWriter if kind == "csv" else pyarrow.parquet.ParquetWriter
                writers[name] = closing.enter_context(to(paths[name], schema))
            for block in run.blocks():
                for name, rows_of in TABLES.items():
                    rows = rows_of(block)
                    if len(rows):
                        writers[name].write_table(table(run, rows))
    except OSError as error:
        raise OperationError(f"{folder}: can't be written: {error.strerror or error}") from error
    return list(paths.values())


# -- a file that draws itself ---------------------------------------------------------------------------------------


def export_foxglove(run: Run, path: Path) -> Path:
    """Copy a recording, message by message, and add what Foxglove's 3D panel and rerun's MCAP loader draw.

    `/tf` (foxglove.FrameTransforms, one a state), `/scene` (foxglove.SceneUpdate: the arm's solids), `/points/<link>`
    (foxglove.PointCloud: the same as points, for viewers that draw no solids) and `/log` (foxglove.Log: the events).

    Raises:
        InputError: the recording has no URDF, or the file exists.
        OperationError: the file can't be written.
    """
    if not run.urdf:
        raise InputError(f"{run.path}: has no URDF attached: without it there is no arm to draw")
    if path.exists():
        raise InputError(f"{path}: exists; choose another name")
    arm, solids = read_arm(run.urdf), solids_of(run.urdf)
    draft = path.with_name(path.name + DRAFT_SUFFIX)
    try:
        # Left by an export that was killed.
        draft.unlink(missing_ok=True)
        with run.path.open("rb") as stream:
            reader = SeekingReader(stream)
            summary = reader.get_summary()
            if summary is None:
                raise InputError(f"{run.path}: has no index; `hilrig recover` makes one")
            writer = RunWriter(path, part=draft, schemas=(), channels=(), library="hilrig export")
            try:
                drawing = _Drawing(writer, run, arm, solids, max(summary.schemas, default=0), max(summary.channels))
                for schema in summary.schemas.values():
                    writer.add_schema(schema)
                for channel in summary.channels.values():
                    writer.add_channel(channel)
                drawing.declare()
                for record in reader.iter_metadata():
                    writer.add_metadata(record.name, record.metadata)
                for item in reader.iter_attachments():
                    writer.add_attachment(
                        item.name, item.media_type, item.data, log_time=item.log_time, create_time=item.create_time
                    )
                _copy(run, writer, drawing, {channel.topic: channel.id for channel in summary.channels.values()})
                writer.finish()
                if writer.given_up:
                    raise OperationError(f"{path}: can't be written: no space is left for it")
                writer.publish()
            except BaseException:
                writer.discard()
                raise
    except OSError as error:
        raise OperationError(f"{path}: can't be written: {error.strerror or error}") from error
    return path


def _copy(run: Run, writer: RunWriter, drawing: "_Drawing", channel_ids: dict[str, int]) -> None:
    messages = run.file.messages(ALL_TOPICS)
    while block := list(islice(messages, BLOCK_ROWS)):
        drawing.expect(block)
        for topic, sequence, log_ns, publish_ns, payload in block:
            channel_id = channel_ids[f"/{topic}"]
            writer.add(encode_message(channel_id, sequence, log_ns, publish_ns, payload))
            if topic == "state":
                drawing.state(log_ns)
            elif topic == "event":
                drawing.event(log_ns, Event.FromString(payload))


class _Drawing:
    """What is added to the messages, as they go by in the order of the file."""

    def __init__(
        self, writer: RunWriter, run: Run, arm: ArmPicture, solids: list[Solid], last_schema: int, last_channel: int
    ) -> None:
        self._writer = writer
        self._arm = arm
        self._solids = solids
        self._types: dict[str, type[Message]] = {
            "/tf": foxglove.FrameTransforms,
            "/scene": foxglove.SceneUpdate,
            "/log": foxglove.Log,
            **{f"/points/{solid.link}": foxglove.PointCloud for solid in solids},
        }
        self._last_schema = last_schema
        self._ids = {topic: last_channel + number for number, topic in enumerate(self._types, start=1)}
        self._sequences = dict.fromkeys(self._types, 0)
        self._still = fixed_joints(run.urdf)
        self._scene = _scene(solids)
        self._clouds = list(_clouds(solids))
        self._drawn = 0
        self._moved: Iterator[Any] = iter(())

    def expect(self, messages: Iterable[RawMessage]) -> None:
        """Find how the arm stands in each of the states that come next."""
        decoder = Decoder(StringTable(), Timebase())
        for topic, sequence, log_ns, _, payload in messages:
            if topic == "state":
                decoder.add(topic, payload, sequence, log_ns)
        states = decoder.drain().states
        frames = (joint.transforms(states["position"][:, number]) for number, joint in enumerate(self._arm.joints))
        self._moved = zip(states["wall_ns"].tolist(), *(zip(*both, strict=True) for both in frames), strict=True)

    def declare(self) -> None:
        """Write the schemas and channels."""
        schema_ids: dict[str, int] = {}
        for topic, message in self._types.items():
            name = message.DESCRIPTOR.full_name
            if name not in schema_ids:
                schema_ids[name] = self._last_schema + len(schema_ids) + 1
                schema = Schema(schema_ids[name], file_descriptor_set(message), "protobuf", name)
                self._writer.add_schema(schema)
            self._writer.add_channel(
                Channel(
                    id=self._ids[topic],
                    topic=topic,
                    message_encoding="protobuf",
                    metadata={},
                    schema_id=schema_ids[name],
                )
            )

    def state(self, log_ns: int) -> None:
        """Draw the next state."""
        stamp, *moved = next(self._moved)
        message = foxglove.FrameTransforms()
        for joint, (translation, quaternion) in zip(self._arm.joints, moved, strict=True):
            _transform(message, stamp, joint.parent, joint.child, translation, quaternion)
        self._drawn += 1
        if self._drawn % _STILL_PERIOD == 1:
            nowhere, unturned = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
            if self._arm.root != WORLD:
                _transform(message, stamp, WORLD, self._arm.root, nowhere, unturned)
            for parent, child, translation, rotation in self._still:
                _transform(message, stamp, parent, child, translation, rotation)
            for entity in self._scene.entities:
                _stamp(entity.timestamp, stamp)
            self._put("/scene", log_ns, stamp, self._scene)
            for cloud in self._clouds:
                _stamp(cloud.timestamp, stamp)
                self._put(f"/points/{cloud.frame_id}", log_ns, stamp, cloud)
        self._put("/tf", log_ns, stamp, message)

    def event(self, log_ns: int, event: Event) -> None:
        """Tell an event."""
        level = foxglove.LOG_LEVELS.get(enum_name(Event.Severity, event.severity), 0)
        message = foxglove.Log(level=level, message=event.text, name=event.source)
        _stamp(message.timestamp, event.wall_ns)
        self._put("/log", log_ns, event.wall_ns, message)

    def _put(self, topic: str, log_ns: int, stamp: int, message: Any) -> None:
        self._sequences[topic] += 1
        channel_id = self._ids[topic]
        payload = message.SerializeToString()
        self._writer.add(encode_message(channel_id, self._sequences[topic], log_ns, stamp, payload))


def _scene(solids: list[Solid]) -> Any:
    message = foxglove.SceneUpdate()
    for number, solid in enumerate(solids):
        entity = message.entities.add(frame_id=solid.link, id=f"{solid.link}-{number}", frame_locked=True)
        shapes = {"box": entity.cubes, "cylinder": entity.cylinders, "sphere": entity.spheres}[solid.kind]
        shape = shapes.add()
        _set(shape.pose.position, solid.translation)
        _set(shape.pose.orientation, solid.rotation)
        _set(shape.size, np.array(solid.size))
        shape.color.r, shape.color.g, shape.color.b, shape.color.a = solid.color
        if solid.kind == "cylinder":
            shape.bottom_scale = shape.top_scale = 1.0
    return message


def _clouds(solids: list[Solid]) -> Iterator[Any]:
    packed = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])
    for link in dict.fromkeys(solid.link for solid in solids):
        pieces = []
        for solid in solids:
            if solid.link == link:
                points = solid.points()
                rows = np.empty(len(points), packed)
                rows["xyz"] = points
                rows["rgba"] = np.round(np.array(solid.color) * 255)
                pieces.append(rows)
        message = foxglove.PointCloud(
            frame_id=link, point_stride=packed.itemsize, data=np.concatenate(pieces).tobytes()
        )
        message.pose.orientation.w = 1.0
        for number, name in enumerate(("x", "y", "z")):
            message.fields.add(name=name, offset=4 * number, type=foxglove.FLOAT32)
        for number, name in enumerate(("red", "green", "blue", "alpha")):
            message.fields.add(name=name, offset=12 + number, type=foxglove.UINT8)
        yield message


def _transform(
    message: Any, stamp: int, parent: str, child: str, translation: NDArray[np.float64], rotation: NDArray[np.float64]
) -> None:
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    _stamp(transform.timestamp, stamp)
    _set(transform.translation, translation)
    _set(transform.rotation, rotation)


def _stamp(timestamp: Any, wall_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(wall_ns, 1_000_000_000)


def _set(vector: Any, values: NDArray[np.float64]) -> None:
    for name, value in zip("xyzw", values.tolist(), strict=False):
        setattr(vector, name, value)
