"""Client side of a running lab: discovers its services and queries its edges."""

import sys
import time
from collections.abc import Sequence, Set
from importlib.metadata import version
from typing import Any, Final, TypeVar

from google.protobuf.message import DecodeError, Message

from hilrig_cli.service_kinds import RIG_SERVICES
from hilrig_runtime.bus.acl import RULES
from hilrig_runtime.bus.api import Bus
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.bus.zenoh_config import own_identity
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.escaping import printable
from hilrig_runtime.process.control import check_versions
from hilrig_runtime.process.discovery import list_services
from hilrig_schemas import ControlReply, ControlRequest, ServiceInfo
from hilrig_schemas.topics import CONTROL, RigTopic, Topic, parse_rig_key

MessageT = TypeVar("MessageT", bound=Message)

QUERY_TIMEOUT_S: Final = 3.0
"""Timeout of a query, including the time to set up the link to the service."""
WAIT_MESSAGE_AFTER_S: Final = 0.5
"""Waiting time after which a message is printed."""


def query_edges(lab: LabConfig, topic: RigTopic[MessageT], rigs: Sequence[str], request: Message) -> list[MessageT]:
    """Query a topic of rigs, or of every rig if `rigs` is empty; return at least one reply, in the lab's order.

    Rigs that were added since the lab started come last.

    Raises:
        InputError: the lab has no such rig.
        OperationError: no edge replies, an edge refuses the request, or a reply is invalid; the other rigs are done
            nevertheless.
    """
    check_permission(lab, topic)
    payload = request.SerializeToString()
    deadline_s = time.monotonic() + QUERY_TIMEOUT_S
    with ZenohBus(lab.bus, "tool") as bus:
        for rig in rigs:
            check_rig(bus, lab, rig)
        if not rigs:
            # Without a link to every edge, the reply of the first edge would be taken for that of all.
            discover_services(bus, lab, {"edge"})
        replies = []
        for rig in rigs or ["*"]:
            while not (found := bus.query(topic.key(lab.name, rig), payload)) and time.monotonic() < deadline_s:
                time.sleep(0.05)
            if not found:
                rest = f"rig {rig!r}" if rigs else f"lab {lab.name!r}"
                raise OperationError(f"no edge answers for {rest}: {lab.bus.no_answer_hint}")
            replies += found
    positions = {rig.name: position for position, rig in enumerate(lab.rigs)}
    try:
        if refused := [f"rig {parse_rig_key(reply.key).rig!r}: {reply.error}" for reply in replies if reply.error]:
            raise OperationError(f"the edge refused: {'; '.join(refused)}")
        by_rig = {parse_rig_key(reply.key).rig: topic.decode_from(reply.key, reply.payload) for reply in replies}
    except (DecodeError, ValueError) as error:
        raise _invalid_reply("an edge", error) from error
    return [by_rig[rig] for rig in sorted(by_rig, key=lambda rig: (positions.get(rig, len(positions)), rig))]


def check_permission(lab: LabConfig, topic: Topic[Any]) -> None:
    """Check that the certificate of this command may query a topic: the bus would not answer a denied query.

    Raises:
        OperationError: it may not.
    """
    role = "operator" if lab.bus.tls is None else own_identity(lab.bus.tls, "tool")
    if role not in RULES[topic.name].subscribers:
        raise OperationError(
            f"this host has only the {role} certificate; {topic.name} requests need operator: copy operator.pem and "
            f"operator.key into bus.tls.folder, or run the command on a host that has them"
        )


def send_control_request(bus: Bus, lab: LabConfig, info: ServiceInfo, request: ControlRequest) -> ControlReply:
    """Send a control request to a discovered service; return its reply.

    Raises:
        OperationError: the service has another version, does not reply, refuses the request, or its reply is invalid.
    """
    check_permission(lab, CONTROL)
    request.software_version = version("hilrig")
    check_versions(info.software_version, request.software_version)
    key = CONTROL.key(lab.name, info.service, info.instance)
    replies = bus.query(key, request.SerializeToString(), timeout_s=QUERY_TIMEOUT_S)
    name = f"{info.service}/{info.instance} on {info.host}"
    if not replies:
        raise OperationError(f"{name} does not reply within {QUERY_TIMEOUT_S:g} s: see its log")
    if replies[0].error:
        raise OperationError(f"{name} refused: {replies[0].error}")
    try:
        reply = CONTROL.decode(replies[0].payload)
    except DecodeError as error:
        raise _invalid_reply(name, error) from error
    reply.text, reply.session = printable(reply.text), printable(reply.session)
    return reply


def _invalid_reply(name: str, error: Exception) -> OperationError:
    return OperationError(
        f"{name} sent an invalid reply: {error}; compare the versions (hilrig doctor), and see its log"
    )


def discover_services(bus: Bus, lab: LabConfig, required: Set[str]) -> list[ServiceInfo]:
    """Discover the services of a lab; wait up to `QUERY_TIMEOUT_S` until each required kind of service is found."""
    deadline_s = time.monotonic() + QUERY_TIMEOUT_S
    found: list[ServiceInfo] = []
    # Links are set up one after the other: discovery is complete when two successive queries return the same number.
    while time.monotonic() < deadline_s:
        before, found = found, list_services(bus, lab)
        if required <= {info.service for info in found} and len(found) == len(before):
            break
        time.sleep(0.05)
    return found


def check_rig(bus: Bus, lab: LabConfig, rig: str) -> None:
    """Check that a lab has a rig, in its file or added since.

    Raises:
        InputError: the lab has no such rig.
    """
    in_file = [known.name for known in lab.rigs]
    if rig in in_file:
        return
    start_s, message_printed = time.monotonic(), False
    while True:
        found = list_services(bus, lab)
        if any(rig in info.rigs for info in found):
            return
        waited_s = time.monotonic() - start_s
        if _all_responded(found, in_file) or waited_s > QUERY_TIMEOUT_S:
            added = {name for info in found if info.service in RIG_SERVICES for name in info.rigs}
            raise lab.no_such_rig(rig, sorted(added))
        if waited_s > WAIT_MESSAGE_AFTER_S and not message_printed:
            message_printed = True
            where = "for a service that it was added to"
            print(
                f"hilrig: rig {rig!r} is not in lab.toml; waiting up to {QUERY_TIMEOUT_S:g} s {where}", file=sys.stderr
            )
        time.sleep(0.05)


def _all_responded(found: Sequence[ServiceInfo], in_file: Sequence[str]) -> bool:
    """Whether every service that can have a rig has responded.

    Each simulation and each edge starts with rigs of the lab's file, and no two of a kind have the same rig: once all
    of these rigs are served, no service is missing. (A service that has lost all of these rigs is found by the other
    kind of service.)
    """
    return all(
        set(in_file) <= {rig for info in found if info.service == service for rig in info.rigs}
        for service in RIG_SERVICES
    )
