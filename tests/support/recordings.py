"""Recordings with known content: a scripted rig and controller in simulated time, written with the stock MCAP writer.

Simulation and edge use unrelated clocks, as on two machines. The actions of the controller and their times are
scripted, so a test knows each stage of each loop independently of the code under test.
"""

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from types import MappingProxyType

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from hilrig_recorder.mcap_format.reader import decompress
from hilrig_recorder.mcap_format.records import Chunk
from hilrig_recorder.mcap_format.scan import scan
from hilrig_runtime.config.lab import LabConfig, RigSettings
from hilrig_schemas import Event, JointState, ModbusKind, ModbusTraffic, PartState, TorqueCommand
from hilrig_schemas.topics import RECORDED
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.parameters import rig_parameters

START_WALL_NS = 1_767_225_600_000_000_000
SIM_FROM_WALL_NS = 9_000_000_000_000 - START_WALL_NS
EDGE_FROM_WALL_NS = 77_000_000_000_000_000 - START_WALL_NS
MS = 1_000_000
REGISTER_SCALE = np.array([180 / np.pi, 180 / np.pi, 1000.0, 180 / np.pi])
"""Conversion from rad and m to the units of the registers, degrees and mm."""
CONTROLLER = "192.0.2.7:40001"
PARAMETERS = rig_parameters(LabConfig(), RigSettings())


@dataclass(frozen=True)
class Script:
    """Script of a recorded run; times in ms unless the name has another unit."""

    seconds: float = 4.0
    step_ms: float = 20.0
    poll_ms: float = 5.0
    """Cycle time of the controller; 0: as fast as possible."""
    delay_ms: float = 0.0
    """Computation time of the controller between reading and writing."""
    order: str = "read-compute-write"
    """Or `write-read`: each cycle writes the result of the previous cycle's read, then reads and waits."""
    network_ms: float = 0.4
    """One-way network delay between controller and edge."""
    injected_state_ms: float = 0.0
    injected_command_ms: float = 0.0
    stalls: Mapping[int, float] = field(default_factory=dict)
    """Stalls of the simulation: step at whose start it stalls → duration."""
    edge_stalls: Mapping[float, float] = field(default_factory=dict)
    """Stalls of the edge: start time, s → duration."""
    law: str = "wave"
    """Control law: a `wave`, or `feedback` from the positions that were read."""
    feedback_delay_polls: int = 0
    """Age of the positions that the feedback uses, polls."""
    delayed_ack_ms: float = 0.0
    """Delay of a request that directly follows a write, caused by a delayed acknowledgment."""
    lost_transport: int = 0
    lost_recorder: int = 0
    clock_steps: int = 0
    controllers: bool = True
    parts: bool = True
    seed: int = 1


def position(seconds: float) -> np.ndarray:
    """Position of the arm: rad, rad, m, rad."""
    t = seconds
    return np.array([0.9 * np.sin(0.7 * t), 1.1 * np.sin(0.9 * t + 0.5), 0.1 - 0.1 * np.cos(1.3 * t), 0.8 * np.sin(t)])


@dataclass
class TimedMessage:
    """One message of a recording."""

    topic: str
    publish_wall_ns: int
    message: Message


