"""Fault tests of the watchdog: after any controller failure the torque is zero within the timeout plus one step.

The recording of the rig is evaluated. Timestamps of edge and simulation are compared, because on one host both are from
the same clock.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import TypeVar

import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader

from hilrig_schemas import Event, JointState, TorqueCommand
from support.hilrig_process import HILRIG
from support.labs import RunningLab, hilrig, write_lab
from support.namespaces import Network, require_namespaces
from support.waiting import LONG_TIMEOUT_S, eventually

TIMEOUT_MS, STEP_MS = 400, 20
MessageT = TypeVar("MessageT", bound=Message)
TOLERANCE_MS = 1000
"""Other processes may take the processors for some time, ms; with a clock of its own: tests/unit/test_device.py."""

ASK = ("lease", "--json", "--config")

CONTROLLER = """
import socket, sys, time
rig = socket.create_connection((sys.argv[1], int(sys.argv[2])))
rig.settimeout(60)
turn = 0
while True:
    turn += 1
    rig.sendall(bytes.fromhex("000100000006010300040004"))
    rig.recv(300)
    if sys.argv[3] == "writes" or turn < 25:
        rig.sendall(bytes.fromhex("00020000000f0110000000040801f401f401f40064"))
        rig.recv(300)
    if turn == 25:
        print("running", flush=True)
    time.sleep(0.02)
"""


def controller(port: int, mode: str = "writes", host: str = "127.0.0.1") -> list[str]:
    return [sys.executable, "-c", CONTROLLER, host, str(port), mode]


def messages(path: Path, topic: str, kind: type[MessageT]) -> list[MessageT]:
    with path.open("rb") as file:
        return [kind.FromString(message.data) for _, _, message in make_reader(file).iter_messages(topics=[topic])]


def check_recording(recording: Path, cause: str) -> None:
    """Check that the torque of the last write ended in time, and that the event has the cause."""
    commands = messages(recording, "/command", TorqueCommand)
    states = messages(recording, "/state", JointState)
    events = messages(recording, "/event", Event)
    last_write = [command for command in commands if command.controller][-1]
    acting = [state for state in states if any(state.effort)]
    assert acting, "the controller never moved the arm"
    first_zero = next(state for state in states if state.step > acting[-1].step)
    assert first_zero.sampled_ns > last_write.write_arrived_ns
    took_ms = (first_zero.sampled_ns - last_write.write_arrived_ns) / 1e6
    assert TIMEOUT_MS <= took_ms <= TIMEOUT_MS + STEP_MS + TOLERANCE_MS
    [trip] = [event for event in events if event.kind == Event.WATCHDOG_TRIP]
    assert cause in trip.text
    assert trip.watchdog_data.timeout_ns == TIMEOUT_MS * 1_000_000
    assert TIMEOUT_MS <= trip.watchdog_data.silent_ns / 1e6 < TIMEOUT_MS + TOLERANCE_MS


FAULTS: dict[str, tuple[str, signal.Signals | None, str]] = {
    "rig1": ("writes", signal.SIGKILL, "no longer holds the lease"),
    "rig2": ("writes", signal.SIGSTOP, "no request from"),
    "rig3": ("reads on", None, "reads but does not write"),
}
"""By rig: mode of its controller, signal sent to it, and cause in the event."""


@pytest.mark.rig
def test_torque_is_zero_after_controller_failure(tmp_path: Path) -> None:
    config = write_lab(tmp_path, rigs=3, extra=f"edge.watchdog_ms = {TIMEOUT_MS}")
    with RunningLab(config) as lab:
        processes = {
            rig: subprocess.Popen(controller(lab.lab.ports[rig], mode), stdout=subprocess.PIPE, text=True)
            for rig, (mode, _, _) in FAULTS.items()
        }
        try:
            for process in processes.values():
                assert process.stdout is not None
                assert process.stdout.readline() == "running\n"
            for rig, (_, fault, _) in FAULTS.items():
                if fault is not None:
                    processes[rig].send_signal(fault)
            eventually(lambda: all(tripped(status) for status in json.loads(hilrig(*ASK, config).stdout)))
        finally:
            for process in processes.values():
                process.kill()
                process.communicate()
        assert lab.stop() == 0
        for rig, (_, _, cause) in FAULTS.items():
            [recording] = [path for path in lab.recordings if path.parent.name == rig]
            check_recording(recording, cause)


def tripped(status: dict[str, object]) -> bool:
    return bool(status["watchdog_tripped"])


@pytest.mark.rig
def test_torque_is_zero_after_edge_failure(tmp_path: Path) -> None:
    """A killed edge does not repeat the command: the command timeout of the simulation stops the torque."""
    extra = "sim.command_timeout_ms = 300\nedge.repeat_ms = 100"
    config = write_lab(tmp_path, extra=extra)
    with RunningLab(config) as lab:
        process = subprocess.Popen(controller(lab.port), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "running\n"
            os.kill(lab.service_pid("edge"), signal.SIGKILL)
            # `up` restarts it, without a lease holder.
            eventually(lambda: hilrig("lease", "rig1", "--config", config).returncode == 0)
        finally:
            process.kill()
            process.communicate()
        assert lab.stop() == 0
        [recording] = lab.recordings[:1]
        commands = [c for c in messages(recording, "/command", TorqueCommand) if c.controller]
        states = messages(recording, "/state", JointState)
        acting = [state for state in states if any(state.effort)]
        zero = next(state for state in states if state.step > acting[-1].step)
        # The last command may be a repetition, which is not recorded.
        assert 0 < (zero.sampled_ns - commands[-1].sent_ns) / 1e6 <= 300 + 100 + STEP_MS + TOLERANCE_MS


@pytest.mark.hosts
def test_torque_is_zero_after_network_failure(tmp_path: Path) -> None:
    require_namespaces()
    lab = write_lab(tmp_path, extra=f"edge.watchdog_ms = {TIMEOUT_MS}\nedge.host = '0.0.0.0'")
    with Network(["rig", "pc"]) as network:
        log = (tmp_path / "up.log").open("w")
        up = network.popen("rig", [*HILRIG, "up", "--config", str(lab)], stdout=log, stderr=log, cwd=tmp_path)
        eventually(lambda: "running" in (tmp_path / "up.log").read_text())
        from hilrig_runtime.config.lab import load_lab

        port = load_lab(lab).ports["rig1"]
        command = controller(port, host=network.address("rig"))
        process = network.popen("pc", command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        network.set_link("pc", up=False)

        def status() -> dict[str, object]:
            asked = network.run("rig", [*HILRIG, "lease", "rig1", "--json", "--config", str(lab)], capture_output=True)
            return json.loads(asked.stdout)

        eventually(lambda: tripped(status()))
        up.send_signal(signal.SIGTERM)
        assert up.wait(LONG_TIMEOUT_S) == 0
        log.close()
    [recording] = (tmp_path / "recordings").rglob("*.mcap")
    check_recording(recording, "no request from")
