"""Test bench of a Modbus device: manual clock, states of the test, and a record of all its output."""

import random
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.device import Device
from hilrig_modbus_edge.device.settings import DeviceSettings
from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.lab import EdgeConfig
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import ManualClock
from hilrig_schemas import Event, JointState, TorqueCommand

MS = 1_000_000


class Bench:
    """A device and its recorded output."""

    def __init__(self, **settings: Any) -> None:
        self.clock = ManualClock()
        self.commands: list[TorqueCommand] = []
        self.repeats: list[TorqueCommand] = []
        self.events: list[Event] = []
        self.session_changes = 0
        self.deadlines: list[int] = []
        self.sends: list[int] = []
        self.arrive: Callable[[TimestampedPayload], None] | None = None
        self.arrival: TimestampedPayload | None = None
        device_settings = replace(DeviceSettings.of(EdgeConfig(), ImpairmentConfig()), **settings)
        self.device = Device("rig1", device_settings, self.clock, self, lambda: self.arrival, random.Random(4))

    def send_command(self, command: TorqueCommand) -> None:
        self.commands.append(TorqueCommand.FromString(command.SerializeToString()))

    def repeat_command(self, command: TorqueCommand) -> None:
        self.repeats.append(TorqueCommand.FromString(command.SerializeToString()))

    def emit(self, event: Event) -> None:
        self.events.append(event)

    def sessions_changed(self) -> None:
        self.session_changes += 1

    def watch(self, deadline_ns: int) -> None:
        self.deadlines.append(deadline_ns)

    def send_at(self, deadline_ns: int) -> None:
        self.sends.append(deadline_ns)

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

    def connect(self, host: str = "10.0.0.1", port: int = 1000, **permissions: bool) -> Client:
        return self.device.connect(host, port, **permissions)

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

    def kinds(self) -> list[str]:
        return [Event.Kind.Name(event.kind) for event in self.events]
