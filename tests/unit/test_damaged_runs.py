"""Damaged and recovered recordings: each lost message is counted at the place where it was lost."""

from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.records import Chunk, Message
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.mcap_format.scan import read_chunk, scan
from hilrig_replay.analysis.index import RunIndex
from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from support import recordings
from support.labs import hilrig

RECORDED = Path(__file__).parents[1] / "data/before-columns-of-requests.mcap"


def damage(source: Path, damaged: Path, number: int) -> int:
    """Copy a recording and destroy one of its chunks; returns the number of messages in the chunk."""
    data = bytearray(source.read_bytes())
    chunk = [item for _, item in scan(bytes(data)) if isinstance(item, Chunk)][number]
    # After the record header, which contains the length.
    middle = chunk.offset + 60 + len(chunk.data) // 2
    data[middle : middle + 20] = bytes(20)
    damaged.write_bytes(data)
    return sum(isinstance(item, Message) for item in read_chunk(chunk))


@pytest.mark.parametrize("number", [0, 1, -1])
def test_counts_messages_of_a_damaged_chunk_as_lost_in_file(tmp_path: Path, number: int) -> None:
    damaged, whole = tmp_path / "run.mcap", tmp_path / "lab" / "rig1" / "whole.mcap"
    whole.parent.mkdir(parents=True)
    messages = damage(RECORDED, damaged, number)
    recover(damaged, whole)
    report = measure(open_run(whole))
    assert (report.lost.transport, report.lost.recorder, report.lost.file) == (0, 0, messages)
    assert any(f"{messages} messages lost in the damaged file" in reason.text for reason in report.reasons)
    [entry] = RunIndex(tmp_path / "lab").load()
    assert (entry.lost_transport, entry.lost_recorder, entry.lost_file) == (0, 0, messages)
    assert f", {messages} in the file" in hilrig("latency", whole).stdout.replace("\n", " ")


def test_counts_sequence_gaps_of_a_recovered_file(tmp_path: Path) -> None:
    damaged, whole = tmp_path / "run.mcap", tmp_path / "whole.mcap"
    made = recordings.record(tmp_path / "made.mcap", recordings.Script(seconds=6.0, lost_transport=2))
    assert damage(made, damaged, 1) > 50
    recover(damaged, whole)
    lost = measure(open_run(whole)).lost
    assert lost.transport == 2
    assert lost.file > 50


def test_gap_in_a_truncated_file_was_lost_in_transport(tmp_path: Path) -> None:
    script = recordings.Script(seconds=6.0)
    made = recordings.write(
        tmp_path / "made.mcap", recordings.make(script), script=script, finish=False, missing={"state": {77, 78}}
    )
    made.write_bytes(made.read_bytes()[:-40])
    recover(made, tmp_path / "whole.mcap")
    lost = measure(open_run(tmp_path / "whole.mcap")).lost
    assert (lost.transport, lost.file) == (2, 0)
