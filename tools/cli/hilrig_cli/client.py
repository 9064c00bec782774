"""Asking a running lab who is there, and its edges about their rigs."""

import sys
import time
from collections.abc import Sequence, Set
from typing import Final, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus.api import Bus
from hilrig_runtime.bus.zenoh_bus import ZenohBus
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.discovery import list_services
from hilrig_schemas import ServiceInfo
from hilrig_schemas.topics import RigTopic, parse_rig_key

MessageT = TypeVar("MessageT", bound=Message)

ANSWER_WITHIN_S: Final = 3.0
"""How long a service has to answer; a link to it may have to be made first."""
PATIENCE_S: Final = 0.5
"""Who waits longer is told for what."""
SERVING: Final = ("sim", "edge")
"""Services that have each rig, also one that was added."""


def ask_edges(lab: LabConfig, topic: RigTopic[MessageT], rig: str, question: Message) -> list[MessageT]:
    """Ask on a rig's topic, or on every rig's where `rig` is empty; the answers, at least one, in the lab's order.

    Rigs that were added since the lab started come last.

    Raises:
        InputError: the lab has no such rig.
        OperationError: nobody answers, or the edge refuses.
    """
    payload = question.SerializeToString()
    deadline_s = time.monotonic() + ANSWER_WITHIN_S
    with ZenohBus(lab.bus, "tool") as bus:
        if rig:
            check_rig(bus, lab, rig)
        else:
            # Else the first edge that answers would be taken for all.
            list_all_services(bus, lab, {"edge"})
        while not (answers := bus.query(topic.key(lab.name, rig or "*"), payload)) and time.monotonic() < deadline_s:
            time.sleep(0.05)
    for answer in answers:
        if answer.error:
            raise OperationError(f"rig {rig!r}: the edge refused: {answer.error}")
    if not answers:
        raise OperationError(f"no edge answers for lab {lab.name!r}: is it running (hilrig up), with this lab.toml?")
    places = {rig.name: place for place, rig in enumerate(lab.rigs)}
    by_rig = {parse_rig_key(answer.key).rig: answer.payload for answer in answers}
    return [topic.decode(by_rig[rig]) for rig in sorted(by_rig, key=lambda rig: (places.get(rig, len(places)), rig))]


def list_all_services(bus: Bus, lab: LabConfig, services: Set[str]) -> list[ServiceInfo]:
    """What the services of a lab say of themselves; waits `ANSWER_WITHIN_S` for those kinds of them, if it must."""
    deadline_s = time.monotonic() + ANSWER_WITHIN_S
    found: list[ServiceInfo] = []
    # A link to each has to be made first: what one look finds and the next one too is all that there is.
    while time.monotonic() < deadline_s:
        before, found = found, list_services(bus, lab.name)
        if services <= {info.service for info in found} and len(found) == len(before):
            break
        time.sleep(0.05)
    return found


def check_rig(bus: Bus, lab: LabConfig, rig: str) -> None:
    """See that a lab has a rig: in its file, or added since.

    Raises:
        InputError: it has not.
    """
    in_file = [known.name for known in lab.rigs]
    if rig in in_file:
        return
    begun_s, told = time.monotonic(), False
    while True:
        found = list_services(bus, lab.name)
        if any(rig in info.rigs for info in found):
            return
        waited_s = time.monotonic() - begun_s
        if _all_heard(found, in_file) or waited_s > ANSWER_WITHIN_S:
            added = {name for info in found if info.service in SERVING for name in info.rigs}
            raise lab.no_such_rig(rig, sorted(added))
        if waited_s > PATIENCE_S and not told:
            told = True
            print(
                f"hilrig: {rig!r} is not in lab.toml: looking for a service that it was added to, for up to "
                f"{ANSWER_WITHIN_S:g} s",
                file=sys.stderr,
            )
        time.sleep(0.05)


def _all_heard(found: Sequence[ServiceInfo], in_file: Sequence[str]) -> bool:
    """Whether every service that can have a rig has answered.

    Each simulation and each edge begins with rigs of the lab's file, and one has a rig that another does not: once all
    of those are served, nobody is missing. (One that lost all of those rigs is known by the other kind of service.)
    """
    return all(
        set(in_file) <= {rig for info in found if info.service == service for rig in info.rigs} for service in SERVING
    )
