"""A rig's events, each with the session and the step that it belongs to."""

from hilrig_modbus_edge.device.settings import Outlet
from hilrig_schemas import Event


class Journal:
    """Tells what happens to one rig."""

    def __init__(self, rig: str, outlet: Outlet) -> None:
        self.session = ""
        """Id of the session that is open; empty: none."""
        self.step = 0
        """Step of the newest state that was seen."""
        self._rig = rig
        self._outlet = outlet

    def event(self, kind: Event.Kind, severity: Event.Severity, text: str) -> Event:
        """An event, to be filled in and told."""
        return Event(rig=self._rig, session=self.session, kind=kind, severity=severity, text=text, step=self.step)

    def tell(self, event: Event) -> None:
        """Send an event."""
        self._outlet.emit(event)

    def tell_of_controller(
        self,
        kind: Event.Kind,
        severity: Event.Severity,
        text: str,
        controller: str,
        *,
        reason: str = "",
        holder: str = "",
    ) -> None:
        """Send an event about a controller, "host:port"; `holder` is who holds the rig, where that is another one."""
        event = self.event(kind, severity, text)
        event.controller_data.controller = controller
        event.controller_data.reason = reason
        event.controller_data.holder = holder
        self.tell(event)


def times(count: int) -> str:
    """How often, for the end of a sentence; nothing for once."""
    return f" ({count} times)" if count > 1 else ""
