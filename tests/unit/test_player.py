"""Playback of a recording: schedule and published messages."""

import json
import threading
from itertools import islice

import pytest

from hilrig_modbus_edge.registers.image import StateImage
from hilrig_replay.export.player import Player, publish_recording, rig_config
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.counters import Counters
from hilrig_runtime.errors import InputError
from hilrig_runtime.messaging.latest_value_cache import LatestValueCache
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import JointState
from hilrig_schemas.topics import RECORDED, STATE, STATES, parse_rig_key
from support import recordings
from support.labs import hilrig

MADE = recordings.make(recordings.Script(seconds=2))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("player") / "run.mcap"
    return open_run(recordings.write(path, MADE, script=recordings.Script(seconds=2)))


class ManualEvent(threading.Event):
    """An event whose `wait` advances the test's clock."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self._clock = clock

    def wait(self, timeout: float | None = None) -> bool:
        self._clock.advance(round((timeout or 0) * 1e9))
        return self.is_set()


@pytest.mark.parametrize("speed", [1.0, 0.5, 10.0])
def test_schedule_restores_the_publication_intervals(run: Run, speed: float) -> None:
    schedule = list(Player(run, speed=speed))
    assert len(schedule) == len(MADE)
    first = MADE[0].publish_wall_ns
    assert [each.message.publish_time for each in schedule] == [one.publish_wall_ns for one in MADE]
    for each, one in zip(schedule, MADE, strict=True):
        assert each.offset_ns == round((one.publish_wall_ns - first) / speed)


def test_playback_starts_at_start_s(run: Run) -> None:
    schedule = list(Player(run, start_s=1.0))
    first = MADE[0].publish_wall_ns + 1_000_000_000
    assert len(schedule) == sum(one.publish_wall_ns >= first for one in MADE)
    assert 0 <= schedule[0].offset_ns < 20_000_000


def test_loop_restarts_after_the_end(run: Run) -> None:
    length = len(MADE)
    schedule = list(islice(Player(run, loop=True), 3 * length))
    assert [schedule[number * length].repetition for number in range(3)] == [0, 1, 2]
    times = [each.offset_ns for each in schedule]
    assert times == sorted(times)
    assert schedule[length].offset_ns > schedule[length - 1].offset_ns


def test_start_after_the_end_is_rejected(run: Run) -> None:
    with pytest.raises(InputError, match="ends before 60 s"):
        Player(run, start_s=60)


def test_recorded_bytes_are_published_on_schedule(run: Run) -> None:
    bus, clock = MemoryBus(), ManualClock()
    received: list[tuple[str, bytes]] = []
    times = []

    def on_message(key: str, payload: bytes) -> None:
        received.append((parse_rig_key(key).topic.name, payload))
        times.append(clock.monotonic_ns())

    bus.subscribe("hil/lab/rig1/*", on_message)
    begin = clock.monotonic_ns()
    assert publish_recording(bus, "lab", Player(run, speed=2.0), clock, ManualEvent(clock)) == len(MADE)
    assert received == [(one.topic, one.message.SerializeToString()) for one in MADE]
    first = MADE[0].publish_wall_ns
    for at, one in zip(times, MADE, strict=True):
        assert at - begin == pytest.approx((one.publish_wall_ns - first) / 2, abs=1000)


def test_rename_changes_keys_and_messages(run: Run) -> None:
    bus, clock = MemoryBus(), ManualClock()
    received: list[bytes] = []
    bus.subscribe(STATE.key("lab", "rig9"), lambda _, payload: received.append(payload))
    publish_recording(bus, "lab", Player(run), clock, ManualEvent(clock), rename="rig9")
    states = [JointState.FromString(payload) for payload in received]
    assert {state.rig for state in states} == {"rig9"}
    assert [state.step for state in states] == [one.message.step for one in MADE if isinstance(one.message, JointState)]
    assert rig_config(run, "rig9").urdf == run.urdf


def test_edge_follows_a_playback(run: Run) -> None:
    # An edge receives the states of a simulation in batches only.
    bus, clock = MemoryBus(), ManualClock()
    states = LatestValueCache(clock, Counters(), {})
    bus.subscribe_newest(STATES.key("lab", "*", "*"), states.on_message, 64)
    publish_recording(bus, "lab", Player(run), clock, ManualEvent(clock), rename="rig9")
    newest = states.get("rig9")
    assert newest is not None
    image = StateImage()
    assert image.update(newest)
    assert image.step == max(one.message.step for one in MADE if isinstance(one.message, JointState))


def test_playback_stops_when_stopping_is_set(run: Run) -> None:
    clock = ManualClock()
    stopping = ManualEvent(clock)
    bus = MemoryBus()
    bus.subscribe("hil/lab/**", lambda *_: stopping.set())
    assert publish_recording(bus, "lab", Player(run, loop=True), clock, stopping) == 1


def test_all_recorded_topics_are_played(run: Run) -> None:
    assert {each.topic for each in Player(run)} == set(RECORDED)


def test_command_rejects_an_invalid_rig_name(run: Run) -> None:
    answer = hilrig("play", run.path, "--rig", "a/b")
    assert answer.returncode == 2
    assert json.dumps("a/b").strip('"') in answer.stderr
