from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ControlRequest(_message.Message):
    __slots__ = ("software_version", "add_rig", "remove_rig", "reset_rig", "start_session", "stop_session", "revoke_client")
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    ADD_RIG_FIELD_NUMBER: _ClassVar[int]
    REMOVE_RIG_FIELD_NUMBER: _ClassVar[int]
    RESET_RIG_FIELD_NUMBER: _ClassVar[int]
    START_SESSION_FIELD_NUMBER: _ClassVar[int]
    STOP_SESSION_FIELD_NUMBER: _ClassVar[int]
    REVOKE_CLIENT_FIELD_NUMBER: _ClassVar[int]
    software_version: str
    add_rig: AddRig
    remove_rig: RemoveRig
    reset_rig: ResetRig
    start_session: StartSession
    stop_session: StopSession
    revoke_client: RevokeClient
    def __init__(self, software_version: _Optional[str] = ..., add_rig: _Optional[_Union[AddRig, _Mapping]] = ..., remove_rig: _Optional[_Union[RemoveRig, _Mapping]] = ..., reset_rig: _Optional[_Union[ResetRig, _Mapping]] = ..., start_session: _Optional[_Union[StartSession, _Mapping]] = ..., stop_session: _Optional[_Union[StopSession, _Mapping]] = ..., revoke_client: _Optional[_Union[RevokeClient, _Mapping]] = ...) -> None: ...

class AddRig(_message.Message):
    __slots__ = ("settings_json",)
    SETTINGS_JSON_FIELD_NUMBER: _ClassVar[int]
    settings_json: str
    def __init__(self, settings_json: _Optional[str] = ...) -> None: ...

class RemoveRig(_message.Message):
    __slots__ = ("rig",)
    RIG_FIELD_NUMBER: _ClassVar[int]
    rig: str
    def __init__(self, rig: _Optional[str] = ...) -> None: ...

class ResetRig(_message.Message):
    __slots__ = ("rig",)
    RIG_FIELD_NUMBER: _ClassVar[int]
    rig: str
    def __init__(self, rig: _Optional[str] = ...) -> None: ...

class StartSession(_message.Message):
    __slots__ = ("rig",)
    RIG_FIELD_NUMBER: _ClassVar[int]
    rig: str
    def __init__(self, rig: _Optional[str] = ...) -> None: ...

class StopSession(_message.Message):
    __slots__ = ("rig",)
    RIG_FIELD_NUMBER: _ClassVar[int]
    rig: str
    def __init__(self, rig: _Optional[str] = ...) -> None: ...

class RevokeClient(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class ControlReply(_message.Message):
    __slots__ = ("software_version", "text", "session")
    SOFTWARE_VERSION_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    software_version: str
    text: str
    session: str
    def __init__(self, software_version: _Optional[str] = ..., text: _Optional[str] = ..., session: _Optional[str] = ...) -> None: ...
