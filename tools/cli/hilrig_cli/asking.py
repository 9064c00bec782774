"""Asking a running lab who is there, and its edges about their rigs."""

import time
from collections.abc import Set
from typing import Final, TypeVar

from google.protobuf.message import Message

from hilrig_runtime.bus import Bus
from hilrig_runtime.config import LabConfig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.presence import rosters
from hilrig_runtime.zenoh_bus import ZenohBus
from hilrig_schemas import Roster
from hilrig_schemas.topics import RigTopic, parse_rig_key

MessageT = TypeVar("MessageT", bound=Message)

ANSWER_WITHIN_S: Final = 3.0
"""How long a service has to answer; a link to it may have to be made first."""


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
            all_rosters(bus, lab, {"edge"})
        while not (answers := bus.ask(topic.key(lab.name, rig or "*"), payload)) and time.monotonic() < deadline_s:
            time.sleep(0.05)
    for answer in answers:
        if answer.error:
            raise OperationError(f"rig {rig!r}: the edge refused: {answer.error}")
    if not answers:
        raise OperationError(f"no edge answers for lab {lab.name!r}: is it running (hilrig up), with this lab.toml?")
    places = {rig.name: place for place, rig in enumerate(lab.rigs)}
    by_rig = {parse_rig_key(answer.key).rig: answer.payload for answer in answers}
    return [topic.decode(by_rig[rig]) for rig in sorted(by_rig, key=lambda rig: (places.get(rig, len(places)), rig))]


def all_rosters(bus: Bus, lab: LabConfig, services: Set[str]) -> list[Roster]:
    """What the services of a lab say of themselves; waits `ANSWER_WITHIN_S` for those kinds of them, if it must."""
    deadline_s = time.monotonic() + ANSWER_WITHIN_S
    found: list[Roster] = []
    # A link to each has to be made first: what one look finds and the next one too is all that there is.
    while time.monotonic() < deadline_s:
        before, found = found, rosters(bus, lab.name)
        if services <= {roster.service for roster in found} and len(found) == len(before):
            break
        time.sleep(0.05)
    return found


def check_rig(bus: Bus, lab: LabConfig, rig: str) -> None:
    """See that a lab has a rig: in its file, or added since.

    Raises:
        InputError: it has not.
    """
    deadline_s = time.monotonic() + ANSWER_WITHIN_S
    while all(rig != known.name for known in lab.rigs):
        if any(rig in roster.rigs for roster in rosters(bus, lab.name)):
            return
        if time.monotonic() > deadline_s:
            lab.rig(rig)
        time.sleep(0.05)
