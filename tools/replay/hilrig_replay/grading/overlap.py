"""Sessions of one rig at the same time: a manual recording, and the sessions of controllers in it.

Both files contain the same motion. They are marked, and only the sessions of the controllers are graded.
"""

from bisect import bisect_left
from collections.abc import Sequence
from typing import Final, NamedTuple


class Span(NamedTuple):
    """When, and of which simulation, a session was recorded."""

    session: str = ""
    rig: str = ""
    is_manual: bool = False
    start_ns: int = 0
    """Start of the session, without the pre-roll; wall clock, ns."""
    end_ns: int = 0
    incarnations: tuple[int, ...] = ()
    """Those of the first and the last state: labs of the same name on several computers are not the same rig."""


NO_SPAN: Final = Span()


def overlapping(spans: Sequence[Span]) -> list[tuple[str, ...]]:
    """Sessions that each session overlaps: of a manual one those of controllers, of a controller's the manual ones."""
    found: list[list[str]] = [[] for _ in spans]
    # Sorted by their start; each controller's session is compared with the manual ones that start before it ends.
    manual = sorted((one.start_ns, place) for place, one in enumerate(spans) if one.is_manual)
    for place, one in enumerate(spans):
        if one.is_manual:
            continue
        for _, other in manual[: bisect_left(manual, (one.end_ns, 0))]:
            recorded = spans[other]
            is_same_rig = recorded.rig == one.rig and not set(recorded.incarnations).isdisjoint(one.incarnations)
            if is_same_rig and recorded.end_ns > one.start_ns:
                found[place].append(recorded.session)
                found[other].append(one.session)
    return [tuple(dict.fromkeys(sessions)) for sessions in found]
