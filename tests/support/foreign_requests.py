"""Control requests of other versions, as they are on the bus, and the text with which every service refuses them."""

from importlib.metadata import version

from hilrig_runtime.bus.api import Bus
from hilrig_runtime.process.control import release_series
from hilrig_schemas import ControlRequest, Event, RemoveRig, ServiceInfo, topics

OWN = version("hilrig")
SERIES = ".".join(release_series(OWN))


def older_request(kind: Event.Kind, text: str = "") -> bytes:
    """Return a request of version 0.1: an event."""
    event = Event(rig="rig1", session="s", kind=kind, severity=Event.INFO, text="text", wall_ns=1, source="a/1", step=2)
    event.configuration_data.text = text
    return event.SerializeToString()


def newer_request(software_version: str) -> bytes:
    """Return a request of another version, of a kind that this one knows."""
    return ControlRequest(software_version=software_version, remove_rig=RemoveRig(rig="rig1")).SerializeToString()


def unknown_request(software_version: str) -> bytes:
    """Return a request of a later version of a series, of a kind (field 40, a message) that this one does not know."""
    return ControlRequest(software_version=software_version).SerializeToString() + b"\xc2\x02\x02\x0a\x00"


def wrong_version(command: str) -> str:
    return f"wrong version: services {OWN}, command {command}; install the same version on both"


REFUSED = [
    *(
        (older_request(kind, '{"name": "rig2"}'), wrong_version("0.1"))
        for kind in (Event.RIG_ADDED, Event.RIG_REMOVED, Event.RESET, Event.SESSION_START, Event.SESSION_END)
    ),
    (newer_request("0.0.9"), wrong_version("0.0.9")),
    (newer_request("0.91.0"), wrong_version("0.91.0")),
    (newer_request("99.2.0"), wrong_version("99.2.0")),
    (unknown_request(f"{SERIES}.99"), wrong_version(f"{SERIES}.99")),
    (b"", wrong_version("0.1")),
    (b"\xff\x00rubbish", "not a valid ControlRequest: 9 bytes can't be decoded"),
]
"""Payloads and the errors of the replies to them."""

EXECUTED = {
    "sim": ("add_rig", "remove_rig"),
    "edge": ("add_rig", "remove_rig", "reset_rig", "revoke_client"),
    "recorder": ("start_session", "stop_session"),
}
"""Requests that each service executes."""
KINDS = tuple(field.name for field in ControlRequest.DESCRIPTOR.oneofs_by_name["request"].fields)


def assert_refuses_foreign_requests(bus: Bus, lab: str, info: ServiceInfo) -> None:
    """Query a service's control key with every payload of `REFUSED`, and the requests that other services execute."""
    key = topics.CONTROL.key(lab, info.service, info.instance)
    for payload, error in REFUSED:
        (reply,) = bus.query(key, payload)
        assert (reply.error, reply.payload) == (error, b""), payload
    executed = EXECUTED[info.service]
    for kind in set(KINDS).difference(executed):
        request = ControlRequest(software_version=OWN)
        getattr(request, kind).SetInParent()
        (reply,) = bus.query(key, request.SerializeToString())
        assert reply.error == f"this service does not execute {kind}; it executes {', '.join(executed)}"
