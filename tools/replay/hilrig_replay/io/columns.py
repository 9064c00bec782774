"""Row types of a recording, and functions that decode messages in bulk to numpy structured arrays.

Each row type is declared once, as a numpy dtype. Its layout is the same for `struct`, which packs the fields of a
message into a buffer in one call, and for numpy, which reads the buffer as an array without a copy.

Repeated doubles are slow to read from a protobuf message in Python. A packed `repeated double` is encoded as a length
and the bytes of the numbers, exactly like a `bytes` field. Messages are therefore parsed with a variant of their type
in which these fields are `bytes`, and the bytes are copied to the row unchanged.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from hilrig_schemas import JointState, TorqueCommand

Rows: TypeAlias = NDArray[np.void]
"""A structured array: one row per message, fields by name."""

JointValues: TypeAlias = tuple[float, float, float, float]
"""One number a joint."""

_STRUCT_CODES: Final = {
    "<i8": "q",
    "<u8": "Q",
    "<f8": "d",
    "<u4": "I",
    "<u2": "H",
    "|u1": "B",
    "|b1": "?",
}
_VECTOR: Final = ("<f8", (4,))

STATE_DTYPE: Final = np.dtype(
    [
        ("step", "<u8"),
        ("incarnation", "<u8"),
        ("sampled_ns", "<i8"),
        ("wall_ns", "<i8"),
        ("lateness_ns", "<i8"),
        ("position", *_VECTOR),
        ("velocity", *_VECTOR),
        ("effort", *_VECTOR),
        ("integration_error", *_VECTOR),
        ("external_force_z", "<f8"),
        ("external_torque_z", "<f8"),
        ("command_seq", "<u8"),
        ("basis_step", "<u8"),
        ("command_arrived_ns", "<i8"),
        ("loop_latency_ns", "<i8"),
        ("log_ns", "<i8"),
        ("missed_steps", "<u4"),
        ("sequence", "<u4"),
        ("limit_flags", "<u2"),
        ("substeps", "<u2"),
        ("session", "<u2"),
        ("held_part", "<u2"),
        ("magnet", "|b1"),
        ("safe", "|b1"),
    ]
)
"""One row per `JointState`, units as in joint_state.proto. `sequence`: sequence number of the sender; `log_ns`: arrival
at the recorder (wall clock); `session` and `held_part`: codes of a `StringTable`."""

COMMAND_DTYPE: Final = np.dtype(
    [
        ("seq", "<u8"),
        ("wall_ns", "<i8"),
        ("effort", *_VECTOR),
        ("basis_incarnation", "<u8"),
        ("basis_step", "<u8"),
        ("state_arrived_ns", "<i8"),
        ("state_served_ns", "<i8"),
        ("write_arrived_ns", "<i8"),
        ("write_received_ns", "<i8"),
        ("sent_ns", "<i8"),
        ("state_injected_ns", "<i8"),
        ("command_injected_ns", "<i8"),
        ("positions_acknowledged_ns", "<i8"),
        ("read_sent_ns", "<i8"),
        ("stale_read_sent_ns", "<i8"),
        ("log_ns", "<i8"),
        ("sequence", "<u4"),
        ("resets", "<u4"),
        ("echo", "<u2"),
        ("session", "<u2"),
        ("controller", "<u2"),
        ("magnet", "|b1"),
        ("safe", "|b1"),
        ("basis_on_other_connection", "|b1"),
        ("basis_is_bound", "|b1"),
    ]
)
"""One row per `TorqueCommand`, units as in torque_command.proto; `session` and `controller` are codes of a
`StringTable`. `write_received_ns`: `write_arrived_ns` if the kernel's timestamp is unavailable."""

TRAFFIC_DTYPE: Final = np.dtype(
    [
        ("wall_ns", "<i8"),
        ("arrived_ns", "<i8"),
        ("answered_ns", "<i8"),
        ("address", "<u2"),
        ("count", "<u2"),
        ("controller", "<u2"),
        ("function", "|u1"),
        ("exception", "|u1"),
    ]
)
"""One row per Modbus request, units as in modbus_traffic.proto; `wall_ns` is `arrived_ns` on the wall clock."""

