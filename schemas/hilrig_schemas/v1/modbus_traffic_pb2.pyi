from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ModbusTraffic(_message.Message):
    __slots__ = ("rig", "wall_ns", "closed_ns", "requests")
    RIG_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    CLOSED_NS_FIELD_NUMBER: _ClassVar[int]
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    rig: str
    wall_ns: int
    closed_ns: int
    requests: _containers.RepeatedCompositeFieldContainer[ModbusRequest]
    def __init__(self, rig: _Optional[str] = ..., wall_ns: _Optional[int] = ..., closed_ns: _Optional[int] = ..., requests: _Optional[_Iterable[_Union[ModbusRequest, _Mapping]]] = ...) -> None: ...

class ModbusRequest(_message.Message):
    __slots__ = ("function", "address", "count", "arrived_ns", "answered_ns", "exception", "controller")
    FUNCTION_FIELD_NUMBER: _ClassVar[int]
    ADDRESS_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    ANSWERED_NS_FIELD_NUMBER: _ClassVar[int]
    EXCEPTION_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    function: int
    address: int
    count: int
    arrived_ns: int
    answered_ns: int
    exception: int
    controller: str
    def __init__(self, function: _Optional[int] = ..., address: _Optional[int] = ..., count: _Optional[int] = ..., arrived_ns: _Optional[int] = ..., answered_ns: _Optional[int] = ..., exception: _Optional[int] = ..., controller: _Optional[str] = ...) -> None: ...
