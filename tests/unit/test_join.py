"""Segments of one session are joined into one recording with every message once."""

from pathlib import Path

import pytest

from hilrig_replay.analysis.latency import measure
from hilrig_replay.export.join import join
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from support.labs import hilrig
from support.recordings import Script, record
from support.segments import contents, split


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
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(one.read_bytes())
    (other, _) = split(whole, tmp_path, [(0, 0.5), (0.5, 1)], session="t")
    for paths, problem in (
        ([one, three], r"s\.3\.mcap: segment 3; expected segment 2 after"),
        ([one, copy], "segment 1 of the session is given twice"),
        ([one, other], "of session t, but"),
        ([one, whole], "of session 2026"),
    ):
        with pytest.raises(InputError, match=problem):
            join(paths, tmp_path / "new.mcap")
    with pytest.raises(InputError, match="file exists"):
        join([one, two], three)
    two.write_bytes(two.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"s\.2\.mcap: truncated .*run `hilrig recover"):
        join([one, two], tmp_path / "new.mcap")
    assert not (tmp_path / "new.mcap").exists()
