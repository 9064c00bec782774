"""What every recording has in common: its channels, in a fixed order, and their schemas.

A channel has the same id in every file, so a message is encoded once for however many files it goes into, and before
it is known whether it goes into any.
"""

import struct
from typing import Any, Final, NamedTuple

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hilrig_schemas.topics import EVENT, RECORDED

SCHEMA_VERSION: Final = "hilrig.v1"
"""The protobuf package of the messages; it changes when a message becomes unreadable for older readers."""

_MESSAGE: Final = struct.Struct("<BQHIQQ")
_FIXED_LENGTH: Final = _MESSAGE.size - 9
_OPCODE: Final = int(Opcode.MESSAGE)
_pack: Final = _MESSAGE.pack


def file_descriptor_set(message: type[Message]) -> bytes:
    """The schema of a message as MCAP wants it: a `FileDescriptorSet` with every dependency before its user."""
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
"""Channel id of a topic's name."""
EVENT_CHANNEL: Final = CHANNEL_OF_TOPIC[EVENT.name]


class MessageHead(NamedTuple):
    """What stands before a message's bytes in its record; times are wall clock, ns."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int


def message_head(record: bytes) -> MessageHead:
    """The head of a record that `encode_message` made."""
    return MessageHead(*_MESSAGE.unpack_from(record)[2:])


def encode_message(channel_id: int, sequence: int, log_time: int, publish_time: int, payload: bytes) -> bytes:
    """One MCAP message record; times are wall clock, ns. MCAP keeps 32 bits of the sequence number."""
    length = _FIXED_LENGTH + len(payload)
    return _pack(_OPCODE, length, channel_id, sequence & 0xFFFFFFFF, log_time, publish_time) + payload
