"""Attempts: assigns the recordings of a folder to the students of a roster.

A recording belongs to the student whose id it contains. Without one it belongs to that whose id is its file name, the
beginning of its file name up to a separator, or the name of its folder; else to the only student of its rig.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hilrig_runtime.config.roster import Roster, Student

_SEPARATORS = "-_. "


@dataclass(frozen=True, slots=True)
class Owner:
    """Student of a recording, or the reason why no student was found."""

    student: Student | None
    problem: str = ""


def owner_of(path: Path, rig: str, roster: Roster, recorded: Sequence[str] = ()) -> Owner:
    """Find the student of a recording.

    Args:
        path: the recording, relative to the graded folder.
        rig: name of its rig; empty: not known.
        roster: the class.
        recorded: ids in the recording.
    """
    students = roster.by_id()
    names = [_named(name, students) for name in (path.stem, *reversed(path.parent.parts))]
    named = next((students[name] for name in names if name), None)
    owners = [students[one] for one in recorded if one in students]
    if owners and named is not None:
        # Members of a group hand in the same run.
        if named in owners or (named.group and named.group == owners[0].group):
            return Owner(named)
        return Owner(None, f"recorded for {', '.join(recorded)}, but named after {named.id}: ask both")
    if len(owners) == 1 or named is not None:
        return Owner(named or owners[0])
    if owners:
        return Owner(None, f"recorded for a group ({', '.join(recorded)}): name the file after one of them")
    of_rig = roster.of_rig(rig) if rig else ()
    if len(of_rig) == 1:
        return Owner(of_rig[0])
    if of_rig:
        ids = ", ".join(student.id for student in of_rig)
        return Owner(None, f"rig {rig} has several students ({ids}): name the file after one of them")
    return Owner(None, f"no student: neither its name nor its rig {rig or '(unknown)'} is in the roster")


def _named(name: str, ids: Sequence[str] | dict[str, Student]) -> str:
    """The longest id with which a name begins, up to its end or a separator; empty: none."""
    lower = name.lower()
    fitting = [
        each
        for each in ids
        if lower == each.lower() or any(lower.startswith(each.lower() + sign) for sign in _SEPARATORS)
    ]
    return max(fitting, key=len, default="")
