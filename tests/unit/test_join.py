"""Segments of one session are joined into one recording with every message once."""

from collections.abc import Sequence
from pathlib import Path

import pytest
from mcap.records import Metadata

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.join import join
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import ALL_TOPICS, Run, open_run
from hilrig_runtime.errors import InputError
from support.labs import hilrig
from support.recordings import Script, record


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
    found = run.file.messages(ALL_TOPICS)
    return [(run.file.topics[one.channel_id], one.sequence, one.publish_time, one.data) for one in found]


@pytest.mark.parametrize("shares", [[(0, 0.5), (0.5, 1)], [(0, 0.4), (0.3, 0.7), (0.7, 1)]])
def test_joined_file_has_every_message_once(tmp_path: Path, shares: list[tuple[float, float]]) -> None:
    whole = record(tmp_path / "whole.mcap", Script(seconds=4.0))
    paths = split(whole, tmp_path, shares)
    done = hilrig("join", *reversed(paths), "--out", tmp_path / "all.mcap")
    assert done.returncode == 0, done.stderr
    joined, expected = open_run(tmp_path / "all.mcap"), open_run(whole)
    assert contents(joined) == contents(expected)
    assert measure(joined).loop_ms == measure(expected).loop_ms
    assert joined.losses is not None
    assert joined.losses.transport == len(shares)
    assert joined.metadata["hilrig.config"] == expected.metadata["hilrig.config"]
    assert joined.ended == "ended"
    assert all(path.exists() for path in paths)


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    whole = record(tmp_path / "whole.mcap", Script(seconds=1.0))
    one, two, three = split(whole, tmp_path, [(0, 0.3), (0.3, 0.6), (0.6, 1)])
    (other, _) = split(whole, tmp_path, [(0, 0.5), (0.5, 1)], session="t")
    for paths, problem in (
        ([one, three], r"s\.3\.mcap: segment 3; expected segment 2 after"),
        ([one, one], "segment 1; expected segment 2"),
        ([one, other], "of session t, but"),
        ([one, whole], "of session 2026"),
    ):
        with pytest.raises(InputError, match=problem):
            join(paths, tmp_path / "new.mcap")
    with pytest.raises(InputError, match="file exists"):
        join([one, two], three)
    two.write_bytes(two.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"s\.2\.mcap: damaged .*run `hilrig recover"):
        join([one, two], tmp_path / "new.mcap")
    assert not (tmp_path / "new.mcap").exists()
