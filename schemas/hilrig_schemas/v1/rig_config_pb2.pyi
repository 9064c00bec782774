from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class RigConfig(_message.Message):
    __slots__ = ("rig", "incarnation", "step_ns", "parameters_json", "urdf", "lab_toml", "software_version", "machine")
    RIG_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    STEP_NS_FIELD_NUMBER: _ClassVar[int]
    PARAMETERS_JSON_FIELD_NUMBER: _ClassVar[int]
    URDF_FIELD_NUMBER: _ClassVar[int]
    LAB_TOML_FIELD_NUMBER: _ClassVar[int]
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    MACHINE_FIELD_NUMBER: _ClassVar[int]
    rig: str
    incarnation: int
    step_ns: int
    parameters_json: str
    urdf: str
    lab_toml: str
    software_version: str
    machine: str
    def __init__(self, rig: _Optional[str] = ..., incarnation: _Optional[int] = ..., step_ns: _Optional[int] = ..., parameters_json: _Optional[str] = ..., urdf: _Optional[str] = ..., lab_toml: _Optional[str] = ..., software_version: _Optional[str] = ..., machine: _Optional[str] = ...) -> None: ...
