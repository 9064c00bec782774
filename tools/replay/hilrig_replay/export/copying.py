"""Copies a recording, of one file or several, into a new file with the channels of this version."""

from collections.abc import Iterator
from typing import Final

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.records import Message
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.io.recording_file import RecordingFile
from hilrig_schemas.topics import RECORDED

REORDER_WINDOW_NS: Final = 1_000_000_000
"""Streams arrive in batches: a message may be stored this long after one that was published later."""


def copy_metadata(recording: RecordingFile, writer: RecordingWriter) -> None:
    """Write the metadata and the attachments."""
    for name, values in recording.metadata.items():
        writer.add_metadata(name, values, is_repeated=name.startswith(("hilrig.session", "hilrig.config")))
    for item in recording.attachment_records:
        writer.add_attachment(
            item.name, item.media_type, item.data, log_time=item.log_time, create_time=item.create_time
        )


def own_messages(recording: RecordingFile) -> Iterator[Message]:
    """All messages in file order, with the channel ids of this version."""
    ids = {channel: CHANNEL_OF_TOPIC[topic] for channel, topic in recording.topics.items()}
    for message in recording.messages(frozenset(RECORDED)):
        yield message._replace(channel_id=ids[message.channel_id])


def without_clock_steps(messages: Iterator[Message], longest_ns: int = REORDER_WINDOW_NS) -> Iterator[Message]:
    """The messages with publication times as if the wall clock had not been set.

    A difference of consecutive messages of more than `longest_ns` is a step.
    """
    newest: int | None = None
    sums: dict[int, int] = {}
    total = 0
    for message in messages:
        step_ns = sums.get(message.channel_id, 0)
        publish_ns = message.publish_time - step_ns
        if newest is not None and abs(publish_ns - newest) > longest_ns:
            # Another channel may have found the step before.
            if abs(message.publish_time - total - newest) > longest_ns:
                total = message.publish_time - newest
            step_ns = sums[message.channel_id] = total
            publish_ns = message.publish_time - step_ns
        newest = publish_ns if newest is None else max(newest, publish_ns)
        yield message._replace(publish_time=publish_ns)
