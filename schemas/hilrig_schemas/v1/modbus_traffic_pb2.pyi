from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ModbusTraffic(_message.Message):
    __slots__ = ("rig", "wall_ns", "closed_ns", "requests", "kinds", "kind_indexes", "arrived_ns", "answered_after_ns", "connections")
    RIG_FIELD_NUMBER: _ClassVar[int]
    WALL_NS_FIELD_NUMBER: _ClassVar[int]
    CLOSED_NS_FIELD_NUMBER: _ClassVar[int]
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    KINDS_FIELD_NUMBER: _ClassVar[int]
    KIND_INDEXES_FIELD_NUMBER: _ClassVar[int]
    ARRIVED_NS_FIELD_NUMBER: _ClassVar[int]
    ANSWERED_AFTER_NS_FIELD_NUMBER: _ClassVar[int]
    CONNECTIONS_FIELD_NUMBER: _ClassVar[int]
    rig: str
    wall_ns: int
    closed_ns: int
    requests: _containers.RepeatedCompositeFieldContainer[ModbusRequest]
    kinds: _containers.RepeatedCompositeFieldContainer[ModbusKind]
    kind_indexes: _containers.RepeatedScalarFieldContainer[int]
    arrived_ns: _containers.RepeatedScalarFieldContainer[int]
    answered_after_ns: _containers.RepeatedScalarFieldContainer[int]
    connections: _containers.RepeatedCompositeFieldContainer[ModbusConnection]
    def __init__(self, rig: _Optional[str] = ..., wall_ns: _Optional[int] = ..., closed_ns: _Optional[int] = ..., requests: _Optional[_Iterable[_Union[ModbusRequest, _Mapping]]] = ..., kinds: _Optional[_Iterable[_Union[ModbusKind, _Mapping]]] = ..., kind_indexes: _Optional[_Iterable[int]] = ..., arrived_ns: _Optional[_Iterable[int]] = ..., answered_after_ns: _Optional[_Iterable[int]] = ..., connections: _Optional[_Iterable[_Union[ModbusConnection, _Mapping]]] = ...) -> None: ...

class ModbusConnection(_message.Message):
    __slots__ = ("controller", "min_rtt_us", "retransmissions")
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    MIN_RTT_US_FIELD_NUMBER: _ClassVar[int]
    RETRANSMISSIONS_FIELD_NUMBER: _ClassVar[int]
    controller: str
    min_rtt_us: int
    retransmissions: int
    def __init__(self, controller: _Optional[str] = ..., min_rtt_us: _Optional[int] = ..., retransmissions: _Optional[int] = ...) -> None: ...

class ModbusKind(_message.Message):
    __slots__ = ("function", "address", "count", "exception", "controller")
    FUNCTION_FIELD_NUMBER: _ClassVar[int]
    ADDRESS_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    EXCEPTION_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FIELD_NUMBER: _ClassVar[int]
    function: int
    address: int
    count: int
    exception: int
    controller: str
    def __init__(self, function: _Optional[int] = ..., address: _Optional[int] = ..., count: _Optional[int] = ..., exception: _Optional[int] = ..., controller: _Optional[str] = ...) -> None: ...

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
