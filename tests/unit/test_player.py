"""Playing a recording: what is due when, and what arrives on the bus."""

import json
import threading
from itertools import islice

import pytest

from hilrig_replay.export.player import Player, play_on, rig_config
from hilrig_replay.io.run import Run, open_run
from hilrig_runtime.bus.memory_bus import MemoryBus
from hilrig_runtime.errors import InputError
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import JointState
from hilrig_schemas.topics import RECORDED, STATE, parse_rig_key
from support import recordings
from support.labs import hilrig

MADE = recordings.make(recordings.Script(seconds=2))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("player") / "run.mcap"
    return open_run(recordings.write(path, MADE, script=recordings.Script(seconds=2)))


class Waiting(threading.Event):
    """Waits on a clock that the test owns."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self._clock = clock

    def wait(self, timeout: float | None = None) -> bool:
        self._clock.advance(round((timeout or 0) * 1e9))
        return self.is_set()


@pytest.mark.parametrize("speed", [1.0, 0.5, 10.0])
def test_messages_are_due_at_the_distances_at_which_they_were_published(run: Run, speed: float) -> None:
    dues = list(Player(run.file, speed=speed))
    assert len(dues) == len(MADE)
    first = MADE[0].publish_wall_ns
    assert [due.message.publish_ns for due in dues] == [one.publish_wall_ns for one in MADE]
    for due, one in zip(dues, MADE, strict=True):
        assert due.at_ns == round((one.publish_wall_ns - first) / speed)


def test_it_begins_where_it_is_told(run: Run) -> None:
    dues = list(Player(run.file, start_s=1.0))
    first = MADE[0].publish_wall_ns + 1_000_000_000
    assert len(dues) == sum(one.publish_wall_ns >= first for one in MADE)
    assert 0 <= dues[0].at_ns < 20_000_000


def test_a_loop_begins_again_where_it_ended(run: Run) -> None:
    whole = len(MADE)
    dues = list(islice(Player(run.file, loop=True), 3 * whole))
    assert [dues[number * whole].round for number in range(3)] == [0, 1, 2]
    times = [due.at_ns for due in dues]
    assert times == sorted(times)
    assert dues[whole].at_ns > dues[whole - 1].at_ns


def test_a_start_behind_the_end_is_named(run: Run) -> None:
    with pytest.raises(InputError, match="ends before 60 s"):
        Player(run.file, start_s=60)


def test_on_the_bus_come_the_bytes_that_were_recorded_when_they_are_due(run: Run) -> None:
    bus, clock = MemoryBus(), ManualClock()
    heard: list[tuple[str, bytes]] = []
    times = []

    def on_message(key: str, payload: bytes) -> None:
        heard.append((parse_rig_key(key).topic.name, payload))
        times.append(clock.monotonic_ns())

    bus.subscribe("hil/lab/rig1/*", on_message)
    begin = clock.monotonic_ns()
    assert play_on(bus, "lab", Player(run.file, speed=2.0), clock, Waiting(clock)) == len(MADE)
    assert heard == [(one.topic, one.message.SerializeToString()) for one in MADE]
    first = MADE[0].publish_wall_ns
    for at, one in zip(times, MADE, strict=True):
        assert at - begin == pytest.approx((one.publish_wall_ns - first) / 2, abs=1000)


def test_another_rig_s_name_is_in_the_keys_and_in_the_messages(run: Run) -> None:
    bus, clock = MemoryBus(), ManualClock()
    heard: list[bytes] = []
    bus.subscribe(STATE.key("lab", "rig9"), lambda _, payload: heard.append(payload))
    play_on(bus, "lab", Player(run.file), clock, Waiting(clock), rename="rig9")
    states = [JointState.FromString(payload) for payload in heard]
    assert {state.rig for state in states} == {"rig9"}
    assert [state.step for state in states] == [one.message.step for one in MADE if isinstance(one.message, JointState)]
    assert rig_config(run, "rig9").urdf == run.urdf


def test_it_stops_when_it_is_told(run: Run) -> None:
    clock = ManualClock()
    stopping = Waiting(clock)
    bus = MemoryBus()
    bus.subscribe("hil/lab/**", lambda *_: stopping.set())
    assert play_on(bus, "lab", Player(run.file, loop=True), clock, stopping) == 1


def test_every_recorded_topic_can_be_played(run: Run) -> None:
    assert {due.message.topic for due in Player(run.file)} == set(RECORDED)


def test_the_command_refuses_a_name_that_is_none(run: Run) -> None:
    answer = hilrig("play", run.path, "--rig", "a/b")
    assert answer.returncode == 2
    assert json.dumps("a/b").strip('"') in answer.stderr
