"""Scan time of a controller's program, from the changes of its echo."""

import numpy as np
import pytest

from hilrig_replay.analysis.client_role.device_scan import device_scan
from hilrig_replay.io.columns import COMMAND_DTYPE, Rows

MS = 1_000_000


def commands_of(scan_ms: float, *, cycle_ms: float = 20.0, seconds: float = 10.0, seed: int = 1) -> Rows:
    """Commands of an edge that writes at the start of each cycle and reads 14 ms later."""
    rng = np.random.default_rng(seed)
    ends_ms = np.cumsum(rng.normal(scan_ms, 0.02 * scan_ms, int(1000 * seconds / scan_ms)))
    found, echo, stale_ms = [], -1, 0.0
    for cycle in range(int(1000 * seconds / cycle_ms)):
        read_ms = cycle * cycle_ms + 14.0
        done = int(np.searchsorted(ends_ms, read_ms)) - 1
        # A scan uses the positions that were written before it began.
        seen = int((ends_ms[done] - scan_ms) // cycle_ms) if done >= 0 else -1
        if seen < 0 or seen == echo:
            stale_ms = read_ms
            continue
        echo, row = seen, np.zeros(1, COMMAND_DTYPE)
        served_ms = seen * cycle_ms
        row["state_served_ns"], row["positions_acknowledged_ns"] = served_ms * MS + 1, (served_ms + 0.3) * MS
        row["read_sent_ns"], row["write_arrived_ns"] = read_ms * MS, (read_ms + 0.3) * MS
        row["stale_read_sent_ns"] = stale_ms * MS if stale_ms > served_ms else 0
        found.append(row)
    return np.concatenate(found)


@pytest.mark.parametrize("scan_ms", [28.0, 50.0, 80.0])
def test_slow_program_is_measured_within_its_error(scan_ms: float) -> None:
    scan = device_scan(commands_of(scan_ms))
    assert scan is not None
    assert not scan.is_bound
    assert abs(scan.scan_ms - scan_ms) <= max(scan.error_ms, 1.0)
    assert scan.error_ms < 1.0
    # The positions are up to a cycle old when a scan begins.
    assert scan.pickup_ms[0] <= scan_ms + 10.0 <= scan.pickup_ms[1]


def test_fast_program_has_a_bound() -> None:
    scan = device_scan(commands_of(5.0))
    assert scan is not None
    assert scan.is_bound
    assert scan.scan_ms == pytest.approx(20.0, abs=0.5)
    assert str(scan).startswith("scan of the controller's program ≤ 20.0 ms")


def test_pauses_are_left_out() -> None:
    commands = commands_of(50.0)
    late = np.arange(len(commands)) >= len(commands) // 2
    for name in ("write_arrived_ns", "read_sent_ns", "state_served_ns", "positions_acknowledged_ns"):
        commands[name][late] += 5_000 * MS
    scan = device_scan(commands)
    assert scan is not None
    assert scan.scan_ms == pytest.approx(50.0, abs=1.0)


def test_overlapping_windows_do_not_shorten_the_scan() -> None:
    commands = commands_of(50.0)
    scan = device_scan(np.concatenate((commands[:150], commands[50:])))
    assert scan is not None
    assert scan.scan_ms == pytest.approx(50.0, abs=1.0)


def test_server_role_and_missing_echo_have_no_scan() -> None:
    commands = commands_of(50.0)
    assert device_scan(commands[:10]) is None
    commands["basis_is_bound"] = True
    assert device_scan(commands) is None
    commands["basis_is_bound"], commands["read_sent_ns"] = False, 0
    assert device_scan(commands) is None
