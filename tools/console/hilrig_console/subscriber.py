"""The bus into a page: one subscription of each kind, whatever the number of browsers.

The states are subscribed to only while somebody looks, for they are many. What the rigs look like is asked one rig
after the other: each answer is work for a simulation that has a loop to close.
"""

import logging
import threading
import time
from collections import deque
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_console.view_model import Frame, Page
from hilrig_runtime.bus.api import Bus, Handle
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import HilrigError
from hilrig_runtime.process.discovery import rosters
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import RigConfig
from hilrig_schemas.topics import CONFIG, EVENT, HEALTH, STATES

RETRY_S: Final = 2.0
"""Between tries to join the bus."""
TURN_S: Final = 0.2
"""How often the feed looks whether there is something to ask."""
ROSTERS_S: Final = 10.0
"""How often it is asked where the rigs are reached."""
NEWCOMERS_S: Final = 1.0
"""The same while there are rigs of which that is not known yet."""
ASKED_A_TURN: Final = 4
"""Rigs that are asked what they look like, one after the other, before the next turn."""
LEFT_S: Final = 5.0
"""So long after the last browser has left, states are still taken: one that is loaded anew comes back at once."""
_BATCHES: Final = 64

logger = logging.getLogger(__name__)


class Feed:
    """Keeps a page up to date from a thread of its own; a context manager."""

    def __init__(self, lab: LabConfig) -> None:
        self._lab = lab
        self._page = Page(lab.name, tuple(rig.name for rig in lab.rigs), SYSTEM_CLOCK.wall_ns() // 1_000_000)
        self._states: deque[bytes] = deque(maxlen=_BATCHES)
        self._looked_s = -LEFT_S
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def frame(self, more: dict[str, Any]) -> Frame:
        """What there is to show now; as long as it is asked for, somebody looks."""
        now_s = time.monotonic()
        self._looked_s = now_s
        page = self._page
        with page.lock:
            page.poses.hear([self._states.popleft() for _ in range(len(self._states))], now_s)
            return page.frame(now_s, more)

    def scenes(self) -> list[Any]:
        """What stands still around the arms; rigs name theirs by its number."""
        with self._page.lock:
            return list(self._page.poses.scenes)

    def __enter__(self) -> "Feed":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                with ZenohBus(self._lab.bus, "tool") as bus:
                    self._say("")
                    self._follow(bus)
            except HilrigError as error:
                self._say(str(error))
            except Exception:
                # The page says so, and goes on with a new connection.
                logger.exception("following the bus failed")
                self._say("following the bus failed; the console's log says why")
            self._stopping.wait(RETRY_S)

    def _say(self, trouble: str) -> None:
        with self._page.lock:
            self._page.link(trouble)

    def _follow(self, bus: Bus) -> None:
        bus.subscribe(HEALTH.key(self._lab.name, "*", "*"), self._on_health)
        bus.subscribe(EVENT.key(self._lab.name, "*"), self._on_event)
        states: Handle | None = None
        asked_s = -ROSTERS_S
        while not self._stopping.wait(TURN_S):
            now_s = time.monotonic()
            watched = now_s - self._looked_s < LEFT_S
            if watched and states is None:
                states = bus.subscribe_newest(STATES.key(self._lab.name, "*", "*"), self._on_states, _BATCHES)
            elif not watched and states is not None:
                states.close()
                states = None
            if watched and self._are_rosters_due(now_s, now_s - asked_s):
                asked_s = now_s
                found = rosters(bus, self._lab.name)
                with self._page.lock:
                    self._page.know(found)
            self._ask_what_rigs_look_like(bus)

    def _are_rosters_due(self, now_s: float, age_s: float) -> bool:
        if not NEWCOMERS_S < age_s <= ROSTERS_S:
            return age_s > ROSTERS_S
        with self._page.lock:
            return self._page.has_newcomers(now_s)

    def _ask_what_rigs_look_like(self, bus: Bus) -> None:
        with self._page.lock:
            rigs = self._page.poses.unknown()[:ASKED_A_TURN]
        for rig in rigs:
            config = _config(bus, self._lab.name, rig)
            with self._page.lock:
                self._page.poses.learn(rig, config)

    def _on_health(self, key: str, payload: bytes) -> None:
        del key
        try:
            health = HEALTH.decode(payload)
        except DecodeError:
            return
        with self._page.lock:
            self._page.view.update(health, time.monotonic())

    def _on_event(self, key: str, payload: bytes) -> None:
        del key
        with self._page.lock:
            self._page.events.hear(payload)

    def _on_states(self, key: str, payload: bytes) -> None:
        del key
        self._states.append(payload)


def _config(bus: Bus, lab: str, rig: str) -> RigConfig | None:
    for answer in bus.ask(CONFIG.key(lab, rig), timeout_s=0.5):
        if answer.payload and not answer.error:
            try:
                return CONFIG.decode(answer.payload)
            except DecodeError:
                continue
    return None
