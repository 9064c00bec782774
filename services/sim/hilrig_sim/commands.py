"""Latches the command that is applied to a rig at a tick, with its timeout and its basis for the loop latency.

Received messages and time are passed in. A command is new if its session or number differs from those of the latched
one; a repetition only shows that the edge is alive.
"""

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Final, NamedTuple

from google.protobuf.message import DecodeError

from hilrig_runtime.counters import Counters
from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_schemas import TorqueCommand
from hilrig_schemas.bounds import MAX_INTEGER, MAX_SESSION_ID
from hilrig_sim.arm.model import LARGEST_EFFORT

ZERO_EFFORT: Final = (0.0, 0.0, 0.0, 0.0)
Effort = tuple[float, float, float, float]


class StepTimes:
    """Ring buffer of the sampling times of the last steps, for commands that are based on an earlier state."""

    def __init__(self, capacity: int = 8192) -> None:
        self._times_ns = [0] * capacity
        self._capacity = capacity
        self.step = 0
        """The last step."""

    def add(self, step: int, sampled_ns: int) -> None:
        """Add the sampling time of the next step."""
        self._times_ns[step % self._capacity] = sampled_ns
        self.step = step

    def get(self, step: int) -> int | None:
        """Return the sampling time of a step, ns; None: it is too old, or has not been sampled."""
        if 0 < step <= self.step and self.step - step < self._capacity:
            return self._times_ns[step % self._capacity]
        return None


class _Command(NamedTuple):
    """The used fields of a command."""

    seq: int
    session: str
    effort: Effort
    magnet: bool
    basis_incarnation: int
    basis_step: int
    resets: int


# Built by tuple.__new__: the class's own constructor is interpreted code.
_command: Final = partial(tuple.__new__, _Command)


@dataclass(slots=True)
class CommandLatch:
    """Latches the commands of one rig; the attributes describe the command that is applied from the latest tick on."""

    incarnation: int
    """Incarnation of this simulation: only its own steps can be a basis."""
    timeout_ns: int
    """Time without a message after which the effort is zero, ns; 0: never."""
    effort: Effort = ZERO_EFFORT
    """Applied effort: N·m, N·m, N, N·m."""
    magnet: bool = False
    session: str = ""
    seq: int = 0
    """Number of the latched command; 0: none yet."""
    safe: bool = True
    """Commands have timed out: the effort is zero. The magnet is unchanged, so that no part falls."""
    is_new: bool = False
    """A new command is applied from this tick on."""
    basis_step: int = 0
    """Step that the new command is based on; 0: no new command, or its basis is of another incarnation."""
    arrived_ns: int = 0
    """Arrival of the new command, ns; 0: no new command."""
    changed: bool = False
    """`effort` or `magnet` may differ from those of the previous tick."""
    command_lost: bool = False
    """The commands timed out at this tick."""
    command_resumed: bool = False
    """Commands are received again since this tick."""
    reset: bool = False
    """A reset is requested for this tick."""
    silent_ns: int = 0
    """Time without a message before `command_lost` or `command_resumed`, ns."""
    counters: Counters = field(default_factory=Counters)
    """Count malformed messages."""
    received: TimestampedPayload | None = None
    """The latched message."""
    _last_received_ns: int = 0
    _commanded: Effort = ZERO_EFFORT
    _resets: int | None = None
    _flags_clear: bool = True

    def start_step(self) -> None:
        """Clear everything that describes one tick only, after that tick."""
        if not self._flags_clear:
            self.is_new = self.changed = self.command_lost = self.command_resumed = self.reset = False
            self.basis_step = self.arrived_ns = 0
            self._flags_clear = True

    def latch(self, command: TimestampedPayload | None, now_ns: int) -> None:
        """Latch the newest received command for the next tick; it replaces one that was latched before the same tick.

        `command` is the same object as before if no message was received; it is not later than `now_ns`.
        """
        if command is not self.received and command is not None:
            self._flags_clear = False
            self.received = command
            self._apply(command, now_ns)
        elif not self.safe and self.timeout_ns and now_ns - self._last_received_ns > self.timeout_ns:
            self._flags_clear = False
            self.safe = self.command_lost = self.changed = True
            self.silent_ns = now_ns - self._last_received_ns
            self.effort = ZERO_EFFORT
            # A command for this tick that timed out because the tick was late is not applied.
            self.is_new = False
            self.basis_step = self.arrived_ns = 0

    def _apply(self, received: TimestampedPayload, now_ns: int) -> None:
        command = _decode(received.payload)
        if command is None:
            self.counters.reject("command", "not a valid command")
            return
        was_silent_ns = now_ns - self._last_received_ns
        self._last_received_ns = received.arrived_ns
        if command.seq != self.seq or command.session != self.session or self._resets is None:
            self.is_new = self.changed = True
            self.seq, self.session, self.magnet = command.seq, command.session, command.magnet
            self.effort = self._commanded = command.effort
            self.arrived_ns = received.arrived_ns
            self.basis_step = command.basis_step if command.basis_incarnation == self.incarnation else 0
        if self.safe:
            # Not for the first command, and not if it was received between `latch` and the tick.
            self.command_resumed = self._resets is not None and not self.command_lost
            self.command_lost = False
            self.silent_ns = was_silent_ns
            self.safe = False
            self.changed = True
            self.effort = self._commanded
        # A lower count is that of a restarted edge. The reset request of a superseded command is kept.
        self.reset |= self._resets is not None and command.resets > self._resets
        self._resets = command.resets


def _decode(payload: bytes) -> _Command | None:
    """Decode a command; None: the message is malformed."""
    try:
        message = TorqueCommand.FromString(payload)
    except DecodeError:
        return None
    # Copied into a list: reading the numbers of a repeated field one by one takes twice as long.
    effort, session = message.effort[:], message.session
    # The session and the number are copied into each state. Every value of the other fields is valid.
    if len(effort) != 4 or len(session) > MAX_SESSION_ID or message.seq > MAX_INTEGER:
        return None
    return _command(
        (
            message.seq,
            session,
            _bounded(*effort),
            message.magnet,
            message.basis_incarnation,
            message.basis_step,
            message.resets,
        )
    )


def _bounded(first: float, second: float, third: float, fourth: float) -> Effort:
    limit = LARGEST_EFFORT
    # Fast path for efforts within the limits: this runs for each rig at each step.
    if (
        -limit <= first <= limit
        and -limit <= second <= limit
        and -limit <= third <= limit
        and -limit <= fourth <= limit
    ):
        return first, second, third, fourth
    return _finite(first), _finite(second), _finite(third), _finite(fourth)


def _finite(value: float) -> float:
    return min(max(value, -LARGEST_EFFORT), LARGEST_EFFORT) if not math.isnan(value) else 0.0
