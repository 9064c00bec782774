"""Bus subscriber of the console: updates the view model, with one subscription per topic for all browsers.

States are subscribed to only while a browser is connected, because of their data rate. The configurations of the rigs
are queried one after the other, because each reply takes time of a simulation.
"""

import logging
import threading
import time
from collections import deque
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_console.view_model import Frame, ViewModel
from hilrig_monitoring.lab_view import LabView
from hilrig_runtime.bus.api import Bus, Handle
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import HilrigError
from hilrig_runtime.process.discovery import list_services
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import RigConfig
from hilrig_schemas.topics import CONFIG, EVENT, HEALTH, STATES

RECONNECT_DELAY_S: Final = 2.0
"""Delay between attempts to connect to the bus, s."""
POLL_PERIOD_S: Final = 0.2
"""Period in which due queries are sent, s."""
SERVICES_PERIOD_S: Final = 10.0
"""Period of the query for the addresses of the rigs, s."""
NEW_RIG_PERIOD_S: Final = 1.0
"""Period of this query while the address of a rig is unknown, s."""
MAX_QUERIES_PER_POLL: Final = 4
"""Upper limit of configuration queries per poll."""
VIEWER_TIMEOUT_S: Final = 5.0
"""Time without browsers after which states are unsubscribed, s; a reloaded page shows states at once."""
_MAX_QUEUED_BATCHES: Final = 64

logger = logging.getLogger(__name__)


class LabSubscriber:
    """Updates a view model from the bus in a thread; a context manager."""

    def __init__(self, lab: LabConfig) -> None:
        self._lab = lab
        view = LabView(tuple(rig.name for rig in lab.rigs), lab.bus.may_serve)
        self._model = ViewModel(lab.name, view, SYSTEM_CLOCK.wall_ns() // 1_000_000)
        self._states: deque[bytes] = deque(maxlen=_MAX_QUEUED_BATCHES)
        self._viewed_s = -VIEWER_TIMEOUT_S
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="subscriber", daemon=True)

    def frame(self, extra: dict[str, Any]) -> Frame:
        """Return the current frame; calling this keeps the subscription of the states."""
        now_s = time.monotonic()
        self._viewed_s = now_s
        model = self._model
        with model.lock:
            model.poses.add([self._states.popleft() for _ in range(len(self._states))], now_s)
            return model.frame(now_s, extra)

    def scenes(self) -> list[Any]:
        """Return the static scenes; a rig refers to its scene by its number."""
        with self._model.lock:
            return list(self._model.poses.scenes)

    def __enter__(self) -> "LabSubscriber":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                with ZenohBus(self._lab.bus, "tool") as bus:
                    self._set_bus_error("")
                    self._receive(bus)
            except HilrigError as error:
                self._set_bus_error(str(error))
            except Exception:
                # The page shows the error, and the next iteration connects again.
                logger.exception("receiving from the bus failed")
                self._set_bus_error("receiving from the bus failed; see the log of the console")
            self._stopping.wait(RECONNECT_DELAY_S)

    def _set_bus_error(self, error: str) -> None:
        with self._model.lock:
            self._model.bus_error = error

    def _receive(self, bus: Bus) -> None:
        bus.subscribe(HEALTH.key(self._lab.name, "*", "*"), self._on_health)
        bus.subscribe(EVENT.key(self._lab.name, "*"), self._on_event)
        states: Handle | None = None
        queried_s = -SERVICES_PERIOD_S
        while not self._stopping.wait(POLL_PERIOD_S):
            now_s = time.monotonic()
            is_viewed = now_s - self._viewed_s < VIEWER_TIMEOUT_S
            if is_viewed and states is None:
                key = STATES.key(self._lab.name, "*", "*")
                states = bus.subscribe_newest(key, lambda _, batch: self._states.append(batch), _MAX_QUEUED_BATCHES)
            elif not is_viewed and states is not None:
                states.close()
                states = None
            if is_viewed and self._is_service_query_due(now_s, now_s - queried_s):
                queried_s = now_s
                found = list_services(bus, self._lab)
                with self._model.lock:
                    self._model.set_addresses(found)
            self._query_configurations(bus)

    def _is_service_query_due(self, now_s: float, age_s: float) -> bool:
        if not NEW_RIG_PERIOD_S < age_s <= SERVICES_PERIOD_S:
            return age_s > SERVICES_PERIOD_S
        with self._model.lock:
            return self._model.has_unknown_addresses(now_s)

    def _query_configurations(self, bus: Bus) -> None:
        with self._model.lock:
            rigs = self._model.poses.unconfigured()[:MAX_QUERIES_PER_POLL]
        for rig in rigs:
            config = _config(bus, self._lab.name, rig)
            with self._model.lock:
                self._model.poses.configure(rig, config)

    def _on_health(self, key: str, payload: bytes) -> None:
        try:
            health = HEALTH.decode_from(key, payload)
        except DecodeError:
            return
        with self._model.lock:
            self._model.view.update(health, time.monotonic())

    def _on_event(self, key: str, payload: bytes) -> None:
        with self._model.lock:
            self._model.events.add(key, payload)


def _config(bus: Bus, lab: str, rig: str) -> RigConfig | None:
    for reply in bus.query(CONFIG.key(lab, rig), timeout_s=0.5):
        if reply.payload and not reply.error:
            try:
                return CONFIG.decode_from(reply.key, reply.payload)
            except DecodeError:
                continue
    return None
