"""Joins the segments of one session into one file. The segments are not changed."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel

from hilrig_recorder.mcap_format.channels import CHANNELS
from hilrig_recorder.mcap_format.fsutil import open_file
from hilrig_recorder.mcap_format.new_file import new_file
from hilrig_recorder.mcap_format.reader import file_reader
from hilrig_recorder.mcap_format.records import DamagedError, check_attachment, encode_message
from hilrig_replay.export.copying import copy_metadata, own_messages
from hilrig_replay.io.joined_recording import open_segments
from hilrig_replay.io.recording_file import DamagedRecordingError, open_recording
from hilrig_replay.io.segments import Segment, group_files, read_segment
from hilrig_runtime.errors import InputError


def join(paths: Sequence[Path], path: Path) -> int:
    """Write the segments of one session as one file; return the number of messages.

    Raises:
        InputError: the files are not complete segments of one session, or `path` exists.
        OperationError: the file can't be written.
    """
    for source in paths:
        _check_file(source)
    first, *others = group_files(paths)
    for files in others:
        _refuse(files[0], first[0])
    for before, source in pairwise(first):
        _check_order(before, source)
    recording = open_segments(first)
    with new_file(path) as writer:
        copy_metadata(recording, writer)
        for message in own_messages(recording):
            writer.add(encode_message(*message))
        writer.finish()
    return writer.message_count


def _check_file(path: Path) -> None:
    """Check what reading a recording does not: its channels, and the checksums of its attachments."""
    recording = open_recording(path)
    own = {channel.topic for channel in CHANNELS}
    try:
        with open_file(path) as stream:
            reader = file_reader(stream)
            for item in reader.summary_items(reader.summary()):
                if isinstance(item, Channel) and item.topic not in own:
                    raise InputError(f"{path}: not a segment: it has a channel {item.topic}; expected {sorted(own)}")
                if isinstance(item, AttachmentIndex):
                    check_attachment(reader.indexed(Opcode.ATTACHMENT, item.offset, item.length), item.offset)
    except (DamagedError, OSError) as error:
        raise DamagedRecordingError(path, str(error)) from error
    if not recording.metadata.get("hilrig.session", {}).get("session"):
        raise InputError(f"{path}: not a hilrig recording: no session is recorded")


def _refuse(path: Path, first: Path) -> None:
    mine, other = read_segment(path), read_segment(first)
    if mine.session != other.session:
        raise InputError(f"{path}: of session {mine.session}, but {first} is of session {other.session}")
    raise InputError(f"{path}: {_name(mine)} of the session is given twice, also in {first}")


def _check_order(before: Path, path: Path) -> None:
    mine, other = read_segment(path), read_segment(before)
    if mine.first > other.last + 1:
        raise InputError(f"{path}: {_name(mine)}; expected segment {other.last + 1} after {before}")


def _name(segment: Segment) -> str:
    return f"segment {segment.first}" if segment.first == segment.last else f"segments {segment.first}-{segment.last}"
