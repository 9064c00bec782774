"""Who else runs in the lab: each service says what it is and for which rigs, and gives way to an elder.

Two simulations of one rig, or two edges, would each tell the controller something else. So a service asks the others
of its kind before it begins, and again whenever one appears and every few seconds: a network that was in two halves
may have let both in. Of two that have a rig in common, or a name, the one that started later ends and says why. The
same answers tell how far the hosts' wall clocks are apart; nothing depends on that, people want to know. Nor does
anything depend on who is gone: it stands in the log, so that an operator finds the moment at which a link broke.
"""

import logging
import platform
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from queue import Empty, SimpleQueue
from typing import Final

from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Bus, Handle
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.liveliness import PeerDownTracker
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import ServiceInfo
from hilrig_schemas.topics import SERVICE_INFO, alive_key, source_of_alive_key

ASK_PERIOD_NS: Final = 10_000_000_000
ASK_AGAIN_S: Final = 0.1
ASK_TIMEOUT_S: Final = 0.5
CLAIM_TIMEOUT_S: Final = 3.0
"""For one that is there and slow to answer; who has answered is not waited for."""
NAMED: Final = 3
"""Rigs that a refusal names before it says "and … more"."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """How far another service's wall clock is ahead of ours."""

    peer: str = ""
    """The service, "<service>/<instance>"; empty: nobody was heard."""
    offset_ns: int = 0
    uncertainty_ns: int = 0
    """Half of the round trip of the question."""


def conflict(own: ServiceInfo, others: Iterable[ServiceInfo]) -> str:
    """Why a service must give way, for people; empty: it need not.

    It does to an elder of its kind that has its instance name or one of its rigs; of two that started in the same
    nanosecond the name decides, so that exactly one goes on.
    """
    for other in others:
        if other.service != own.service or (other.incarnation, other.instance) >= (own.incarnation, own.instance):
            continue
        where = f"{other.service}/{other.instance} on {other.host}"
        if other.instance == own.instance:
            return f"another {own.service} is called {own.instance!r} already: {where}; choose another --instance"
        shared = sorted(set(own.rigs) & set(other.rigs))
        if shared:
            more = f" and {len(shared) - NAMED} more" if len(shared) > NAMED else ""
            return f"{where} serves {', '.join(shared[:NAMED])}{more} already; a rig has one {own.service} (--rigs)"
    return ""


def worst_offset(others: Iterable[ServiceInfo], own_incarnation: int, asked_ns: int, heard_ns: int) -> ClockOffset:
    """The clock that differs most from ours; the question left at `asked_ns`, all had answered at `heard_ns`, wall."""
    middle_ns, half_ns = (asked_ns + heard_ns) // 2, (heard_ns - asked_ns) // 2
    offsets = [
        ClockOffset(f"{other.service}/{other.instance}", other.wall_ns - middle_ns, half_ns)
        for other in others
        if other.incarnation != own_incarnation
    ]
    return max(offsets, key=lambda offset: abs(offset.offset_ns), default=ClockOffset())


def list_services(bus: Bus, lab: str, service: str = "*", *, timeout_s: float = ASK_TIMEOUT_S) -> list[ServiceInfo]:
    """What the services of a lab that answer say of themselves, by service and instance."""
    found = []
    for answer in bus.query(SERVICE_INFO.key(lab, service, "*"), timeout_s=timeout_s):
        try:
            if not answer.error:
                found.append(ServiceInfo.FromString(answer.payload))
        except DecodeError:
            continue
    return sorted(found, key=lambda info: (info.service, info.instance, info.incarnation))


