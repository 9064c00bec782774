from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class ImpairmentRequest(_message.Message):
    __slots__ = ("set_json", "restore_lab")
    SET_JSON_FIELD_NUMBER: _ClassVar[int]
    RESTORE_LAB_FIELD_NUMBER: _ClassVar[int]
    set_json: str
    restore_lab: bool
    def __init__(self, set_json: _Optional[str] = ..., restore_lab: _Optional[bool] = ...) -> None: ...

class ImpairmentStatus(_message.Message):
    __slots__ = ("rig", "text", "links_json", "seed", "source", "states", "states_lost", "states_superseded", "commands", "commands_lost", "commands_superseded")
    RIG_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    LINKS_JSON_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    STATES_FIELD_NUMBER: _ClassVar[int]
    STATES_LOST_FIELD_NUMBER: _ClassVar[int]
    STATES_SUPERSEDED_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_LOST_FIELD_NUMBER: _ClassVar[int]
    COMMANDS_SUPERSEDED_FIELD_NUMBER: _ClassVar[int]
    rig: str
    text: str
    links_json: str
    seed: int
    source: str
    states: int
    states_lost: int
    states_superseded: int
    commands: int
    commands_lost: int
    commands_superseded: int
    def __init__(self, rig: _Optional[str] = ..., text: _Optional[str] = ..., links_json: _Optional[str] = ..., seed: _Optional[int] = ..., source: _Optional[str] = ..., states: _Optional[int] = ..., states_lost: _Optional[int] = ..., states_superseded: _Optional[int] = ..., commands: _Optional[int] = ..., commands_lost: _Optional[int] = ..., commands_superseded: _Optional[int] = ...) -> None: ...
