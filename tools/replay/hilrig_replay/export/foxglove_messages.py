"""Foxglove's message types for the export: those that its 3D panel and rerun's MCAP loader support.

The fields are defined here with Foxglove's documented names and numbers
(https://docs.foxglove.dev/docs/sdk/schemas), so that the export needs no further package.
"""

from typing import Any, Final

from google.protobuf import descriptor_pb2, descriptor_pool, duration_pb2, message_factory, timestamp_pb2

_FIELD: Final = descriptor_pb2.FieldDescriptorProto
_SCALARS: Final = {
    "double": _FIELD.TYPE_DOUBLE,
    "string": _FIELD.TYPE_STRING,
    "bytes": _FIELD.TYPE_BYTES,
    "bool": _FIELD.TYPE_BOOL,
    "fixed32": _FIELD.TYPE_FIXED32,
}
_TIMESTAMP: Final = ".google.protobuf.Timestamp"
_DURATION: Final = ".google.protobuf.Duration"

# Message name: fields as (name, number, type). A type in brackets is repeated; a type with a dot is a message type.
_MESSAGES: Final[dict[str, tuple[tuple[str, int, str], ...]]] = {
    "Vector3": (("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double")),
    "Quaternion": (("x", 1, "double"), ("y", 2, "double"), ("z", 3, "double"), ("w", 4, "double")),
    "Color": (("r", 1, "double"), ("g", 2, "double"), ("b", 3, "double"), ("a", 4, "double")),
    "Pose": (("position", 1, ".foxglove.Vector3"), ("orientation", 2, ".foxglove.Quaternion")),
    "FrameTransform": (
        ("timestamp", 1, _TIMESTAMP),
        ("parent_frame_id", 2, "string"),
        ("child_frame_id", 3, "string"),
        ("translation", 4, ".foxglove.Vector3"),
        ("rotation", 5, ".foxglove.Quaternion"),
    ),
    "FrameTransforms": (("transforms", 1, "[.foxglove.FrameTransform]"),),
    "CubePrimitive": (
        ("pose", 1, ".foxglove.Pose"),
        ("size", 2, ".foxglove.Vector3"),
        ("color", 3, ".foxglove.Color"),
    ),
    "SpherePrimitive": (
        ("pose", 1, ".foxglove.Pose"),
        ("size", 2, ".foxglove.Vector3"),
        ("color", 3, ".foxglove.Color"),
    ),
    "CylinderPrimitive": (
        ("pose", 1, ".foxglove.Pose"),
        ("size", 2, ".foxglove.Vector3"),
        ("bottom_scale", 3, "double"),
        ("top_scale", 4, "double"),
        ("color", 5, ".foxglove.Color"),
    ),
    "SceneEntity": (
        ("timestamp", 1, _TIMESTAMP),
        ("frame_id", 2, "string"),
        ("id", 3, "string"),
        ("lifetime", 4, _DURATION),
        ("frame_locked", 5, "bool"),
        ("cubes", 8, "[.foxglove.CubePrimitive]"),
        ("spheres", 9, "[.foxglove.SpherePrimitive]"),
        ("cylinders", 10, "[.foxglove.CylinderPrimitive]"),
    ),
    "SceneUpdate": (("entities", 2, "[.foxglove.SceneEntity]"),),
    "PackedElementField": (("name", 1, "string"), ("offset", 2, "fixed32"), ("type", 3, "enum")),
    "PointCloud": (
        ("timestamp", 1, _TIMESTAMP),
        ("frame_id", 2, "string"),
        ("pose", 3, ".foxglove.Pose"),
        ("point_stride", 4, "fixed32"),
        ("fields", 5, "[.foxglove.PackedElementField]"),
        ("data", 6, "bytes"),
    ),
    "Log": (
        ("timestamp", 1, _TIMESTAMP),
        ("level", 2, "enum"),
        ("message", 3, "string"),
        ("name", 4, "string"),
    ),
}
_ENUMS: Final = {
    "PackedElementField": (
        "NumericType",
        ("UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"),
    ),
    "Log": ("Level", ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")),
}


def _file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/hilrig_export.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto", "google/protobuf/duration.proto"],
    )
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        if name in _ENUMS:
            enum_name, values = _ENUMS[name]
            enum = message.enum_type.add(name=enum_name)
            for number, value in enumerate(values):
                enum.value.add(name=value, number=number)
        for field_name, number, type_text in fields:
            repeated, kind = type_text.startswith("["), type_text.strip("[]")
            label = _FIELD.LABEL_REPEATED if repeated else _FIELD.LABEL_OPTIONAL
            field = message.field.add(name=field_name, number=number, label=label)
            if kind == "enum":
                field.type, field.type_name = _FIELD.TYPE_ENUM, f".foxglove.{name}.{_ENUMS[name][0]}"
            elif kind.startswith("."):
                field.type, field.type_name = _FIELD.TYPE_MESSAGE, kind
            else:
                field.type = _SCALARS[kind]
    return file


def _classes() -> dict[str, type[Any]]:
    # A separate pool: in a program that also uses Foxglove's package, the default pool would have two definitions.
    pool = descriptor_pool.DescriptorPool()
    for known in (timestamp_pb2, duration_pb2):
        pool.AddSerializedFile(known.DESCRIPTOR.serialized_pb)
    pool.Add(_file_descriptor())
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}")) for name in _MESSAGES}


_CLASS: Final = _classes()
FrameTransforms: Final[type[Any]] = _CLASS["FrameTransforms"]
SceneUpdate: Final[type[Any]] = _CLASS["SceneUpdate"]
PointCloud: Final[type[Any]] = _CLASS["PointCloud"]
Log: Final[type[Any]] = _CLASS["Log"]
LOG_LEVELS: Final = {"INFO": 2, "WARNING": 3, "ERROR": 4}
FLOAT32: Final = 7
UINT8: Final = 1
