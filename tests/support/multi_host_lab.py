"""Lab whose services run on separate emulated hosts around a router, for tests of faults between hosts.

All hosts share the kernel's monotonic clock: fault times can be compared with times in recordings.
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
from support.waiting import LONG_TIMEOUT_S, eventually

HILRIG = str(Path(sys.executable).with_name("hilrig"))
TIMEOUT_NS = 600_000_000
"""The simulation's command_timeout_ms."""
TOLERANCE_NS = 250_000_000
"""Tolerance beyond the timeout: repeats are sent every 200 ms, a step is 20 ms, and other tests run in parallel."""
STEP_S = 0.02
_CONTROLLER = Path(__file__).with_name("steady_controller.py")
_STATUS = """
import socket, struct, sys
with socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=2) as c:
    c.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 1, 2, 0, 16))
    print(int.from_bytes(c.recv(64)[9:11], "little"))
"""
"""Program that prints the status word: the discrete inputs of the edge."""


@dataclass(frozen=True, slots=True)
class RigAddress:
    """Name and Modbus address of a rig."""

    name: str = "rig1"
    edge: str = "edge"
    port: int = 5020


@dataclass
class MultiHostLab:
    """A lab with one `hilrig` process per host, as defined by `commands`."""

    network: Network
    config: Path
    lab: LabConfig
    commands: dict[str, list[str]]
    """Arguments of `hilrig`, by host."""
    processes: dict[str, subprocess.Popen[Any]] = field(default_factory=dict)
    environ: dict[str, dict[str, str]] = field(default_factory=dict)
    """Environment of the process of a host, if it is not that of the test."""

    def start(self, host: str) -> None:
        """Start the process of a host."""
        command = [HILRIG, *self.commands[host], "-c", str(self.config)]
        with self.log(host).open("a") as log:
            self.processes[host] = self.network.popen(
                host, command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=self.environ.get(host)
            )

    def log(self, host: str) -> Path:
        """Log file of the process of a host."""
        return self.config.parent / f"{host}.log"

    def kill(self, host: str) -> int:
        """Kill the process of a host with SIGKILL; returns the time, ns, monotonic clock."""
        self.processes[host].kill()
        self.processes[host].wait(LONG_TIMEOUT_S)
        return time.monotonic_ns()

    def run(self, host: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command of `hilrig` on a host."""
        return self.network.run(host, [HILRIG, *arguments], check=False, capture_output=True, text=True, timeout=30)

    def controller(self, rig: RigAddress) -> subprocess.Popen[str]:
        """Start a controller on the host `pc`: it ends with its standard input and prints the number of writes."""
        command = [sys.executable, str(_CONTROLLER), rig.edge, str(rig.port)]
        return self.network.popen("pc", command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def status(self, rig: RigAddress) -> int:
        """Status word of the rig, read by Modbus; 0 if the edge does not answer."""
        command = [sys.executable, "-c", _STATUS, rig.edge, str(rig.port)]
        done = self.network.run("pc", command, check=False, capture_output=True, text=True, timeout=10)
        return int(done.stdout) if done.returncode == 0 else 0

    def receives_states(self, rig: RigAddress = RigAddress()) -> bool:
        """Whether the edge receives states."""
        return bool(self.status(rig) & Status.SIMULATION_ALIVE)

    def loop_is_closed(self, rig: RigAddress = RigAddress()) -> bool:
        """Whether the edge receives states and the simulation receives commands."""
        both = Status.SIMULATION_ALIVE | Status.SIMULATION_SAFE
        return self.status(rig) & both == Status.SIMULATION_ALIVE

    def wait_for_closed_loop(self, within_s: float, rig: RigAddress = RigAddress()) -> None:
        """Wait until the loop is closed; fail after `within_s`."""
        eventually(lambda: self.loop_is_closed(rig), timeout_s=within_s, every_s=0.1)

    def recordings(self, rig: str = "*") -> list[Path]:
        return sorted((self.lab.recorder.folder / self.lab.name).glob(f"{rig}/*.mcap"))

    def unfinished(self, rig: str = "*") -> list[Path]:
        return sorted((self.lab.recorder.folder / self.lab.name).glob(f"{rig}/*.part"))


class ControllerSession:
    """Session of a controller; after the context has ended, `states` reads its recordings."""

    def __init__(self, lab: MultiHostLab, rig: RigAddress = RigAddress()) -> None:
        self.lab = lab
        self.rig = rig
        self._before = set(lab.recordings(rig.name))

    def __enter__(self) -> "ControllerSession":
        eventually(lambda: self.lab.receives_states(self.rig), every_s=0.1)
        self.controller = self.lab.controller(self.rig)
        eventually(lambda: self.lab.unfinished(self.rig.name))
        time.sleep(1.0)  # recorded before the fault
        return self

    def __exit__(self, *_: object) -> None:
        time.sleep(1.0)  # recorded after the fault
        self.end_ns = time.monotonic_ns()
        assert self.controller.stdin is not None
        self.controller.stdin.close()
        self.controller.wait(LONG_TIMEOUT_S)
        assert self.controller.stdout is not None
        output = self.controller.stdout.read()
        self.answered = int(output) if output else 0

    def _finished(self) -> list[Path]:
        """Wait until the recordings of this session are closed; returns them."""

        def finished() -> list[Path]:
            if self.lab.unfinished(self.rig.name):
                return []
            return [path for path in self.lab.recordings(self.rig.name) if path not in self._before]

        return eventually(finished, every_s=0.1)

    def states(self) -> np.ndarray:
        """States in the recordings of this session, sorted by time; shape (n,)."""
        found = []
        for path in self._finished():
            try:
                found.append(open_run(path).states)
            except InputError:
                continue
        states = np.concatenate(found)
        return states[np.argsort(states["sampled_ns"], kind="stable")]

    def event_texts(self, kind: str) -> list[str]:
        """Texts of the events of a kind in the recordings of this session."""
        events = [event for path in self._finished() for event in open_run(path).events]
        return [event["message"].text for event in events if event["kind"] == kind]

    def reported_lost(self) -> int:
        """Number of lost messages reported by the recordings of this session."""
        losses = [open_run(path).losses for path in self._finished()]
        return sum(loss.transport + loss.recorder for loss in losses if loss is not None)


def time_to_zero_ns(states: np.ndarray, fault_ns: int) -> int:
    """Time from a fault to zero torque, ns; the torque must stay zero for at least 200 ms."""
    later = states[states["sampled_ns"] > fault_ns]
    moving = np.abs(later["effort"]).max(axis=1) > 0
    assert not moving.all(), "the torque did not become zero after the fault"
    first = int(np.flatnonzero(~moving)[0])
    assert not moving[first : first + 10].any()
    return int(later["sampled_ns"][first]) - fault_ns
