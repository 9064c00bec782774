"""Recordings are copied and put back while the lab runs, as docs/operations.md says."""

import json
import shutil
from pathlib import Path

import pytest

from support.labs import RunningLab, hilrig, steady_controller, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig


def listed(folder: Path) -> dict[str, str]:
    """How each recording of a folder ended, by its file's name."""
    done = hilrig("runs", folder, "--json")
    assert done.returncode == 0, done.stderr
    return {Path(run["path"]).name: run["ended"] for run in json.loads(done.stdout)["runs"]}


def test_recordings_are_backed_up_and_restored_while_another_is_written(tmp_path: Path) -> None:
    recordings, backup = tmp_path / "recordings", tmp_path / "backup"
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 100")) as lab:
        with steady_controller(lab.port):
            eventually(lambda: list(recordings.rglob("*.part")))
        (ended,) = eventually(lambda: lab.recordings)
        with steady_controller(lab.port):
            (going_on,) = eventually(
                lambda: [path for path in recordings.rglob("*.part") if path.stat().st_size > 9999]
            )
            shutil.copytree(recordings, backup, ignore=shutil.ignore_patterns(".*", "*.part"))
            kept = ended.read_bytes()
            assert listed(backup) == {ended.name: "ended"}
            torn = backup / ended.relative_to(recordings).with_name(going_on.name)
            shutil.copy(going_on, torn)
            assert hilrig("recover", torn).returncode == 0
            assert set(listed(backup).values()) == {"ended", "recovered"}
            ended.unlink()
            shutil.copy(backup / ended.relative_to(recordings), ended)
        whole = going_on.with_suffix("")
        eventually(whole.exists)
        assert ended.read_bytes() == kept
        assert listed(recordings) == {ended.name: "ended", whole.name: "ended"}
        assert torn.with_suffix("").stat().st_size < whole.stat().st_size, "to restore it over the whole one would lose"
