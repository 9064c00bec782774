"""Plays a recording on the bus with its original timing, at any speed, from any position, optionally in a loop.

`Player` computes when each message is due, without side effects; `publish_recording` waits and publishes. The schedule
follows the publication times by the senders' clocks, so that the original intervals are restored without the delays
between senders and recorder.
"""

import heapq
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from hilrig_recorder.mcap_format.records import Message
from hilrig_replay.export.copying import REORDER_WINDOW_NS, without_clock_steps
from hilrig_replay.io.run import Run, decoding
from hilrig_runtime.bus.api import Bus, Publisher
from hilrig_runtime.errors import InputError
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigBatch, RigConfig
from hilrig_schemas.topics import RECORDED, STATE, STATES

ALL_TOPICS: Final = frozenset(RECORDED)
_MAX_PAUSE_NS: Final = 3_600_000_000_000
"""A longer time without messages is a step of the clock, or damage."""


@dataclass(frozen=True, slots=True)
class ScheduledMessage:
    """A message and its time of publication."""

    offset_ns: int
    """Time since the start of playback, ns."""
    repetition: int
    """Number of previous complete playbacks."""
    topic: str
    message: Message


class Player:
    """Playback schedule of a run from `start_s`, at `speed` times the original speed; `loop` repeats it.

    Raises:
        InputError: the recording is empty, or shorter than `start_s`.
    """

    def __init__(
        self,
        run: Run,
        *,
        speed: float = 1.0,
        start_s: float = 0.0,
        loop: bool = False,
        topics: frozenset[str] = ALL_TOPICS,
    ) -> None:
        file = self._file = run.file
        self.rig = file.metadata.get("hilrig.session", {}).get("rig", "") or "rig"
        """Name of the recorded rig."""
        self.path = run.path
        self._has_clock_steps = run.has_clock_steps
        self._speed = speed
        self._topics = topics
        self._loop = loop
        first = next(iter(self._ordered(None)), None)
        if first is None:
            raise InputError(f"{file.path}: nothing to play: no messages of the topics {', '.join(sorted(topics))}")
        self.origin_ns = first.publish_time + round(start_s * 1e9)
        """Publication time at which playback starts, ns, wall clock of the sender."""
        if next(iter(self._ordered(self.origin_ns)), None) is None:
            raise InputError(f"{file.path}: the recording ends before {start_s:g} s")

    def __iter__(self) -> Iterator[ScheduledMessage]:
        offset_ns = 0
        for number in count():
            last_ns = 0
            for message in self._ordered(self.origin_ns):
                last_ns = round((message.publish_time - self.origin_ns) / self._speed)
                yield ScheduledMessage(offset_ns + last_ns, number, self._file.topics[message.channel_id], message)
            if not self._loop:
                return
            # A minimum interval: the repetitions of a recording of one message must not all be due at once.
            offset_ns += max(last_ns, 1_000_000) + round(1_000_000 / self._speed)

    def _ordered(self, from_publish_ns: int | None) -> Iterator[Message]:
        """Messages in order of publication; only those within the reorder window are held in memory."""
        buffer: list[tuple[int, int, Message]] = []
        has_steps = self._has_clock_steps
        from_log_ns = None if from_publish_ns is None or has_steps else self._earliest_arrival(from_publish_ns)
        messages = self._file.messages(self._topics, from_ns=from_log_ns)
        longest_ns = REORDER_WINDOW_NS if has_steps else _MAX_PAUSE_NS
        for number, message in enumerate(without_clock_steps(messages, longest_ns)):
            if from_publish_ns is not None and message.publish_time < from_publish_ns:
                continue
            heapq.heappush(buffer, (message.publish_time, number, message))
            while buffer[0][0] < message.publish_time - REORDER_WINDOW_NS:
                yield heapq.heappop(buffer)[2]
        while buffer:
            yield heapq.heappop(buffer)[2]

    def _earliest_arrival(self, publish_ns: int) -> int | None:
        # The clocks of sender and recorder may differ: the index is used only if they are consistent.
        return publish_ns - REORDER_WINDOW_NS if self._file.start_ns <= publish_ns <= self._file.end_ns else None


def publish_recording(
    bus: Bus, lab: str, player: Player, clock: Clock, stopping: threading.Event, *, rename: str | None = None
) -> int:
    """Publish a recording's messages when they are due, until its end or until `stopping` is set; returns the count.

    `rename` replaces the rig's name in keys and messages. As a simulation does, it publishes each state in a batch too,
    which edges and the console follow.
    """
    rig = player.rig if rename is None else rename
    start_ns = clock.monotonic_ns()
    count_sent = 0
    with ExitStack() as closing:
        publishers: dict[str, Publisher] = {}
        batches = closing.enter_context(bus.publisher(STATES.key(lab, "sim", "play"), STATES.traffic))
        for scheduled in player:
            wait_ns = start_ns + scheduled.offset_ns - clock.monotonic_ns()
            if stopping.wait(wait_ns * 1e-9) if wait_ns > 0 else stopping.is_set():
                break
            name, payload = scheduled.topic, scheduled.message.data
            topic = RECORDED[name]
            if name not in publishers:
                publishers[name] = closing.enter_context(bus.publisher(topic.key(lab, rig), topic.traffic))
            if rename is not None:
                with decoding(player.path):
                    message: Any = topic.message.FromString(payload)
                message.rig = rename
                payload = message.SerializeToString()
            if topic.name == STATE.name:
                batches.put(RigBatch(source="sim/play", rigs=[rig], messages=[payload]).SerializeToString())
            publishers[name].put(payload)
            count_sent += 1
    return count_sent


def rig_config(run: Run, name: str) -> RigConfig:
    """Configuration reply of a rig that plays a recording."""
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
