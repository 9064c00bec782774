"""Register image of one state of the simulation: computed once per state, served to every client.

A read is served from one image, so that no 32-bit value is torn and no block mixes two steps.
"""

from array import array
from collections.abc import Sequence
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.map import MAP_VERSION, Status, struct_of
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import JointState

MAX_STATE_AGE_NS: Final = 1_000_000_000
"""Age of the newest state, ns, from which on the simulation, or the connection to it, counts as down."""

StateRef = tuple[int, int, int, int]
"""Reference to a state: incarnation of the simulation, step, arrival time at the edge (ns, monotonic clock), and the
injected delay (ns). The tuple is shared by all clients that were served the same state."""

NO_STATE_REF: Final[StateRef] = (0, 0, 0, 0)
"""Reference to no state."""

_INPUTS: Final = struct_of(RegisterTable.INPUT_REGISTER)


class StateImage:
    """The newest state, encoded as registers."""

    def __init__(self) -> None:
        self.arrival: TimestampedPayload | None = None
        """The received state; None: none so far, and everything else is zero."""
        self.arrived_ns = 0
        self.step = 0
        self.basis: StateRef = NO_STATE_REF
        """Reference to the state; writes that are based on it carry it."""
        self.position_words = bytes(8)
        self._message = JointState()
        self._saturated = False
        self._latency_us = 0
        self._floats: Sequence[float] = ()

    def update(self, arrival: TimestampedPayload) -> bool:
        """Compute the image of a received state; False: the message is invalid and ignored."""
        try:
            message = JointState.FromString(arrival.payload)
        except DecodeError:
            return False
        # Copied into a list: reading the numbers of a repeated field one by one takes twice as long.
        position = message.position[:]
        latency_ns = message.loop_latency_ns
        if not len(position) == len(message.velocity) == len(message.effort) == 4 or latency_ns < 0:
            return False
        self.arrival = arrival
        self._message = message
        self.arrived_ns = arrival.arrived_ns
        self.step = message.step
        self.basis = message.incarnation, self.step, arrival.arrived_ns, arrival.injected_ns
        self.position_words, self._saturated = codec.words_of_position(position)
        if latency_ns:
            self._latency_us = min(latency_ns // 1000, 0xFFFFFFFF)
        self._floats = ()
        return True

    @property
    def position(self) -> Sequence[float]:
        """Position of the joints; rad, rad, m, rad."""
        return self._message.position

    def status(self, now_ns: int) -> int:
        """Return the status bits that depend on the simulation; ns, monotonic clock."""
        message = self._message
        status = 0
        if self.arrival is None:
            return status
        if now_ns - self.arrived_ns < MAX_STATE_AGE_NS:
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
        """Return all input registers, big-endian: the values in the order of the map."""
        message = self._message
        if not self._floats:
            # An array of 32-bit floats converts a number beyond their range to infinity.
            self._floats = array(
                "f", (*codec.display_of(message.position), *codec.display_of(message.velocity), *message.effort)
            )
        return _INPUTS.pack(
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
            *self._floats,
        )
