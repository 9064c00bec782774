"""Manual sessions: started and stopped with `hilrig record`, and owned by the recorder.

Starting one publishes an event on the recorder's own recording stream. From then on it is recorded like a session of an
edge.
"""

import random
from collections.abc import Callable

from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.session_id import session_id
from hilrig_schemas import Event, OpenSession


class ManualSessions:
    """The open manual sessions, at most one per rig.

    Args:
        rig_exists: whether this recorder records a rig of that name.
        rng: random generator of the session ids.
    """

    def __init__(self, rig_exists: Callable[[str], bool], rng: random.Random) -> None:
        self._rig_exists = rig_exists
        self._rng = rng
        self._open: dict[str, OpenSession] = {}

    @property
    def sessions(self) -> list[OpenSession]:
        """The open sessions, as announced on the recording stream."""
        return list(self._open.values())

    def restore(self, session: OpenSession) -> None:
        """Continue a session that a previous recorder did not end."""
        self._open.setdefault(session.rig, session)

    def start(self, rig: str, wall_ns: int) -> Event:
        """Start a session; returns the event to publish.

        Raises:
            OperationError: the rig does not exist, or has an open manual session.
        """
        if not self._rig_exists(rig):
            raise OperationError(f"there is no rig {rig!r} in this lab; `hilrig rig list` lists the rigs")
        if rig in self._open:
            raise OperationError(f"{rig}: manual recording {self._open[rig].session} is already running")
        session = session_id(rig, wall_ns, self._rng)
        self._open[rig] = OpenSession(rig=rig, session=session, start_wall_ns=wall_ns)
        return self._event(Event.SESSION_START, rig, session, "started manually")

    def stop(self, rig: str) -> Event:
        """End a session; returns the event to publish.

        Raises:
            OperationError: the rig has no open manual session.
        """
        session = self._open.pop(rig, None)
        if session is None:
            raise OperationError(f"{rig}: no manual recording is running")
        return self._event(Event.SESSION_END, rig, session.session, "ended manually")

    @staticmethod
    def _event(kind: Event.Kind, rig: str, session: str, reason: str) -> Event:
        event = Event(kind=kind, rig=rig, session=session, severity=Event.INFO, text=f"recording {session} {reason}")
        event.session_data.reason = reason
        return event