def make(script: Script, session: str = "20260101T000000Z-rig1-abcd", rig: str = "rig1") -> list[TimedMessage]:
    """The messages of a scripted run, in the order of publication."""
    random = Random(script.seed)
    step_ns = round(script.step_ms * MS)
    ticks = _ticks(script, step_ns, random)
    writes = list(_cycles(script, ticks, random)) if script.controllers else []
    made: list[TimedMessage] = []
    for write in writes:
        command = write.command
        command.rig, command.session, command.controller = rig, session, CONTROLLER
        made.append(TimedMessage("command", command.sent_ns - EDGE_FROM_WALL_NS, command))
    waiting = iter(writes)
    following = next(waiting, None)
    newest: _Write | None = None
    sampled: dict[int, int] = {}
    held = 0
    parts = [
        PartState(name=part.name, x=part.position[0], y=part.position[1], z=part.position[2], yaw=part.yaw)
        for part in (PARAMETERS.scene.parts if script.parts else ())
    ]
    for step, (tick_ns, lateness_ns, missed) in ticks.items():
        seconds = tick_ns / 1e9
        sampled[step] = tick_ns
        fresh = None
        while following is not None and following.arrives_ns <= tick_ns:
            fresh = newest = following
            following = next(waiting, None)
        q, ahead = position(seconds), position(seconds + 1e-4)
        state = JointState(rig=rig, session=session, incarnation=7, step=step)
        state.sampled_ns = tick_ns + START_WALL_NS + SIM_FROM_WALL_NS
        state.wall_ns = tick_ns + START_WALL_NS
        state.lateness_ns, state.missed_steps = lateness_ns, missed
        state.position.extend(q)
        state.velocity.extend((ahead - q) / 1e-4)
        state.effort.extend(newest.command.effort if newest else [0.0] * 4)
        state.integration_error.extend([1e-12] * 4)
        if newest:
            state.command_seq, state.magnet = newest.command.seq, newest.command.magnet
        if fresh and fresh.command.basis_step:
            state.basis_step = fresh.command.basis_step
            state.command_arrived_ns = fresh.arrives_ns + START_WALL_NS + SIM_FROM_WALL_NS
            state.loop_latency_ns = tick_ns - sampled[fresh.command.basis_step]
        if parts and (step - 1) % 50 == 0:
            parts[held].x += 0.002
            state.parts.extend(parts)
        made.append(TimedMessage("state", state.wall_ns, state))
        if missed:
            text = f"{missed} steps missed"
            event = Event(rig=rig, session=session, kind=Event.OVERRUN, severity=Event.WARNING, text=text, step=step)
            event.wall_ns, event.source = state.wall_ns, "sim/1"
            event.overrun_data.missed_steps = missed
            made.append(TimedMessage("event", event.wall_ns, event))
    started, ended = f"started by {CONTROLLER}", "ended: the connection was closed"
    for at_ns, kind, text in ((0, Event.SESSION_START, started), (tick_ns, Event.SESSION_END, ended)):
        event = Event(rig=rig, session=session, kind=kind, severity=Event.INFO, text=f"session {session} {text}")
        event.wall_ns, event.source = START_WALL_NS + at_ns, "edge/1"
        made.append(TimedMessage("event", event.wall_ns, event))
    made.extend(_traffic(writes, rig))
    return sorted(made, key=lambda one: one.publish_wall_ns)


@dataclass
class _Write:
    command: TorqueCommand
    arrives_ns: int
    """Arrival at the simulation."""
    asked_ns: int
    """Arrival of the preceding read at the edge, on the clock of the edge."""


def _ticks(script: Script, step_ns: int, random: Random) -> dict[int, tuple[int, int, int]]:
    ticks = {}
    at_ns, step = 0, 1
    while at_ns < script.seconds * 1e9:
        late_ns = random.randrange(50_000, 150_000)
        missed = 0
        stall_ns = round(script.stalls.get(step, 0) * MS)
        if stall_ns:
            missed = (stall_ns + late_ns) // step_ns
            at_ns += missed * step_ns
            late_ns += stall_ns - missed * step_ns
        ticks[step] = (at_ns + late_ns, late_ns, missed)
        at_ns += step_ns
        step += 1
    return ticks


