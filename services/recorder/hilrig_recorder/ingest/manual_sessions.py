"""Sessions that a person begins and ends with `hilrig record`; the recorder keeps them, as the edge keeps the others.

Beginning one only says so on the recorder's own log stream: from there on it is a session like any other.
"""

import random
from collections.abc import Callable

from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.session_id import session_id
from hilrig_schemas import Event, OpenSession


class HandSessions:
    """At most one session by hand for each rig that `is_there`."""

    def __init__(self, is_there: Callable[[str], bool], letters: random.Random) -> None:
        self._is_there = is_there
        self._letters = letters
        self._open: dict[str, OpenSession] = {}

    @property
    def sessions(self) -> list[OpenSession]:
        """Those that go on, as the log stream states them."""
        return list(self._open.values())

    def restore(self, session: OpenSession) -> None:
        """Go on with a session of a recorder that did not end it."""
        self._open.setdefault(session.rig, session)

    def begin(self, rig: str, wall_ns: int) -> Event:
        """Begin one; the event to send.

        Raises:
            OperationError: there is no such rig, or it is being recorded by hand already.
        """
        if not self._is_there(rig):
            raise OperationError(f"there is no rig {rig!r} in this lab: `hilrig rig list` names those that there are")
        if rig in self._open:
            raise OperationError(f"{rig} is being recorded by hand already: {self._open[rig].session}")
        session = session_id(rig, wall_ns, self._letters)
        self._open[rig] = OpenSession(rig=rig, session=session, start_wall_ns=wall_ns)
        return self._event(Event.SESSION_START, rig, session, "begun by hand")

    def end(self, rig: str) -> Event:
        """End one; the event to send.

        Raises:
            OperationError: the rig is not being recorded by hand.
        """
        session = self._open.pop(rig, None)
        if session is None:
            raise OperationError(f"{rig} is not being recorded by hand")
        return self._event(Event.SESSION_END, rig, session.session, "ended by hand")

    @staticmethod
    def _event(kind: Event.Kind, rig: str, session: str, reason: str) -> Event:
        event = Event(kind=kind, rig=rig, session=session, severity=Event.INFO, text=f"recording {session} {reason}")
        event.session_data.reason = reason
        return event
