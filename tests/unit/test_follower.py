"""Live view of a running rig over the in-memory bus: drawing, silence, restart."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun as rr

from hilrig_replay.rerun_view.layout import layout
from hilrig_replay.rerun_view.live import SILENCE_TIMEOUT_NS, Follower
from hilrig_replay.rerun_view.sinks import to_file
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import JointState, RigConfig
from hilrig_schemas.topics import CONFIG, RIG_TOPICS, Traffic
from hilrig_sim.arm.urdf import urdf
from support.recordings import PARAMETERS, Script, TimedMessage, make
from support.rrd_files import RrdFile

KEYS = {topic.name: topic.key("lab", "rig1") for topic in RIG_TOPICS}


class Watched:
    """A follower with its bus, clock and output file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bus = MemoryBus()
        self.clock = ManualClock()
        self.notices: list[str] = []
        self.stream: rr.RecordingStream = to_file(path, "live-rig1", layout(live=True))
        self.follower = Follower(self.bus, "lab", "rig1", self.stream, self.clock, self.notices.append)

    def serve(self) -> None:
        config = RigConfig(rig="rig1", step_ns=20_000_000, parameters_json=PARAMETERS.to_json(), urdf=urdf(PARAMETERS))
        self.bus.declare_queryable(CONFIG.key("lab", "rig1"), lambda _: config.SerializeToString())

    def send(self, made: list[TimedMessage]) -> None:
        for one in made:
            self.bus.publisher(KEYS[one.topic], Traffic.CONTROL).put(one.message.SerializeToString())

    def shown(self) -> RrdFile:
        self.stream.disconnect()
        return RrdFile(self.path)


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    watched = Watched(tmp_path / "live.rrd")
    yield watched
    watched.follower.close()
    watched.stream.disconnect()


def test_follower_draws_received_messages_in_batches(watched: Watched) -> None:
    watched.serve()
    assert watched.follower.find(threading.Event())
    made = make(Script(seconds=3.0))
    for start in range(0, len(made), 50):
        watched.send(made[start : start + 50])
        watched.follower.step()
    shown = watched.shown()
    assert shown.rows("/position") == 150
    assert shown.rows("/scene/joints/d3") == 150
    assert shown.rows("/stages") > 130
    assert shown.rows("/events") == 2
    assert 25 < shown.rows("/modbus/192.0.2.7_40001/reads") < 32


def test_missing_simulation_raises_with_a_hint(watched: Watched) -> None:
    with pytest.raises(OperationError, match=r"no reply from a simulation of rig 'rig1' in lab 'lab'.*hilrig up"):
        watched.follower.find(threading.Event(), timeout_s=0.0)


def test_find_returns_when_stopping_is_set(watched: Watched) -> None:
    stopping = threading.Event()
    stopping.set()
    assert not watched.follower.find(stopping)


def test_silence_and_recovery_are_reported_once(watched: Watched) -> None:
    watched.serve()
    watched.follower.find(threading.Event())
    made = [one for one in make(Script(seconds=1.0)) if one.topic == "state"]
    watched.send(made[:10])
    watched.follower.step()
    for _ in range(3):
        watched.clock.advance(SILENCE_TIMEOUT_NS)
        watched.follower.step()
    watched.send(made[10:])
    watched.follower.step()
    assert watched.notices == ["rig1: no states received for 2 s; waiting", "rig1: receiving states again"]


def test_view_continues_after_a_simulation_restart(watched: Watched) -> None:
    watched.serve()
    watched.follower.find(threading.Event())
    made = [one for one in make(Script(seconds=2.0)) if one.topic == "state"]
    watched.send(made[:50])
    watched.follower.step()
    for number, one in enumerate(made[50:]):
        assert isinstance(one.message, JointState)
        one.message.incarnation, one.message.step = 99, number + 1
        one.message.sampled_ns -= 1_000_000_000_000
    watched.send(made[50:])
    watched.follower.step()
    assert watched.shown().rows("/position") == 100


def test_commands_before_the_first_state_are_ignored(watched: Watched) -> None:
    watched.serve()
    watched.follower.find(threading.Event())
    made = make(Script(seconds=1.0))
    watched.send([one for one in made if one.topic == "command"][:5])
    watched.follower.step()
    watched.send([one for one in made if one.topic == "state"])
    watched.follower.step()
    assert watched.shown().rows("/position") == 50


def test_invalid_messages_are_skipped_and_reported_rarely(watched: Watched) -> None:
    watched.bus.declare_queryable(CONFIG.key("lab", "rig1"), lambda _: b"\xff")
    watched.serve()
    watched.follower.find(threading.Event())
    for payload in (b"\xff\xff\xff", JointState(rig="rig2").SerializeToString(), b"\xff"):
        watched.bus.publisher(KEYS["state"], Traffic.CONTROL).put(payload)
    watched.follower.step()
    assert len(watched.notices) == 1
    assert "rig1/state: a message is invalid" in watched.notices[0]
    watched.clock.advance(10_000_000_000)
    watched.follower.step()
    assert "(2 times)" in watched.notices[1]


def test_pending_messages_are_bounded(watched: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    watched.serve()
    watched.follower.find(threading.Event())
    state = next(one for one in make(Script(seconds=0.1)) if one.topic == "state")
    for _ in range(30_000):
        watched.send([state])
    assert watched.follower.step() == 20_000
