"""Every message type of the bus with random content, from a peer with an edge's certificate, or of a bus without any.

The peer publishes and answers on its own keys and on those of others, sends requests to all services, and commands a
rig of another edge. Afterwards every service is the same process as before, the dropped messages are counted, the
simulation has not missed more steps than without the peer, and the rig of the other edge never had a torque.
"""

import os
import random
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.messaging.recording_stream import encode_batch
from hilrig_schemas import Health, JointState, LogBatch, OpenSession, RigBatch, TorqueCommand
from hilrig_schemas.topics import (
    COMMANDS,
    CONTROL,
    EVENT,
    HEALTH,
    IMPAIRMENT,
    LEASE,
    LOG,
    RECORDED,
    RIG_TOPICS,
    SERVICE_INFO,
    STATE,
    STATES,
    Topic,
    alive_key,
)
from support.bus_certificates import make_bus_folder
from support.labs import RunningLab, write_lab
from support.random_messages import random_bytes, random_message
from support.waiting import eventually

pytestmark = pytest.mark.rig

MESSAGES = int(os.environ.get("HILRIG_BUS_FUZZ_MESSAGES", "5000"))
SEED = int(os.environ.get("HILRIG_BUS_FUZZ_SEED", random.SystemRandom().randrange(2**32)))
WITHOUT_CERTIFICATES = pytest.mark.skipif(
    "HILRIG_BUS_FUZZ_MESSAGES" not in os.environ,
    reason="the other run has access rules too: set the number of messages",
)
LAB = "lab"
WATCHED_S = 1.5
UNKNOWN_RIG = "rig7"
NAMES = (UNKNOWN_RIG, "rig2", "forged", "edge", "edge/west", "west", "sim", "sim/9", "s1")


class Fuzzer:
    """Sends random messages of one type after the other."""

    def __init__(self, bus: ZenohBus, rng: random.Random, rig: str) -> None:
        self.bus = bus
        self.rng = rng
        self.rig = rig
        keys: list[tuple[Topic[Any], str]] = [(topic, topic.key(LAB, rig)) for topic in RECORDED.values()]
        self.forged = bus.publisher(RECORDED["command"].key(LAB, "rig1"), RECORDED["command"].traffic).put
        keys += [(HEALTH, HEALTH.key(LAB, "edge", "west")), (EVENT, EVENT.key(LAB, "edge"))]
        self.publishers = [(topic.message, bus.publisher(key, topic.traffic).put) for topic, key in keys]
        self.commands = bus.publisher(COMMANDS.key(LAB, "edge", "west"), COMMANDS.traffic).put
        self.states = bus.publisher(STATES.key(LAB, "sim", "9"), STATES.traffic).put
        self.log = bus.publisher(LOG.key(LAB, "edge", "west"), LOG.traffic).put
        bus.declare_queryable(SERVICE_INFO.key(LAB, "edge", "west"), lambda _: self.random(SERVICE_INFO.message))
        bus.declare_token(alive_key(LAB, "edge", "west"))

    def random(self, kind: type) -> bytes:
        return random_bytes(self.rng, random_message(self.rng, kind, NAMES).SerializeToString())

    def publish(self) -> None:
        kind, put = self.rng.choice(self.publishers)
        put(self.random(kind))

    def forge(self) -> None:
        """Send a valid command of a rig that another edge serves, on its key and in a batch of this edge."""
        number = self.rng.randrange(1 << 40)
        command = TorqueCommand(rig="rig1", seq=number, effort=(5.0, 0, 0, 0))
        payload = command.SerializeToString()
        self.forged(payload)
        self.commands(RigBatch(source="edge/west", rigs=["rig1"], messages=[payload]).SerializeToString())

    def send_batch(self) -> None:
        topic, put = self.rng.choice(((RECORDED["command"], self.commands), (STATE, self.states)))
        count = self.rng.choice((1, 2, 50))
        rigs = [self.rng.choice(NAMES) for _ in range(count)]
        batch = RigBatch(source="edge/west", rigs=rigs, messages=[self.random(topic.message) for _ in rigs])
        put(random_bytes(self.rng, batch.SerializeToString()))

    def send_log(self) -> None:
        batch: LogBatch = random_message(self.rng, LogBatch, NAMES)
        if self.rng.random() < 0.8:
            # With a valid identity, so that its content is examined.
            batch.source, batch.incarnation = "edge/west", self.rng.choice((1, 2, 3))
            for column in (batch.keys, batch.sequences, batch.publish_wall_ns, batch.payloads):
                del column[:]
            for _ in range(self.rng.randrange(5)):
                topic = self.rng.choice(RIG_TOPICS)
                batch.keys.append(topic.key(LAB, self.rng.choice(NAMES)))
                batch.sequences.append(self.rng.choice((1, 2, 3, 1 << 40, 1 << 63)))
                batch.publish_wall_ns.append(self.rng.choice((-1, 0, time.time_ns())))
                batch.payloads.append(self.random(topic.message))
            if self.rng.random() < 0.1:
                batch.sessions.append(OpenSession(rig=self.rig, session="s1", start_wall_ns=-1))
        del batch.sessions[8:]
        self.log(encode_batch(batch))

    def send_request(self) -> None:
        topic = self.rng.choice((CONTROL, LEASE, IMPAIRMENT))
        assert topic.request is not None
        key = f"hil/{LAB}/control/*/*" if topic is CONTROL else f"hil/{LAB}/rig2/{topic.name}"
        self.bus.query(key, self.random(topic.request), timeout_s=0.02)

    def run(self, count: int) -> None:
        """Send messages of all types in random order."""
        actions: tuple[Callable[[], None], ...] = (self.publish, self.send_batch, self.send_log)
        for number in range(count):
            if number % 50 == 0 and self.rig != UNKNOWN_RIG:
                self.forge()
            if number % 100 == 0:
                self.send_request()
            self.rng.choice(actions)()
            if number % 20 == 0:
                time.sleep(0.005)  # the services shall receive the messages: at full rate zenoh drops them


