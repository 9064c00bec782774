from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class ServiceInfo(_message.Message):
    __slots__ = ("service", "instance", "incarnation", "host", "software_version", "wall_ns", "rigs", "addresses", "received")
    SERVICE_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    HOST_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    RIGS_FIELD_NUMBER: _ClassVar[int]
    ADDRESSES_FIELD_NUMBER: _ClassVar[int]
    RECEIVED_FIELD_NUMBER: _ClassVar[int]
    service: str
    instance: str
    incarnation: int
    host: str
    software_version: str
    wall_ns: int
    rigs: _containers.RepeatedScalarFieldContainer[str]
    addresses: _containers.RepeatedScalarFieldContainer[str]
    received: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, service: _Optional[str] = ..., instance: _Optional[str] = ..., incarnation: _Optional[int] = ..., host: _Optional[str] = ..., software_version: _Optional[str] = ..., wall_ns: _Optional[int] = ..., rigs: _Optional[_Iterable[str]] = ..., addresses: _Optional[_Iterable[str]] = ..., received: _Optional[_Iterable[str]] = ...) -> None: ...
