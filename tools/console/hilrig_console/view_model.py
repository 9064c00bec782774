"""View model of the console page: the state of a lab as server-sent events. Pure except for its lock.

A browser receives `lab` once per second, `poses` several times per second, and each `event`. `lab` and `poses` contain
the complete state and are encoded once for all browsers, so a slow browser may skip some of them.
"""

import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hilrig_console.events import EventBuffer
from hilrig_console.poses import PoseCache
from hilrig_monitoring.lab_view import LabView
from hilrig_schemas import ServiceInfo


@dataclass(frozen=True, slots=True)
class ClientState:
    """Messages that a browser has received."""

    lab: str = ""
    poses: str = ""
    event: int = 0


@dataclass(frozen=True, slots=True)
class Frame:
    """State of the lab at one time, encoded as JSON."""

    lab: str
    poses: str
    events: tuple[tuple[int, str], ...]

    def updates(self, state: ClientState) -> tuple[str, ClientState]:
        """Return the server-sent events that update a browser (empty: none), and its new state."""
        parts = []
        if self.lab != state.lab:
            parts.append(f"event: lab\ndata: {self.lab}\n\n")
        parts += [
            f"event: event\nid: {number}\ndata: {event}\n\n" for number, event in self.events if number > state.event
        ]
        if self.poses != state.poses:
            parts.append(f"event: poses\ndata: {self.poses}\n\n")
        last = self.events[-1][0] if self.events else 0
        return "".join(parts), ClientState(self.lab, self.poses, max(state.event, last))


class ViewModel:
    """State of a lab as shown on the page; hold `lock` while using it."""

    def __init__(self, lab: str, view: LabView, start: int) -> None:
        self.lock = threading.Lock()
        self.view = view
        self.poses = PoseCache()
        self.events = EventBuffer(start)
        self._lab = lab
        self.bus_error = ""
        """Reason why the bus is unavailable; empty: connected."""
        self._addresses: dict[str, str] = {}
        self._lab_text = ""
        self._lab_due_s = 0.0

    def set_addresses(self, infos: list[ServiceInfo]) -> None:
        """Set the addresses of the rigs from the announcements of the edges."""
        self._addresses = {
            rig: address
            for info in infos
            if info.service == "edge"
            for rig, address in zip(info.rigs, info.addresses, strict=False)
        }

    def has_unknown_addresses(self, now_s: float) -> bool:
        """Return whether an edge serves a rig whose address is unknown."""
        return any(rig.served and rig.rig not in self._addresses for rig in self.view.rigs(now_s))

    def frame(self, now_s: float, extra: Mapping[str, Any]) -> Frame:
        """Return the frame at `now_s`; `extra` is added to its `lab` message."""
        if now_s >= self._lab_due_s:
            self._lab_due_s = now_s + 1.0
            self._lab_text = _json(self._lab_values(now_s) | dict(extra))
        return Frame(self._lab_text, _json(self.poses.as_dict(now_s)), self.events.entries())

    def _lab_values(self, now_s: float) -> dict[str, Any]:
        values = self.view.as_dict(now_s)
        for rig in values["rigs"]:
            rig["address"] = self._addresses.get(rig["rig"], "")
        # The time changes the message every second: a page without messages reports a lost connection.
        return {
            "lab": self._lab,
            "at_s": now_s,
            "bus_error": self.bus_error,
            "scenes": len(self.poses.scenes),
        } | values


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
