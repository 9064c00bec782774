from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class LogBatch(_message.Message):
    __slots__ = ("source", "incarnation", "sequence", "entries", "sessions", "complete_sessions")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    ENTRIES_FIELD_NUMBER: _ClassVar[int]
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    COMPLETE_SESSIONS_FIELD_NUMBER: _ClassVar[int]
    source: str
    incarnation: int
    sequence: int
    entries: _containers.RepeatedCompositeFieldContainer[LogEntry]
    sessions: _containers.RepeatedCompositeFieldContainer[OpenSession]
    complete_sessions: bool
    def __init__(self, source: _Optional[str] = ..., incarnation: _Optional[int] = ..., sequence: _Optional[int] = ..., entries: _Optional[_Iterable[_Union[LogEntry, _Mapping]]] = ..., sessions: _Optional[_Iterable[_Union[OpenSession, _Mapping]]] = ..., complete_sessions: _Optional[bool] = ...) -> None: ...

class LogEntry(_message.Message):
    __slots__ = ("key", "sequence", "publish_wall_ns", "payload")
    KEY_FIELD_NUMBER: _ClassVar[int]
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    PUBLISH_WALL_NS_FIELD_NUMBER: _ClassVar[int]
    PAYLOAD_FIELD_NUMBER: _ClassVar[int]
    key: str
    sequence: int
    publish_wall_ns: int
    payload: bytes
    def __init__(self, key: _Optional[str] = ..., sequence: _Optional[int] = ..., publish_wall_ns: _Optional[int] = ..., payload: _Optional[bytes] = ...) -> None: ...

class OpenSession(_message.Message):
    __slots__ = ("rig", "session", "controller", "start_wall_ns")
    RIG_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    START_WALL_NS_FIELD_NUMBER: _ClassVar[int]
    rig: str
    session: str
    controller: str
    start_wall_ns: int
    def __init__(self, rig: _Optional[str] = ..., session: _Optional[str] = ..., controller: _Optional[str] = ..., start_wall_ns: _Optional[int] = ...) -> None: ...
