"""Test bench of a Modbus device: manual clock, states of the test, and a record of all its output."""

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.ports import Ownership
from hilrig_modbus_edge.device.session import Session
from hilrig_modbus_edge.device.settings import DeviceSettings
from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.lab import EdgeConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event, JointState, TorqueCommand

MS = 1_000_000
EDGE = EdgeConfig(
    watchdog_ms=1000.0,
    watchdog_min_ms=100.0,
    watchdog_max_ms=10_000.0,
    lease_timeout_ms=5000.0,
    session_grace_ms=5000.0,
    repeat_ms=200.0,
)
"""Settings of the tests, independent of the defaults."""


@dataclass
class Timer:
    """A scheduled call."""

    at_ns: int
    callback: Callable[[], None]
    canceled: bool = False

    def cancel(self) -> None:
        self.canceled = True


class Bench:
    """A device and its recorded output: it replaces scheduler, publisher, state cache and output port."""

    def __init__(self, ownership: Ownership | None = None, **settings: Any) -> None:
        self.clock = ManualClock()
        self.commands: list[TorqueCommand] = []
        self.repeats: list[TorqueCommand] = []
        self.events: list[Event] = []
        self.session_changes = 0
        self.scheduled: list[bytes] = []
        self.timers: list[Timer] = []
        self.arrive: Callable[[TimestampedPayload], None] | None = None
        self.arrival: TimestampedPayload | None = None
        self.rejected: list[str] = []
        values = replace(DeviceSettings.of(EDGE, ImpairmentConfig()), **settings)
        sender = CommandSender("rig1", self, self, self.clock, values.repeat_ns)  # type: ignore[arg-type]
        rng, port = random.Random(4), self
        self.device = Device("rig1", values, self.clock, port, port, sender, rng, ownership)  # type: ignore[arg-type]

    @property
    def session(self) -> Session:
        """The open session."""
        assert self.device.session is not None
        return self.device.session

    def send(self, rig: str, payload: bytes, now_ns: int) -> None:
        assert rig == "rig1"
        assert now_ns == self.clock.monotonic_ns()
        self.scheduled.append(payload)

    def publish_encoded(self, payload: bytes, wall_ns: int) -> None:
        assert payload is self.scheduled[-1]
        self.commands.append(TorqueCommand.FromString(payload))
        assert wall_ns == self.commands[-1].wall_ns

    def republish_encoded(self, payload: bytes) -> None:
        assert payload is self.scheduled[-1]
        self.repeats.append(TorqueCommand.FromString(payload))

    def get(self, rig: str) -> TimestampedPayload | None:
        assert rig == "rig1"
        return self.arrival

    def reject(self, key: str, defect: object) -> None:
        self.rejected.append(f"{key}: {defect}")

    def emit(self, event: Event) -> None:
        self.events.append(event)

    def sessions_changed(self) -> None:
        self.session_changes += 1

    def call_at(self, deadline_ns: int, callback: Callable[[], None]) -> Timer:
        self.timers.append(Timer(deadline_ns, callback))
        return self.timers[-1]

    def follow_states(self, arrive: Callable[[TimestampedPayload], None] | None) -> None:
        self.arrive = arrive

    def state(self, step: int, **fields: Any) -> None:
        message = JointState(
            rig="rig1",
            incarnation=7,
            step=step,
            position=fields.pop("position", (0.1, 0.2, 0.03, 0.4)),
            velocity=fields.pop("velocity", (0, 0, 0, 0)),
            effort=fields.pop("effort", (0, 0, 0, 0)),
            **fields,
        )
        self.arrival = TimestampedPayload(message.SerializeToString(), self.clock.monotonic_ns())
        if self.arrive is not None:
            self.arrive(self.arrival)

    def connect(self, host: str = "10.0.0.1", port: int = 1000, **identity: Any) -> Client:
        return self.device.connect(host, port, **identity)

    def read(
        self, client: Client, address: int, count: int, table: RegisterTable = RegisterTable.HOLDING_REGISTER
    ) -> list[int]:
        client.record_request(self.clock.monotonic_ns())
        return list(struct.unpack(f">{count}H", self.device.read_registers(client, table, address, count)))

    def write(self, client: Client, address: int, *values: int) -> None:
        now_ns = self.clock.monotonic_ns()
        client.record_request(now_ns)
        self.device.write_registers(client, address, struct.pack(f">{len(values)}H", *values), now_ns)

    def wait(self, ms: float) -> None:
        self.clock.advance(round(ms * MS))
        self.device.check(self.clock.monotonic_ns())

    def advance(self, ms: float) -> None:
        """Advance the clock as the edge does: with the calls that are due, and a check of the device at the end."""
        end_ns = self.clock.monotonic_ns() + round(ms * MS)
        while due := [timer for timer in self.timers if timer.at_ns <= end_ns and not timer.canceled]:
            timer = min(due, key=lambda one: one.at_ns)
            self.timers.remove(timer)
            self.clock.sleep_until_ns(timer.at_ns)
            timer.callback()
        self.clock.sleep_until_ns(end_ns)
        self.device.check(end_ns)

    def kinds(self) -> list[str]:
        return [Event.Kind.Name(event.kind) for event in self.events]
