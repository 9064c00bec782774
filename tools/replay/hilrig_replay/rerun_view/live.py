"""Live view of a running rig: subscribes to its topics and writes the messages into the same view as a recording.

The bus callback only queues messages; `Follower.step` decodes and draws the queued messages in one batch per topic.
The queue is bounded: when drawing falls behind, the oldest messages are dropped, and the drawn arm jumps.
"""

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import rerun as rr
from google.protobuf.message import DecodeError

from hilrig_replay.io.columns import StringTable
from hilrig_replay.io.records import Decoder
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.rerun_view.rig_view import RerunRigWriter, RigGeometry
from hilrig_runtime.bus.api import Bus
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.timing.clock import Clock
from hilrig_runtime.timing.rate_limiter import RepeatReporter, repeat_suffix
from hilrig_schemas.topics import COMMAND, CONFIG, EVENT, RECORDED, STATE, TRAFFIC, parse_rig_key

VIEWER_PERIOD_S: Final = 0.04
"""Period at which received messages are drawn into a viewer, s."""
FILE_PERIOD_S: Final = 0.5
"""Period for a file, s; longer, because rerun keeps the file's index in memory, one entry per write."""
START_TIMEOUT_S: Final = 5.0
"""Timeout for the simulation's first reply, s."""
SILENCE_TIMEOUT_NS: Final = 2_000_000_000
"""Time without states after which the rig is reported as silent, ns."""
_QUERY_TIMEOUT_S: Final = 0.5
_MAX_PENDING_MESSAGES: Final = 20_000
_MALFORMED_PERIOD_NS: Final = 10_000_000_000
"""Shortest time between two reports of invalid messages of a topic, ns."""


class Follower:
    """Draws one running rig of a lab; `step` draws the messages received since the previous call."""

    def __init__(
        self,
        bus: Bus,
        lab: str,
        rig: str,
        stream: rr.RecordingStream,
        clock: Clock,
        log: Callable[[str], None],
        task: TaskConfig | None = None,
    ) -> None:
        self._bus = bus
        self._lab = lab
        self._rig = rig
        self._stream = stream
        self._clock = clock
        self._log = log
        self._task = task
        self._pending: deque[tuple[str, bytes, int]] = deque(maxlen=_MAX_PENDING_MESSAGES)
        self._malformed: RepeatReporter[str, str] = RepeatReporter(
            _MALFORMED_PERIOD_NS,
            lambda text, count: log(f"{text}{repeat_suffix(count)}; compare the versions (hilrig doctor)"),
        )
        self._names, self._timebase = StringTable(), Timebase()
        self._decoder = Decoder(self._names, self._timebase)
        self._view: RerunRigWriter | None = None
        self._incarnation = 0
        self._last_state_ns = clock.monotonic_ns()
        self._silent = False
        self._handles = [
            bus.subscribe(topic.key(lab, rig), self._on_message) for topic in (STATE, COMMAND, EVENT, TRAFFIC)
        ]

    def _on_message(self, key: str, payload: bytes) -> None:
        self._pending.append((parse_rig_key(key).topic.name, payload, self._clock.wall_ns()))

    def find(self, stopping: threading.Event, timeout_s: float = START_TIMEOUT_S) -> bool:
        """Query the rig's geometry until it replies or `stopping` is set; returns whether it replied.

        Raises:
            OperationError: no reply within the timeout.
        """
        deadline_ns = self._clock.monotonic_ns() + round(timeout_s * 1e9)
        while not stopping.is_set():
            geometry = self._query_geometry()
            if geometry is not None:
                self._view = RerunRigWriter(self._stream, geometry, self._timebase, self._names)
                return True
            if self._clock.monotonic_ns() >= deadline_ns:
                raise OperationError(
                    f"no reply from a simulation of rig {self._rig!r} in lab {self._lab!r}: "
                    "is it running (hilrig up), with this lab.toml? See hilrig doctor"
                )
            stopping.wait(0.05)
        return False

    def step(self) -> int:
        """Draw the messages received since the previous call; returns their count."""
        now_ns = self._clock.monotonic_ns()
        count = len(self._pending)
        for _ in range(count):
            topic, payload, arrived_ns = self._pending.popleft()
            try:
                RECORDED[topic].decode_from(RECORDED[topic].key(self._lab, self._rig), payload)
                self._decoder.decoders[topic](payload, 0, arrived_ns)
            except DecodeError as error:
                self._malformed.record(topic, f"{self._rig}/{topic}: a message is invalid: {error}", now_ns)
        self._malformed.check(now_ns)
        records = self._decoder.drain()
        # Only states count: the edge keeps repeating its command after the simulation has stopped.
        if len(records.states):
            self._last_state_ns = now_ns
            if self._silent:
                self._silent = False
                self._log(f"{self._rig}: receiving states again")
        elif not self._silent and now_ns - self._last_state_ns > SILENCE_TIMEOUT_NS:
            self._silent = True
            self._log(f"{self._rig}: no states received for {SILENCE_TIMEOUT_NS // 1_000_000_000} s; waiting")
        if self._view is None or not self._timebase.start_wall_ns:
            # Before the first state, commands and events can't be placed on the time axis.
            return count
        if len(records.states):
            self._refresh_geometry(int(records.states["incarnation"][-1]))
        self._view.add(records)
        return count

    def _refresh_geometry(self, incarnation: int) -> None:
        """Query the geometry again after a restart of the simulation, whose configuration may have changed."""
        if incarnation == self._incarnation:
            return
        first, self._incarnation = not self._incarnation, incarnation
        geometry = None if first else self._query_geometry()
        if geometry is not None and self._view is not None:
            self._view.update_geometry(geometry)

    def _query_geometry(self) -> RigGeometry | None:
        for answer in self._bus.query(CONFIG.key(self._lab, self._rig), timeout_s=_QUERY_TIMEOUT_S):
            if answer.payload and not answer.error:
                with suppress(DecodeError):
                    config = CONFIG.decode_from(answer.key, answer.payload)
                    return RigGeometry.of(config.urdf, config.parameters_json, config.step_ns, self._task)
        return None

    def close(self) -> None:
        """Unsubscribe; a second call does nothing."""
        while self._handles:
            self._handles.pop().close()


def follow(follower: Follower, is_closed: Callable[[], bool], stopping: threading.Event, period_s: float) -> None:
    """Draw every `period_s` until `is_closed()` or `stopping` is set.

    Raises:
        OperationError: the simulation does not reply.
    """
    try:
        if not follower.find(stopping):
            return
        while not is_closed() and not stopping.wait(period_s):
            follower.step()
        follower.step()
    finally:
        follower.close()
