from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Health(_message.Message):
    __slots__ = ("service", "instance", "incarnation", "wall_ns", "uptime_ns", "cpu_ns", "resident_bytes", "rigs", "ticks", "overruns", "missed_steps", "lateness_p50_ns", "lateness_p99_ns", "lateness_max_ns", "received_hz", "published_hz", "lost_transport", "lost_recorder", "queue_depth", "queue_capacity", "connections", "requests", "malformed", "refused", "recordings", "bytes_written", "alert", "host", "software_version", "clock_offset_ns", "clock_uncertainty_ns", "clock_peer", "rig_reports", "realtime_priority", "peers", "inaccurate_steps")
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_NS_FIELD_NUMBER: _ClassVar[int]
    CPU_NS_FIELD_NUMBER: _ClassVar[int]
    RESIDENT_BYTES_FIELD_NUMBER: _ClassVar[int]
    RIGS_FIELD_NUMBER: _ClassVar[int]
    TICKS_FIELD_NUMBER: _ClassVar[int]
    OVERRUNS_FIELD_NUMBER: _ClassVar[int]
    MISSED_STEPS_FIELD_NUMBER: _ClassVar[int]
    LATENESS_P50_NS_FIELD_NUMBER: _ClassVar[int]
    LATENESS_P99_NS_FIELD_NUMBER: _ClassVar[int]
    LATENESS_MAX_NS_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_HZ_FIELD_NUMBER: _ClassVar[int]
    PUBLISHED_HZ_FIELD_NUMBER: _ClassVar[int]
    LOST_TRANSPORT_FIELD_NUMBER: _ClassVar[int]
    LOST_RECORDER_FIELD_NUMBER: _ClassVar[int]
    QUEUE_DEPTH_FIELD_NUMBER: _ClassVar[int]
    QUEUE_CAPACITY_FIELD_NUMBER: _ClassVar[int]
    CONNECTIONS_FIELD_NUMBER: _ClassVar[int]
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    MALFORMED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    RECORDINGS_FIELD_NUMBER: _ClassVar[int]
    BYTES_WRITTEN_FIELD_NUMBER: _ClassVar[int]
    ALERT_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    CLOCK_OFFSET_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_UNCERTAINTY_NS_FIELD_NUMBER: _ClassVar[int]
    CLOCK_PEER_FIELD_NUMBER: _ClassVar[int]
    RIG_REPORTS_FIELD_NUMBER: _ClassVar[int]
    REALTIME_PRIORITY_FIELD_NUMBER: _ClassVar[int]
    PEERS_FIELD_NUMBER: _ClassVar[int]
    INACCURATE_STEPS_FIELD_NUMBER: _ClassVar[int]
    service: str
    instance: str
    incarnation: int
    wall_ns: int
    uptime_ns: int
    cpu_ns: int
    resident_bytes: int
    rigs: int
    ticks: int
    overruns: int
    missed_steps: int
    lateness_p50_ns: int
    lateness_p99_ns: int
    lateness_max_ns: int
    received_hz: float
    published_hz: float
    lost_transport: int
    lost_recorder: int
    queue_depth: int
    queue_capacity: int
    connections: int
    requests: int
    malformed: int
    refused: int
    recordings: int
    bytes_written: int
    alert: str
    host: str
    software_version: str
    clock_offset_ns: int
    clock_uncertainty_ns: int
    clock_peer: str
    rig_reports: _containers.RepeatedCompositeFieldContainer[RigReport]
    realtime_priority: int
    peers: _containers.RepeatedCompositeFieldContainer[PeerReport]
    inaccurate_steps: int
    def __init__(self, service: _Optional[str] = ..., instance: _Optional[str] = ..., incarnation: _Optional[int] = ..., wall_ns: _Optional[int] = ..., uptime_ns: _Optional[int] = ..., cpu_ns: _Optional[int] = ..., resident_bytes: _Optional[int] = ..., rigs: _Optional[int] = ..., ticks: _Optional[int] = ..., overruns: _Optional[int] = ..., missed_steps: _Optional[int] = ..., lateness_p50_ns: _Optional[int] = ..., lateness_p99_ns: _Optional[int] = ..., lateness_max_ns: _Optional[int] = ..., received_hz: _Optional[float] = ..., published_hz: _Optional[float] = ..., lost_transport: _Optional[int] = ..., lost_recorder: _Optional[int] = ..., queue_depth: _Optional[int] = ..., queue_capacity: _Optional[int] = ..., connections: _Optional[int] = ..., requests: _Optional[int] = ..., malformed: _Optional[int] = ..., refused: _Optional[int] = ..., recordings: _Optional[int] = ..., bytes_written: _Optional[int] = ..., alert: _Optional[str] = ..., host: _Optional[str] = ..., software_version: _Optional[str] = ..., clock_offset_ns: _Optional[int] = ..., clock_uncertainty_ns: _Optional[int] = ..., clock_peer: _Optional[str] = ..., rig_reports: _Optional[_Iterable[_Union[RigReport, _Mapping]]] = ..., realtime_priority: _Optional[int] = ..., peers: _Optional[_Iterable[_Union[PeerReport, _Mapping]]] = ..., inaccurate_steps: _Optional[int] = ...) -> None: ...

