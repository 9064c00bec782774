"""The page's model: everything that is known of a lab as the messages that a browser gets. Pure but for its lock.

A browser gets `lab` when a report has come (once a second), `poses` a few times a second, `event` as they happen. Each
is the whole of it, made once for all browsers: a slow one leaves some out and misses nothing.
"""

import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hilrig_console.events import EventBuffer
from hilrig_console.poses import PoseCache
from hilrig_monitoring.lab_view import LabView
from hilrig_schemas import Roster


@dataclass(frozen=True, slots=True)
class ClientState:
    """What a browser has."""

    lab: str = ""
    poses: str = ""
    event: int = 0


@dataclass(frozen=True, slots=True)
class Frame:
    """What there is to show, at one time."""

    lab: str
    poses: str
    events: tuple[tuple[int, str], ...]

    def news(self, seen: ClientState) -> tuple[str, ClientState]:
        """What is new to a browser, as server-sent events, and what it has then; an empty text: nothing."""
        parts = []
        if self.lab != seen.lab:
            parts.append(f"event: lab\ndata: {self.lab}\n\n")
        parts += [
            f"event: event\nid: {number}\ndata: {event}\n\n" for number, event in self.events if number > seen.event
        ]
        if self.poses != seen.poses:
            parts.append(f"event: poses\ndata: {self.poses}\n\n")
        last = self.events[-1][0] if self.events else 0
        return "".join(parts), ClientState(self.lab, self.poses, max(seen.event, last))


class ViewModel:
    """A lab as it is shown; `lock` is held while it is changed or read."""

    def __init__(self, lab: str, rigs: tuple[str, ...], start: int) -> None:
        self.lock = threading.Lock()
        self.view = LabView(rigs)
        self.poses = PoseCache()
        self.events = EventBuffer(start)
        self._lab = lab
        self._trouble = ""
        self._addresses: dict[str, str] = {}
        self._lab_text = ""
        self._lab_due_s = 0.0

    def link(self, trouble: str) -> None:
        """Say why the bus can't be read; empty: it can."""
        self._trouble = trouble

    def know(self, rosters: list[Roster]) -> None:
        """Take where the rigs are reached, as the edges say."""
        self._addresses = {
            rig: address
            for roster in rosters
            if roster.service == "edge"
            for rig, address in zip(roster.rigs, roster.addresses, strict=False)
        }

    def has_newcomers(self, now_s: float) -> bool:
        """Whether an edge serves a rig of which it is not known where it is reached."""
        return any(rig.served and rig.rig not in self._addresses for rig in self.view.rigs(now_s))

    def frame(self, now_s: float, more: Mapping[str, Any]) -> Frame:
        """What there is to show at `now_s`; `more` goes into the lab's part."""
        if now_s >= self._lab_due_s:
            self._lab_due_s = now_s + 1.0
            self._lab_text = _json(self._lab_now(now_s) | dict(more))
        return Frame(self._lab_text, _json(self.poses.drawn(now_s)), self.events.all())

    def _lab_now(self, now_s: float) -> dict[str, Any]:
        known = self.view.as_dict(now_s)
        for rig in known["rigs"]:
            rig["address"] = self._addresses.get(rig["rig"], "")
        # Its time makes it news although nothing changed: a page that hears nothing takes the console for gone.
        return {"lab": self._lab, "at_s": now_s, "link": self._trouble, "scenes": len(self.poses.scenes)} | known


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
