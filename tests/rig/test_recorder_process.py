"""The recorder as a process on the real bus: shutdown, manual sessions, and one recorder per rig."""

import json
import re
import signal
import subprocess
from functools import partial
from pathlib import Path

import pytest

from support.hilrig_process import HILRIG
from support.labs import free_ports, hilrig
from support.recorder_rig import (
    RecorderProcess,
    Senders,
    files_of,
    make_lab,
    metadata,
    recorded,
    router,
    sending,
    wait_ready,
)
from support.waiting import LONG_TIMEOUT_S, eventually


@pytest.mark.rig
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signaled_recorder_finishes_its_files(tmp_path: Path, number: signal.Signals) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]) as senders, RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        senders.begin("rig1")
        eventually(lambda: senders.count("rig1") > 150)
        eventually(lambda: files_of(lab, "rig1", "*.part"))
        recorder.process.send_signal(number)
        assert recorder.process.wait(LONG_TIMEOUT_S) == 0
        [path] = files_of(lab, "rig1")
        assert not files_of(lab, "rig1", "*.part")
        found = recorded([path])
    assert metadata(path)["hilrig.summary"]["ended"] == "recorder stopped"
    assert metadata(path)["hilrig.config"]["rig"] == "rig1"
    sent = senders.sent["rig1"]
    # All messages up to some time are recorded, without a gap.
    for stream in ("/state", "/command"):
        last = max(sequence for channel, sequence, _ in found if channel == stream)
        assert {key for key in sent if key[0] == stream and key[1] <= last} - set(found) == set()
    assert len(found) > 150


def have_sent(senders: Senders, counts: dict[str, int]) -> bool:
    return all(senders.count(rig) > count for rig, count in counts.items())


@pytest.mark.rig
def test_all_messages_of_a_session_are_recorded_unchanged(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=5)
    rigs = [rig.name for rig in lab.rigs]
    with RecorderProcess(config) as recorder, sending(lab, rigs) as senders:
        wait_ready(lab, recorder)
        for _ in range(2):
            for rig in rigs:
                senders.begin(rig)
            goals = dict.fromkeys(rigs, max(map(senders.count, rigs)) + 150)
            eventually(partial(have_sent, senders, goals))
            for rig in rigs:
                senders.end(rig)
        eventually(lambda: all(len(files_of(lab, rig)) == 2 for rig in rigs))
    for rig in rigs:
        paths = files_of(lab, rig)
        assert set(senders.sent[rig]) <= set(recorded(paths))
        for path in paths:
            summary = metadata(path)["hilrig.summary"]
            assert (summary["ended"], summary["lost_transport"], summary["lost_recorder"]) == ("ended", "0", "0")


@pytest.mark.rig
def test_manual_session_and_its_refusals(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]), RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        started = hilrig("record", "start", "rig1", "--config", config, "--json")
        assert started.returncode == 0, started.stderr
        session = json.loads(started.stdout)["session"]
        eventually(lambda: files_of(lab, "rig1", "*.part"))
        again = hilrig("record", "start", "rig1", "--config", config)
        assert again.returncode == 3
        assert f"rig1: manual recording {session} is already running" in again.stderr
        unknown = hilrig("record", "start", "rig9", "--config", config)
        assert unknown.returncode == 2
        assert unknown.stderr == "hilrig: error: unknown rig 'rig9'; this lab has rig1\n"
        assert hilrig("record", "stop", "rig9", "--config", config).returncode == 2
        # A manual session continues after a restart of the recorder.
        recorder.kill()
        with RecorderProcess(config) as second:
            wait_ready(lab, second)
            eventually(lambda: files_of(lab, "rig1", "*.2.mcap.part"))
            ended = hilrig("record", "stop", "rig1", "--config", config)
            assert ended.returncode == 0, ended.stderr
            assert session in ended.stdout
            [first, last] = eventually(lambda: len(files_of(lab, "rig1")) == 2 and files_of(lab, "rig1"))
            assert first.name == f"{session}.mcap"
            assert metadata(last)["hilrig.session"]["session"] == session
            assert metadata(last)["hilrig.summary"]["reason"] == "ended manually"
            assert len(recorded([first, last])) == len(set(recorded([first, last]))) > 0
            assert hilrig("record", "stop", "rig1", "--config", config).returncode == 3
    no_recorder = hilrig("record", "start", "rig1", "--config", config)
    assert no_recorder.returncode == 3
    assert "no recorder answers" in no_recorder.stderr


