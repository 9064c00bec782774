"""A disk that is full, or slow, or fails: the file ends whole, the operator is told, the other rigs' files go on."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hilrig_recorder.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.scan import Chunk, Message, open_chunk, scan
from hilrig_runtime.config import LabConfig
from hilrig_runtime.zenoh_bus import ZenohBus
from hilrig_schemas import Health, JointState
from hilrig_schemas.topics import HEALTH
from recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, sending, wait_ready
from waiting import eventually


@contextmanager
def tmpfs(folder: Path, size_kib: int, *, files: int = 0) -> Iterator[Path]:
    """A file system of so many KiB, and so many files and folders; 0: any number."""
    if os.name != "posix" or os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("needs root, to mount a small file system")
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
    """Whether messages of a rig's session are on the disk."""
    return any(
        state.session
        for part in files_of(lab, rig, "*.part")
        for _, chunk in scan(part.read_bytes())
        if isinstance(chunk, Chunk)
        for message in open_chunk(chunk)
        if isinstance(message, Message) and message.channel_id == CHANNEL_OF_TOPIC["state"]
        for state in (JointState.FromString(message.data),)
    )


class Troubles:
    """What the recorder's health says, as it comes."""

    def __init__(self, lab: LabConfig) -> None:
        self.heard: list[str] = []
        self._bus = ZenohBus(lab.bus, "tool")
        self._bus.subscribe(HEALTH.key(lab.name, "recorder", "*"), self._on_health)

    def _on_health(self, _key: str, payload: bytes) -> None:
        self.heard.append(Health.FromString(payload).trouble)

    def close(self) -> None:
        self._bus.close()


@pytest.mark.rig
def test_a_full_disk_ends_files_whole_and_recording_goes_on_when_there_is_space_again(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=2, extra="recorder.min_free_mib = 0")
    rigs = [rig.name for rig in lab.rigs]
    with tmpfs(tmp_path / "recordings", 600) as folder, sending(lab, rigs) as senders:
        ballast = folder / "ballast"
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            troubles = Troubles(lab)
            try:
                for rig in rigs:
                    senders.begin(rig)
                eventually(lambda: all(holds_messages(lab, rig) for rig in rigs))
                fill(ballast)
                for rig in rigs:
                    eventually(lambda rig=rig: files_of(lab, rig))
                eventually(lambda: any("No space left" in text for text in troubles.heard))
                full = {rig: files_of(lab, rig)[0] for rig in rigs}
                for rig in rigs:
                    summary = metadata(full[rig])["hilrig.summary"]
                    assert summary["ended"] == "disk full"
                    found = recorded([full[rig]])
                    assert set(found) & set(senders.sent[rig])
                    assert len(found) == len(set(found))
                # Longer than the pre-roll reaches back.
                sent = senders.count(rigs[0])
                eventually(lambda: senders.count(rigs[0]) > sent + 300)
                ballast.unlink()
                # Tried again ten seconds after it failed.
                for rig in rigs:
                    eventually(lambda rig=rig: files_of(lab, rig, "*.part"))
                eventually(lambda: troubles.heard and not troubles.heard[-1])
                for rig in rigs:
                    senders.end(rig)
                for rig in rigs:
                    eventually(lambda rig=rig: len(files_of(lab, rig)) == 2)
            finally:
                troubles.close()
        for rig in rigs:
            last = files_of(lab, rig)[-1]
            assert metadata(last)["hilrig.session"]["previous"] == full[rig].name
            # The gap between the two files is known, and stands in the second.
            lost = int(metadata(last)["hilrig.summary"]["lost_recorder"])
            found = recorded(files_of(lab, rig))
            numbers = {sequence for channel, sequence, _ in found if channel == "/state"}
            assert lost >= max(numbers) - min(numbers) + 1 - len(numbers) > 0


@pytest.mark.rig
def test_a_disk_that_is_full_before_the_first_chunk_is_written_holds_what_came_until_then(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, extra="recorder.min_free_mib = 0")
    with tmpfs(tmp_path / "recordings", 600) as folder, sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            senders.begin("rig1")
            # The file has its beginning, and some messages of the session are on their way into its first chunk.
            eventually(lambda: any(part.stat().st_size for part in files_of(lab, "rig1", "*.part")), every_s=0.002)
            before = senders.count("rig1")
            eventually(lambda: senders.count("rig1") > before + 10, every_s=0.002)
            fill(folder / "ballast")
            [path] = eventually(lambda: files_of(lab, "rig1"))
        found = metadata(path)
        assert found["hilrig.summary"]["ended"] == "disk full"
        assert found["hilrig.session"]["rig"] == "rig1"
        # What was set aside has room for it.
        assert recorded([path])


