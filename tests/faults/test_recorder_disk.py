"""A disk that is full, slow or failing: files are finished, the operator is alerted, other files are not affected."""

import contextlib
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.records import Chunk, Message
from hilrig_recorder.mcap_format.scan import read_chunk, scan
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_schemas import Health, JointState
from hilrig_schemas.topics import HEALTH
from support.recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, sending, wait_ready
from support.waiting import eventually


@contextmanager
def tmpfs(folder: Path, size_kib: int, *, files: int = 0) -> Iterator[Path]:
    """A file system with limited size (KiB) and number of files and folders; 0: no limit."""
    if os.name != "posix" or os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root to mount a small file system")
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size_kib}k,nr_inodes={files}", "tmpfs", str(folder)],
        check=False,
        capture_output=True,
        text=True,
    )
    if mounted.returncode:
        said = mounted.stderr.strip().partition("\n")[0]
        pytest.skip(f"needs the right to mount a small file system (CAP_SYS_ADMIN): {said}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(path: Path) -> None:
    """Write until there is no space left."""
    with path.open("wb", buffering=0) as stream, contextlib.suppress(OSError):
        while stream.write(bytes(4096)):
            pass


def holds_messages(lab: LabConfig, rig: str) -> bool:
    """Whether the disk contains messages of a session of the rig."""
    return any(
        state.session
        for part in files_of(lab, rig, "*.part")
        for _, chunk in scan(part.read_bytes())
        if isinstance(chunk, Chunk)
        for message in read_chunk(chunk)
        if isinstance(message, Message) and message.channel_id == CHANNEL_OF_TOPIC["state"]
        for state in (JointState.FromString(message.data),)
    )


class Alerts:
    """Receives the alerts in the recorder's health reports."""

    def __init__(self, lab: LabConfig) -> None:
        self.received: list[str] = []
        self._bus = ZenohBus(lab.bus, "tool")
        self._bus.subscribe(HEALTH.key(lab.name, "recorder", "*"), self._on_health)

    def _on_health(self, _key: str, payload: bytes) -> None:
        self.received.append(Health.FromString(payload).alert)

    def close(self) -> None:
        self._bus.close()


@pytest.mark.rig
def test_full_disk_finishes_files_and_recording_resumes(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=2, extra="recorder.min_free_mib = 0")
    rigs = [rig.name for rig in lab.rigs]
    with tmpfs(tmp_path / "recordings", 600) as folder, sending(lab, rigs) as senders:
        ballast = folder / "ballast"
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            alerts = Alerts(lab)
            try:
                for rig in rigs:
                    senders.begin(rig)
                eventually(lambda: all(holds_messages(lab, rig) for rig in rigs))
                fill(ballast)
                eventually(lambda: all(files_of(lab, rig) for rig in rigs))
                eventually(lambda: any("No space left" in text for text in alerts.received))
                full = {rig: files_of(lab, rig)[0] for rig in rigs}
                for rig in rigs:
                    summary = metadata(full[rig])["hilrig.summary"]
                    assert summary["ended"] == "disk full"
                    found = recorded([full[rig]])
                    assert set(found) & set(senders.sent[rig])
                    assert len(found) == len(set(found))
                # Longer than the pre-roll.
                sent = senders.count(rigs[0])
                eventually(lambda: senders.count(rigs[0]) > sent + 300)
                ballast.unlink()
                # Recording is retried ten seconds after the failure.
                eventually(lambda: all(files_of(lab, rig, "*.part") for rig in rigs))
                eventually(lambda: alerts.received and not alerts.received[-1])
                for rig in rigs:
                    senders.end(rig)
                eventually(lambda: all(len(files_of(lab, rig)) == 2 for rig in rigs))
            finally:
                alerts.close()
        for rig in rigs:
            last = files_of(lab, rig)[-1]
            assert metadata(last)["hilrig.session"]["previous"] == full[rig].name
            # The second segment states the gap between the two segments.
            lost = int(metadata(last)["hilrig.summary"]["lost_recorder"])
            found = recorded(files_of(lab, rig))
            numbers = {sequence for channel, sequence, _ in found if channel == "/state"}
            assert lost >= max(numbers) - min(numbers) + 1 - len(numbers) > 0


@pytest.mark.rig
def test_disk_full_before_the_first_chunk_keeps_messages(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, extra="recorder.min_free_mib = 0")
    with tmpfs(tmp_path / "recordings", 600) as folder, sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            senders.begin("rig1")
            # The file has its header, and some messages of the session are pending for its first chunk.
            eventually(lambda: any(part.stat().st_size for part in files_of(lab, "rig1", "*.part")), every_s=0.002)
            before = senders.count("rig1")
            eventually(lambda: senders.count("rig1") > before + 10, every_s=0.002)
            fill(folder / "ballast")
            [path] = eventually(lambda: files_of(lab, "rig1"))
        found = metadata(path)
        assert found["hilrig.summary"]["ended"] == "disk full"
        assert found["hilrig.session"]["rig"] == "rig1"
        # The reserved space suffices for it.
        assert recorded([path])


@pytest.mark.rig
def test_recordings_end_below_the_minimum_free_space(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, extra="recorder.min_free_mib = 2")
    with tmpfs(tmp_path / "recordings", 4096) as folder, sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            senders.begin("rig1")
            eventually(lambda: files_of(lab, "rig1", "*.part"))
            (folder / "ballast").write_bytes(bytes(2_600_000))
            [path] = eventually(lambda: files_of(lab, "rig1"))
            assert recorder.process.poll() is None
        assert metadata(path)["hilrig.summary"]["ended"] == "disk full"
        assert "nearly full" in metadata(path)["hilrig.summary"]["reason"]
    assert "recording stopped: " in recorder.log.read_text()


@pytest.mark.rig
def test_disk_without_free_inodes_is_reported(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=8, extra="recorder.min_free_mib = 0")
    rigs = [rig.name for rig in lab.rigs]
    # Enough inodes for the folders of all rigs and the files of some.
    with tmpfs(tmp_path / "recordings", 64 << 10, files=16) as folder, sending(lab, rigs, step_ms=100.0) as senders:
        for rig in rigs:
            (folder / lab.name / rig).mkdir(parents=True)
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            alerts = Alerts(lab)
            try:
                for rig in rigs:
                    senders.begin(rig)
                text = eventually(lambda: next((text for text in alerts.received if " more" in text), ""))
                for rig in rigs:
                    senders.end(rig)
                complete = eventually(lambda: [path for rig in rigs for path in files_of(lab, rig)])
            finally:
                alerts.close()
        assert "can't be recorded: the disk has no free inodes, so it can't store more files" in text
        assert len(text.split("; ")) == 4, text
        for path in complete:
            assert metadata(path)["hilrig.summary"]["ended"] == "ended"


@pytest.mark.rig
def test_read_only_disk_is_one_error_line_and_exit_3(tmp_path: Path) -> None:
    config, _ = make_lab(tmp_path)
    with tmpfs(tmp_path / "recordings", 600) as folder:
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        with RecorderProcess(config) as recorder:
            assert recorder.process.wait(30) == 3
    errors = [line for line in recorder.log.read_text().splitlines() if "error" in line]
    assert len(errors) == 1
    assert "can't write recordings: Read-only file system" in errors[0]


@pytest.mark.rig
def test_unwritable_folder_is_one_error_line_and_exit_3(tmp_path: Path) -> None:
    config, _ = make_lab(tmp_path)
    (tmp_path / "recordings").write_text("not a folder")
    with RecorderProcess(config) as recorder:
        assert recorder.process.wait(30) == 3
    errors = [line for line in recorder.log.read_text().splitlines() if "error" in line]
    assert len(errors) == 1
    assert "can't write recordings" in errors[0]
    assert "Traceback" not in recorder.log.read_text()


@pytest.mark.rig
@pytest.mark.skipif(os.name != "posix", reason="on other systems an open file can't be moved or deleted")
@pytest.mark.parametrize("change", ["file moved", "file deleted", "file truncated", "folder deleted"])
def test_moved_or_deleted_recording_continues_in_new_segment(tmp_path: Path, change: str) -> None:
    config, lab = make_lab(tmp_path)
    elsewhere = tmp_path / "elsewhere.mcap"
    with sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            alerts = Alerts(lab)
            try:
                senders.begin("rig1")
                eventually(lambda: holds_messages(lab, "rig1"))
                [part] = files_of(lab, "rig1", "*.part")
                if change == "file moved":
                    part.rename(elsewhere)
                elif change == "file deleted":
                    part.unlink()
                elif change == "file truncated":
                    os.truncate(part, 100)
                else:
                    shutil.rmtree(lab.recorder.folder)
                eventually(lambda: files_of(lab, "rig1", "*.2.mcap.part"))
                eventually(
                    lambda: any(
                        re.search("(moved or deleted|truncated) while it was being written", text)
                        for text in alerts.received
                    )
                )
                sent = senders.count("rig1")
                eventually(lambda: senders.count("rig1") > sent + 100)
                senders.end("rig1")
                [path] = eventually(lambda: files_of(lab, "rig1"))
            finally:
                alerts.close()
        assert metadata(path)["hilrig.session"]["previous"] == part.name.removesuffix(".part")
        found = recorded([path])
        if change == "file moved":
            # The moved file is finished in its new place; both files together contain all messages.
            assert metadata(elsewhere)["hilrig.summary"]["ended"] == "continued"
            found += recorded([elsewhere])
            assert set(senders.sent["rig1"]) <= set(found)
        assert len(found) == len(set(found))
    assert "Traceback" not in recorder.log.read_text()
