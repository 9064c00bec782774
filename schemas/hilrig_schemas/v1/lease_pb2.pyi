from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class LeaseRequest(_message.Message):
    __slots__ = ("release", "end_claim")
    RELEASE_FIELD_NUMBER: _ClassVar[int]
    END_CLAIM_FIELD_NUMBER: _ClassVar[int]
    release: bool
    end_claim: bool
    def __init__(self, release: _Optional[bool] = ..., end_claim: _Optional[bool] = ...) -> None: ...

class LeaseStatus(_message.Message):
    __slots__ = ("rig", "holder", "released", "silent_ns", "session", "connections", "watchdog_tripped", "watchdog_timeout_ns", "client_of", "controller_fault", "skipped_states", "student", "claimed_from", "claim_ended")
    RIG_FIELD_NUMBER: _ClassVar[int]
    HOLDER_FIELD_NUMBER: _ClassVar[int]
    RELEASED_FIELD_NUMBER: _ClassVar[int]
    SILENT_NS_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    CONNECTIONS_FIELD_NUMBER: _ClassVar[int]
    WATCHDOG_TRIPPED_FIELD_NUMBER: _ClassVar[int]
    WATCHDOG_TIMEOUT_NS_FIELD_NUMBER: _ClassVar[int]
    CLIENT_OF_FIELD_NUMBER: _ClassVar[int]
    CONTROLLER_FAULT_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_STATES_FIELD_NUMBER: _ClassVar[int]
    STUDENT_FIELD_NUMBER: _ClassVar[int]
    CLAIMED_FROM_FIELD_NUMBER: _ClassVar[int]
    CLAIM_ENDED_FIELD_NUMBER: _ClassVar[int]
    rig: str
    holder: str
    released: str
    silent_ns: int
    session: str
    connections: int
    watchdog_tripped: bool
    watchdog_timeout_ns: int
    client_of: str
    controller_fault: str
    skipped_states: int
    student: str
    claimed_from: str
    claim_ended: str
    def __init__(self, rig: _Optional[str] = ..., holder: _Optional[str] = ..., released: _Optional[str] = ..., silent_ns: _Optional[int] = ..., session: _Optional[str] = ..., connections: _Optional[int] = ..., watchdog_tripped: _Optional[bool] = ..., watchdog_timeout_ns: _Optional[int] = ..., client_of: _Optional[str] = ..., controller_fault: _Optional[str] = ..., skipped_states: _Optional[int] = ..., student: _Optional[str] = ..., claimed_from: _Optional[str] = ..., claim_ended: _Optional[str] = ...) -> None: ...
