"""The simulation or the edge is killed while a session is recorded: its file is whole, with what was on the bus."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_schemas import JointState
from hilrig_schemas.topics import STATE
from support.labs import RunningLab, write_lab
from support.recorder_rig import metadata, recorded
from support.waiting import eventually

BATCH_OF_A_SIM = 50
"""States that a killed simulation may have published and not yet put on its log stream; it sends one batch in 20 ms."""


@contextmanager
def controller(port: int) -> Iterator[None]:
    """A controller that reads and writes, and connects again when it has to."""
    stopping = threading.Event()

    def body() -> None:
        while not stopping.is_set():
            with ModbusTcpClient("127.0.0.1", port=port, timeout=1, retries=0) as client:
                try:
                    while not stopping.wait(0.01):
                        client.read_holding_registers(4, count=4)
                        client.write_registers(0, [100, 0, 0, 0])
                except Exception:  # whatever a dying edge does to a client
                    stopping.wait(0.1)

    thread = threading.Thread(target=body)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(10)


class Witness:
    """Every state that was on the bus of a session, as bytes."""

    def __init__(self, lab: LabConfig) -> None:
        self.states: list[tuple[str, bytes]] = []
        self._bus = ZenohBus(lab.bus, "tool")
        self._bus.subscribe(STATE.key(lab.name, "rig1"), self._on_state)

    def _on_state(self, _key: str, payload: bytes) -> None:
        self.states.append((JointState.FromString(payload).session, payload))

    def of(self, session: str) -> list[bytes]:
        return [payload for name, payload in self.states if name == session]

    def close(self) -> None:
        self._bus.close()


@pytest.mark.rig
@pytest.mark.parametrize("victim", ["sim", "edge"])
def test_a_service_that_is_killed_leaves_a_whole_recording(tmp_path: Path, victim: str) -> None:
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 300")) as lab:
        witness = Witness(lab.lab)
        try:
            with controller(lab.port):
                folder = lab.lab.recorder.folder / lab.lab.name / "rig1"
                eventually(lambda: list(folder.glob("*.part")))
                before = len(witness.states)
                eventually(lambda: len(witness.states) > before + 100)
                os.kill(lab.service_pid(victim), signal.SIGKILL)
                count = len(witness.states)
                eventually(lambda: len(witness.states) > count + 100)
            eventually(lambda: lab.recordings and not list(folder.glob("*.part")))
        finally:
            witness.close()
        paths = lab.recordings
        for path in paths:
            assert metadata(path)["hilrig.summary"]["ended"] == "ended"
        found = {data for channel, _, data in recorded(paths) if channel == "/state"}
        for path in paths:
            seen = witness.of(metadata(path)["hilrig.session"]["session"])
            missing = [payload for payload in seen if payload not in found]
            assert len(missing) <= (BATCH_OF_A_SIM if victim == "sim" else 0)
        assert sum(len(witness.of(metadata(path)["hilrig.session"]["session"])) for path in paths) > 50
