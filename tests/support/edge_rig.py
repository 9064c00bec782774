"""Modbus edge on real sockets, in a thread of the test, with an in-memory bus and states of the test."""

import math
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Self

from hilrig_modbus_edge.service import run
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.messaging.recording_stream import entries_of
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import Event, JointState, LogBatch, ModbusTraffic, RigBatch, TorqueCommand, topics
from support.labs import free_ports
from support.waiting import eventually

HEADER = struct.Struct(">HHHB")
START_POSITION = (0.1, -0.2, 0.05, 3.0)


@dataclass
class EdgeRig:
    """A running edge and its recorded output on the bus."""

    lab: LabConfig
    hub: MemoryHub
    service: Service
    commands: list[TorqueCommand] = field(default_factory=list)
    repeats: list[TorqueCommand] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    traffic: list[ModbusTraffic] = field(default_factory=list)
    sessions: list[str] = field(default_factory=list)
    step: int = 0

    @property
    def port(self) -> int:
        return self.lab.ports[self.lab.rigs[0].name]

    def state(self, rig: str = "rig1", position: tuple[float, ...] = START_POSITION, **fields: Any) -> JointState:
        """Publish a state of the simulation."""
        self.step += 1
        state = JointState(
            rig=rig,
            incarnation=77,
            step=self.step,
            position=position,
            velocity=fields.pop("velocity", (0.0, 0.0, 0.0, 0.0)),
            effort=fields.pop("effort", (0.0, 0.0, 0.0, 0.0)),
            **fields,
        )
        payload = state.SerializeToString()
        self.hub.deliver(topics.STATE.key(self.lab.name, rig), payload)
        batch = RigBatch(source="sim/1", rigs=[rig], messages=[payload])
        self.hub.deliver(topics.STATES.key(self.lab.name, "sim", "1"), batch.SerializeToString())
        return state

    def kinds(self) -> list[str]:
        """Kinds of the events so far."""
        return [Event.Kind.Name(event.kind) for event in self.events]

    def event(self, kind: Event.Kind) -> Event:
        """Wait for an event."""
        return eventually(lambda: next((event for event in self.events if event.kind == kind), None))

    def client(self, rig: str = "rig1") -> "RawClient":
        return RawClient(self.lab.edge.host, self.lab.ports[rig])

    def _on_message(self, key: str, payload: bytes) -> None:
        topic = topics.parse_rig_key(key).topic
        if topic is topics.COMMAND:
            command = TorqueCommand.FromString(payload)
            again = any(c.rig == command.rig and c.seq == command.seq for c in self.commands[-50:])
            (self.repeats if again else self.commands).append(command)
        elif topic is topics.EVENT:
            self.events.append(Event.FromString(payload))

    def free(self) -> bool:
        """Return whether there is no lease holder and no open session."""
        kinds = self.kinds()
        pairs = (("LEASE_GRANTED", "LEASE_LOST"), ("SESSION_START", "SESSION_END"))
        return all(kinds.count(begin) == kinds.count(end) for begin, end in pairs)

    def _on_batch(self, _key: str, payload: bytes) -> None:
        batch = LogBatch.FromString(payload)
        if batch.complete_sessions:
            self.sessions[:] = [session.session for session in batch.sessions]
        for key, _, _, message in entries_of(batch):
            if topics.parse_rig_key(key).topic is topics.TRAFFIC:
                self.traffic.append(ModbusTraffic.FromString(message))


@contextmanager
def running_edge(rigs: tuple[str, ...] = ("rig1",), **edge: Any) -> Iterator[EdgeRig]:
    """Run an edge with these settings; every rig has one state on entry.

    `first_rig` are settings of the first rig.
    """
    first_port = free_ports(len(rigs))
    settings: list[dict[str, Any]] = [{"name": name, "port": first_port + number} for number, name in enumerate(rigs)]
    settings = edge.pop("rig_settings", settings)
    settings[0] |= edge.pop("first_rig", {})
    allow = edge.pop("allow", None)
    if allow is not None:
        settings[0]["allow"] = allow
    lab = LabConfig.model_validate({"edge": edge, "rigs": settings})
    hub = MemoryHub()
    with Service("edge", lab, MemoryBus(hub)) as service, MemoryBus(hub) as watcher:
        rig = EdgeRig(lab, hub, service)
        watcher.subscribe(f"{topics.ROOT}/*/*/*", rig._on_message)
        watcher.subscribe(topics.LOG.key(lab.name, "edge", "*"), rig._on_batch)
        failures: list[BaseException] = []

        def body() -> None:
            try:
                run(service)
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=body, name="edge")
        thread.start()
        try:
            alive = topics.alive_key(lab.name, "edge", "*")

            def up() -> bool:
                for name in rigs:
                    if not rig.step or not watcher.get_liveliness(alive):
                        rig.state(name)
                return bool(watcher.get_liveliness(alive)) or bool(failures)

            eventually(up)
            if not failures:
                yield rig
        finally:
            service.stop()
            thread.join(10)
        if failures:
            raise failures[0]
        assert not thread.is_alive()


class RawClient:
    """Modbus client that sends arbitrary bytes."""

    def __init__(self, host: str, port: int) -> None:
        self.socket = socket.create_connection((host, port), timeout=5)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._transaction = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        host, port = self.socket.getsockname()[:2]
        return f"{host}:{port}"

    def close(self) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def frame(self, pdu: bytes, *, unit: int = 1, transaction: int = 1) -> bytes:
        return HEADER.pack(transaction, 0, len(pdu) + 1, unit) + pdu

    def receive(self) -> tuple[int, int, bytes]:
        """Return transaction, unit and PDU of the next response."""
        transaction, protocol, length, unit = HEADER.unpack(self._exactly(7))
        assert protocol == 0
        return transaction, unit, self._exactly(length - 1)

    def ask(self, pdu: bytes | str, *, unit: int = 1) -> bytes:
        """Send the PDU of a request (bytes, or hex); return the PDU of the response."""
        if isinstance(pdu, str):
            pdu = bytes.fromhex(pdu)
        self._transaction = (self._transaction + 1) & 0xFFFF
        self.send(self.frame(pdu, unit=unit, transaction=self._transaction))
        transaction, answered, reply = self.receive()
        assert (transaction, answered) == (self._transaction, unit)
        return reply

    def read(self, address: int, count: int, function: int = 3) -> list[int]:
        """Read registers, as unsigned numbers."""
        reply = self.ask(struct.pack(">BHH", function, address, count))
        assert reply[:2] == bytes((function, 2 * count)), reply.hex()
        return list(struct.unpack(f">{count}H", reply[2:]))

    def write(self, address: int, *values: int) -> bytes:
        """Write registers with function 16; return the PDU of the response."""
        data = b"".join((value & 0xFFFF).to_bytes(2, "big") for value in values)
        return self.ask(struct.pack(">BHHB", 16, address, len(values), 2 * len(values)) + data)

    def closed(self) -> bool:
        """Wait until the peer sends data or closes the connection; return whether it closed it."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionResetError:
            return True

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise ConnectionError(f"closed after {len(data)} of {size} bytes")
            data += part
        return data


def counts(position: tuple[float, ...] = START_POSITION) -> list[int]:
    """Return the position registers of a joint vector, computed independently of the edge."""
    q1, q2, d3, q4 = position
    values = (math.degrees(q1) * 100, math.degrees(q2) * 100, d3 * 1e5, math.degrees(q4) * 100)
    return [round(value) & 0xFFFF for value in values]


def now_ns() -> int:
    return SYSTEM_CLOCK.monotonic_ns()
