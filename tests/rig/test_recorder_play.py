"""`hilrig play` on the zenoh bus: tools receive a played recording like a running rig."""

import signal
import subprocess
import time
from pathlib import Path

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_schemas import JointState, RigConfig
from hilrig_schemas.topics import CONFIG, STATE
from support import recordings
from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import hilrig
from support.recorder_rig import make_lab, sending
from support.waiting import eventually


@pytest.mark.rig
def test_played_recording_is_received_like_a_running_rig(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    made = recordings.make(recordings.Script(seconds=2))
    path = recordings.write(tmp_path / "run.mcap", made, script=recordings.Script(seconds=2))
    received: list[tuple[float, bytes]] = []
    command = [*HILRIG, "play", str(path), "--config", str(config), "--loop", "--rig", "rig7"]
    player = ForkedPopen(command, stderr=subprocess.PIPE, text=True)
    try:
        with ZenohBus(lab.bus, "tool") as bus:
            bus.subscribe(STATE.key(lab.name, "rig7"), lambda _, payload: received.append((time.monotonic(), payload)))
            answers = eventually(lambda: bus.query(CONFIG.key(lab.name, "rig7"), timeout_s=0.5))
            assert RigConfig.FromString(answers[0].payload).urdf
            eventually(lambda: len(received) > 80)
        player.send_signal(signal.SIGINT)
        _, errors = player.communicate(timeout=10)
    finally:
        player.kill()
    assert player.returncode == 0
    assert "played" in errors
    states = [JointState.FromString(payload) for _, payload in received]
    assert {state.rig for state in states} == {"rig7"}
    # 50 states per second, as recorded.
    duration = received[79][0] - received[0][0]
    assert 1.4 < duration < 3.0


@pytest.mark.rig
def test_play_is_rejected_while_a_lab_runs(tmp_path: Path) -> None:
    config, lab = make_lab(tmp_path)
    path = recordings.record(tmp_path / "run.mcap", recordings.Script(seconds=1))
    with sending(lab, ["rig1"]) as senders:
        senders.begin("rig1")
        eventually(lambda: senders.count("rig1"))
        answer = hilrig("play", path, "--config", config)
    assert answer.returncode == 3
    assert "a lab is already running on this host" in answer.stderr
    assert "Traceback" not in answer.stderr
