"""Tests of the simulation as a process: states, configuration, commands and termination."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_schemas import Event, JointState, RigBatch, RigConfig, TorqueCommand
from hilrig_schemas.topics import COMMANDS, CONFIG, EVENT, STATE
from hilrig_sim.arm.model import RigParameters
from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import hilrig, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig


class SimProcess:
    """A `hilrig sim` process and a bus client."""

    def __init__(self, config: Path) -> None:
        self.lab: LabConfig = load_lab(config)
        self.states: list[JointState] = []
        self.events: list[Event] = []
        self.log = config.parent / "sim.log"
        with self.log.open("w") as log:
            self.process = ForkedPopen(
                [*HILRIG, "sim", "--config", str(config)], stdout=log, stderr=log, cwd=config.parent
            )
        self.bus = ZenohBus(self.lab.bus, "edge")
        key = self.lab.name
        self.bus.subscribe(STATE.key(key, "*"), lambda _, payload: self.states.append(STATE.decode(payload)))
        self.bus.subscribe(EVENT.key(key, "*"), lambda _, payload: self.events.append(EVENT.decode(payload)))
        self._command = self.bus.publisher(COMMANDS.key(key, "edge", "1"), COMMANDS.traffic)
        self._seq = 0

    def command(self, *effort: float) -> None:
        """Publish a command of efforts, based on the newest state."""
        self._seq += 1
        newest = self.states[-1]
        command = TorqueCommand(
            rig="rig1",
            session="s",
            seq=self._seq,
            effort=effort,
            basis_step=newest.step,
            basis_incarnation=newest.incarnation,
        )
        batch = RigBatch(source="edge/1", rigs=["rig1"], messages=[command.SerializeToString()])
        self._command.put(batch.SerializeToString())

    def close(self) -> None:
        self.bus.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


@pytest.fixture
def sim(tmp_path: Path) -> Iterator[SimProcess]:
    running = SimProcess(write_lab(tmp_path))
    try:
        eventually(lambda: running.states)
        yield running
    finally:
        running.close()


def test_publishes_states_at_its_step_and_its_configuration(sim: SimProcess) -> None:
    eventually(lambda: len(sim.states) > 60)
    states = sim.states[:60]
    assert [state.step for state in states] == list(range(states[0].step, states[0].step + 60))
    passed_ns = states[-1].sampled_ns - states[0].sampled_ns
    missed = sum(state.missed_steps for state in states[1:])
    assert passed_ns == pytest.approx((59 + missed) * 20e6, abs=20e6)
    (answer,) = sim.bus.query(CONFIG.key(sim.lab.name, "rig1"), timeout_s=5.0)
    config = RigConfig.FromString(answer.payload)
    assert (config.rig, config.incarnation, config.step_ns) == ("rig1", states[0].incarnation, 20_000_000)
    assert len(RigParameters.from_json(config.parameters_json).scene.parts) == 4
    assert config.urdf.startswith("<?xml")
    assert config.lab_toml == sim.lab.source
    assert "numpy" in config.machine


def test_command_moves_the_arm_and_times_out(sim: SimProcess) -> None:
    sim.command(2.0, 0.0, -5.0, 0.0)
    applied = eventually(lambda: next((state for state in sim.states if state.command_seq == 1), None))
    assert list(applied.effort) == [2.0, 0.0, -5.0, 0.0]
    assert applied.basis_step < applied.step
    assert applied.loop_latency_ns > 0
    assert applied.command_arrived_ns <= applied.sampled_ns
    eventually(lambda: sim.states[-1].position[0] > 0.02)
    lost = eventually(lambda: next((event for event in sim.events if event.kind == Event.COMMAND_LOST), None))
    assert lost.rig == "rig1"
    eventually(lambda: sim.states[-1].safe)
    assert list(sim.states[-1].effort) == [0.0] * 4


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_exits_with_0_on_signal(sim: SimProcess, how: signal.Signals) -> None:
    os.kill(sim.process.pid, how)
    assert sim.process.wait(LONG_TIMEOUT_S) == 0
    assert "Traceback" not in sim.log.read_text()


def test_unstable_step_is_rejected_in_one_line(tmp_path: Path) -> None:
    done = hilrig("sim", "--config", write_lab(tmp_path, extra="sim.step_ms = 60\nsim.substeps = 1"))
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if "unstable" in line]
    assert "set sim.substeps = 3 or a shorter sim.step_ms" in line
    assert "Traceback" not in done.stderr
