"""Listening to a running lab: its health reports into a `LabView`."""

import threading
import time
from types import TracebackType
from typing import Final, Self

from google.protobuf.message import DecodeError

from hilrig_monitoring.lab_view import LabView
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.discovery import list_services
from hilrig_schemas.topics import HEALTH

FIRST_REPORTS_S: Final = 3.0
"""Every service reports within a second; a link to it may have to be made first."""


class LabWatch:
    """A `LabView` that is kept up to date; a context manager. Its lock is held while the view changes."""

    def __init__(self, lab: LabConfig) -> None:
        self.lab = lab
        self.view = LabView(tuple(rig.name for rig in lab.rigs))
        self.lock = threading.Lock()
        self._heard: dict[str, int] = {}
        self._bus = ZenohBus(lab.bus, "tool")
        self._bus.subscribe(HEALTH.key(lab.name, "*", "*"), self._hear)

    def wait(self) -> None:
        """Wait until every service that is there was heard twice, so that its share of a processor is known.

        Raises:
            OperationError: none was heard.
        """
        deadline_s = time.monotonic() + FIRST_REPORTS_S
        while time.monotonic() < deadline_s:
            expected = {f"{info.service}/{info.instance}" for info in list_services(self._bus, self.lab.name)}
            with self.lock:
                if expected and all(self._heard.get(name, 0) > 1 for name in expected):
                    return
            time.sleep(0.1)
        with self.lock:
            if not self.view.services():
                raise OperationError(
                    f"nothing is heard of lab {self.lab.name!r}: is it running (hilrig up), with this lab.toml?"
                )

    def _hear(self, key: str, payload: bytes) -> None:  # noqa: ARG002
        try:
            health = HEALTH.decode(payload)
        except DecodeError:
            return
        with self.lock:
            self.view.hear(health, time.monotonic())
            name = f"{health.service}/{health.instance}"
            self._heard[name] = self._heard.get(name, 0) + 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bus.close()