def gaps(states: list[JointState], step_ns: int) -> int:
    """Number of times between two states of rig 1 that are longer than two steps."""
    times = [state.sampled_ns for state in states]
    return sum(later - sooner > 2 * step_ns for sooner, later in pairwise(times))


def secured_lab(folder: Path) -> Path:
    """Write a lab in which the certificate `west` is of an edge that may command rig 2, beside the running edge."""
    make_bus_folder(folder / "bus", ["sim", "1", "west", "recorder", "operator"])
    extra = f"bus.tls.folder = '{folder / 'bus'}'\nbus.tls.edges.1 = ['rig1', 'rig2']\nbus.tls.edges.west = ['rig2']"
    return write_lab(folder, rigs=2, extra=extra)


@pytest.mark.parametrize("secured", [True, pytest.param(False, marks=WITHOUT_CERTIFICATES)])
def test_services_survive_random_messages_of_every_type(tmp_path: Path, secured: bool) -> None:
    print(f"HILRIG_BUS_FUZZ_SEED={SEED} HILRIG_BUS_FUZZ_MESSAGES={MESSAGES}")
    config = secured_lab(tmp_path) if secured else write_lab(tmp_path, rigs=2)
    healths: dict[str, Health] = {}
    states: list[JointState] = []

    def on_health(key: str, payload: bytes) -> None:
        source = "/".join(key.split("/")[-2:])
        if source in ("sim/1", "edge/1", "recorder/1"):
            healths[source] = Health.FromString(payload)

    with RunningLab(config) as lab, ZenohBus(lab.lab.bus, "tool") as bus:
        bus.subscribe(HEALTH.key(LAB, "*", "*"), on_health)
        bus.subscribe(STATE.key(LAB, "rig1"), lambda _, payload: states.append(STATE.decode(payload)))
        eventually(lambda: len(healths) == 3)
        before = {name: health.incarnation for name, health in healths.items()}
        states.clear()
        time.sleep(WATCHED_S)  # the time without random messages is compared with that of the test
        quiet_gaps = gaps(states, lab.lab.sim.step_ns)
        states.clear()
        peer = ZenohBus(lab.lab.bus, "edge", "west") if secured else ZenohBus(lab.lab.bus, "tool")
        with peer:
            Fuzzer(peer, random.Random(SEED), "rig2" if secured else UNKNOWN_RIG).run(MESSAGES)
        fuzzed = list(states)
        received_ns = time.time_ns()
        eventually(lambda: len(healths) == 3 and all(health.wall_ns > received_ns for health in healths.values()))
        assert {name: health.incarnation for name, health in healths.items()} == before, lab.output()
        assert gaps(fuzzed, lab.lab.sim.step_ns) <= quiet_gaps + 1
        # With access rules, another edge's messages reach this one in replies to its queries only.
        for name in ("sim/1", "recorder/1") if secured else ("sim/1", "recorder/1", "edge/1"):
            assert healths[name].malformed > 0, name
        assert "malformed messages dropped" in lab.output()
        assert fuzzed
        if secured:
            assert not any(any(state.effort) for state in fuzzed)
        assert "Traceback" not in lab.output()
        assert lab.stop() == 0
