"""Batches of messages: recorded under each rig's key, cached, and restricted to the rigs of an edge."""

import pytest

from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import parse_lab
from hilrig_runtime.process.health import resident_bytes
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import LogBatch, RigBatch
from hilrig_schemas.topics import COMMANDS, LOG, STATE, STATES
from support.virtual_rig import VirtualRig

LAB = parse_lab("[rigs]\ncount = 3\n")


class Heard:
    """Messages that were published on a key."""

    def __init__(self, hub: MemoryHub, key: str) -> None:
        self.payloads: list[bytes] = []
        MemoryBus(hub).subscribe(key, lambda _, payload: self.payloads.append(payload))

    def batches(self) -> list[dict[str, bytes]]:
        found = [RigBatch.FromString(payload) for payload in self.payloads]
        return [dict(zip(batch.rigs, batch.messages, strict=True)) for batch in found]


def test_batch_and_single_messages_are_published_and_recorded() -> None:
    hub = MemoryHub()
    together, single = Heard(hub, STATES.key("lab", "*", "*")), Heard(hub, STATE.key("lab", "rig2"))
    log = Heard(hub, LOG.key("lab", "*", "*"))
    with Service("sim", LAB, MemoryBus(hub), clock=ManualClock()) as service:
        sender = service.batch_publisher(STATES)
        for rig in ("rig1", "rig2"):
            service.add_to_batch(sender, STATE, rig)
        sender.publish([b"one", b"two"])
        service.add_to_batch(sender, STATE, "rig3")
        sender.remove(0)
        sender.publish([b"four", b"five"])
        service.recording_stream.flush(0)
        assert service.counters.published == 4
    assert together.batches() == [{"rig1": b"one", "rig2": b"two"}, {"rig2": b"four", "rig3": b"five"}]
    assert single.payloads == [b"two", b"four"]
    batch = LogBatch.FromString(log.payloads[0])
    entries = zip((key.split("/")[2] for key in batch.keys), batch.sequences, batch.payloads, strict=True)
    assert list(entries) == [("rig1", 1, b"one"), ("rig2", 1, b"two"), ("rig2", 2, b"four"), ("rig3", 1, b"five")]


def test_cache_keeps_newest_and_counts_malformed() -> None:
    hub = MemoryHub()
    with Service("edge", LAB, MemoryBus(hub), clock=ManualClock()) as service:
        latest = service.latest_value_cache(STATES)
        put = MemoryBus(hub).publisher(STATES.key("lab", "sim", "1"), STATES.traffic).put
        put(RigBatch(rigs=["rig1", "rig2"], messages=[b"a", b"b"]).SerializeToString())
        first = latest.get("rig1")
        put(RigBatch(rigs=["rig2"], messages=[b"c"]).SerializeToString())
        put(b"\xff")
        put(RigBatch(rigs=["rig1"], messages=[]).SerializeToString())
        assert latest.get("rig1") is first
        assert latest.get("rig2").payload == b"c"  # type: ignore[union-attr]
        assert latest.get("rig3") is None
        assert (service.counters.received, service.counters.malformed) == (3, 2)


def test_edge_may_only_publish_for_its_rigs() -> None:
    hub = MemoryHub()
    with Service("sim", LAB, MemoryBus(hub), clock=ManualClock()) as service:
        latest = service.latest_value_cache(COMMANDS, {"east": ("rig1",), "west": ("rig2",)})
        for instance, payload in (("east", b"e"), ("stranger", b"s")):
            batch = RigBatch(rigs=["rig1", "rig2"], messages=[payload, payload])
            MemoryBus(hub).publisher(COMMANDS.key("lab", "edge", instance), COMMANDS.traffic).put(
                batch.SerializeToString()
            )
        assert latest.get("rig1").payload == b"e"  # type: ignore[union-attr]
        assert latest.get("rig2") is None


@pytest.mark.long("takes 5 s")
def test_memory_does_not_grow_while_publishing() -> None:
    with VirtualRig(parse_lab("[rigs]\ncount = 32\n")) as lab:
        lab.service.recording_stream.extend = list  # type: ignore[assignment, method-assign]

        def work(steps: int) -> None:
            for step in range(steps):
                lab.command((0.1, 0.0, 0.0, 0.0), session="20260101T000000Z-rig1-abcd", magnet=step % 50 > 25)
                lab.tick()
                lab.states.clear()
            lab.events.clear()

        work(200)
        before = resident_bytes()
        work(1000)
        # A batch that is used again for all steps would take 7 MB.
        assert resident_bytes() - before < 2_000_000
