"""Names in a folder that are no regular files, folders that are symbolic links, and the beginning of each recording."""

import os
import socket
from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.storage.maintenance import find_unfinished
from hilrig_recorder.storage.retention import finished_recordings
from hilrig_replay.analysis.index import RunIndex, write_verdict
from hilrig_replay.io.output_file import check_output
from hilrig_replay.io.paths import find_runs
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from support import recordings
from support.recordings import MS, START_WALL_NS, Script, record

SCRIPT = Script(seconds=1.0)


def make_special(path: Path, kind: str) -> Path:
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.symlink_to(path)
    return path


@pytest.mark.timeout(20)
@pytest.mark.parametrize("kind", ["fifo", "socket", "device", "loop"])
def test_special_files_are_refused_and_not_waited_for(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "lab" / "rig1"
    folder.mkdir(parents=True)
    good = record(folder / "good.mcap", SCRIPT)
    special = [make_special(folder / f"x{suffix}", kind) for suffix in (".mcap", ".mcap.part")]
    assert [entry.path for entry in RunIndex(tmp_path).load()] == ["lab/rig1/good.mcap"]
    assert find_runs([tmp_path]) == [(good,)]
    assert find_unfinished(tmp_path / "lab") == []
    assert [stored.path for stored in finished_recordings(tmp_path / "lab")] == [good]
    for path in special:
        with pytest.raises(InputError, match=r"x\.mcap.*can't be read: "):
            open_run(path)
        with pytest.raises(InputError, match=r"x\.mcap.*can't be read: "):
            recover(path, tmp_path / "new.mcap")
        if kind == "fifo":
            check_output(path)


def test_linked_folders_are_followed_once(tmp_path: Path) -> None:
    elsewhere, lab = tmp_path / "disk" / "rig2", tmp_path / "recordings" / "lab"
    for folder in (elsewhere, lab / "rig1"):
        folder.mkdir(parents=True)
        record(folder / f"{folder.name}.mcap", SCRIPT)
    (lab / "rig2").symlink_to(elsewhere)
    (lab / "a-second-name").symlink_to(lab / "rig1")
    (lab / "rig1" / "up").symlink_to(tmp_path / "recordings")
    (lab / "rig1" / "self").symlink_to(lab / "rig1" / "self")
    expected = ["lab/rig1/rig1.mcap", "lab/rig2/rig2.mcap"]
    assert sorted(entry.path for entry in RunIndex(tmp_path / "recordings").load()) == expected
    assert find_runs([tmp_path / "recordings"]) == [(tmp_path / "recordings" / path,) for path in expected]


def test_late_arrival_changes_neither_beginning_nor_duration(tmp_path: Path) -> None:
    made = recordings.make(Script(seconds=3.0))
    # The recorder was restarted: it fetched the first two thirds from the caches of the senders.
    path = recordings.write(tmp_path / "run.mcap", made, script=SCRIPT, fetched_until_s=2.0)
    run = open_run(path)
    [entry] = RunIndex(tmp_path).load()
    states = run.states
    assert entry.duration_s == run.duration_s == (states["sampled_ns"][-1] - states["sampled_ns"][0]) / 1e9
    assert abs(entry.duration_s - 3.0) < 0.05
    assert entry.start_wall_ns == run.start_wall_ns == states["wall_ns"][0]
    assert run.file.start_ns - entry.start_wall_ns > 1_900 * MS


def test_duration_after_a_restart_is_that_of_the_wall_clock(tmp_path: Path) -> None:
    made = recordings.make(SCRIPT)
    states = [one.message for one in made if one.topic == "state"]
    for state in states[30:]:
        state.incarnation, state.sampled_ns = 8, state.sampled_ns - (1 << 60)  # type: ignore[attr-defined]
    path = recordings.write(tmp_path / "run.mcap", made, script=SCRIPT)
    assert abs(open_run(path).duration_s - 0.98) < 0.01
    assert abs(RunIndex(tmp_path).load()[0].start_wall_ns - START_WALL_NS) < MS


def test_verdict_is_void_when_the_file_changes(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", SCRIPT)

    def verdict() -> bool | None:
        return RunIndex(tmp_path).load(rebuild=True)[0].verified

    write_verdict(path, verified=True)
    assert verdict() is True
    before, data = path.stat(), path.read_bytes()
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000_000))
    assert verdict() is None
    write_verdict(path, verified=True)
    changed = bytearray(data)
    changed[-12] ^= 1
    path.write_bytes(changed)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1_000_000_000))
    # Same size and time, another checksum of the summary: also found damaged.
    [entry] = RunIndex(tmp_path).load(rebuild=True)
    assert (entry.verified, "bad checksum" in entry.error) == (None, True)


def test_damaged_file_shows_no_verdict(tmp_path: Path) -> None:
    path = record(tmp_path / "run.mcap", Script(seconds=4.0))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    write_verdict(path, verified=True)
    index = RunIndex(tmp_path)
    [entry] = index.measure(index.load())
    assert "damaged" in entry.error
    assert entry.verified is None
    index.save()
    [entry] = RunIndex(tmp_path).load()
    assert entry.verified is None
