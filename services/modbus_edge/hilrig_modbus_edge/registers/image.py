"""What one state of the simulation looks like in registers: computed once a state, shown to every reader alike.

A read is answered from one image, so that no 32-bit value is torn and no block mixes two steps.
"""

import struct
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_modbus_edge.device.client import NO_BASIS, Basis
from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.map import MAP_VERSION, Status
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import JointState

FRESH_NS: Final = 1_000_000_000
"""A state that is older says that the simulation, or the way from it, is down."""

_HEAD: Final = struct.Struct(">HHIIHHHHHH")


class StateImage:
    """The newest state in register form."""

    def __init__(self) -> None:
        self.arrival: TimestampedPayload | None = None
        """What it was made from; None: no state has come yet, and all else is zero."""
        self.arrived_ns = 0
        self.step = 0
        self.basis: Basis = NO_BASIS[0]
        """What a write is based on whose controller was shown this."""
        self.position_words = bytes(8)
        self._message = JointState()
        self._saturated = False
        self._latency_us = 0
        self._floats = b""

    def take(self, arrival: TimestampedPayload) -> None:
        """Make the image of a state that came; a message that is none is left out."""
        try:
            message = JointState.FromString(arrival.payload)
        except DecodeError:
            return
        # Taken as a list at once: to ask a repeated field for its numbers one by one takes twice as long.
        position = message.position[:]
        if not len(position) == len(message.velocity) == len(message.effort) == 4:
            return
        self.arrival = arrival
        self._message = message
        self.arrived_ns = arrival.arrived_ns
        self.step = message.step
        self.basis = message.incarnation, self.step, arrival.arrived_ns, arrival.injected_ns
        self.position_words, self._saturated = codec.words_of_position(position)
        if message.loop_latency_ns:
            self._latency_us = min(message.loop_latency_ns // 1000, 0xFFFFFFFF)
        self._floats = b""

    def status(self, now_ns: int) -> Status:
        """The bits that the simulation decides; `now_ns` of the monotonic clock."""
        message = self._message
        status = Status(0)
        if self.arrival is None:
            return status
        if now_ns - self.arrived_ns < FRESH_NS:
            status |= Status.SIMULATION_ALIVE
        if message.safe:
            status |= Status.SIMULATION_SAFE
        if self._saturated:
            status |= Status.POSITION_SATURATED
        if message.limit_flags:
            status |= Status.ON_STOP
        if message.magnet:
            status |= Status.MAGNET_ON
        if message.held_part:
            status |= Status.PART_HELD
        return status

    def input_words(
        self, *, status: int, lease: int, watchdog: int, timeout_ms: int, session: int, age_ms: int
    ) -> bytes:
        """All input registers, big-endian."""
        message = self._message
        if not self._floats:
            self._floats = (
                codec.floats_of_joints(message.position)
                + codec.floats_of_joints(message.velocity)
                + codec.floats_of(message.effort)
            )
        head = _HEAD.pack(
            MAP_VERSION,
            status,
            self.step & 0xFFFFFFFF,
            self._latency_us,
            lease,
            watchdog,
            timeout_ms,
            session & 0xFFFF,
            message.limit_flags & 0xFFFF,
            min(age_ms, 0xFFFF),
        )
        return head + self._floats
