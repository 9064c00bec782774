"""Simulation or edge is killed during a session: the file is complete and contains the messages from the bus."""

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

MAX_UNBATCHED_STATES = 50
"""States that a killed simulation may have published, but not yet on its recording stream (one batch per 20 ms)."""


@contextmanager
def controller(port: int) -> Iterator[None]:
    """A controller that reads and writes, and reconnects if necessary."""
    stopping = threading.Event()

    def body() -> None:
        while not stopping.is_set():
            with ModbusTcpClient("127.0.0.1", port=port, timeout=1, retries=0) as client:
                try:
                    while not stopping.wait(0.01):
                        client.read_holding_registers(4, count=4)
                        client.write_registers(0, [100, 0, 0, 0])
                except Exception:  # any error of a connection to a killed edge
                    stopping.wait(0.1)

    thread = threading.Thread(target=body)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(10)


class StateSubscriber:
    """Receives every state of rig1 from the bus, as bytes."""

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
def test_killed_service_leaves_a_complete_recording(tmp_path: Path, victim: str) -> None:
    with RunningLab(write_lab(tmp_path, extra="edge.session_grace_ms = 300")) as lab:
        subscriber = StateSubscriber(lab.lab)
        try:
            with controller(lab.port):
                folder = lab.lab.recorder.folder / lab.lab.name / "rig1"
                eventually(lambda: list(folder.glob("*.part")))
                before = len(subscriber.states)
                eventually(lambda: len(subscriber.states) > before + 100)
                os.kill(lab.service_pid(victim), signal.SIGKILL)
                count = len(subscriber.states)
                eventually(lambda: len(subscriber.states) > count + 100)
            eventually(lambda: lab.recordings and not list(folder.glob("*.part")))
        finally:
            subscriber.close()
        paths = lab.recordings
        for path in paths:
            assert metadata(path)["hilrig.summary"]["ended"] == "ended"
        found = {data for channel, _, data in recorded(paths) if channel == "/state"}
        for path in paths:
            seen = subscriber.of(metadata(path)["hilrig.session"]["session"])
            missing = [payload for payload in seen if payload not in found]
            assert len(missing) <= (MAX_UNBATCHED_STATES if victim == "sim" else 0)
        assert sum(len(subscriber.of(metadata(path)["hilrig.session"]["session"])) for path in paths) > 50