class PeerRegistry:
    """Answers for one service, and watches for others of its kind.

    `rigs` gives the name of each of its rigs and where it is reached; `on_conflict` gets the reason to end.
    """

    def __init__(
        self,
        bus: Bus,
        lab: str,
        own: ServiceInfo,
        rigs: Callable[[], Sequence[tuple[str, str]]],
        clock: Clock,
        on_conflict: Callable[[str], None],
    ) -> None:
        self.clock_offset = ClockOffset()
        self._bus = bus
        self._lab = lab
        self._own = own
        self._own.host = platform.node()
        self._own.software_version = version("hilrig")
        self._rigs = rigs
        self._clock = clock
        self._on_conflict = on_conflict
        self._claimed = False
        self._closing = False
        self._peers_down = PeerDownTracker()
        self._seen: SimpleQueue[tuple[str, bool]] = SimpleQueue()
        """Who came (True) or went, "<service>/<instance>"; what ends the watch has no name."""
        self._declared: list[Handle] = [
            bus.declare_queryable(SERVICE_INFO.key(lab, own.service, own.instance), self._answer)
        ]

    def claim(self) -> None:
        """Make sure that nobody has these rigs, and keep an eye on it from now on; a second call does nothing.

        Raises:
            OperationError: an elder has one of them.
        """
        if self._claimed:
            return
        self.recheck()
        self._claimed = True
        watched = alive_key(self._lab, "*", "*")
        self._declared.append(
            self._bus.subscribe_liveliness(
                watched, lambda key, alive: self._seen.put((source_of_alive_key(key), alive))
            )
        )
        threading.Thread(target=self._watch, name="presence", daemon=True).start()

    def recheck(self) -> None:
        """Look for an elder, for as long as the bus may take to be linked with everyone who is there.

        Raises:
            OperationError: one has one of these rigs, or the name.
        """
        reason = self._look()
        asked_s = 0.0
        while not reason and asked_s < self._bus.settle_timeout_s:
            time.sleep(ASK_AGAIN_S)
            asked_s += ASK_AGAIN_S
            reason = self._look()
        if reason:
            raise OperationError(reason)

    def close(self) -> None:
        """Stop answering and watching."""
        self._closing = True
        self._seen.put(("", False))
        while self._declared:
            self._declared.pop().close()

    def _roster(self) -> ServiceInfo:
        own = ServiceInfo()
        own.CopyFrom(self._own)
        for rig, address in self._rigs():
            own.rigs.append(rig)
            own.addresses.append(address)
        own.wall_ns = self._clock.wall_ns()
        return own

    def _answer(self, question: bytes) -> bytes:
        del question
        return self._roster().SerializeToString()

    def _look(self) -> str:
        asked_ns = self._clock.wall_ns()
        others = list_services(self._bus, self._lab, timeout_s=CLAIM_TIMEOUT_S)
        self.clock_offset = worst_offset(others, self._own.incarnation, asked_ns, self._clock.wall_ns())
        return conflict(self._roster(), others)

    def _watch(self) -> None:
        monotonic_ns = self._clock.monotonic_ns
        look_ns = monotonic_ns() + ASK_PERIOD_NS
        while not self._closing:
            due_ns = self._peers_down.due_ns
            next_ns = look_ns if due_ns is None else min(look_ns, due_ns)
            with suppress(Empty):
                who, is_there = self._seen.get(timeout=max(0, next_ns - monotonic_ns()) * 1e-9)
                if self._closing:
                    return
                if is_there and who.startswith(f"{self._own.service}/"):
                    look_ns = monotonic_ns()
                self._note(who, is_there, monotonic_ns())
            self._tell_of_absences(monotonic_ns())
            if monotonic_ns() < look_ns:
                continue
            look_ns = monotonic_ns() + ASK_PERIOD_NS
            try:
                reason = self._look()
            except OperationError:
                # The bus is being closed.
                return
            if reason:
                self._on_conflict(reason)
                return

    def _note(self, who: str, is_there: bool, now_ns: int) -> None:
        # Without a router a service does not see itself either.
        if who == f"{self._own.service}/{self._own.instance}":
            return
        if not is_there:
            self._peers_down.mark_down(who, now_ns)
        elif self._peers_down.mark_up(who):
            logger.info("%s is on the bus again", who)

    def _tell_of_absences(self, now_ns: int) -> None:
        gone = self._peers_down.overdue(now_ns)
        if gone:
            logger.warning("not on the bus any more: %s; ended, or the way there is broken", ", ".join(gone))
