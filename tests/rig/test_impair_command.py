"""`hilrig impair` on a running lab: options, their combinations, and errors."""

import json
from pathlib import Path
from typing import Any

import pytest

from support.edge_rig import RawClient
from support.labs import RunningLab, hilrig, write_lab
from support.recordings import Script, record

pytestmark = pytest.mark.rig


def test_impairment_is_set_by_command_at_run_time(tmp_path: Path) -> None:
    recording = record(tmp_path / "run.mcap", Script(seconds=4.0))
    config = write_lab(tmp_path)
    with RunningLab(config) as lab, RawClient("127.0.0.1", lab.port) as client:
        client.write(0, 1)

        def row(*options: str | Path) -> dict[str, Any]:
            done = hilrig("impair", "rig1", *options, "--json", "--config", config)
            assert done.returncode == 0, done.stderr
            decoded: dict[str, Any] = json.loads(done.stdout)
            return decoded

        assert row()["impairment"] == "none"
        status = row("--preset", "vpn", "--loss", "bernoulli:0.2", "--seed", "7")
        assert status["ways"]["state"]["delay"]["offset_ms"] == 15
        assert status["ways"]["command"]["loss"] == {"kind": "bernoulli", "rate": 0.2}
        assert (status["seed"], status["set_by"]) == (7, "override")
        assert row() | {"states": 0, "commands": 0} == status | {"states": 0, "commands": 0}
        assert row("--trace", recording)["ways"]["command"]["delay"]["kind"] == "trace"
        assert row("--off")["impairment"] == "none"
        assert row("--lab")["set_by"] == "lab.toml"
        table = hilrig("impair", "rig1", "--preset", "mobile", "--seed", "3", "--config", config)
        for word in ("gamma mean 15 ms", "gilbert", "(override, seed 3)"):
            assert word in table.stdout
        for options, message in (
            (("rig1", "--command", "constant:-3"), "--command: delay_ms: must be ≥ 0, got '-3'"),
            (("rig1", "--preset", "wlan"), "unknown preset 'wlan'; must be one of none, wired"),
            (("rig1", "--trace", tmp_path / "none.mcap"), "none.mcap"),
            (("rig1", "--trace", recording, "--command", "constant:1"), "--trace and --command both set the delay"),
            (("rig1", "--off", "--preset", "vpn"), "--off and --lab can't be combined"),
            (("rig9", "--off"), "unknown rig 'rig9'"),
            (("--off",), "no rig given; expected names of rigs, or --all"),
            (("rig1", "--all", "--off"), "both rigs and --all given"),
        ):
            done = hilrig("impair", *options, "--config", config)
            assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
            assert message in done.stderr


def test_missing_edge_is_reported(tmp_path: Path) -> None:
    done = hilrig("impair", "--config", write_lab(tmp_path))
    assert done.returncode == 3
    assert "no edge answers for lab 'lab'" in done.stderr