def _cycles(script: Script, ticks: dict[int, tuple[int, int, int]], random: Random) -> Iterator[_Write]:
    """Cycles of the controller; true time in ns from the start, timestamps on the clock of the edge."""
    network_ns, delay_ns = round(script.network_ms * MS), round(script.delay_ms * MS)
    steps = list(ticks)
    at_edge = np.array([ticks[step][0] + random.randrange(200_000, 300_000) for step in steps])
    release = at_edge + round(script.injected_state_ms * MS)
    free_ns = 0

    def edge_free(at_ns: int) -> int:
        """Time at which the edge processes a request that arrives at `at_ns`: later during a stall."""
        for start_s, stall_ms in script.edge_stalls.items():
            start_ns = round(start_s * 1e9)
            if start_ns <= at_ns < start_ns + stall_ms * MS:
                return start_ns + round(stall_ms * MS)
        return at_ns

    def stamp(true_ns: int) -> int:
        return int(true_ns) + START_WALL_NS + EDGE_FROM_WALL_NS

    begin_ns, seq = round(30 * MS), 0
    seen: tuple[int, int] | None = None
    seen_before: deque[np.ndarray] = deque(maxlen=2 + script.feedback_delay_polls)
    while begin_ns < script.seconds * 1e9 - 100 * MS:
        if script.order == "read-compute-write":
            asked_ns = max(begin_ns + network_ns, free_ns)
            read_ns = edge_free(asked_ns)
            seen = (int(np.searchsorted(release, read_ns, side="right")) - 1, read_ns)
            # A loop that reads right after writing waits for the acknowledgment of its write.
            write_ns = read_ns + 2 * network_ns + delay_ns + random.randrange(50_000)
        else:
            write_ns = begin_ns + network_ns
        sent_ns = edge_free(write_ns) + random.randrange(20_000, 60_000) + round(script.injected_command_ms * MS)
        if seen is not None and seen[0] >= 0:
            seq += 1
            index, served_ns = seen
            seen_before.append(np.round(position(ticks[steps[index]][0] / 1e9) * REGISTER_SCALE, 2))
            effort = _effort(script, seen_before, write_ns / 1e9, seq)
            command = TorqueCommand(
                seq=seq,
                effort=effort,
                magnet=(seq // 200) % 2 == 1,
                basis_incarnation=7,
                basis_step=steps[index],
                state_arrived_ns=stamp(at_edge[index]),
                state_served_ns=stamp(served_ns),
                write_arrived_ns=stamp(write_ns),
                sent_ns=stamp(sent_ns),
                state_injected_ns=round(script.injected_state_ms * MS),
                command_injected_ns=round(script.injected_command_ms * MS),
                wall_ns=sent_ns + START_WALL_NS,
            )
            yield _Write(command, sent_ns + random.randrange(150_000, 250_000), stamp(asked_ns))
        free_ns = write_ns + 20_000 + round(script.delayed_ack_ms * MS)
        done_ns = write_ns + network_ns
        if script.order == "write-read":
            asked_ns = done_ns + network_ns
            read_ns = edge_free(asked_ns)
            seen = (int(np.searchsorted(release, read_ns, side="right")) - 1, read_ns)
            done_ns = read_ns + network_ns + delay_ns
        begin_ns = max(done_ns, begin_ns + round(script.poll_ms * MS))


def _effort(script: Script, seen: Sequence[np.ndarray], seconds: float, seq: int) -> np.ndarray:
    """Torques of a control law: a wave that does not depend on the arm, or feedback from an earlier poll."""
    if script.law == "wave" or len(seen) < 2 + script.feedback_delay_polls:
        return 3 * np.sin(0.9 * seq / 50 + np.arange(4))
    newest, older = seen[-1 - script.feedback_delay_polls], seen[-2 - script.feedback_delay_polls]
    setpoint = position(seconds) * REGISTER_SCALE
    return np.array([0.5, 0.4, 0.3, 0.2]) * (setpoint - newest) - 0.6 * (newest - older)


def _traffic(writes: list[_Write], rig: str) -> Iterator[TimedMessage]:
    read = ModbusKind(function=3, address=4, count=4, controller=CONTROLLER)
    wrote = ModbusKind(function=16, address=0, count=4, controller=CONTROLLER)
    batch = ModbusTraffic(rig=rig, kinds=[read, wrote])
    for write in writes:
        command = write.command
        batch.kind_indexes.extend((0, 1))
        batch.arrived_ns.extend((write.asked_ns, command.write_arrived_ns))
        batch.answered_after_ns.extend((command.state_served_ns - write.asked_ns + 15_000, 15_000))
        if len(batch.arrived_ns) >= 20 or write is writes[-1]:
            batch.closed_ns = command.sent_ns
            batch.wall_ns = command.wall_ns
            yield TimedMessage("traffic", batch.wall_ns, batch)
            batch = ModbusTraffic(rig=rig, kinds=[read, wrote])


def write(
    path: Path,
    made: Iterable[TimedMessage],
    *,
    script: Script = Script(),
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    schema_version: str = "hilrig.v1",
    compression: CompressionType = CompressionType.ZSTD,
    session: str = "20260101T000000Z-rig1-abcd",
    rig: str = "rig1",
    finish: bool = True,
    configured: bool = True,
    missing: Mapping[str, Collection[int]] = MappingProxyType({}),
    arrival_lag_ns: int = 0,
    lab_toml: str = "",
    urdf_text: str | None = None,
    fetched_until_s: float = 0.0,
) -> Path:
    """Write messages as the recorder does.

    Args:
        path: the file.
        made: the messages.
        script: script of the run (used for its metadata).
        metadata: additional or replaced metadata records.
        schema_version: version of the message schemas in the metadata.
        compression: compression of the chunks.
        session: id of the session.
        rig: name of the rig.
        finish: without it the file has no footer, as after a crash of the recorder.
        configured: without it the file has no configuration and no URDF.
        missing: sequence numbers of messages that are not written, by topic.
        arrival_lag_ns: additional arrival delay of the second half of the messages.
        lab_toml: content of the attached lab file.
        fetched_until_s: messages up to this time arrived at this time, from the caches of their senders.
        urdf_text: content of the attached URDF; None: that of the rig.
    """
    if arrival_lag_ns:
        made = list(made)
        late_from = made[len(made) // 2].publish_wall_ns
    missed_steps = 0
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=64 * 1024, compression=compression)
        writer.start()
        channels = {}
        for name, topic in RECORDED.items():
            schema = writer.register_schema(topic.message.DESCRIPTOR.full_name, "protobuf", _descriptors(topic.message))
            channels[name] = writer.register_channel(str(topic.channel), "protobuf", schema)
        writer.add_metadata(
            "hilrig.session",
            {
                "session": session,
                "rig": rig,
                "lab": "lab",
                "controller": CONTROLLER if script.controllers else "",
                "software_version": "0.1.0",
                "machine": "test",
                "schema_version": schema_version,
                "start": "2026-01-01T00:00:00Z",
            },
        )
        configuration = {
            "rig": rig,
            "step_ns": str(round(script.step_ms * MS)),
            "parameters_json": PARAMETERS.to_json(),
        }
        if configured:
            writer.add_metadata("hilrig.config", configuration)
            model = urdf(PARAMETERS) if urdf_text is None else urdf_text
            writer.add_attachment(0, START_WALL_NS, f"{rig}.urdf", "application/xml", model.encode())
        if lab_toml:
            writer.add_attachment(0, START_WALL_NS, "lab.toml", "application/toml", lab_toml.encode())
        sequences = dict.fromkeys(RECORDED, 0)
        for one in made:
            missed_steps += one.message.missed_steps if isinstance(one.message, JointState) else 0
            sequences[one.topic] += 1
            if sequences[one.topic] in missing.get(one.topic, ()):
                continue
            late_ns = 3 * MS + (arrival_lag_ns if arrival_lag_ns and one.publish_wall_ns > late_from else 0)
            writer.add_message(
                channels[one.topic],
                log_time=max(one.publish_wall_ns + late_ns, START_WALL_NS + round(fetched_until_s * 1e9)),
                publish_time=one.publish_wall_ns,
                sequence=sequences[one.topic],
                data=one.message.SerializeToString(),
            )
        if not finish:
            writer.flush()
            return path
        summary = {
            "ended": "session ended",
            "lost_transport": str(script.lost_transport),
            "lost_recorder": str(script.lost_recorder),
            "overruns": str(len(script.stalls)),
            "missed_steps": str(missed_steps),
            "clock_steps": str(script.clock_steps),
        }
        for name, values in {"hilrig.summary": summary, **(metadata or {})}.items():
            writer.add_metadata(name, dict(values))
        writer.finish()
    return path


def record(path: Path, script: Script = Script()) -> Path:
    """Generate a scripted run and write it to a file."""
    return write(path, make(script), script=script)


def _descriptors(message: type[Message]) -> bytes:
    files = FileDescriptorSet()
    message.DESCRIPTOR.file.CopyToProto(files.file.add())
    return files.SerializeToString()


def content_of(path: Path) -> bytes:
    """All bytes of a recording, and those of its chunks."""
    data = path.read_bytes()
    return data + b"".join(decompress(item) for _, item in scan(data) if isinstance(item, Chunk))
