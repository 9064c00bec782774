"""Exports recordings: MCAP with visualization messages for Foxglove and rerun, tables for pandas and MATLAB."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.csv
import pyarrow.parquet
from google.protobuf.message import Message
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from hilrig_recorder.mcap_format.channels import (
    CHANNEL_OF_TOPIC,
    CHANNELS,
    EVENT_CHANNEL,
    SCHEMAS,
    file_descriptor_set,
)
from hilrig_recorder.mcap_format.new_file import new_file
from hilrig_recorder.mcap_format.records import Message as RecordedMessage
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.export import foxglove_messages as foxglove
from hilrig_replay.export.copying import copy_metadata, own_messages, without_clock_steps
from hilrig_replay.geometry.scene import ArmGeometry, parse_arm
from hilrig_replay.geometry.urdf_geometry import VisualShape, fixed_joints, visual_shapes
from hilrig_replay.io.columns import StringTable
from hilrig_replay.io.frames.tables import TABLES, table
from hilrig_replay.io.output_file import output_file
from hilrig_replay.io.records import Decoder, concatenate_records, enum_name
from hilrig_replay.io.run import BLOCK_ROWS, Run, decoding
from hilrig_replay.io.timebase import Timebase
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.escaping import csv_text
from hilrig_schemas import Event
from hilrig_schemas.topics import STATE

WORLD_FRAME: Final = "world"
_STATIC_PERIOD_STATES: Final = 500
"""Static frames and shapes are repeated after this many states, for players that start in the middle of the file."""

_STATE_CHANNEL: Final = CHANNEL_OF_TOPIC[STATE.name]


def export_tables(run: Run, folder: Path, kind: str) -> list[Path]:
    """Write `state`, `command`, `event` and `traffic` tables as `csv` or `parquet` into a folder.

    Raises:
        InputError: a table would replace the recording.
        OperationError: the folder can't be written.
    """
    paths = {name: folder / f"{name}.{kind}" for name in TABLES}
    empty = concatenate_records([])
    escape = csv_text if kind == "csv" else str
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with ExitStack() as closing:
            writers: dict[str, Any] = {}
            for name, rows_of in TABLES.items():
                schema = table(run, rows_of(empty)).schema
                writer = pyarrow.csv.CSVWriter if kind == "csv" else pyarrow.parquet.ParquetWriter
                temporary = closing.enter_context(output_file(paths[name], run.file.paths))
                writers[name] = closing.enter_context(writer(temporary, schema))
            for block in run.blocks():
                for name, rows_of in TABLES.items():
                    rows = rows_of(block)
                    if len(rows):
                        writers[name].write_table(table(run, rows, escape))
    except FileExistsError as error:
        raise OperationError(f"{folder}: expected a folder, found a file") from error
    except OSError as error:
        raise OperationError(f"{folder}: can't be written: {error.strerror or error}") from error
    return list(paths.values())


# -- MCAP file with visualization messages ---------------------------------------------------------------------------


def export_foxglove(run: Run, path: Path) -> Path:
    """Copy a recording and add visualization messages for Foxglove's 3D panel and rerun's MCAP loader.

    Added are `/tf` (foxglove.FrameTransforms, one per state), `/scene` (foxglove.SceneUpdate: the arm's shapes),
    `/points/<link>` (foxglove.PointCloud: the same shapes as points, for viewers that do not draw shapes) and `/log`
    (foxglove.Log: the events).

    Raises:
        InputError: the recording has no URDF or is damaged, or the file exists.
        OperationError: the file can't be written.
    """
    if not run.urdf:
        raise InputError(f"{run.path}: has no URDF attachment, which is needed to draw the arm")
    arm, shapes = parse_arm(run.urdf), visual_shapes(run.urdf)
    with new_file(path, library="hilrig export") as writer, decoding(run.path):
        visualization = _Visualization(writer, run, arm, shapes)
        visualization.write_channels()
        copy_metadata(run.file, writer)
        messages = own_messages(run.file)
        if run.has_clock_steps:
            # Viewers place messages by their times of arrival.
            messages = (one._replace(log_time=one.publish_time) for one in without_clock_steps(messages))
        while block := list(islice(messages, BLOCK_ROWS)):
            visualization.prepare(message for message in block if message.channel_id == _STATE_CHANNEL)
            for message in block:
                writer.add(encode_message(*message))
                if message.channel_id == _STATE_CHANNEL:
                    visualization.add_state(message.log_time)
                elif message.channel_id == EVENT_CHANNEL:
                    visualization.add_event(message.log_time, Event.FromString(message.data))
        writer.finish()
    return path


class _Visualization:
    """Adds visualization messages while the recorded messages are copied in file order."""

    def __init__(
        self,
        writer: RecordingWriter,
        run: Run,
        arm: ArmGeometry,
        shapes: list[VisualShape],
    ) -> None:
        self._writer = writer
        self._arm = arm
        self._shapes = shapes
        self._types: dict[str, type[Message]] = {
            "/tf": foxglove.FrameTransforms,
            "/scene": foxglove.SceneUpdate,
            "/log": foxglove.Log,
            **{f"/points/{shape.link}": foxglove.PointCloud for shape in shapes},
        }
        self._ids = {topic: len(CHANNELS) + number for number, topic in enumerate(self._types, start=1)}
        self._sequences = dict.fromkeys(self._types, 0)
        self._fixed_joints = fixed_joints(run.urdf)
        self._scene = _scene(shapes)
        self._clouds = list(_clouds(shapes))
        self._state_count = 0
        self._poses: Iterator[Any] = iter(())

    def prepare(self, state_messages: Iterable[RecordedMessage]) -> None:
        """Compute the joint frames of the next states at once."""
        decoder = Decoder(StringTable(), Timebase())
        for _, sequence, log_time, _, payload in state_messages:
            decoder.decoders["state"](payload, sequence, log_time)
        states = decoder.drain().states
        frames = (joint.transforms(states["position"][:, number]) for number, joint in enumerate(self._arm.joints))
        self._poses = zip(states["wall_ns"].tolist(), *(zip(*both, strict=True) for both in frames), strict=True)

    def write_channels(self) -> None:
        """Write the schemas and channels of the added topics."""
        schema_ids: dict[str, int] = {}
        for topic, message in self._types.items():
            name = message.DESCRIPTOR.full_name
            if name not in schema_ids:
                schema_ids[name] = len(SCHEMAS) + len(schema_ids) + 1
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

    def add_state(self, log_ns: int) -> None:
        """Add the messages of the next state."""
        stamp, *poses = next(self._poses)
        message = foxglove.FrameTransforms()
        for joint, (translation, quaternion) in zip(self._arm.joints, poses, strict=True):
            _transform(message, stamp, joint.parent, joint.child, translation, quaternion)
        self._state_count += 1
        if self._state_count % _STATIC_PERIOD_STATES == 1:
            zero_translation, identity = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
            if self._arm.root != WORLD_FRAME:
                _transform(message, stamp, WORLD_FRAME, self._arm.root, zero_translation, identity)
            for parent, child, translation, rotation in self._fixed_joints:
                _transform(message, stamp, parent, child, translation, rotation)
            for entity in self._scene.entities:
                _set_time(entity.timestamp, stamp)
            self._write("/scene", log_ns, stamp, self._scene)
            for cloud in self._clouds:
                _set_time(cloud.timestamp, stamp)
                self._write(f"/points/{cloud.frame_id}", log_ns, stamp, cloud)
        self._write("/tf", log_ns, stamp, message)

    def add_event(self, log_ns: int, event: Event) -> None:
        """Add an event as a log message."""
        level = foxglove.LOG_LEVELS.get(enum_name(Event.Severity, event.severity), 0)
        message = foxglove.Log(level=level, message=event.text, name=event.source)
        _set_time(message.timestamp, event.wall_ns)
        self._write("/log", log_ns, event.wall_ns, message)

    def _write(self, topic: str, log_ns: int, stamp: int, message: Any) -> None:
        self._sequences[topic] += 1
        channel_id = self._ids[topic]
        payload = message.SerializeToString()
        # The time of a sender whose clock is before 1970 is negative; MCAP has no negative times.
        self._writer.add(encode_message(channel_id, self._sequences[topic], log_ns, max(stamp, 0), payload))


def _scene(shapes: list[VisualShape]) -> Any:
    message = foxglove.SceneUpdate()
    for number, shape in enumerate(shapes):
        entity = message.entities.add(frame_id=shape.link, id=f"{shape.link}-{number}", frame_locked=True)
        primitives = {"box": entity.cubes, "cylinder": entity.cylinders, "sphere": entity.spheres}[shape.kind]
        primitive = primitives.add()
        _set(primitive.pose.position, shape.translation)
        _set(primitive.pose.orientation, shape.rotation)
        _set(primitive.size, np.array(shape.size))
        primitive.color.r, primitive.color.g, primitive.color.b, primitive.color.a = shape.color
        if shape.kind == "cylinder":
            primitive.bottom_scale = primitive.top_scale = 1.0
    return message


def _clouds(shapes: list[VisualShape]) -> Iterator[Any]:
    packed = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])
    for link in dict.fromkeys(shape.link for shape in shapes):
        pieces = []
        for shape in shapes:
            if shape.link == link:
                points = shape.points()
                rows = np.empty(len(points), packed)
                rows["xyz"] = points
                rows["rgba"] = np.round(np.array(shape.color) * 255)
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
    _set_time(transform.timestamp, stamp)
    _set(transform.translation, translation)
    _set(transform.rotation, rotation)


def _set_time(timestamp: Any, wall_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(wall_ns, 1_000_000_000)


def _set(vector: Any, values: NDArray[np.float64]) -> None:
    for name, value in zip("xyzw", values.tolist(), strict=False):
        setattr(vector, name, value)
