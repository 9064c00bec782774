"""A lab with one emulated host per service, around a router, for tests of faults between hosts.

All hosts share the kernel's monotonic clock, so that the time of a fault can be compared with the recordings.
"""

import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hilrig_modbus_edge.registers.map import Status
from hilrig_replay.io.run import open_run
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import InputError
from support.namespaces import Network
from support.waiting import PATIENT_S, eventually

HILRIG = str(Path(sys.executable).with_name("hilrig"))
TIMEOUT_NS = 600_000_000
"""The simulation's command_timeout_ms."""
SLACK_NS = 250_000_000
"""Beyond it: repeats come every 200 ms, steps every 20 ms, and the machine is shared."""
STEP_S = 0.02
_CONTROLLER = Path(__file__).with_name("steady_controller.py")
_STATUS = """
import socket, struct, sys
with socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=2) as c:
    c.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 2, 0, 16))
    print(int.from_bytes(c.recv(64)[9:11], "little"))
"""
"""The edge's discrete inputs: the status word."""


@dataclass(frozen=True, slots=True)
class Rig:
    """Where controllers find a rig."""

    name: str = "rig1"
    edge: str = "edge"
    port: int = 5020


@dataclass
class LabOfHosts:
    """Everything that runs, by the name of its host; each host runs what `commands` says."""

    network: Network
    config: Path
    lab: LabConfig
    commands: dict[str, list[str]]
    """Arguments of `hilrig`, by host."""
    processes: dict[str, subprocess.Popen[Any]] = field(default_factory=dict)

    def start(self, host: str) -> None:
        """Start what belongs on a host."""
        command = [HILRIG, *self.commands[host], "-c", str(self.config)]
        with self.log(host).open("a") as log:
            self.processes[host] = self.network.popen(host, command, stdin=subprocess.PIPE, stdout=log, stderr=log)

    def log(self, host: str) -> Path:
        """Return the output of a host's process."""
        return self.config.parent / f"{host}.log"

    def kill(self, host: str) -> int:
        """Kill it as a power cut would; gives the time, ns."""
        self.processes[host].kill()
        self.processes[host].wait(PATIENT_S)
        return time.monotonic_ns()

    def run(self, host: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of `hilrig` on a host."""
        return self.network.run(host, [HILRIG, *arguments], check=False, capture_output=True, text=True, timeout=30)

    def controller(self, rig: Rig) -> subprocess.Popen[str]:
        """A controller on the host `pc`: works until its standard input ends, then tells how many writes went well."""
        command = [sys.executable, str(_CONTROLLER), rig.edge, str(rig.port)]
        return self.network.popen("pc", command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def status(self, rig: Rig) -> Status:
        """Return a controller's reading of the rig; empty: the edge does not answer."""
        command = [sys.executable, "-c", _STATUS, rig.edge, str(rig.port)]
        done = self.network.run("pc", command, check=False, capture_output=True, text=True, timeout=10)
        return Status(int(done.stdout)) if done.returncode == 0 else Status(0)

    def simulation_is_alive(self, rig: Rig = Rig()) -> bool:
        """Whether states come to the edge."""
        return Status.SIMULATION_ALIVE in self.status(rig)

    def loop_is_closed(self, rig: Rig = Rig()) -> bool:
        """Whether states come to the edge and commands to the simulation."""
        both = Status.SIMULATION_ALIVE | Status.SIMULATION_SAFE
        return self.status(rig) & both == Status.SIMULATION_ALIVE

    def comes_back(self, within_s: float, rig: Rig = Rig()) -> None:
        """Wait until the loop is closed again."""
        eventually(lambda: self.loop_is_closed(rig), timeout_s=within_s, every_s=0.1)

    def recordings(self, rig: str = "*") -> list[Path]:
        return sorted((self.lab.recorder.folder / self.lab.name).glob(f"{rig}/*.mcap"))

    def unfinished(self, rig: str = "*") -> list[Path]:
        return sorted((self.lab.recorder.folder / self.lab.name).glob(f"{rig}/*.part"))


class Session:
    """A controller at work; after it was left, `states` are those of its recordings."""

    def __init__(self, lab: LabOfHosts, rig: Rig = Rig()) -> None:
        self.lab = lab
        self.rig = rig
        self._before = set(lab.recordings(rig.name))

    def __enter__(self) -> "Session":
        eventually(lambda: self.lab.simulation_is_alive(self.rig), every_s=0.1)
        self.controller = self.lab.controller(self.rig)
        eventually(lambda: self.lab.unfinished(self.rig.name))
        time.sleep(1.0)
        return self

    def __exit__(self, *_: object) -> None:
        # What follows the fault is recorded for a while too.
        time.sleep(1.0)
        self.end_ns = time.monotonic_ns()
        assert self.controller.stdin is not None
        self.controller.stdin.close()
        self.controller.wait(PATIENT_S)
        assert self.controller.stdout is not None
        said = self.controller.stdout.read()
        self.answered = int(said) if said else 0

    def _finished(self) -> list[Path]:
        """The recordings of this session, once they are closed."""

        def finished() -> list[Path]:
            if self.lab.unfinished(self.rig.name):
                return []
            return [path for path in self.lab.recordings(self.rig.name) if path not in self._before]

        return eventually(finished, every_s=0.1)

    def states(self) -> np.ndarray:
        """States of the recordings of this session, by time; shape (n,)."""
        found = []
        for path in self._finished():
            try:
                found.append(open_run(path).states)
            except InputError:
                continue
        states = np.concatenate(found)
        return states[np.argsort(states["sampled_ns"], kind="stable")]

    def stated_lost(self) -> int:
        """Messages that the recordings of this session say are missing."""
        losses = [open_run(path).losses for path in self._finished()]
        return sum(loss.transport + loss.recorder for loss in losses if loss is not None)


def zero_after(states: np.ndarray, fault_ns: int) -> int:
    """How long after a fault the torque was zero, ns; it stays so for at least 200 ms."""
    later = states[states["sampled_ns"] > fault_ns]
    moving = np.abs(later["effort"]).max(axis=1) > 0
    assert not moving.all(), "the torque was never set to zero"
    first = int(np.flatnonzero(~moving)[0])
    assert not moving[first : first + 10].any()
    return int(later["sampled_ns"][first]) - fault_ns
