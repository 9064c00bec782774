"""The recorder service on an in-process bus: the files contain the messages of the other services."""

import errno
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_recorder.service import run
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig, RecorderConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import Event, OpenSession, RigConfig, ServiceInfo
from hilrig_schemas.topics import CONFIG, LOG, Traffic
from support.foreign_requests import assert_refuses_foreign_requests
from support.log_streams import FakeSource
from support.waiting import LONG_TIMEOUT_S, eventually

SESSION = "20260101T000000Z-rig1-abcd"


class Lab:
    """A recorder in a thread, and fake services that publish to it."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.folder = folder
        self.hub = MemoryHub()
        self.bus = MemoryBus(self.hub)
        self.config = LabConfig(recorder=RecorderConfig(folder=folder, **settings))

    def send(self, source: FakeSource, sessions: Sequence[OpenSession] | None = None) -> None:
        service, instance = source.name.split("/")
        publisher = self.bus.publisher(LOG.key("lab", service, instance), Traffic.RECORDING)
        publisher.put(source.batch(sessions).SerializeToString())

    @contextmanager
    def recorder(self) -> Iterator[Service]:
        with Service("recorder", self.config, MemoryBus(self.hub)) as service:
            errors: list[BaseException] = []

            def body() -> None:
                try:
                    run(service)
                except BaseException as error:  # raised in the test's thread
                    errors.append(error)

            thread = threading.Thread(target=body)
            thread.start()
            try:
                eventually(lambda: errors or self.hub.tokens)
                yield service
            finally:
                service.stop()
                thread.join(10)
            assert not thread.is_alive()
            if errors:
                raise errors[0]

    def recordings(self) -> list[Path]:
        return sorted(self.folder.rglob("*.mcap"))


def metadata(path: Path) -> dict[str, dict[str, str]]:
    with path.open("rb") as stream:
        return {record.name: record.metadata for record in make_reader(stream).iter_metadata()}


def payloads(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as stream:
        return [
            (channel.topic, message.sequence, message.publish_time, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def sent(*sources: FakeSource) -> list[tuple[str, int, int, bytes]]:
    return [
        (f"/{message.key.rpartition('/')[2]}", message.sequence, message.publish_ns, message.payload)
        for source in sources
        for message in source.sent
    ]


def now() -> int:
    return SYSTEM_CLOCK.wall_ns()


def test_session_is_recorded_with_every_published_byte(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    config = RigConfig(rig="rig1", incarnation=1, step_ns=20_000_000, urdf="<robot/>", lab_toml="name = 'lab'\n")
    lab.bus.declare_queryable(CONFIG.key("lab", "rig1"), lambda _: config.SerializeToString())
    sim, edge = FakeSource("sim/1"), FakeSource("edge/1")
    with lab.recorder():
        sim.state("rig1", now())
        lab.send(sim)
        edge.start("rig1", SESSION, now())
        lab.send(edge)
        part = tmp_path / "lab" / "rig1" / f"{SESSION}.mcap.part"
        eventually(part.exists)
        for _ in range(100):
            sim.state("rig1", now(), SESSION)
            edge.command("rig1", now(), SESSION)
            lab.send(sim)
            lab.send(edge)
        edge.end("rig1", SESSION, now())
        lab.send(edge)
        sim.state("rig1", now())
        lab.send(sim)
        [path] = eventually(lab.recordings)
        assert not part.exists()
    assert sorted(payloads(path)) == sorted(sent(sim, edge))
    found = metadata(path)
    assert found["hilrig.session"]["session"] == SESSION
    assert found["hilrig.session"]["controller"] == "192.0.2.7:40001"
    assert "student" not in found["hilrig.session"], "the lab has no roster"
    assert found["hilrig.config"]["step_ns"] == "20000000"
    assert found["hilrig.summary"]["ended"] == "ended"
    assert found["hilrig.summary"]["reason"] == "the controller closed the connection"
    assert found["hilrig.summary"]["lost_transport"] == found["hilrig.summary"]["lost_recorder"] == "0"
    assert found["hilrig.summary"]["messages"] == "204"
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        assert attachments == {"lab.toml": b"name = 'lab'\n", "rig1.urdf": b"<robot/>"}
        steps = [state.step for _, _, _, state in reader.iter_decoded_messages(topics=["/state"])]
        assert steps == list(range(1, 103))


def test_stopped_recorder_finishes_its_files(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    sim, edge = FakeSource("sim/1"), FakeSource("edge/1")
    with lab.recorder():
        edge.start("rig1", SESSION, now())
        sim.state("rig1", now(), SESSION)
        lab.send(edge)
        lab.send(sim)
        eventually(lambda: list(tmp_path.rglob("*.part")))
    [path] = lab.recordings()
    assert metadata(path)["hilrig.summary"]["ended"] == "recorder stopped"
    assert sorted(payloads(path)) == sorted(sent(sim, edge))


def test_unwritable_folder_is_reported_at_start(tmp_path: Path) -> None:
    folder = tmp_path / "file"
    folder.write_text("not a folder")
    with (
        pytest.raises(OperationError, match=r"file/lab: can't write recordings: Not a directory"),
        Lab(folder).recorder(),
    ):
        pass


def test_write_error_of_one_file_does_not_affect_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(tmp_path)
    sim, edge = FakeSource("sim/1"), FakeSource("edge/1")
    failing = threading.Event()
    append = RecordingWriter._append

    def fail(writer: RecordingWriter, data: bytes) -> None:
        if failing.is_set() and writer.path.parent.name == "rig1":
            raise OSError(errno.EIO, "Input/output error")
        append(writer, data)

    monkeypatch.setattr(RecordingWriter, "_append", fail)
    events: list[Event] = []
    lab.bus.subscribe("hil/lab/rig1/event", lambda _, payload: events.append(Event.FromString(payload)))
    with lab.recorder() as service:
        for rig in ("rig1", "rig2"):
            edge.start(rig, f"{SESSION}-{rig}", now())
        lab.send(edge)
        eventually(lambda: len(list(tmp_path.rglob("*.part"))) == 2)
        failing.set()
        for _ in range(50):
            for rig in ("rig1", "rig2"):
                sim.state(rig, now())
            lab.send(sim)
        eventually(lambda: any("Input/output error" in event.text for event in events))
        assert {event.kind for event in events if event.severity == Event.ERROR} == {Event.RECORDING}
        eventually(lambda: "Input/output error" in service.counters.alert)
        edge.end("rig2", f"{SESSION}-rig2", now())
        lab.send(edge)
        for rig in ("rig1", "rig2"):
            sim.state(rig, now())
        lab.send(sim)
        [path] = eventually(lab.recordings)
    assert path.parent.name == "rig2"
    assert metadata(path)["hilrig.summary"]["lost_recorder"] == "0"
    assert len(payloads(path)) == 53
    # The other file is recovered at the next start.
    failing.clear()
    with lab.recorder():
        eventually(lambda: len(lab.recordings()) == 2)


def test_blocked_disk_fills_queue_and_drops_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(tmp_path, queue_entries=40)
    sim, edge = FakeSource("sim/1"), FakeSource("edge/1")
    slow, resume = threading.Event(), threading.Event()
    close_chunk = RecordingWriter.close_chunk

    def close_slowly(writer: RecordingWriter) -> None:
        if slow.is_set():
            resume.wait(LONG_TIMEOUT_S)
        close_chunk(writer)

    monkeypatch.setattr(RecordingWriter, "close_chunk", close_slowly)
    with lab.recorder() as service:
        edge.start("rig1", SESSION, now())
        lab.send(edge)
        eventually(lambda: list(tmp_path.rglob("*.part")))
        slow.set()

        def publish_more() -> int:
            sim.state("rig1", now(), SESSION)
            lab.send(sim)
            return service.counters.lost_recorder or len(sim.sent) > 300

        # The disk blocks: messages are queued first, then dropped.
        eventually(publish_more)
        resume.set()
        eventually(lambda: service.counters.queue_depth == 0 and service.counters.lost_recorder)
        edge.end("rig1", SESSION, now())
        lab.send(edge)
        sim.state("rig1", now())
        lab.send(sim)
        [path] = eventually(lab.recordings)
    missing = len(sim.sent) + len(edge.sent) - len(payloads(path))
    summary = metadata(path)["hilrig.summary"]
    assert missing > 0
    assert int(summary["lost_recorder"]) == missing
    assert summary["lost_transport"] == "0"


def test_large_recording_is_rotated_without_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_recorder.storage.store.MIB", 12 * 1024)
    lab = Lab(tmp_path, rotate_mib=1, min_free_mib=0)
    sim, edge = FakeSource("sim/1"), FakeSource("edge/1")
    with lab.recorder():
        edge.start("rig1", SESSION, now())
        lab.send(edge)

        def three_files() -> bool:
            for _ in range(20):
                sim.state("rig1", now(), SESSION)
            lab.send(sim)
            lab.send(edge, [OpenSession(rig="rig1", session=SESSION)])
            return len(lab.recordings()) >= 2

        eventually(three_files)
        edge.end("rig1", SESSION, now())
        lab.send(edge)
        sim.state("rig1", now())
        lab.send(sim)
        eventually(lambda: not list(tmp_path.rglob("*.part")))
    paths = sorted(lab.recordings(), key=lambda path: (len(path.name), path.name))
    assert [metadata(path)["hilrig.session"]["part"] for path in paths] == [str(n + 1) for n in range(len(paths))]
    assert sorted(message for path in paths for message in payloads(path)) == sorted(sent(sim, edge))


def test_restarted_recorder_ignores_ended_sessions(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    edge = FakeSource("edge/1")
    with lab.recorder():
        edge.start("rig1", SESSION, now())
        lab.send(edge)
        edge.command("rig1", now(), SESSION)
        edge.end("rig1", SESSION, now())
        lab.send(edge)
        eventually(lab.recordings)
    before = [path.read_bytes() for path in lab.recordings()]
    # The next recorder receives the start and end of the session again from the caches of the streams.
    with lab.recorder() as service:
        eventually(lambda: service.counters.received >= 3)
    assert [path.read_bytes() for path in lab.recordings()] == before


def test_requests_of_other_versions_are_refused(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    with lab.recorder():
        assert_refuses_foreign_requests(lab.bus, "lab", ServiceInfo(service="recorder", instance="1"))
