from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Event(_message.Message):
    __slots__ = ("rig", "session", "kind", "severity", "text", "wall_ns", "source", "step", "session_data", "controller_data", "watchdog_data", "limit_data", "part_data", "overrun_data", "configuration_data", "integration_data")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        KIND_UNSPECIFIED: _ClassVar[Event.Kind]
        SESSION_START: _ClassVar[Event.Kind]
        SESSION_END: _ClassVar[Event.Kind]
        LEASE_GRANTED: _ClassVar[Event.Kind]
        LEASE_REFUSED: _ClassVar[Event.Kind]
        LEASE_LOST: _ClassVar[Event.Kind]
        WATCHDOG_TRIP: _ClassVar[Event.Kind]
        WATCHDOG_REARM: _ClassVar[Event.Kind]
        LIMIT_HIT: _ClassVar[Event.Kind]
        PART_PICKED: _ClassVar[Event.Kind]
        PART_DROPPED: _ClassVar[Event.Kind]
        OVERRUN: _ClassVar[Event.Kind]
        IMPAIRMENT_CHANGED: _ClassVar[Event.Kind]
        CONFIGURATION: _ClassVar[Event.Kind]
        COMMAND_LOST: _ClassVar[Event.Kind]
        COMMAND_BACK: _ClassVar[Event.Kind]
        RESET: _ClassVar[Event.Kind]
        CONNECTION_REFUSED: _ClassVar[Event.Kind]
        RECORDING: _ClassVar[Event.Kind]
        RIG_ADDED: _ClassVar[Event.Kind]
        RIG_REMOVED: _ClassVar[Event.Kind]
        INACCURATE_STEP: _ClassVar[Event.Kind]
        STATE_LOST: _ClassVar[Event.Kind]
        STATE_BACK: _ClassVar[Event.Kind]
        CONTROLLER_FAULT: _ClassVar[Event.Kind]
        CONTROLLER_BACK: _ClassVar[Event.Kind]
        CLAIM: _ClassVar[Event.Kind]
    KIND_UNSPECIFIED: Event.Kind
    SESSION_START: Event.Kind
    SESSION_END: Event.Kind
    LEASE_GRANTED: Event.Kind
    LEASE_REFUSED: Event.Kind
    LEASE_LOST: Event.Kind
    WATCHDOG_TRIP: Event.Kind
    WATCHDOG_REARM: Event.Kind
    LIMIT_HIT: Event.Kind
    PART_PICKED: Event.Kind
    PART_DROPPED: Event.Kind
    OVERRUN: Event.Kind
    IMPAIRMENT_CHANGED: Event.Kind
    CONFIGURATION: Event.Kind
    COMMAND_LOST: Event.Kind
    COMMAND_BACK: Event.Kind
    RESET: Event.Kind
    CONNECTION_REFUSED: Event.Kind
    RECORDING: Event.Kind
    RIG_ADDED: Event.Kind
    RIG_REMOVED: Event.Kind
    INACCURATE_STEP: Event.Kind
    STATE_LOST: Event.Kind
    STATE_BACK: Event.Kind
    CONTROLLER_FAULT: Event.Kind
    CONTROLLER_BACK: Event.Kind
    CLAIM: Event.Kind
    class Severity(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        SEVERITY_UNSPECIFIED: _ClassVar[Event.Severity]
        INFO: _ClassVar[Event.Severity]
        WARNING: _ClassVar[Event.Severity]
        ERROR: _ClassVar[Event.Severity]
    SEVERITY_UNSPECIFIED: Event.Severity
    INFO: Event.Severity
    WARNING: Event.Severity
    ERROR: Event.Severity
    RIG_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    SEVERITY_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    SESSION_DATA_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_DATA_FIELD_NUMBER: _ClassVar[int]
    WATCHDOG_DATA_FIELD_NUMBER: _ClassVar[int]
    LIMIT_DATA_FIELD_NUMBER: _ClassVar[int]
    PART_DATA_FIELD_NUMBER: _ClassVar[int]
    OVERRUN_DATA_FIELD_NUMBER: _ClassVar[int]
    CONFIGURATION_DATA_FIELD_NUMBER: _ClassVar[int]
    INTEGRATION_DATA_FIELD_NUMBER: _ClassVar[int]
    rig: str
    session: str
    kind: Event.Kind
    severity: Event.Severity
    text: str
    wall_ns: int
    source: str
    step: int
    session_data: SessionData
    controller_data: ControllerData
    watchdog_data: WatchdogData
    limit_data: LimitData
    part_data: PartData
    overrun_data: OverrunData
    configuration_data: ConfigurationData
    integration_data: IntegrationData
    def __init__(self, rig: _Optional[str] = ..., session: _Optional[str] = ..., kind: _Optional[_Union[Event.Kind, str]] = ..., severity: _Optional[_Union[Event.Severity, str]] = ..., text: _Optional[str] = ..., wall_ns: _Optional[int] = ..., source: _Optional[str] = ..., step: _Optional[int] = ..., session_data: _Optional[_Union[SessionData, _Mapping]] = ..., controller_data: _Optional[_Union[ControllerData, _Mapping]] = ..., watchdog_data: _Optional[_Union[WatchdogData, _Mapping]] = ..., limit_data: _Optional[_Union[LimitData, _Mapping]] = ..., part_data: _Optional[_Union[PartData, _Mapping]] = ..., overrun_data: _Optional[_Union[OverrunData, _Mapping]] = ..., configuration_data: _Optional[_Union[ConfigurationData, _Mapping]] = ..., integration_data: _Optional[_Union[IntegrationData, _Mapping]] = ...) -> None: ...

class SessionData(_message.Message):
    __slots__ = ("reason", "controller", "certificate", "student")
    REASON_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    CERTIFICATE_FIELD_NUMBER: _ClassVar[int]
    STUDENT_FIELD_NUMBER: _ClassVar[int]
    reason: str
    controller: str
    certificate: str
    student: str
    def __init__(self, reason: _Optional[str] = ..., controller: _Optional[str] = ..., certificate: _Optional[str] = ..., student: _Optional[str] = ...) -> None: ...

class ControllerData(_message.Message):
    __slots__ = ("controller", "holder", "reason", "certificate", "student")
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    HOLDER_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CERTIFICATE_FIELD_NUMBER: _ClassVar[int]
    STUDENT_FIELD_NUMBER: _ClassVar[int]
    controller: str
    holder: str
    reason: str
    certificate: str
    student: str
    def __init__(self, controller: _Optional[str] = ..., holder: _Optional[str] = ..., reason: _Optional[str] = ..., certificate: _Optional[str] = ..., student: _Optional[str] = ...) -> None: ...

class WatchdogData(_message.Message):
    __slots__ = ("silent_ns", "timeout_ns")
    SILENT_NS_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_NS_FIELD_NUMBER: _ClassVar[int]
    silent_ns: int
    timeout_ns: int
    def __init__(self, silent_ns: _Optional[int] = ..., timeout_ns: _Optional[int] = ...) -> None: ...

class LimitData(_message.Message):
    __slots__ = ("joint", "upper", "speed")
    JOINT_FIELD_NUMBER: _ClassVar[int]
    UPPER_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    joint: int
    upper: bool
    speed: float
    def __init__(self, joint: _Optional[int] = ..., upper: _Optional[bool] = ..., speed: _Optional[float] = ...) -> None: ...

class PartData(_message.Message):
    __slots__ = ("part", "x", "y", "z", "mass")
    PART_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    MASS_FIELD_NUMBER: _ClassVar[int]
    part: str
    x: float
    y: float
    z: float
    mass: float
    def __init__(self, part: _Optional[str] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., mass: _Optional[float] = ...) -> None: ...

class OverrunData(_message.Message):
    __slots__ = ("lateness_ns", "missed_steps", "stalls")
    LATENESS_NS_FIELD_NUMBER: _ClassVar[int]
    MISSED_STEPS_FIELD_NUMBER: _ClassVar[int]
    STALLS_FIELD_NUMBER: _ClassVar[int]
    lateness_ns: int
    missed_steps: int
    stalls: int
    def __init__(self, lateness_ns: _Optional[int] = ..., missed_steps: _Optional[int] = ..., stalls: _Optional[int] = ...) -> None: ...

class ConfigurationData(_message.Message):
    __slots__ = ("text",)
    TEXT_FIELD_NUMBER: _ClassVar[int]
    text: str
    def __init__(self, text: _Optional[str] = ...) -> None: ...

class IntegrationData(_message.Message):
    __slots__ = ("error", "steps")
    ERROR_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    error: _containers.RepeatedScalarFieldContainer[float]
    steps: int
    def __init__(self, error: _Optional[_Iterable[float]] = ..., steps: _Optional[int] = ...) -> None: ...
