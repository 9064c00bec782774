"""Segments of one session, cut from a complete recording."""

from collections.abc import Sequence
from pathlib import Path

from mcap.records import Metadata

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.io.run import ALL_TOPICS, Run, open_run


def split(whole: Path, folder: Path, shares: Sequence[tuple[float, float]], session: str = "s") -> list[Path]:
    """Write parts of a recording as segments, as the recorder does."""
    run = open_run(whole)
    messages = list(run.file.messages(ALL_TOPICS))
    paths = []
    for number, (begin, end) in enumerate(shares, start=1):
        path = folder / f"{session}{'' if number == 1 else f'.{number}'}.mcap"
        values = {"session": session, "rig": "rig1", "part": str(number), "schema_version": "hilrig.v1"}
        writer = RecordingWriter(path, metadata=(Metadata("hilrig.session", values),))
        writer.add_metadata("hilrig.config", run.metadata["hilrig.config"], is_repeated=True)
        writer.add_attachment("rig1.urdf", "application/xml", run.urdf.encode(), log_time=1)
        for channel, sequence, log_ns, publish_ns, data in messages[
            round(begin * len(messages)) : round(end * len(messages))
        ]:
            channel_id = CHANNEL_OF_TOPIC[run.file.topics[channel]]
            writer.add(encode_message(channel_id, sequence, log_ns, publish_ns, data))
        ended = "continued" if number < len(shares) else "ended"
        summary = {"ended": ended, "lost_transport": "1", "lost_recorder": "0", "messages": "0"}
        writer.finish(lambda values=summary: {"hilrig.summary": values})  # type: ignore[misc]
        writer.publish()
        paths.append(path)
    return paths


def contents(run: Run) -> list[tuple[str, int, int, bytes]]:
    """Topic, number, time and payload of every message of a run."""
    found = run.file.messages(ALL_TOPICS)
    return [(run.file.topics[one.channel_id], one.sequence, one.publish_time, one.data) for one in found]