@pytest.mark.rig
def test_second_recorder_on_the_same_folder_exits(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]) as senders, RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        senders.begin("rig1")
        # The same folder on another bus, as with a copied lab.toml with other ports.
        other = tmp_path / "other"
        other.mkdir()
        text = config.read_text().replace(f"first_port = {lab.bus.first_port}", f"first_port = {free_ports(3)}")
        (other / "lab.toml").write_text(text)
        with RecorderProcess(other / "lab.toml") as second:
            assert second.process.wait(30) == 3
        log = second.log.read_text()
        assert "another recorder" in log
        assert f"process {recorder.process.pid}" in log
        assert "Traceback" not in log
        assert recorder.process.poll() is None
        senders.end("rig1")
        eventually(lambda: files_of(lab, "rig1"))


@pytest.mark.rig
def test_second_recorder_on_the_same_bus_exits(tmp_path: Path) -> None:
    with router() as endpoint:
        config, lab = make_lab(tmp_path, extra=f'bus.topology = "router"\nbus.router = "{endpoint}"')
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            other = tmp_path / "other"
            other.mkdir()
            text = config.read_text().replace(str(lab.recorder.folder), str(other / "recordings"))
            (other / "lab.toml").write_text(text)
            with RecorderProcess(other / "lab.toml") as second:
                assert second.process.wait(30) == 3
            assert "has the same instance name; choose another --instance" in second.log.read_text()
            assert recorder.process.poll() is None


@pytest.mark.rig
def test_recorders_partition_the_rigs_of_a_lab(tmp_path: Path) -> None:
    with router() as endpoint:
        config, lab = make_lab(tmp_path, rigs=3, extra=f'bus.topology = "router"\nbus.router = "{endpoint}"')
        rigs = [rig.name for rig in lab.rigs]
        partitions = [("--instance", "one", "--rigs", "rig1,rig2"), ("--instance", "two", "--rigs", "rig3")]
        with (
            RecorderProcess(config, *partitions[0]) as first,
            RecorderProcess(config, *partitions[1]) as second,
            sending(lab, rigs) as senders,
        ):
            wait_ready(lab, first, "one")
            wait_ready(lab, second, "two")
            with RecorderProcess(config, "--instance", "three", "--rigs", "rig2,rig3") as third:
                assert third.process.wait(30) == 3
            refusal = third.log.read_text()
            assert re.search(
                r"recorder/one on \S+ already serves rig2; recorder/two on \S+ already serves rig3;", refusal
            )
            # A rig that is not in the lab file belongs to the recorder of the first rig.
            added = hilrig("record", "start", "rig9", "--config", config)
            assert "unknown rig 'rig9'; this lab has rig1, rig2, rig3" in added.stderr
            manual = hilrig("record", "start", "rig3", "--config", config, "--json")
            assert manual.returncode == 0, manual.stderr
            for rig in rigs:
                senders.begin(rig)
            eventually(lambda: min(map(senders.count, rigs)) > 100)
            assert hilrig("record", "stop", "rig3", "--config", config).returncode == 0
            for rig in rigs:
                senders.end(rig)
            eventually(lambda: [len(files_of(lab, rig)) for rig in ("rig1", "rig2", "rig3")] == [1, 1, 2])
        for rig in rigs:
            assert set(senders.sent[rig]) <= set(recorded(files_of(lab, rig)))
            for path in files_of(lab, rig):
                found_metadata = metadata(path)
                assert found_metadata["hilrig.session"]["recorder"] == (
                    "recorder/two" if rig == "rig3" else "recorder/one"
                )
                assert (
                    found_metadata["hilrig.summary"]["lost_transport"],
                    found_metadata["hilrig.summary"]["lost_recorder"],
                ) == (
                    "0",
                    "0",
                )


@pytest.mark.rig
def test_rotation_loses_no_messages(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, extra="recorder.rotate_min = 0.02")
    with RecorderProcess(config) as recorder, sending(lab, ["rig1"]) as senders:
        wait_ready(lab, recorder)
        senders.begin("rig1")
        eventually(lambda: len(files_of(lab, "rig1")) >= 3)
        senders.end("rig1")
        eventually(lambda: not files_of(lab, "rig1", "*.part"))
        paths = files_of(lab, "rig1")
    found = recorded(paths)
    assert len(found) == len(set(found))
    assert set(senders.sent["rig1"]) <= set(found)
    ends = [metadata(path)["hilrig.summary"]["ended"] for path in paths]
    assert ends == ["continued"] * (len(paths) - 1) + ["ended"]
    for path in paths:
        found_metadata = metadata(path)
        assert found_metadata["hilrig.config"]["rig"] == "rig1"
        assert found_metadata["hilrig.summary"]["lost_recorder"] == "0"


def test_help_of_record_lists_start_and_stop() -> None:
    output = subprocess.run([*HILRIG, "record", "--help"], check=True, capture_output=True, text=True).stdout
    assert "start" in output
    assert "stop" in output
