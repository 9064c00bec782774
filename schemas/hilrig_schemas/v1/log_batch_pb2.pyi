from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LogBatch(_message.Message):
    __slots__ = ("source", "incarnation", "sequence", "sessions", "complete_sessions", "keys", "sequences", "publish_wall_ns", "payloads", "events", "checksum")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    COMPLETE_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    KEYS_FIELD_NUMBER: _ClassVar[int]
    SEQUENCES_FIELD_NUMBER: _ClassVar[int]
    PUBLISH_WALL_NS_FIELD_NUMBER: _ClassVar[int]
    PAYLOADS_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    CHECKSUM_FIELD_NUMBER: _ClassVar[int]
    source: str
    incarnation: int
    sequence: int
    sessions: _containers.RepeatedCompositeFieldContainer[OpenSession]
    complete_sessions: bool
    keys: _containers.RepeatedScalarFieldContainer[str]
    sequences: _containers.RepeatedScalarFieldContainer[int]
    publish_wall_ns: _containers.RepeatedScalarFieldContainer[int]
    payloads: _containers.RepeatedScalarFieldContainer[bytes]
    events: bool
    checksum: int
    def __init__(self, source: _Optional[str] = ..., incarnation: _Optional[int] = ..., sequence: _Optional[int] = ..., sessions: _Optional[_Iterable[_Union[OpenSession, _Mapping]]] = ..., complete_sessions: _Optional[bool] = ..., keys: _Optional[_Iterable[str]] = ..., sequences: _Optional[_Iterable[int]] = ..., publish_wall_ns: _Optional[_Iterable[int]] = ..., payloads: _Optional[_Iterable[bytes]] = ..., events: _Optional[bool] = ..., checksum: _Optional[int] = ...) -> None: ...

class OpenSession(_message.Message):
    __slots__ = ("rig", "session", "controller", "start_wall_ns", "certificate", "student")
    RIG_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    START_WALL_NS_FIELD_NUMBER: _ClassVar[int]
    CERTIFICATE_FIELD_NUMBER: _ClassVar[int]
    STUDENT_FIELD_NUMBER: _ClassVar[int]
    rig: str
    session: str
    controller: str
    start_wall_ns: int
    certificate: str
    student: str
    def __init__(self, rig: _Optional[str] = ..., session: _Optional[str] = ..., controller: _Optional[str] = ..., start_wall_ns: _Optional[int] = ..., certificate: _Optional[str] = ..., student: _Optional[str] = ...) -> None: ...
