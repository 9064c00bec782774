from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class TorqueCommand(_message.Message):
    __slots__ = ("rig", "session", "seq", "effort", "magnet", "controller", "safe", "echo", "resets", "basis_incarnation", "basis_step", "state_arrived_ns", "state_served_ns", "write_arrived_ns", "sent_ns", "state_injected_ns", "command_injected_ns", "wall_ns", "write_received_ns", "basis_on_other_connection", "positions_acknowledged_ns", "read_sent_ns", "stale_read_sent_ns", "basis_is_bound")
    RIG_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    SEQ_FIELD_NUMBER: _ClassVar[int]
    EFFORT_FIELD_NUMBER: _ClassVar[int]
    MAGNET_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    SAFE_FIELD_NUMBER: _ClassVar[int]
    ECHO_FIELD_NUMBER: _ClassVar[int]
    RESETS_FIELD_NUMBER: _ClassVar[int]
    BASIS_INCARNATION_FIELD_NUMBER: _ClassVar[int]
    BASIS_STEP_FIELD_NUMBER: _ClassVar[int]
    STATE_ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_SERVED_NS_FIELD_NUMBER: _ClassVar[int]
    WRITE_ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    SENT_NS_FIELD_NUMBER: _ClassVar[int]
    STATE_INJECTED_NS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_INJECTED_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    WRITE_RECEIVED_NS_FIELD_NUMBER: _ClassVar[int]
    BASIS_ON_OTHER_CONNECTION_FIELD_NUMBER: _ClassVar[int]
    POSITIONS_ACKNOWLEDGED_NS_FIELD_NUMBER: _ClassVar[int]
    READ_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    STALE_READ_SENT_NS_FIELD_NUMBER: _ClassVar[int]
    BASIS_IS_BOUND_FIELD_NUMBER: _ClassVar[int]
    rig: str
    session: str
    seq: int
    effort: _containers.RepeatedScalarFieldContainer[float]
    magnet: bool
    controller: str
    safe: bool
    echo: int
    resets: int
    basis_incarnation: int
    basis_step: int
    state_arrived_ns: int
    state_served_ns: int
    write_arrived_ns: int
    sent_ns: int
    state_injected_ns: int
    command_injected_ns: int
    wall_ns: int
    write_received_ns: int
    basis_on_other_connection: bool
    positions_acknowledged_ns: int
    read_sent_ns: int
    stale_read_sent_ns: int
    basis_is_bound: bool
    def __init__(self, rig: _Optional[str] = ..., session: _Optional[str] = ..., seq: _Optional[int] = ..., effort: _Optional[_Iterable[float]] = ..., magnet: _Optional[bool] = ..., controller: _Optional[str] = ..., safe: _Optional[bool] = ..., echo: _Optional[int] = ..., resets: _Optional[int] = ..., basis_incarnation: _Optional[int] = ..., basis_step: _Optional[int] = ..., state_arrived_ns: _Optional[int] = ..., state_served_ns: _Optional[int] = ..., write_arrived_ns: _Optional[int] = ..., sent_ns: _Optional[int] = ..., state_injected_ns: _Optional[int] = ..., command_injected_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., write_received_ns: _Optional[int] = ..., basis_on_other_connection: _Optional[bool] = ..., positions_acknowledged_ns: _Optional[int] = ..., read_sent_ns: _Optional[int] = ..., stale_read_sent_ns: _Optional[int] = ..., basis_is_bound: _Optional[bool] = ...) -> None: ...