class PeerReport(_message.Message):
    __slots__ = ("service", "host", "silent_ns")
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    SILENT_NS_FIELD_NUMBER: _ClassVar[int]
    service: str
    host: str
    silent_ns: int
    def __init__(self, service: _Optional[str] = ..., host: _Optional[str] = ..., silent_ns: _Optional[int] = ...) -> None: ...

class RigReport(_message.Message):
    __slots__ = ("rig", "loop_us", "safe", "controller", "session", "watchdog_tripped", "connections", "recording", "age_us", "exceptions", "alert", "student")
    RIG_FIELD_NUMBER: _ClassVar[int]
    LOOP_US_FIELD_NUMBER: _ClassVar[int]
    SAFE_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    WATCHDOG_TRIPPED_FIELD_NUMBER: _ClassVar[int]
    CONNECTIONS_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    AGE_US_FIELD_NUMBER: _ClassVar[int]
    EXCEPTIONS_FIELD_NUMBER: _ClassVar[int]
    ALERT_FIELD_NUMBER: _ClassVar[int]
    STUDENT_FIELD_NUMBER: _ClassVar[int]
    rig: str
    loop_us: _containers.RepeatedScalarFieldContainer[int]
    safe: bool
    controller: str
    session: str
    watchdog_tripped: bool
    connections: int
    recording: bool
    age_us: _containers.RepeatedScalarFieldContainer[int]
    exceptions: _containers.RepeatedCompositeFieldContainer[ExceptionCount]
    alert: str
    student: str
    def __init__(self, rig: _Optional[str] = ..., loop_us: _Optional[_Iterable[int]] = ..., safe: _Optional[bool] = ..., controller: _Optional[str] = ..., session: _Optional[str] = ..., watchdog_tripped: _Optional[bool] = ..., connections: _Optional[int] = ..., recording: _Optional[bool] = ..., age_us: _Optional[_Iterable[int]] = ..., exceptions: _Optional[_Iterable[_Union[ExceptionCount, _Mapping]]] = ..., alert: _Optional[str] = ..., student: _Optional[str] = ...) -> None: ...

class ExceptionCount(_message.Message):
    __slots__ = ("host", "function", "code", "count")
    HOST_FIELD_NUMBER: _ClassVar[int]
    FUNCTION_FIELD_NUMBER: _ClassVar[int]
    CODE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    host: str
    function: int
    code: int
    count: int
    def __init__(self, host: _Optional[str] = ..., function: _Optional[int] = ..., code: _Optional[int] = ..., count: _Optional[int] = ...) -> None: ...
