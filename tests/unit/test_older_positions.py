"""Bound and estimate of the latency without an echo register contain the truth that virtual devices know."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrig_modbus_edge.client.written_positions import WrittenPositions
from hilrig_replay.analysis.client_role.older_positions import OlderPositions, older_positions
from hilrig_replay.analysis.feedback import rounding_gains
from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE, Rows
from hilrig_sim.arm.joints import JOINT_SCALE

MS = 1_000_000
STEP_MS = 20.0
INCARNATION = 7


@dataclass
class Device:
    """A controller whose program reads its inputs at the start of a scan and writes its outputs later in that scan."""

    scan_ms: float
    network_ms: float
    output_share: float
    """Time of the outputs in the scan, as a share of it."""
    seed: int
    seconds: float = 8.0
    switching: bool = False
    """Whether the program switches between two torques of each joint instead of a proportional law."""
    at_rest: bool = False
    states: Rows = field(init=False)

    def __post_init__(self) -> None:
        self._rng = rng = np.random.default_rng(self.seed)
        count = int(self.seconds * 1e3 / STEP_MS)
        time_s = np.arange(count + 8) * STEP_MS / 1e3
        amplitude = rng.uniform(0.3, 1.2, 4) * (1, 1, 0.08, 1) * (not self.at_rest)
        self.states = np.zeros(len(time_s), STATE_DTYPE)
        self.states["step"], self.states["incarnation"] = np.arange(1, len(time_s) + 1), INCARNATION
        self.states["position"] = amplitude * np.sin(np.outer(time_s, rng.uniform(0.5, 1.5, 4)) + rng.uniform(0, 6, 4))
        self.counts = np.rint(self.states["position"] * JOINT_SCALE * 100)
        starts = np.cumsum(rng.normal(self.scan_ms, 0.02 * self.scan_ms, int(self.seconds * 1e3 / self.scan_ms) + 20))
        self.begins_ms = starts - 3 * self.scan_ms
        self.ends_ms = self.begins_ms + self.output_share * self.scan_ms
        self._gain = rng.uniform(0.5, 3.0, 4) * (1, 1, 0.3, 0.3)

    def _torques(self, state: int, begin_ms: float) -> np.ndarray:
        goal = 1000 * np.sin(0.8 * begin_ms / 1e3 + np.arange(4)) * (not self.at_rest)
        errors = goal - self.counts[state]
        return np.where(errors > 0, 500, -500) if self.switching else np.rint(self._gain * errors)

    def polled(self) -> tuple[Rows, list[float]]:
        """Commands that the edge reads, and the time by which each answers older positions than its basis, ms."""
        written_ms: list[float] = []
        written: list[int] = []
        rows, older_ms, at_ms = [], [], 0.5
        while (state := int((at_ms - 0.5) // STEP_MS)) < len(self.states) - 8:
            if written and state == written[-1]:
                at_ms = (state + 1) * STEP_MS + 0.5 + self._rng.uniform(0, 0.3)
                continue
            served_ms, acknowledged_ms = at_ms, at_ms + 2 * self.network_ms + 0.2
            written_ms.append(served_ms + self.network_ms + 0.1)
            written.append(state)
            sent_ms = max(acknowledged_ms, acknowledged_ms // STEP_MS * STEP_MS + STEP_MS - 6 - 2 * self.network_ms)
            read_ms, at_ms = sent_ms + self.network_ms + 0.1, sent_ms + 2 * self.network_ms + 0.2
            scan = int(np.searchsorted(self.ends_ms, read_ms)) - 1
            used = int(np.searchsorted(written_ms, self.begins_ms[scan])) - 1
            if scan < 0 or used < 0:
                continue
            row = np.zeros(1, COMMAND_DTYPE)
            row["effort"] = self._torques(written[used], self.begins_ms[scan]) / 1e3
            row["basis_step"], row["basis_incarnation"], row["basis_is_bound"] = state + 1, INCARNATION, True
            row["state_served_ns"], row["positions_acknowledged_ns"] = served_ms * MS, acknowledged_ms * MS
            row["read_sent_ns"], row["write_arrived_ns"] = sent_ms * MS, at_ms * MS
            rows.append(row)
            older_ms.append((state - written[used]) * STEP_MS)
        return np.concatenate(rows), older_ms


def estimate(device: Device, commands: Rows) -> OlderPositions | None:
    gains = rounding_gains([(device.states, commands)])
    return older_positions([commands], gains, round(STEP_MS * MS))


@pytest.mark.parametrize("network_ms", [0.0, 5.0, 20.0])
@pytest.mark.parametrize("scan_ms", [5.0, 14.0, 20.0, 33.0, 50.0, 80.0])
def test_truth_is_within_bound_and_estimate(scan_ms: float, network_ms: float) -> None:
    for seed, output_share in ((1, 0.0), (2, 0.5), (3, 0.98)):
        device = Device(scan_ms, network_ms, output_share, seed)
        commands, older_ms = device.polled()
        assert min(older_ms) >= 0
        found = estimate(device, commands)
        assert found is not None
        # The times of the states vary by less than a millisecond against those of the writes.
        assert found.low_ms - 1 <= np.mean(older_ms) <= found.high_ms + 1, (seed, found)
        assert found.high_ms - found.low_ms <= 2 * (STEP_MS + 6 * network_ms) + scan_ms


def test_rounding_errors_narrow_the_estimate() -> None:
    device = Device(5.0, 0.0, 0.5, 4)
    commands, _ = device.polled()
    found = estimate(device, commands)
    assert found is not None
    smooth = older_positions([commands], rounding_gains([]), round(STEP_MS * MS))
    assert smooth is not None
    assert (smooth.low_ms, smooth.high_ms) == (0.0, pytest.approx(2 * STEP_MS, abs=1))
    assert found.low_ms == 0.0
    assert found.high_ms < 0.8 * smooth.high_ms
    assert str(found).endswith(f"0 to {found.high_ms:.0f} ms older than those of the loop latency")


@pytest.mark.parametrize("change", [{"switching": True}, {"at_rest": True}])
def test_torques_that_show_no_scans_have_no_estimate(change: dict[str, bool]) -> None:
    device = Device(50.0, 0.0, 0.0, 5, **change)
    commands, _ = device.polled()
    commands["effort"] += np.linspace(0, 0.1, len(commands))[:, np.newaxis].round(3) * device.at_rest
    assert estimate(device, commands) is None


def test_runs_with_an_echo_have_no_estimate() -> None:
    device = Device(50.0, 0.0, 0.0, 6)
    commands, _ = device.polled()
    commands["basis_is_bound"] = False
    assert estimate(device, commands) is None
    assert older_positions([commands[:0]], rounding_gains([]), round(STEP_MS * MS)) is None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(["cycle", "scan", "write lost", "late write", "read only"]), max_size=40))
def test_basis_is_never_older_than_the_positions_used(actions: list[str]) -> None:
    edge, device, used, now_ns = WrittenPositions(), 0, 0, 0
    for step, action in enumerate(actions, 1):
        now_ns += 10
        if action == "scan":
            used = device
            continue
        if action != "read only":
            served = ((INCARNATION, step, 0, 0), now_ns)
            edge.add(served)
            if action != "write lost":
                device = step
            if action == "cycle":
                edge.acknowledge(served, now_ns + 1)
        # The program may run at any time until the read.
        for answered in (used, device):
            (basis, served_ns), times = edge.newest_basis(now_ns + 2)
            assert basis[1] >= answered
            assert times.basis_is_bound
            assert not edge.any_acknowledged or served_ns <= times.positions_acknowledged_ns <= times.read_sent_ns
