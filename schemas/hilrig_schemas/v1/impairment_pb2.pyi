from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class ImpairmentRequest(_message.Message):
    __slots__ = ("set_json", "as_lab")
    SET_JSON_FIELD_NUMBER: _ClassVar[int]
    AS_LAB_FIELD_NUMBER: _ClassVar[int]
    set_json: str
    as_lab: bool
    def __init__(self, set_json: _Optional[str] = ..., as_lab: _Optional[bool] = ...) -> None: ...

class ImpairmentStatus(_message.Message):
    __slots__ = ("rig", "text", "ways_json", "seed", "source", "states", "states_lost", "states_overtaken", "commands", "commands_lost", "commands_overtaken")
    RIG_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    WAYS_JSON_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    STATES_LOST_FIELD_NUMBER: _ClassVar[int]
    STATES_OVERTAKEN_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_LOST_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_OVERTAKEN_FIELD_NUMBER: _ClassVar[int]
    rig: str
    text: str
    ways_json: str
    seed: int
    source: str
    states: int
    states_lost: int
    states_overtaken: int
    commands: int
    commands_lost: int
    commands_overtaken: int
    def __init__(self, rig: _Optional[str] = ..., text: _Optional[str] = ..., ways_json: _Optional[str] = ..., seed: _Optional[int] = ..., source: _Optional[str] = ..., states: _Optional[int] = ..., states_lost: _Optional[int] = ..., states_overtaken: _Optional[int] = ..., commands: _Optional[int] = ..., commands_lost: _Optional[int] = ..., commands_overtaken: _Optional[int] = ...) -> None: ...
