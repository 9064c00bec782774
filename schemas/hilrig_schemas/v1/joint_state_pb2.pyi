from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class JointState(_message.Message):
    __slots__ = ("rig", "session", "incarnation", "step", "sampled_ns", "wall_ns", "lateness_ns", "missed_steps", "position", "velocity", "effort", "external_force_z", "external_torque_z", "integration_error", "magnet", "held_part", "parts", "limit_flags", "command_seq", "safe", "basis_step", "command_arrived_ns", "loop_latency_ns", "substeps", "run_delay_ns")
    RIG_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    SAMPLED_NS_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    LATENESS_NS_FIELD_NUMBER: _ClassVar[int]
    MISSED_STEPS_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    VELOCITY_FIELD_NUMBER: _ClassVar[int]
    EFFORT_FIELD_NUMBER: _ClassVar[int]
    EXTERNAL_FORCE_Z_FIELD_NUMBER: _ClassVar[int]
    EXTERNAL_TORQUE_Z_FIELD_NUMBER: _ClassVar[int]
    INTEGRATION_ERROR_FIELD_NUMBER: _ClassVar[int]
    MAGNET_FIELD_NUMBER: _ClassVar[int]
    HELD_PART_FIELD_NUMBER: _ClassVar[int]
    PARTS_FIELD_NUMBER: _ClassVar[int]
    LIMIT_FLAGS_FIELD_NUMBER: _ClassVar[int]
    COMMAND_SEQ_FIELD_NUMBER: _ClassVar[int]
    SAFE_FIELD_NUMBER: _ClassVar[int]
    BASIS_STEP_FIELD_NUMBER: _ClassVar[int]
    COMMAND_ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    LOOP_LATENCY_NS_FIELD_NUMBER: _ClassVar[int]
    SUBSTEPS_FIELD_NUMBER: _ClassVar[int]
    RUN_DELAY_NS_FIELD_NUMBER: _ClassVar[int]
    rig: str
    session: str
    incarnation: int
    step: int
    sampled_ns: int
    wall_ns: int
    lateness_ns: int
    missed_steps: int
    position: _containers.RepeatedScalarFieldContainer[float]
    velocity: _containers.RepeatedScalarFieldContainer[float]
    effort: _containers.RepeatedScalarFieldContainer[float]
    external_force_z: float
    external_torque_z: float
    integration_error: _containers.RepeatedScalarFieldContainer[float]
    magnet: bool
    held_part: str
    parts: _containers.RepeatedCompositeFieldContainer[PartState]
    limit_flags: int
    command_seq: int
    safe: bool
    basis_step: int
    command_arrived_ns: int
    loop_latency_ns: int
    substeps: int
    run_delay_ns: int
    def __init__(self, rig: _Optional[str] = ..., session: _Optional[str] = ..., incarnation: _Optional[int] = ..., step: _Optional[int] = ..., sampled_ns: _Optional[int] = ..., wall_ns: _Optional[int] = ..., lateness_ns: _Optional[int] = ..., missed_steps: _Optional[int] = ..., position: _Optional[_Iterable[float]] = ..., velocity: _Optional[_Iterable[float]] = ..., effort: _Optional[_Iterable[float]] = ..., external_force_z: _Optional[float] = ..., external_torque_z: _Optional[float] = ..., integration_error: _Optional[_Iterable[float]] = ..., magnet: _Optional[bool] = ..., held_part: _Optional[str] = ..., parts: _Optional[_Iterable[_Union[PartState, _Mapping]]] = ..., limit_flags: _Optional[int] = ..., command_seq: _Optional[int] = ..., safe: _Optional[bool] = ..., basis_step: _Optional[int] = ..., command_arrived_ns: _Optional[int] = ..., loop_latency_ns: _Optional[int] = ..., substeps: _Optional[int] = ..., run_delay_ns: _Optional[int] = ...) -> None: ...

class PartState(_message.Message):
    __slots__ = ("name", "x", "y", "z", "yaw", "vx", "vy", "vz")
    NAME_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    VZ_FIELD_NUMBER: _ClassVar[int]
    name: str
    x: float
    y: float
    z: float
    yaw: float
    vx: float
    vy: float
    vz: float
    def __init__(self, name: _Optional[str] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., yaw: _Optional[float] = ..., vx: _Optional[float] = ..., vy: _Optional[float] = ..., vz: _Optional[float] = ...) -> None: ...
