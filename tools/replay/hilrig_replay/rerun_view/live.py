"""A running rig, followed on the bus into the same view that a recording has.

The bus's callback only stores; `Follower.step` decodes and draws what has come since the last time, in one batch a
topic. What waits is bounded: when drawing falls behind, the oldest messages are dropped, and the arm jumps.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Final

import rerun as rr
from google.protobuf.message import DecodeError

from hilrig_replay.io.columns import StringTable
from hilrig_replay.io.records import Decoder
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.rerun_view.rig_view import Drawn, RigView
from hilrig_runtime.bus.api import Bus
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas.topics import COMMAND, CONFIG, EVENT, STATE, TRAFFIC, parse_rig_key

VIEWER_PERIOD_S: Final = 0.04
"""How often what has come in is drawn into a viewer, s."""
FILE_PERIOD_S: Final = 0.5
"""The same into a file, whose index, kept in memory until its end, grows with each piece."""
START_TIMEOUT_S: Final = 5.0
"""A rig that does not answer within this time is not there, s."""
SILENCE_NS: Final = 2_000_000_000
"""A rig from which nothing comes for so long is said to be silent, ns."""
_ASK_S: Final = 0.5
_WAITING: Final = 20_000
"""Messages that may wait to be drawn, count."""


class Follower:
    """Draws one rig of a lab for as long as it is stepped."""

    def __init__(
        self,
        bus: Bus,
        lab: str,
        rig: str,
        stream: rr.RecordingStream,
        clock: Clock,
        say: Callable[[str], None],
        task: TaskConfig | None = None,
    ) -> None:
        self._bus = bus
        self._lab = lab
        self._rig = rig
        self._stream = stream
        self._clock = clock
        self._say = say
        self._task = task
        self._waiting: deque[tuple[str, bytes, int]] = deque(maxlen=_WAITING)
        self._names, self._timebase = StringTable(), Timebase()
        self._decoder = Decoder(self._names, self._timebase)
        self._view: RigView | None = None
        self._incarnation = 0
        self._heard_ns = clock.monotonic_ns()
        self._silent = False
        self._handles = [
            bus.subscribe(topic.key(lab, rig), self._on_message) for topic in (STATE, COMMAND, EVENT, TRAFFIC)
        ]

    def _on_message(self, key: str, payload: bytes) -> None:
        self._waiting.append((parse_rig_key(key).topic.name, payload, self._clock.wall_ns()))

    def find(self, stopping: threading.Event, timeout_s: float = START_TIMEOUT_S) -> bool:
        """Ask the rig what it looks like, until it answers or `stopping` is set; whether it did.

        Raises:
            OperationError: nothing runs there.
        """
        deadline_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        while not stopping.is_set():
            drawn = self._ask()
            if drawn is not None:
                self._view = RigView(self._stream, drawn, self._timebase, self._names)
                return True
            if self._clock.monotonic_ns() >= deadline_ns:
                raise OperationError(
                    f"no simulation of rig {self._rig!r} answers for lab {self._lab!r}: "
                    "is it running (hilrig up), with this lab.toml?"
                )
            stopping.wait(0.05)
        return False

    def step(self) -> int:
        """Draw what has come since the last time; how many messages that was."""
        now_ns = self._clock.monotonic_ns()
        count = len(self._waiting)
        for _ in range(count):
            topic, payload, arrived_ns = self._waiting.popleft()
            try:
                self._decoder.add(topic, payload, 0, arrived_ns)
            except DecodeError:
                self._say(f"a message of {self._rig}/{topic} can't be decoded: another version of hilrig sends it")
        records = self._decoder.drain()
        # The edge goes on repeating its command when the simulation is gone: states are the sign of life.
        if len(records.states):
            self._heard_ns = now_ns
            if self._silent:
                self._silent = False
                self._say(f"{self._rig} is back")
        elif not self._silent and now_ns - self._heard_ns > SILENCE_NS:
            self._silent = True
            self._say(f"nothing comes from {self._rig}: waiting for it")
        if self._view is None or not self._timebase.start_wall_ns:
            # Commands and events before the first state have no place in time yet.
            return count
        if len(records.states):
            self._look_again(int(records.states["incarnation"][-1]))
        self._view.add(records)
        return count

    def _look_again(self, incarnation: int) -> None:
        """After a restart of the simulation its rig may be another one."""
        if incarnation == self._incarnation:
            return
        first, self._incarnation = not self._incarnation, incarnation
        drawn = None if first else self._ask()
        if drawn is not None and self._view is not None:
            self._view.draw(drawn)

    def _ask(self) -> Drawn | None:
        for answer in self._bus.ask(CONFIG.key(self._lab, self._rig), timeout_s=_ASK_S):
            if answer.payload and not answer.error:
                config = CONFIG.decode(answer.payload)
                return Drawn.of(config.urdf, config.parameters_json, config.step_ns, self._task)
        return None

    def close(self) -> None:
        """Listen no longer; a second call does nothing."""
        while self._handles:
            self._handles.pop().close()


def follow(follower: Follower, over: Callable[[], bool], stopping: threading.Event, period_s: float) -> None:
    """Draw every `period_s` until `over()` says so or `stopping` is set.

    Raises:
        OperationError: nothing runs there.
    """
    try:
        if not follower.find(stopping):
            return
        while not over() and not stopping.wait(period_s):
            follower.step()
        follower.step()
    finally:
        follower.close()
