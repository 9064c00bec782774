"""Owners of the rigs of one edge: fixed by the roster, or claimed with a code. Times are passed in.

A claim binds a rig to the machine from which the code was written: to the name in its certificate, or to its address as
the edge sees it. It ends with the lab slot.
"""

from collections.abc import Iterable, Sequence
from datetime import UTC
from pathlib import Path
from typing import Final

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.classroom.claim_files import Claim, ClaimFiles, CodeBook
from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.ports import NoOwner, Ownership, Refusal
from hilrig_runtime.config.classroom import ClassroomConfig
from hilrig_runtime.config.roster import Roster
from hilrig_runtime.timing.guess_throttle import GuessThrottle

NOT_CLAIMED: Final = "is not claimed: claim it with your code (hilrig claim CODE, docs/classroom.md)"


class ClassOwners:
    """Owners of the rigs of one edge; without a `[classroom]` they have none."""

    def __init__(self, config: ClassroomConfig | None, rigs: Iterable[str]) -> None:
        """Read the roster.

        Raises:
            InputError: it can't be read, or has mistakes.
        """
        self._roster = Roster(()) if config is None else config.students([*rigs])
        self._claims = None if config is None or config.claims is None else _Claims(config.claims)

    def of(self, rig: str) -> Ownership:
        """Return the ownership of a rig, with its stored claim."""
        if self._claims is not None:
            return self._claims.of(rig)
        students = [student.id for student in self._roster.of_rig(rig)]
        return FixedOwner(rig, students, self._roster.by_id().keys()) if students else NoOwner()

    def remove(self, rig: str) -> None:
        """Forget a rig that is no longer served."""
        if self._claims is not None:
            self._claims.rigs.pop(rig, None)

    def close(self) -> None:
        """Wait until the claims are stored."""
        if self._claims is not None:
            self._claims.files.close()


class FixedOwner(NoOwner):
    """Ownership of a rig that the roster gives to one student, or to a group."""

    def __init__(self, rig: str, owners: Sequence[str], students: Iterable[str]) -> None:
        self.student = ",".join(owners)
        self._rig = rig
        self._others = frozenset(students) - {*owners}

    def denial(self, client: Client, *, reserved: bool) -> str:
        """See `Ownership.denial`: a certificate with the id of another student may not write."""
        if reserved or client.certificate not in self._others:
            return ""
        return f"{self._rig} belongs to {self.student} by the roster, the certificate to {client.certificate}"


class _Claims:
    """Claims of all rigs of an edge."""

    def __init__(self, folder: Path) -> None:
        self.codes = CodeBook(folder)
        self.files = ClaimFiles(folder)
        self.throttle = GuessThrottle()
        self.rigs: dict[str, ClaimedRig] = {}

    def of(self, rig: str) -> "ClaimedRig":
        self.rigs[rig] = ClaimedRig(rig, self)
        return self.rigs[rig]


class ClaimedRig:
    """Ownership of a rig that is claimed with a code. Implements `Ownership`."""

    takes_codes = True

    def __init__(self, rig: str, claims: _Claims) -> None:
        self._rig = rig
        self._claims = claims
        self._claim = claims.files.load(rig)

    @property
    def student(self) -> str:
        """See `Ownership.student`."""
        return "" if self._claim is None else self._claim.student

    @property
    def claimed_from(self) -> str:
        """See `Ownership.claimed_from`."""
        return "" if self._claim is None else self._claim.machine

    @property
    def ends_wall_ns(self) -> int | None:
        """See `Ownership.ends_wall_ns`."""
        return None if self._claim is None else self._claim.ends_wall_ns

    def denial(self, client: Client, *, reserved: bool) -> str:
        """See `Ownership.denial`. The controller that the edge connects to is that of lab.toml, for any student."""
        claim = self._claim
        if claim is None:
            return f"{self._rig} {NOT_CLAIMED}"
        if reserved or claim.is_made_by(client):
            return ""
        return f"{self._rig} is claimed by {claim.student} from {claim.machine}; write to the rig of your own code"

    def claim(self, client: Client, code: str, *, in_use: bool, now_ns: int, wall_ns: int) -> Refusal | None:
        """See `Ownership.claim`."""
        wait_ns = self._claims.throttle.wait_ns(client.host, now_ns)
        if wait_ns:
            return _later(f"too many wrong codes from {client.host}; try again in {wait_ns / 1e9:.0f} s")
        found = self._claims.codes.find(code)
        if found is None:
            self._claims.throttle.record_failure(client.host, now_ns)
            return _invalid("unknown code; type it as it is printed, or make a new one with hilrig rig codes")
        ends_wall_ns = round(found.ends.timestamp()) * 1_000_000_000
        if found.rig not in ("", self._rig):
            return _invalid(f"the code of {found.student} is for {found.rig}")
        if ends_wall_ns <= wall_ns:
            ended = found.ends.astimezone(UTC)
            return _invalid(f"the lab slot of {found.student}'s code ended at {ended:%Y-%m-%d %H:%M} UTC")
        claim = Claim.of(found.student, client, ends_wall_ns)
        if self._claim is not None and self._claim.student != claim.student:
            reason = f"{self._rig} is claimed by {self.student} until the end of the lab slot"
            return _later(f"{reason}; to end it, run: hilrig lease {self._rig} --end-claim", self.student)
        if self._claim is not None and self._claim.machine != claim.machine and in_use:
            reason = f"{self.student} writes from {self.claimed_from}; stop that program first"
            return _later(reason, self.student)
        for rig, other in self._claims.rigs.items():
            if rig != self._rig and other.student == claim.student:
                reason = f"{claim.student} has claimed {rig}; to end that, run: hilrig lease {rig} --end-claim"
                return _later(reason, claim.student)
        self._set(claim)
        return None

    def end(self) -> str:
        """See `Ownership.end`."""
        student = self.student
        if student:
            self._set(None)
        return student

    def _set(self, claim: Claim | None) -> None:
        self._claim = claim
        self._claims.files.save(self._rig, claim)


def _invalid(reason: str) -> Refusal:
    return Refusal("code", f"claim refused: {reason}", ExcCodes.DEVICE_FAILURE)


def _later(reason: str, student: str = "") -> Refusal:
    return Refusal("claim", f"claim refused: {reason}", ExcCodes.DEVICE_BUSY, student=student)
