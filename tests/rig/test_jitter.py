"""`hilrig jitter` with a short measurement: statistics, verdict, and no remaining processes."""

import json
from pathlib import Path

import pytest

from support.labs import hilrig

pytestmark = pytest.mark.rig


def stress_processes() -> list[str]:
    """Process ids of CPU stress processes on this host."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            arguments = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"hilrig_cli.bench.cpu_stress" in arguments:
            found.append(path.parent.name)
    return found


def test_measures_with_and_without_load_and_stops_its_processes() -> None:
    others = stress_processes()
    done = hilrig("jitter", "--load", "--seconds", "1", "--step-ms", "10", "--json")
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert (result["step_ms"], result["fit"]) == (10.0, False)
    assert [condition["loaded"] for condition in result["conditions"]] == [False, True]
    for condition in result["conditions"]:
        assert 100 <= condition["ticks"] + condition["missed_steps"] < 500
        assert condition["step_ms"] == 10.0
        # A measurement that is too short is never suitable.
        assert any(reason.endswith("measure longer") for reason in condition["reasons"])
        assert not condition["fit"]
        for name in ("tick_lateness_ms", "bus_ms", "modbus_ms", "loop_ms"):
            statistics = condition[name]
            percentiles = [statistics[key] for key in ("p50", "p95", "p99", "p999", "max")]
            assert percentiles[0] >= 0
            assert percentiles == sorted(percentiles)
        assert condition["loop_ms"]["p50"] >= 9.0, "a loop takes at least one step"
        assert 0.01 < condition["modbus_ms"]["p50"] < 1000
        assert condition["stolen"] is None or 0 <= condition["stolen"] <= 1
    assert [pid for pid in stress_processes() if pid not in others] == []


def test_table_contains_steal_time_and_verdict() -> None:
    done = hilrig("jitter", "--seconds", "1")
    assert done.returncode == 1, done.stderr
    text = " ".join(done.stdout.split())
    verdict = "not suitable for a study at a step of 20 ms: "
    for expected in ("tick lateness", "Modbus round trip", "CPU steal: ", verdict):
        assert expected in text
    assert max(map(len, done.stdout.splitlines())) <= 80


@pytest.mark.parametrize("option", [("--step-ms", "0"), ("--seconds", "-1"), ("--seconds", "many")])
def test_invalid_options_are_rejected(option: tuple[str, str]) -> None:
    done = hilrig("jitter", *option)
    assert done.returncode == 2
    assert option[0] in done.stderr
    assert "Traceback" not in done.stderr
