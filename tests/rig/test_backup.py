"""Recordings are backed up and restored while the lab runs, as described in docs/maintenance.md."""

import json
import shutil
from pathlib import Path

import pytest

from support.labs import RunningLab, hilrig, steady_controller, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig


def listed(folder: Path) -> dict[str, str]:
    """How each recording of a folder ended, by file name."""
    done = hilrig("runs", folder, "--json")
    assert done.returncode == 0, done.stderr
    return {Path(run["path"]).name: run["ended"] for run in json.loads(done.stdout)["runs"]}


def test_backup_and_restore_during_recording(tmp_path: Path) -> None:
    recordings, backup = tmp_path / "recordings", tmp_path / "backup"
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 100")) as lab:
        with steady_controller(lab.port):
            eventually(lambda: list(recordings.rglob("*.part")))
        (ended,) = eventually(lambda: lab.recordings)
        with steady_controller(lab.port):
            (unfinished,) = eventually(
                lambda: [path for path in recordings.rglob("*.part") if path.stat().st_size > 9999]
            )
            shutil.copytree(recordings, backup, ignore=shutil.ignore_patterns(".*", "*.part"))
            kept = ended.read_bytes()
            assert listed(backup) == {ended.name: "ended"}
            truncated = backup / ended.relative_to(recordings).with_name(unfinished.name)
            shutil.copy(unfinished, truncated)
            assert hilrig("recover", truncated).returncode == 0
            assert set(listed(backup).values()) == {"ended", "recovered"}
            ended.unlink()
            shutil.copy(backup / ended.relative_to(recordings), ended)
        complete = unfinished.with_suffix("")
        eventually(complete.exists)
        assert ended.read_bytes() == kept
        assert listed(recordings) == {ended.name: "ended", complete.name: "ended"}
        assert truncated.with_suffix("").stat().st_size < complete.stat().st_size, (
            "restoring it over the complete file would lose messages"
        )
