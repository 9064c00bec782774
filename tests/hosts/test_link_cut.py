"""Link cut between the recorder and the rig on another host: no message is lost."""

import contextlib
import pickle
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.namespaces import Network, require_namespaces
from support.recorder_rig import ZERO_TORQUE, Key, files_of, make_lab, metadata, recorded, recorded_events
from support.waiting import eventually

TESTS = Path(__file__).parents[1]
HILRIG = str(Path(sys.executable).with_name("hilrig"))


def record_with_a_cut(folder: Path, cut_s: float) -> tuple[list[Key], list[Path]]:
    """Record a session with a link cut of the recorder; returns the sent messages and the files of the session."""
    require_namespaces()
    config, lab = make_lab(folder, extra='bus.topology = "router"\nbus.router = "tcp/rig:7447"')
    sent_file = folder / "sent.pickle"
    with Network(["rig", "store"]) as network, (folder / "log").open("w") as log:
        router = [sys.executable, str(TESTS / "support/zenoh_router.py"), "--listen", "tcp/0.0.0.0:7447"]
        network.popen("rig", [*router, "--no-multicast-scouting"], stdin=subprocess.PIPE)
        recorder = network.popen("store", [HILRIG, "recorder", "-c", str(config)], stderr=log, cwd=folder)
        command = [sys.executable, "-m", "support.recorder_rig", str(config), str(sent_file)]
        sender = network.popen("rig", command, stdin=subprocess.PIPE, text=True, cwd=TESTS)
        assert sender.stdin is not None

        def send_line(line: str) -> None:
            print(line, file=sender.stdin, flush=True)

        send_line("begin rig1")

        def size() -> int:
            found = 0
            for path in files_of(lab, "rig1", "*.mcap*"):
                # The recorder may rename the file at this moment.
                with contextlib.suppress(FileNotFoundError):
                    found += path.stat().st_size
            return found

        eventually(lambda: size() > 20_000)
        network.set_link("store", False)
        send_line("emit rig1")
        time.sleep(cut_s)  # the duration of the cut is under test
        during = size()
        network.set_link("store", True)
        eventually(lambda: size() > during + 10_000)
        send_line("end rig1")
        eventually(lambda: files_of(lab, "rig1") and not files_of(lab, "rig1", "*.part"))
        sender.stdin.close()
        assert sender.wait(20) == 0
        assert recorder.poll() is None
    return pickle.loads(sent_file.read_bytes())["rig1"], files_of(lab, "rig1")


@pytest.mark.hosts
@pytest.mark.rig
def test_five_second_link_cut_loses_nothing(tmp_path: Path) -> None:
    sent, [path] = record_with_a_cut(tmp_path, 5.0)
    found = recorded([path])
    assert len(found) == len(set(found))
    missing = set(sent) - set(found)
    summary = metadata(path)["hilrig.summary"]
    assert not missing, f"{len(missing)} of {len(sent)} are missing: {sorted(missing)[0][:2]}…; summary: {summary}"
    assert (summary["lost_transport"], summary["lost_recorder"], summary["clock_steps"]) == ("0", "0", "0")
    assert len(recorded_events([path], ZERO_TORQUE)) == 1


@pytest.mark.hosts
@pytest.mark.rig
@pytest.mark.long("runs for more than a minute")
def test_longer_link_cut_is_counted_exactly(tmp_path: Path) -> None:
    sent, paths = record_with_a_cut(tmp_path, 45.0)
    missing = set(sent) - set(recorded(paths))
    assert len(missing) > 0
    # Without a message of the session's owner for 30 s the file ends; the session continues in the next file.
    summaries = [metadata(path)["hilrig.summary"] for path in paths]
    assert [summary["ended"] for summary in summaries] == ["keeper lost", "ended"]
    lost = [int(summary["lost_transport"]) + int(summary["lost_recorder"]) for summary in summaries]
    assert lost == [0, len(missing)], summaries
    assert len(recorded_events(paths, ZERO_TORQUE)) == 1, "an event at the begin of the cut is lost"
