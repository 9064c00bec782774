"""Channels and schemas of every recording, in a fixed order.

A channel has the same id in every file. So a message is encoded once, before it is known which files it is written to.
"""

import struct
from typing import Any, Final, NamedTuple

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hilrig_schemas.topics import EVENT, RECORDED

SCHEMA_VERSION: Final = "hilrig.v1"
"""The protobuf package of the messages. It changes when older readers can no longer read a message."""

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_FIXED_LENGTH: Final = _MESSAGE.size - 9
_OPCODE: Final = int(Opcode.MESSAGE)
_pack: Final = _MESSAGE.pack


def file_descriptor_set(message: type[Message]) -> bytes:
    """The MCAP schema of a message: a `FileDescriptorSet` in which dependencies precede the files that import them."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(files.file.add())

    add(message.DESCRIPTOR.file)
    return files.SerializeToString()


SCHEMAS: Final = tuple(
    Schema(number, file_descriptor_set(topic.message), "protobuf", topic.message.DESCRIPTOR.full_name)
    for number, topic in enumerate(RECORDED.values(), start=1)
)
CHANNELS: Final = tuple(
    Channel(id=number, topic=str(topic.channel), message_encoding="protobuf", metadata={}, schema_id=number)
    for number, topic in enumerate(RECORDED.values(), start=1)
)
CHANNEL_OF_TOPIC: Final = {name: number for number, name in enumerate(RECORDED, start=1)}
"""Channel id by topic name."""
EVENT_CHANNEL: Final = CHANNEL_OF_TOPIC[EVENT.name]


class MessageHeader(NamedTuple):
    """Fields of a message record before its payload; times are wall clock, ns."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int


def parse_message_header(record: bytes) -> MessageHeader:
    """The header of a record made by `encode_message`."""
    return MessageHeader(*_MESSAGE.unpack_from(record)[2:])


def encode_message(channel_id: int, sequence: int, log_time: int, publish_time: int, payload: bytes) -> bytes:
    """One MCAP message record; times are wall clock, ns. MCAP stores the low 32 bits of the sequence number."""
    length = _FIXED_LENGTH + len(payload)
    return _pack(_OPCODE, length, channel_id, sequence & 0xFFFFFFFF, log_time, publish_time) + payload
