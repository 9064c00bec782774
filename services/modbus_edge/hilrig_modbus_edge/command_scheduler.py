"""When commands leave for the simulation, which takes the newest of each rig at its tick and no other.

A message costs its sender, threads of the bus on both sides and the simulation a wake-up each: on a small machine these
are taken from the very requests that are to be answered. So where commands are many they leave together, and each early
enough for the tick that it is meant for. A rig's first word on a new state is what a loop is measured by; more of them
before the next state come from a controller that asks again and again, and replace each other: the newest leaves.
What else the edge has to do, and can choose when, it does right after the last of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from hilrig_runtime.messaging.latest_value_cache import TimestampedPayload
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch

MANY: Final = 32
"""Commands from one `look` to the next, 20 ms later, from which on they wait for each other."""
GATHER_NS: Final = 2_000_000
"""For so long a first word waits for others, if the tick is far enough."""
NEAR_NS: Final = 3_000_000
"""So long before the tick it waits no more."""
LAST_NS: Final = 1_500_000
"""So long before the tick all that waits leaves: a tick is a state's way earlier than seen from here, and a command has
its way to go."""
PARTS: Final = 50
"""Of a step, one of which lies between two departures after that."""
FEW: Final = 8
"""Words on one state that still leave then: one who writes each torque by itself is not to be cut in two by a tick. Who
has said more than that says something newer right after it."""
JUST_AFTER_NS: Final = 50_000
"""So long after the last departure the edge turns to other things."""


class Timer(Protocol):
    """What was asked for, to be taken back."""

    def cancel(self) -> None:
        """Do not call."""


@dataclass(slots=True)
class _Said:
    """What a rig said on its newest state."""

    state_ns: int
    """When that came, monotonic clock; 0: none has."""
    words: int = 0


class Departures:
    """Sends the commands of an edge's rigs, on its loop.

    `newest_state` gives a rig's, which tells when its last tick was; rigs of several simulations have several.
    `call_at` has the loop call something at a time of its clock, s.
    """

    def __init__(
        self,
        source: str,
        put: Callable[[bytes], None],
        newest_state: Callable[[str], TimestampedPayload | None],
        step_ns: int,
        clock: Clock,
        call_at: Callable[[float, Callable[[], None]], Timer],
    ) -> None:
        self._source = source
        self._put = put
        self._newest_state = newest_state
        self._step_ns = step_ns
        self._apart_ns = step_ns // PARTS
        self._monotonic_ns = clock.monotonic_ns
        self._call_at = call_at
        self._waiting: dict[str, bytes] = {}
        """By rig, its newest command, encoded."""
        self._count = 0
        self._many = False
        self._said: dict[str, _Said] = {}
        self._timer: Timer | None = None
        self._due_ns = 0
        """When it comes."""

    def send(self, rig: str, command: bytes) -> None:
        """Send an encoded command of a rig, now or in time for the next tick."""
        self._waiting[rig] = command
        self._count += 1
        if not self._many:
            self.flush()
            return
        now_ns = self._monotonic_ns()
        self._leave_at(now_ns + self._waits_ns(rig, now_ns))

    def look(self) -> None:
        """Once a tick of the edge: decide from how many there were since then whether they wait for each other."""
        self._many = self._count >= MANY
        self._count = 0
        if not self._many:
            self.flush()

    def after_last(self, rig: str, when_ns: int) -> int:
        """Of the moments at which a rig's last command before a tick has just left, the nearest to `when_ns`, and that
        itself while the rig's simulation has said nothing; ns, monotonic clock."""
        state = self._newest_state(rig)
        if state is None:
            return when_ns
        half_ns = self._step_ns // 2
        return when_ns + (state.arrived_ns - LAST_NS + JUST_AFTER_NS - when_ns + half_ns) % self._step_ns - half_ns

    def flush(self) -> None:
        """Send what waits."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        waiting = self._waiting
        if waiting:
            self._put(RigBatch(source=self._source, rigs=waiting, messages=waiting.values()).SerializeToString())
            waiting.clear()

    def _waits_ns(self, rig: str, now_ns: int) -> int:
        """How long a word of a rig can wait, ns."""
        state = self._newest_state(rig)
        state_ns = 0 if state is None else state.arrived_ns
        to_tick_ns = state_ns + self._step_ns - now_ns
        if to_tick_ns < -self._step_ns:
            # The simulation is silent: there is no tick to be in time for.
            to_tick_ns = self._step_ns
        said = self._said.get(rig)
        if said is None or said.state_ns != state_ns:
            said = self._said[rig] = _Said(state_ns)
        said.words += 1
        if said.words == 1:
            return 0 if to_tick_ns < NEAR_NS else GATHER_NS
        if to_tick_ns > LAST_NS:
            return to_tick_ns - LAST_NS
        if said.words <= FEW:
            return self._apart_ns
        # Where the tick is late they are late enough.
        return max(to_tick_ns + GATHER_NS, self._apart_ns)

    def _leave_at(self, when_ns: int) -> None:
        if self._timer is not None:
            if self._due_ns <= when_ns:
                return
            self._timer.cancel()
        self._due_ns = when_ns
        self._timer = self._call_at(when_ns * 1e-9, self.flush)
