"""A recording in its own time: which message is due when, at any speed, from any point, over and over.

`Player` is pure and says what is due; `play_on` waits and sends. A message is due by the time at which it was
published, as its sender's clock had it: the distances of what was sent come back, whatever the way to the recorder
did to them.
"""

import heapq
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from hilrig_replay.io.recording_file import RawMessage, RecordingFile
from hilrig_replay.io.run import Run
from hilrig_runtime.bus.api import Bus, Publisher
from hilrig_runtime.errors import InputError
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigConfig
from hilrig_schemas.topics import RECORDED

ALL_TOPICS: Final = frozenset(RECORDED)
_REORDER_NS: Final = 1_000_000_000
"""Streams arrive in batches: a message may stand this much behind one that was published later."""


@dataclass(frozen=True, slots=True)
class Due:
    """A message and when it is to be sent."""

    at_ns: int
    """After the start of playing, ns."""
    round: int
    """How often the recording was played before, count."""
    message: RawMessage


class Player:
    """Plays a recording from `start_s` on at `speed` times its own; `loop` begins again at the end.

    Raises:
        InputError: the recording is empty, or shorter than `start_s`.
    """

    def __init__(
        self,
        file: RecordingFile,
        *,
        speed: float = 1.0,
        start_s: float = 0.0,
        loop: bool = False,
        topics: frozenset[str] = ALL_TOPICS,
    ) -> None:
        self.rig = file.metadata.get("hilrig.session", {}).get("rig", "") or "rig"
        """Name of the rig that was recorded."""
        self._file = file
        self._speed = speed
        self._topics = topics
        self._loop = loop
        first = next(iter(self._ordered(None)), None)
        if first is None:
            raise InputError(f"{file.path}: nothing to play: it holds none of {', '.join(sorted(topics))}")
        self.origin_ns = first.publish_ns + round(start_s * 1e9)
        """What is played first, ns, wall clock of its sender."""
        if next(iter(self._ordered(self.origin_ns)), None) is None:
            raise InputError(f"{file.path}: ends before {start_s:g} s")

    def __iter__(self) -> Iterator[Due]:
        offset_ns = 0
        for number in count():
            last_ns = 0
            for message in self._ordered(self.origin_ns):
                last_ns = round((message.publish_ns - self.origin_ns) / self._speed)
                yield Due(offset_ns + last_ns, number, message)
            if not self._loop:
                return
            # A recording of one message must not be played without end in one moment.
            offset_ns += max(last_ns, 1_000_000) + round(1_000_000 / self._speed)

    def _ordered(self, from_publish_ns: int | None) -> Iterator[RawMessage]:
        """The messages in the order of their publication; only so many are held as may come out of order."""
        waiting: list[tuple[int, int, RawMessage]] = []
        from_log_ns = None if from_publish_ns is None else self._earliest_arrival(from_publish_ns)
        for number, message in enumerate(self._file.messages(self._topics, from_ns=from_log_ns)):
            if from_publish_ns is not None and message.publish_ns < from_publish_ns:
                continue
            heapq.heappush(waiting, (message.publish_ns, number, message))
            while waiting[0][0] < message.publish_ns - _REORDER_NS:
                yield heapq.heappop(waiting)[2]
        while waiting:
            yield heapq.heappop(waiting)[2]

    def _earliest_arrival(self, publish_ns: int) -> int | None:
        # Clocks of sender and recorder may differ by anything: skipped by index only where they plainly agree.
        return publish_ns - _REORDER_NS if self._file.start_ns <= publish_ns <= self._file.end_ns else None


def play_on(
    bus: Bus, lab: str, player: Player, clock: Clock, stopping: threading.Event, *, rename: str | None = None
) -> int:
    """Send a recording's messages when they are due, until it ends or `stopping` is set; how many were sent.

    With `rename` they are another rig's, in their keys and in themselves.
    """
    begin_ns = clock.monotonic_ns()
    sent = 0
    with ExitStack() as closing:
        publishers: dict[str, Publisher] = {}
        for due in player:
            wait_ns = begin_ns + due.at_ns - clock.monotonic_ns()
            if stopping.wait(wait_ns * 1e-9) if wait_ns > 0 else stopping.is_set():
                break
            name, payload = due.message.topic, due.message.payload
            topic = RECORDED[name]
            if name not in publishers:
                rig = player.rig if rename is None else rename
                publishers[name] = closing.enter_context(bus.publisher(topic.key(lab, rig), topic.traffic))
            if rename is not None:
                message: Any = topic.decode(payload)
                message.rig = rename
                payload = message.SerializeToString()
            publishers[name].put(payload)
            sent += 1
    return sent


def rig_config(run: Run, name: str) -> RigConfig:
    """What a rig that plays a recording answers when it is asked what it is."""
    return RigConfig(
        rig=name,
        incarnation=run.number("config", "incarnation") or 0,
        step_ns=run.step_ns,
        parameters_json=run.parameters_json,
        urdf=run.urdf,
        lab_toml=run.file.attachments.get("lab.toml", b"").decode(errors="replace"),
        software_version=run.metadata.get("hilrig.config", {}).get("software_version", ""),
        machine=run.metadata.get("hilrig.config", {}).get("machine", ""),
    )
