"""`hilrig jitter` with the real rig, briefly: its figures, its verdict, and nothing left behind."""

import json
from pathlib import Path

import pytest

from support.labs import hilrig

pytestmark = [pytest.mark.rig, pytest.mark.alone]


def processes_that_burn() -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"hilrig_cli.bench.cpu_stress" in words:
            found.append(path.parent.name)
    return found


def test_it_measures_with_and_without_load_and_ends_its_processes() -> None:
    others = processes_that_burn()
    done = hilrig("jitter", "--load", "--seconds", "3", "--step-ms", "10", "--json")
    assert done.returncode == 1, done.stderr
    said = json.loads(done.stdout)
    assert (said["step_ms"], said["fit"]) == (10.0, False)
    assert [condition["loaded"] for condition in said["conditions"]] == [False, True]
    for condition in said["conditions"]:
        assert 300 <= condition["ticks"] < 500
        assert condition["step_ms"] == 10.0
        # So short a measurement is never called fit, however well it went.
        assert any(reason.endswith("measure longer") for reason in condition["reasons"])
        assert not condition["fit"]
        for what in ("tick_lateness_ms", "bus_ms", "modbus_ms", "loop_ms"):
            figures = condition[what]
            assert 0 <= figures["p50"] <= figures["p95"] <= figures["p99"] <= figures["p999"] <= figures["max"]
        assert condition["loop_ms"]["p50"] >= 9.0, "a loop takes a step at least"
        assert 0.01 < condition["modbus_ms"]["p50"] < 10
        assert condition["stolen"] is None or 0 <= condition["stolen"] <= 1
    assert [pid for pid in processes_that_burn() if pid not in others] == []


def test_the_table_says_the_verdict_in_words() -> None:
    done = hilrig("jitter", "--seconds", "1")
    assert done.returncode == 1, done.stderr
    text = " ".join(done.stdout.split())
    for words in ("tick lateness", "Modbus round trip", "not fit for a study at 20 ms: ", "taken away by the host"):
        assert words in text
    assert max(map(len, done.stdout.splitlines())) <= 80


@pytest.mark.parametrize("option", [("--step-ms", "0"), ("--seconds", "-1"), ("--seconds", "many")])
def test_wrong_options_are_refused(option: tuple[str, str]) -> None:
    done = hilrig("jitter", *option)
    assert done.returncode == 2
    assert option[0] in done.stderr
    assert "Traceback" not in done.stderr
