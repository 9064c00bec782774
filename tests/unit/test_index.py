"""Index of recordings: complete, correct, cached, and robust against unusable files."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.records import Metadata

from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.analysis.index import IN_PROGRESS, INDEX_NAME, RunIndex, read_entry, read_verdict, write_verdict
from hilrig_runtime.errors import InputError
from support import recordings
from support.in_process import hilrig_in_process
from support.labs import hilrig

SCRIPT = recordings.Script(seconds=1.0)


def make(folder: Path, name: str = "20260101T000000Z-rig1-abcd", **options: Any) -> Path:
    path = folder / "lab" / "rig1" / f"{name}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    script = replace(SCRIPT, **options)
    return recordings.write(path, recordings.make(script, session=name), script=script, session=name)


def test_entry_has_the_metadata_of_the_file(tmp_path: Path) -> None:
    path = make(tmp_path, lost_transport=3, lost_recorder=2)
    [entry] = RunIndex(tmp_path).load()
    assert (tmp_path / entry.path) == path
    assert (entry.rig, entry.lab, entry.controller) == ("rig1", "lab", recordings.CONTROLLER)
    assert entry.duration_s == pytest.approx(1.0, abs=0.05)
    assert entry.size == path.stat().st_size
    assert (entry.lost_transport, entry.lost_recorder) == (3, 2)
    assert entry.error == ""


def test_measures_the_loop_latency_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path)
    index = RunIndex(tmp_path)
    [entry] = index.measure(index.load())
    assert entry.loop_p50_ms == pytest.approx(20, abs=1)
    assert entry.loop_p50_ms is not None
    assert entry.loop_p99_ms is not None
    assert entry.loop_p99_ms >= entry.loop_p50_ms
    index.save()
    monkeypatch.setattr("hilrig_replay.analysis.index.read_entry", lambda *_: pytest.fail("was read again"))
    monkeypatch.setattr("hilrig_replay.analysis.index.measure_entry", lambda *_: pytest.fail("was measured again"))
    again = RunIndex(tmp_path)
    assert again.measure(again.load()) == [entry]


def test_measuring_reports_damage_inside_a_file(tmp_path: Path) -> None:
    path = make(tmp_path)
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[0]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    index = RunIndex(tmp_path)
    [entry] = index.measure(index.load())
    assert entry.error.startswith("damaged")
    assert "hilrig recover" in entry.error
    assert (entry.fit, entry.loop_p50_ms) == (False, None)
    index.save()
    # The damage is stored in the index.
    assert RunIndex(tmp_path).load() == [entry]
    assert "damaged" in hilrig("runs", tmp_path).stdout


def test_reads_a_changed_file_again(tmp_path: Path) -> None:
    path = make(tmp_path)
    index = RunIndex(tmp_path)
    [before] = index.load()
    index.save()
    recordings.record(path, recordings.Script(seconds=2.0))
    [after] = RunIndex(tmp_path).load()
    assert after.duration_s > before.duration_s + 0.5


def test_rebuilds_a_damaged_index(tmp_path: Path) -> None:
    make(tmp_path)
    for content in ("", "{", '{"version": 1}', json.dumps({"version": 1, "fields": [], "runs": [[1, 2]]})):
        (tmp_path / INDEX_NAME).write_text(content)
        [entry] = RunIndex(tmp_path).load()
        assert entry.messages > 0


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b"", "the file is empty"),
        (b"not an mcap file, but long enough to be one", "not an MCAP file (bad magic)"),
        (None, "truncated (no footer)"),
    ],
)
def test_lists_an_unusable_file_with_the_reason(tmp_path: Path, content: bytes | None, error: str) -> None:
    path = make(tmp_path)
    good = path.read_bytes()
    path.write_bytes(good[:-100] if content is None else content)
    [entry] = RunIndex(tmp_path).load()
    assert error in entry.error


def test_lists_files_truncated_or_changed_anywhere(tmp_path: Path) -> None:
    path = make(tmp_path)
    good = path.read_bytes()
    for length in range(0, len(good), 97):
        path.write_bytes(good[:length])
        entry = read_entry(tmp_path, "lab/rig1/" + path.name, path.stat())
        assert entry.error
    for at in range(len(good) - 600, len(good)):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        read_entry(tmp_path, "lab/rig1/" + path.name, path.stat())


def test_lists_a_file_that_is_being_written(tmp_path: Path) -> None:
    path = make(tmp_path)
    path.rename(path.with_name(path.name + ".part"))
    index = RunIndex(tmp_path)
    [entry] = index.load()
    assert (entry.ended, entry.rig, entry.session) == (IN_PROGRESS, "rig1", "20260101T000000Z-rig1-abcd")
    assert index.measure([entry]) == [entry]


def test_verdict_is_valid_for_the_verified_file_only(tmp_path: Path) -> None:
    path = make(tmp_path)
    assert read_verdict(path) is None
    write_verdict(path, True)
    [entry] = RunIndex(tmp_path).load()
    assert entry.verified is True
    path.write_bytes(path.read_bytes() + b"x")
    assert read_verdict(path) is None


def test_reports_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        RunIndex(tmp_path / "nowhere").load()


def test_lists_a_folder_without_write_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "write_text", refuse)
    index = RunIndex(tmp_path)
    [entry] = index.load()
    index.save()
    assert entry.messages > 0
    assert not (tmp_path / INDEX_NAME).exists()


def test_lists_ten_thousand_indexed_files_quickly(tmp_path: Path) -> None:
    good = make(tmp_path)
    index = RunIndex(tmp_path)
    [entry] = index.load()
    paths = [good.with_name(f"20260101T000000Z-rig1-{number:04}.mcap") for number in range(9_999)]
    for path in paths:
        os.link(good, path)
    # As if each had been read; reading ten thousand takes 20 s.
    index._known |= {(name,): replace(entry, path=name) for name in (str(path.relative_to(tmp_path)) for path in paths)}
    index.save()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hilrig_replay.analysis.index.read_entry", lambda *_: pytest.fail("was read again"))
        begin_s = time.process_time()
        assert len(RunIndex(tmp_path).load()) == 10_000
    # Measured: 0.2 s of processor time; more if caches are shared with another busy process.
    assert time.process_time() - begin_s < 2


@pytest.mark.parametrize(
    ("field", "value"),
    [("start_wall_ns", '"x"'), ("duration_s", "1e999"), ("loop_p50_ms", "NaN"), ("size", "9" * 5000), ("span", "5")],
)
def test_forged_index_is_rebuilt(tmp_path: Path, field: str, value: str) -> None:
    make(tmp_path)
    index = RunIndex(tmp_path)
    entries = index.load()
    index.save()
    content = json.loads((tmp_path / INDEX_NAME).read_text())
    content["runs"][0][content["fields"].index(field)] = "FORGED"
    (tmp_path / INDEX_NAME).write_text(json.dumps(content).replace('"FORGED"', value))
    assert RunIndex(tmp_path).load() == entries


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs POSIX FIFOs")
@pytest.mark.timeout(20)
def test_index_and_verdict_that_are_fifos_are_ignored(tmp_path: Path) -> None:
    path = make(tmp_path)
    os.mkfifo(tmp_path / INDEX_NAME)
    os.mkfifo(f"{path}.verified")
    [entry] = RunIndex(tmp_path).load()
    assert (entry.error, entry.verified) == ("", None)


def test_command_lists_filters_and_sorts(tmp_path: Path) -> None:
    make(tmp_path, "20260101T000000Z-rig1-abcd")
    make(tmp_path, "20260101T000000Z-rig1-long", seconds=2.0)
    (tmp_path / "lab" / "rig1" / "bad.mcap").write_bytes(b"")
    answer = hilrig("runs", tmp_path, "--json", "--sort", "duration")
    # One of the listed files is unusable.
    assert answer.returncode == 1, answer.stderr
    runs = json.loads(answer.stdout)["runs"]
    assert [Path(run["path"]).stem[-4:] for run in runs] == ["long", "abcd", "bad"]
    assert runs[2]["error"] == "the file is empty"
    assert json.loads(hilrig("runs", tmp_path, "--json", "--rig", "rig2").stdout)["runs"] == []
    limited = json.loads(hilrig("runs", tmp_path, "--json", "--limit", "1", "--controller", "192.0.2").stdout)
    assert (limited["total"], len(limited["runs"])) == (2, 1)
    table = hilrig("runs", tmp_path)
    assert "empty" in table.stdout
    assert "20.0" in table.stdout


def test_command_reports_a_missing_folder_in_one_line(tmp_path: Path) -> None:
    answer = hilrig("runs", tmp_path / "nowhere")
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1
    assert "nowhere" in answer.stderr


def test_command_shows_the_reason_of_an_abnormal_ending(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lab" / "rig1" / "20260101T000000Z-rig1-abcd.mcap"
    path.parent.mkdir(parents=True)
    writer = RecordingWriter(path, metadata=(Metadata("hilrig.session", {"rig": "rig1", "session": path.stem}),))
    writer.finish(lambda: {"hilrig.summary": {"ended": "disk full", "reason": "No space left on device"}})
    writer.publish()
    for columns in ("80", "81", "150", "240"):
        monkeypatch.setenv("COLUMNS", columns)
        answer = hilrig_in_process("runs", tmp_path)
        assert answer.returncode == 0, answer.stderr
        assert "disk full: No space left on device" in " ".join(answer.stdout.split())
