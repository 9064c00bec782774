"""Copies a recording, of one file or several, into a new file with the channels of this version."""

from collections.abc import Iterator

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.records import Message
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.io.recording_file import RecordingFile
from hilrig_schemas.topics import RECORDED


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