CONNECTION_DTYPE: Final = np.dtype(
    [("wall_ns", "<i8"), ("min_rtt_us", "<u4"), ("retransmissions", "<u4"), ("controller", "<u2")]
)
"""One row per `ModbusConnection`, units as in modbus_traffic.proto; `wall_ns`: time of its batch."""

PART_DTYPE: Final = np.dtype(
    [
        ("step", "<u8"),
        ("wall_ns", "<i8"),
        ("x", "<f8"),
        ("y", "<f8"),
        ("z", "<f8"),
        ("yaw", "<f8"),
        ("vx", "<f8"),
        ("vy", "<f8"),
        ("vz", "<f8"),
        ("part", "<u2"),
        ("held", "|b1"),
    ]
)
"""One row per `PartState` in a state: center (world, m), yaw (rad) and velocity (m/s) of the part; `part` is a code of
a `StringTable`."""


class StringTable:
    """String interning table: maps repeated texts of a recording to 16-bit codes; code 0 is the empty text.

    The number of codes is bounded, because a controller that reconnects for each request has a different address each
    time. When the codes are used up, further texts share the last code.
    """

    MAX_STRINGS: Final = 1 << 16
    OVERFLOW_TEXT: Final = "others"

    def __init__(self) -> None:
        self._texts: list[str] = [""]
        self.code: Final = _Codes(self._texts).__getitem__
        """Code of a text; a new text gets the next code, or the shared last code if none is left."""

    def __getitem__(self, code: int) -> str:
        return self._texts[code]

    def texts(self, codes: NDArray[np.integer]) -> NDArray[np.object_]:
        """Texts for an array of codes, same shape, as Python strings."""
        texts: NDArray[np.object_] = np.array(self._texts, dtype=object)
        return np.asarray(texts[codes])


class _Codes(dict[str, int]):
    """Codes of the texts in a list, to which a new text is appended; without a Python call for a known text."""

    def __init__(self, texts: list[str]) -> None:
        super().__init__({text: code for code, text in enumerate(texts)})
        self._texts = texts

    def __missing__(self, text: str) -> int:
        code = len(self._texts)
        if code == StringTable.MAX_STRINGS:
            return code - 1
        self[text] = code
        self._texts.append(text if code < StringTable.MAX_STRINGS - 1 else StringTable.OVERFLOW_TEXT)
        return code


class RowBuffer:
    """Rows of a type: each is packed when it is added, and `drain` reads all of them as an array without a copy."""

    def __init__(self, dtype: np.dtype[np.void]) -> None:
        self._dtype = dtype
        self._rows: list[bytes] = []
        self.pack: Final = struct.Struct("<" + "".join(_code(dtype[name]) for name in dtype.names or ())).pack
        """Packs the fields of a row in order, a vector as bytes."""
        self.add: Final = self._rows.append
        """Adds a packed row."""
        self.extend: Final = self._rows.extend
        """Adds packed rows."""

    def drain(self) -> Rows:
        """Return the rows, shape (number of rows,), and empty the buffer."""
        rows = np.frombuffer(bytearray().join(self._rows), self._dtype)
        self._rows.clear()
        return rows


def _code(dtype: np.dtype[Any]) -> str:
    return f"{dtype.itemsize}s" if dtype.subdtype else _STRUCT_CODES[dtype.str]


def _bulk_view(message: type[Message]) -> type[Any]:
    """Variant of a message type with each `repeated double` as `bytes`: same encoding, faster to parse."""
    described = descriptor_pb2.FileDescriptorProto()
    message.DESCRIPTOR.file.CopyToProto(described)
    package = described.package
    described.package = f"{package}.bulk"
    for part in described.message_type:
        for field in part.field:
            if field.HasField("type_name"):
                field.type_name = field.type_name.replace(f".{package}.", f".{described.package}.")
            if field.type == field.TYPE_DOUBLE and field.label == field.LABEL_REPEATED:
                field.type, field.label = field.TYPE_BYTES, field.LABEL_OPTIONAL
    pool = descriptor_pool.DescriptorPool()
    pool.Add(described)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{described.package}.{message.DESCRIPTOR.name}"))


_StateView: Final = _bulk_view(JointState)
_CommandView: Final = _bulk_view(TorqueCommand)
_NO_VECTOR: Final = bytes(32)