@pytest.mark.rig
def test_with_little_space_left_recordings_end_before_the_disk_is_full(tmp_path: Path) -> None:
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
    assert "only" in recorder.log.read_text()


@pytest.mark.rig
def test_a_disk_that_takes_no_more_files_is_told_apart_from_a_full_one(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=8, extra="recorder.min_free_mib = 0")
    rigs = [rig.name for rig in lab.rigs]
    # The folders of all rigs, and files of some.
    with tmpfs(tmp_path / "recordings", 64 << 10, files=16) as folder, sending(lab, rigs, step_ms=100.0) as senders:
        for rig in rigs:
            (folder / lab.name / rig).mkdir(parents=True)
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            troubles = Troubles(lab)
            try:
                for rig in rigs:
                    senders.begin(rig)
                text = eventually(lambda: next((text for text in troubles.heard if " more" in text), ""))
                for rig in rigs:
                    senders.end(rig)
                whole = eventually(lambda: [path for rig in rigs for path in files_of(lab, rig)])
            finally:
                troubles.close()
        assert "can't be recorded: the disk takes no more files (it has no inodes left)" in text
        assert len(text.split("; ")) == 4, text
        for path in whole:
            assert metadata(path)["hilrig.summary"]["ended"] == "ended"


@pytest.mark.rig
def test_a_disk_that_is_read_only_is_one_line_and_exit_3(tmp_path: Path) -> None:
    config, _ = make_lab(tmp_path)
    with tmpfs(tmp_path / "recordings", 600) as folder:
        subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        with RecorderProcess(config) as recorder:
            assert recorder.process.wait(30) == 3
    errors = [line for line in recorder.log.read_text().splitlines() if "error" in line]
    assert len(errors) == 1
    assert "recordings can't be written there: Read-only file system" in errors[0]


@pytest.mark.rig
def test_a_folder_that_can_not_be_written_is_one_line_and_exit_3(tmp_path: Path) -> None:
    config, _ = make_lab(tmp_path)
    (tmp_path / "recordings").write_text("in the way")
    with RecorderProcess(config) as recorder:
        assert recorder.process.wait(30) == 3
    errors = [line for line in recorder.log.read_text().splitlines() if "error" in line]
    assert len(errors) == 1
    assert "recordings can't be written there" in errors[0]
    assert "Traceback" not in recorder.log.read_text()


@pytest.mark.rig
@pytest.mark.skipif(os.name != "posix", reason="elsewhere an open file can't be moved or deleted")
@pytest.mark.parametrize("what", ["file moved", "file deleted", "folder deleted"])
def test_a_recording_that_is_moved_or_deleted_while_it_is_written_goes_on_in_a_next_file(
    tmp_path: Path, what: str
) -> None:
    config, lab = make_lab(tmp_path)
    elsewhere = tmp_path / "elsewhere.mcap"
    with sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            troubles = Troubles(lab)
            try:
                senders.begin("rig1")
                eventually(lambda: holds_messages(lab, "rig1"))
                [part] = files_of(lab, "rig1", "*.part")
                if what == "file moved":
                    part.rename(elsewhere)
                elif what == "file deleted":
                    part.unlink()
                else:
                    shutil.rmtree(lab.recorder.folder)
                eventually(lambda: files_of(lab, "rig1", "*.2.mcap.part"))
                eventually(lambda: any("moved or deleted while it was written" in text for text in troubles.heard))
                sent = senders.count("rig1")
                eventually(lambda: senders.count("rig1") > sent + 100)
                senders.end("rig1")
                [path] = eventually(lambda: files_of(lab, "rig1"))
            finally:
                troubles.close()
        assert metadata(path)["hilrig.session"]["previous"] == part.name.removesuffix(".part")
        found = recorded([path])
        if what == "file moved":
            # Finished where it is now; the two together have everything.
            assert metadata(elsewhere)["hilrig.summary"]["ended"] == "continued"
            found += recorded([elsewhere])
            assert set(senders.sent["rig1"]) <= set(found)
        assert len(found) == len(set(found))
    assert "Traceback" not in recorder.log.read_text()
