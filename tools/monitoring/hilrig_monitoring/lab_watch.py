"""Subscription to the health reports of a running lab, which update a `LabView`."""

import threading
import time
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_monitoring.lab_view import LabView
from hilrig_runtime.bus.api import Handle
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.discovery import list_services
from hilrig_schemas.topics import HEALTH, SERVICES

FIRST_REPORTS_TIMEOUT_S: Final = 3.0
"""Timeout for the first reports: the time to set up the links, and one report period of 1 s."""


class LabWatch(Handle):
    """Keeps a `LabView` up to date until it is closed; `lock` is held while the view changes."""

    def __init__(self, lab: LabConfig) -> None:
        self.lab = lab
        self.view = LabView(tuple(rig.name for rig in lab.rigs), lab.bus.may_serve)
        self.lock = threading.Lock()
        self._bus = ZenohBus(lab.bus, "tool")
        self._bus.subscribe(HEALTH.key(lab.name, "*", "*"), self._on_health)

    def wait(self) -> None:
        """Wait until every service has reported twice, so that its CPU usage is known, or until the timeout.

        Raises:
            OperationError: no service has reported.
        """
        deadline_s = time.monotonic() + FIRST_REPORTS_TIMEOUT_S
        while time.monotonic() < deadline_s:
            expected = {f"{info.service}/{info.instance}" for info in list_services(self._bus, self.lab)}
            # A stopped service does not answer.
            is_complete = {name.partition("/")[0] for name in expected}.issuperset(SERVICES)
            with self.lock:
                reported = {service.name for service in self.view.services() if service.reports > 1}
                if is_complete and expected <= reported:
                    return
            time.sleep(0.1)
        with self.lock:
            if not self.view.services():
                raise OperationError(f"no service of lab {self.lab.name!r} found: {self.lab.bus.no_answer_hint}")

    def _on_health(self, key: str, payload: bytes) -> None:
        try:
            health = HEALTH.decode_from(key, payload)
        except DecodeError:
            return
        with self.lock:
            self.view.update(health, time.monotonic())

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()
