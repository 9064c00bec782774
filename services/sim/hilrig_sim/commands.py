"""Which command acts on a rig at a tick, how old it is, and what latency it closes the loop with.

Pure: arrivals and time are passed in. A command is new where its session or its number differ from those of the one
in force; a repeat only says that the edge is still there.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from google.protobuf.message import DecodeError

from hilrig_schemas import TorqueCommand
from hilrig_sim.arm.model import LARGEST_EFFORT

ZERO_EFFORT: Final = (0.0, 0.0, 0.0, 0.0)
Effort = tuple[float, float, float, float]


class Arrival(Protocol):
    """A message as it came in."""

    @property
    def payload(self) -> bytes:
        """Its bytes."""

    @property
    def arrived_ns(self) -> int:
        """When, ns, monotonic clock."""


class StepTimes:
    """When the last steps were sampled: a ring, for commands that answer to a state of some steps ago."""

    def __init__(self, capacity: int = 8192) -> None:
        self._times_ns = [0] * capacity
        self._capacity = capacity
        self._step = 0

    def add(self, step: int, sampled_ns: int) -> None:
        """Steps are added one after the other."""
        self._times_ns[step % self._capacity] = sampled_ns
        self._step = step

    def get(self, step: int) -> int | None:
        """sampled_ns of a step; None: it is not kept any more, or has not been."""
        if 0 < step <= self._step and self._step - step < self._capacity:
            return self._times_ns[step % self._capacity]
        return None


class _Command(NamedTuple):
    """What matters of a command."""

    seq: int
    session: str
    effort: Effort
    magnet: bool
    basis_incarnation: int
    basis_step: int
    resets: int


@dataclass(slots=True)
class CommandFollower:
    """Follows the commands of one rig; its attributes say what acts from the latest tick on."""

    incarnation: int
    """Of this run of the simulation: only steps of its own can be a basis."""
    timeout_ns: int
    """With no command for so long the effort is zero; 0: never."""
    effort: Effort = ZERO_EFFORT
    """What acts: N·m, N·m, N, N·m."""
    magnet: bool = False
    session: str = ""
    seq: int = 0
    """Of the command in force; 0: none yet."""
    safe: bool = True
    """No fresh command: the effort is zero. The magnet stays as it is, so that nothing is dropped."""
    is_new: bool = False
    """A new command took effect at this tick."""
    basis_step: int = 0
    """The new command's; 0 where there is no new one, or its basis was not of this run."""
    arrived_ns: int = 0
    """Of the new command, ns; 0 where there is none."""
    changed: bool = False
    """`effort` or `magnet` may differ from those of the tick before."""
    lost: bool = False
    """The commands stopped coming at this tick."""
    back: bool = False
    """They came again at this tick."""
    reset: bool = False
    """A reset was asked for at this tick."""
    silent_ns: int = 0
    """How long nothing had been heard, where `lost` or `back`, ns."""
    malformed: int = 0
    """Messages that were no commands."""
    _arrival: Arrival | None = None
    _heard_ns: int = 0
    _commanded: Effort = ZERO_EFFORT
    _resets: int | None = None
    _is_plain: bool = True

    def latch(self, arrival: Arrival | None, now_ns: int) -> None:
        """Take the newest arrival, the same object as before where nothing came; `now_ns` is not before it."""
        if not self._is_plain:
            self.is_new = self.changed = self.lost = self.back = self.reset = False
            self.basis_step = self.arrived_ns = 0
            self._is_plain = True
        self.overtake(arrival, now_ns)

    def overtake(self, arrival: Arrival | None, now_ns: int) -> None:
        """Take what came after `latch`, but before the tick that it was for: what it overtakes has never acted."""
        if arrival is not self._arrival and arrival is not None:
            self._is_plain = False
            self._arrival = arrival
            self._take(arrival, now_ns)
        elif not self.safe and self.timeout_ns and now_ns - self._heard_ns > self.timeout_ns:
            self._is_plain = False
            self.safe = self.lost = self.changed = True
            self.silent_ns = now_ns - self._heard_ns
            self.effort = ZERO_EFFORT
            # Where it came for this very tick, and that was held up for so long, it does not act.
            self.is_new = False
            self.basis_step = self.arrived_ns = 0

    def _take(self, arrival: Arrival, now_ns: int) -> None:
        command = _decode(arrival.payload)
        if command is None:
            self.malformed += 1
            return
        was_silent_ns = now_ns - self._heard_ns
        self._heard_ns = arrival.arrived_ns
        if command.seq != self.seq or command.session != self.session or self._resets is None:
            self.is_new = self.changed = True
            self.seq, self.session, self.magnet = command.seq, command.session, command.magnet
            self.effort = self._commanded = command.effort
            self.arrived_ns = arrival.arrived_ns
            self.basis_step = command.basis_step if command.basis_incarnation == self.incarnation else 0
        if self.safe:
            # Not at the first command of all: nothing was lost before it. Nor was it where it came just in time.
            self.back = self._resets is not None and not self.lost
            self.lost = False
            self.silent_ns = was_silent_ns
            self.safe = False
            self.changed = True
            self.effort = self._commanded
        # A count that fell is an edge that was started anew. A reset that is overtaken is asked for all the same.
        self.reset |= self._resets is not None and command.resets > self._resets
        self._resets = command.resets


def _decode(payload: bytes) -> _Command | None:
    """The command that some bytes are; None: they are none."""
    try:
        message = TorqueCommand.FromString(payload)
    except DecodeError:
        return None
    # Taken as a list at once: to ask a repeated field for its numbers one by one takes twice as long.
    effort = message.effort[:]
    if len(effort) != 4:
        return None
    return _Command(
        message.seq,
        message.session,
        _bounded(*effort),
        message.magnet,
        message.basis_incarnation,
        message.basis_step,
        message.resets,
    )


def _bounded(first: float, second: float, third: float, fourth: float) -> Effort:
    most = LARGEST_EFFORT
    # Of each rig at each step: what is within bounds is not looked at twice.
    if -most <= first <= most and -most <= second <= most and -most <= third <= most and -most <= fourth <= most:
        return first, second, third, fourth
    return _finite(first), _finite(second), _finite(third), _finite(fourth)


def _finite(value: float) -> float:
    return min(max(value, -LARGEST_EFFORT), LARGEST_EFFORT) if not math.isnan(value) else 0.0
