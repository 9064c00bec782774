"""`hilrig events` and commands for several rigs, with a running lab and with recordings."""

import json
import signal
import subprocess
import time
from pathlib import Path

import pytest

from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import RunningLab, hilrig, write_lab
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig
DATA = Path(__file__).parents[1] / "data"


def test_events_of_a_recording_are_filtered() -> None:
    recording = DATA / "simulation-restarted.mcap"
    everything = [json.loads(line) for line in hilrig("events", recording, "--json").stdout.splitlines()]
    kinds = {event["kind"] for event in everything}
    assert {"session-start", "session-end"} <= kinds
    assert len({event["severity"] for event in everything}) > 1
    some = hilrig("events", recording, "--json", "--kind", "SESSION_START", "--kind", "session-end").stdout
    expected = [event for event in everything if event["kind"] in ("session-start", "session-end")]
    assert [json.loads(line) for line in some.splitlines()] == expected
    serious = hilrig("events", recording, "--severity", "warning").stdout.splitlines()
    assert len(serious) == sum(event["severity"] != "info" for event in everything)
    assert hilrig("events", recording, "--rig", "rig9").stdout == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--kind", "nonsense"), "--kind nonsense: no such kind of event; expected one of"),
        (("--config", "lab.toml"), "a recording and --config can't be combined"),
    ],
)
def test_invalid_filters_are_refused(arguments: tuple[str, ...], message: str) -> None:
    done = hilrig("events", DATA / "limit-cycle.mcap", *arguments)
    assert done.returncode == 2
    assert message in done.stderr


def test_live_events_and_commands_for_several_rigs(tmp_path: Path) -> None:
    config = write_lab(tmp_path, rigs=3)
    with RunningLab(config) as lab:
        follower = ForkedPopen(
            [*HILRIG, "events", "--json", "--rig", "rig2", "--config", lab.config],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert follower.stdout is not None
        assert follower.stderr is not None
        assert "following the events of lab" in follower.stderr.readline()
        time.sleep(0.5)  # The subscription reaches the publishers after it was declared.
        started = json.loads(hilrig("record", "start", "rig1", "rig2", "--json", "--config", config).stdout)
        assert [row["rig"] for row in started] == ["rig1", "rig2"]
        for options in (("rig1", "rig3", "--loss", "0.01"), ("--all", "--command", "constant:5")):
            done = hilrig("impair", *options, "--json", "--config", config)
            assert done.returncode == 0, done.stderr
            rows = json.loads(done.stdout)
            assert [row["rig"] for row in rows] == (
                ["rig1", "rig2", "rig3"] if "--all" in options else ["rig1", "rig3"]
            )
            assert ("0.01" in json.dumps(rows[0]["ways"])) == ("--loss" in options)
        assert "0.01" in json.dumps(
            json.loads(hilrig("impair", "rig1", "--loss", "0.01", "--json", "-c", config).stdout)
        )
        reset = hilrig("rig", "reset", "--all", "--config", config)
        assert len(reset.stdout.splitlines()) == 3, reset.stderr
        released = hilrig("lease", "--all", "--release", "--json", "--config", config)
        assert (released.returncode, len(json.loads(released.stdout))) == (1, 3)
        nothing = hilrig("record", "stop", "--config", config)
        assert nothing.returncode == 2
        assert "no rig given; expected names of rigs, or --all" in nothing.stderr
        stopped = hilrig("record", "stop", "rig1", "rig2", "--json", "--config", config)
        assert [row["rig"] for row in json.loads(stopped.stdout)] == ["rig1", "rig2"], stopped.stderr
        seen: list[str] = []

        def has_ended() -> bool:
            event = json.loads(follower.stdout.readline()) if follower.stdout else {}
            assert event["rig"] == "rig2"
            seen.append(event["kind"])
            return event["kind"] == "session-end"

        eventually(has_ended)
        assert "impairment-changed" in seen
        follower.send_signal(signal.SIGINT)
        assert follower.wait(LONG_TIMEOUT_S) == 0
        for pipe in (follower.stdout, follower.stderr):
            pipe.close()
