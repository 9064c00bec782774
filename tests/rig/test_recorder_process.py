"""The recorder as a process on the real bus: orderly ends, sessions by hand, and only one recorder a lab."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

from support.labs import HILRIG, free_ports, hilrig
from support.recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, router, sending, wait_ready
from support.waiting import PATIENT_S, eventually


@pytest.mark.rig
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_recorder_that_is_told_to_end_finishes_its_files(tmp_path: Path, number: signal.Signals) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]) as senders, RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        senders.begin("rig1")
        eventually(lambda: senders.count("rig1") > 150)
        eventually(lambda: files_of(lab, "rig1", "*.part"))
        recorder.process.send_signal(number)
        assert recorder.process.wait(PATIENT_S) == 0
        [path] = files_of(lab, "rig1")
        assert not files_of(lab, "rig1", "*.part")
        found = recorded([path])
    assert metadata(path)["hilrig.summary"]["ended"] == "recorder stopped"
    assert metadata(path)["hilrig.config"]["rig"] == "rig1"
    sent = senders.sent["rig1"]
    # All that was sent up to some moment, and nothing is missing in between.
    for stream in ("/state", "/command"):
        last = max(sequence for channel, sequence, _ in found if channel == stream)
        assert {key for key in sent if key[0] == stream and key[1] <= last} - set(found) == set()
    assert len(found) > 150


@pytest.mark.rig
def test_every_message_of_a_session_is_in_its_file_byte_for_byte(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path, rigs=5)
    rigs = [rig.name for rig in lab.rigs]
    with RecorderProcess(config) as recorder, sending(lab, rigs) as senders:
        wait_ready(lab, recorder)
        for _ in range(2):
            for rig in rigs:
                senders.begin(rig)
            goal = max(map(senders.count, rigs)) + 150
            eventually(lambda goal=goal: min(map(senders.count, rigs)) > goal)
            for rig in rigs:
                senders.end(rig)
        for rig in rigs:
            eventually(lambda rig=rig: len(files_of(lab, rig)) == 2)
    for rig in rigs:
        paths = files_of(lab, rig)
        assert set(senders.sent[rig]) <= set(recorded(paths))
        for path in paths:
            summary = metadata(path)["hilrig.summary"]
            assert (summary["ended"], summary["lost_transport"], summary["lost_recorder"]) == ("ended", "0", "0")


@pytest.mark.rig
def test_a_session_by_hand_and_its_refusals(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]), RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        begun = hilrig("record", "start", "rig1", "--config", config, "--json")
        assert begun.returncode == 0, begun.stderr
        session = json.loads(begun.stdout)["session"]
        eventually(lambda: files_of(lab, "rig1", "*.part"))
        again = hilrig("record", "start", "rig1", "--config", config)
        assert again.returncode == 3
        assert f"is being recorded by hand already: {session}" in again.stderr
        unknown = hilrig("record", "start", "rig9", "--config", config)
        assert unknown.returncode == 2
        assert unknown.stderr == "hilrig: error: no rig is called 'rig9'; this lab has rig1\n"
        assert hilrig("record", "stop", "rig9", "--config", config).returncode == 2
        # By hand too, a session outlives the recorder.
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
            assert metadata(last)["hilrig.summary"]["reason"] == "ended by hand"
            assert len(recorded([first, last])) == len(set(recorded([first, last]))) > 0
            assert hilrig("record", "stop", "rig1", "--config", config).returncode == 3
    nobody = hilrig("record", "start", "rig1", "--config", config)
    assert nobody.returncode == 3
    assert "no recorder answers" in nobody.stderr


@pytest.mark.rig
def test_a_second_recorder_on_the_same_folder_refuses(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]) as senders, RecorderProcess(config) as recorder:
        wait_ready(lab, recorder)
        senders.begin("rig1")
        # The same folder on another bus, as a copied lab.toml with other ports does it.
        other = tmp_path / "other"
        other.mkdir()
        text = config.read_text().replace(f"first_port = {lab.bus.first_port}", f"first_port = {free_ports(3)}")
        (other / "lab.toml").write_text(text)
        with RecorderProcess(other / "lab.toml") as second:
            assert second.process.wait(30) == 3
        said = second.log.read_text()
        assert "another recorder" in said
        assert f"process {recorder.process.pid}" in said
        assert "Traceback" not in said
        assert recorder.process.poll() is None
        senders.end("rig1")
        eventually(lambda: files_of(lab, "rig1"))


@pytest.mark.rig
def test_a_second_recorder_on_the_same_bus_refuses(tmp_path: Path) -> None:
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
            assert "another recorder is called '1' already: recorder/1" in second.log.read_text()
            assert recorder.process.poll() is None


@pytest.mark.rig
def test_recorders_share_the_rigs_of_a_lab_and_no_rig_has_two(tmp_path: Path) -> None:
    with router() as endpoint:
        config, lab = make_lab(tmp_path, rigs=3, extra=f'bus.topology = "router"\nbus.router = "{endpoint}"')
        rigs = [rig.name for rig in lab.rigs]
        shares = [("--instance", "one", "--rigs", "rig1,rig2"), ("--instance", "two", "--rigs", "rig3")]
        with (
            RecorderProcess(config, *shares[0]) as first,
            RecorderProcess(config, *shares[1]) as second,
            sending(lab, rigs) as senders,
        ):
            wait_ready(lab, first, "one")
            wait_ready(lab, second, "two")
            with RecorderProcess(config, "--instance", "three", "--rigs", "rig2,rig3") as third:
                assert third.process.wait(30) == 3
            assert "serves rig2 already; a rig has one recorder" in third.log.read_text()
            # Not in the lab's file, as one that was added while the lab runs: the first rig's recorder has it.
            added = hilrig("record", "start", "rig9", "--config", config)
            assert "no rig is called 'rig9'; this lab has rig1, rig2, rig3" in added.stderr
            by_hand = hilrig("record", "start", "rig3", "--config", config, "--json")
            assert by_hand.returncode == 0, by_hand.stderr
            for rig in rigs:
                senders.begin(rig)
            eventually(lambda: min(map(senders.count, rigs)) > 100)
            assert hilrig("record", "stop", "rig3", "--config", config).returncode == 0
            for rig in rigs:
                senders.end(rig)
            for rig, count in (("rig1", 1), ("rig2", 1), ("rig3", 2)):
                eventually(lambda rig=rig, count=count: len(files_of(lab, rig)) == count)
        for rig in rigs:
            assert set(senders.sent[rig]) <= set(recorded(files_of(lab, rig)))
            for path in files_of(lab, rig):
                about = metadata(path)
                assert about["hilrig.session"]["recorder"] == ("recorder/two" if rig == "rig3" else "recorder/one")
                assert (about["hilrig.summary"]["lost_transport"], about["hilrig.summary"]["lost_recorder"]) == (
                    "0",
                    "0",
                )


@pytest.mark.rig
def test_rotation_loses_nothing_at_the_seams(tmp_path: Path) -> None:
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
        about = metadata(path)
        assert about["hilrig.config"]["rig"] == "rig1"
        assert about["hilrig.summary"]["lost_recorder"] == "0"


def test_help_of_record_names_both_words() -> None:
    said = subprocess.run([*HILRIG, "record", "--help"], check=True, capture_output=True, text=True).stdout
    assert "start" in said
    assert "stop" in said
