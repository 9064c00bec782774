"""Channels and schemas of every recording, in a fixed order.

A channel has the same id in every file. So a message is encoded once, before it is known which files it is written to.
"""

from typing import Any, Final

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.records import Channel, Schema

from hilrig_schemas.topics import EVENT, RECORDED

SCHEMA_VERSION: Final = "hilrig.v1"
"""The protobuf package of the messages. It changes when older readers can no longer read a message."""


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