DecodeFunction = Callable[[bytes, int, int], None]
"""Adds one message to its buffer: payload, sequence number of the sender, arrival at the recorder (ns, wall clock)."""


def state_decoder(states: RowBuffer, parts: RowBuffer, names: StringTable) -> DecodeFunction:
    """Return a function that adds `JointState` messages to `states` and the parts in them to `parts`."""
    message = _StateView()
    parse, code, add, pack = message.ParseFromString, names.code, states.add, states.pack

    def decode(payload: bytes, sequence: int, log_ns: int) -> None:
        parse(payload)
        held_part = message.held_part
        position, velocity, effort = message.position, message.velocity, message.effort
        if not len(position) == len(velocity) == len(effort) == len(_NO_VECTOR):
            position, velocity, effort = map(_vector, (position, velocity, effort))
        add(
            pack(
                message.step,
                message.incarnation,
                message.sampled_ns,
                message.wall_ns,
                message.lateness_ns,
                position,
                velocity,
                effort,
                message.integration_error or _NO_VECTOR,
                message.external_force_z,
                message.external_torque_z,
                message.command_seq,
                message.basis_step,
                message.command_arrived_ns,
                message.loop_latency_ns,
                log_ns,
                message.missed_steps,
                sequence,
                message.limit_flags,
                message.substeps,
                code(message.session),
                code(held_part) if held_part else 0,
                message.magnet,
                message.safe,
            )
        )
        for part in message.parts:
            parts.add(
                parts.pack(
                    message.step,
                    message.wall_ns,
                    part.x,
                    part.y,
                    part.z,
                    part.yaw,
                    part.vx,
                    part.vy,
                    part.vz,
                    code(part.name),
                    part.name == held_part,
                )
            )

    return decode


def command_decoder(commands: RowBuffer, names: StringTable) -> DecodeFunction:
    """Return a function that adds `TorqueCommand` messages to `commands`."""
    message = _CommandView()
    parse, code, add, pack = message.ParseFromString, names.code, commands.add, commands.pack

    def decode(payload: bytes, sequence: int, log_ns: int) -> None:
        parse(payload)
        effort, write_arrived_ns = message.effort, message.write_arrived_ns
        add(
            pack(
                message.seq,
                message.wall_ns,
                effort if len(effort) == len(_NO_VECTOR) else _vector(effort),
                message.basis_incarnation,
                message.basis_step,
                message.state_arrived_ns,
                message.state_served_ns,
                write_arrived_ns,
                message.write_received_ns or write_arrived_ns,
                message.sent_ns,
                message.state_injected_ns,
                message.command_injected_ns,
                message.positions_acknowledged_ns,
                message.read_sent_ns,
                message.stale_read_sent_ns,
                log_ns,
                sequence,
                message.resets,
                message.echo & 0xFFFF,
                code(message.session),
                code(message.controller),
                message.magnet,
                message.safe,
                message.basis_on_other_connection,
                message.basis_is_bound,
            )
        )

    return decode


def _vector(packed: bytes) -> bytes:
    if len(packed) == 32:
        return packed
    if not packed:
        # The sender did not set the vector.
        return _NO_VECTOR
    raise DecodeError(f"expected a vector of 4 numbers, got {len(packed) // 8}")


def concatenate_rows(pieces: Sequence[Rows], dtype: np.dtype[np.void]) -> Rows:
    """Concatenate arrays; shape (sum of their lengths,)."""
    return np.concatenate(pieces) if pieces else np.empty(0, dtype)


def written(commands: Rows) -> Rows:
    """Commands that a controller wrote after it had been served a state, of commands with `COMMAND_DTYPE`."""
    kept = (commands["basis_step"] > 0) & ~commands["safe"] & (commands["write_arrived_ns"] > 0)
    return np.asarray(commands[kept])


def last_of_each_read(commands: Rows) -> Rows:
    """The last write after each read, of commands with `COMMAND_DTYPE`: a program may write register by register."""
    commands = written(commands)
    if not len(commands):
        return commands
    return np.asarray(commands[np.append(np.diff(commands["state_served_ns"]) != 0, True)])


def joint_values(values: NDArray[np.float64]) -> JointValues:
    """Return an array of shape (4,) as numbers of Python."""
    theta1, theta2, d3, theta4 = values.tolist()
    return theta1, theta2, d3, theta4
