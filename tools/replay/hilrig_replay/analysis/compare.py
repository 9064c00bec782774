"""Runs beside each other: aligned in time, how far they differ in motion, torque and latency.

The first run is the reference. Runs are aligned by their first state, by the first motion of the arm, or by the first
event of a kind; then every other run is interpolated at the reference's times, where both were recorded. A run that
can't be aligned does not hide the others.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.summary import Course, RunSummary, summarise, under_command
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import InputError

MOVING: Final = (0.01, 0.01, 0.005, 0.01)
"""A joint faster than this moves; rad/s, rad/s, m/s, rad/s."""
SHORTEST_S: Final = 0.1

Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Difference:
    """One run against the reference, over the time that both have."""

    session: str
    overlap_s: float
    position_rms: Four
    """Root mean square; rad, rad, m, rad."""
    position_max: Four
    """Largest magnitude; rad, rad, m, rad."""
    tool_rms_mm: float
    """Distance of the tools, root mean square, mm."""
    tool_max_mm: float
    effort_rms: Four
    """N·m, N·m, N, N·m."""
    loop_p50_ms: float | None
    """Loop latency's median less the reference's, ms; None: one of them has none."""
    loop_p99_ms: float | None


@dataclass(frozen=True, slots=True)
class Origin:
    """Aligned zero of a run."""

    ns: int
    """In the run's own time."""
    by: str
    """What it is: `motion`, else where nothing moved under command the first `command`, else `start`; or an event."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Aligned runs, and their differences from the first."""

    aligned_by: str
    """What was asked for."""
    runs: tuple[Run, ...]
    summaries: tuple[RunSummary, ...]
    """Courses are on the aligned time axis."""
    origins: tuple[Origin, ...]
    differences: tuple[Difference, ...]
    """One a run after the first."""
    left_out: tuple[str, ...] = ()
    """Why a run is not in it, one sentence each."""

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return {
            "aligned_by": self.aligned_by,
            "runs": [
                {**summary.as_dict(), "origin_s": origin.ns / 1e9, "aligned_by": origin.by}
                for summary, origin in zip(self.summaries, self.origins, strict=True)
            ],
            "differences": [asdict(difference) for difference in self.differences],
            "left_out": self.left_out,
        }


def compare(runs: Sequence[Run], align: str = "motion") -> Comparison:
    """Compare runs with the first of them.

    Args:
        runs: two or more; their time axes are moved (`timebase.origin_ns`) to the aligned zero.
        align: `motion`, `start`, or an event's kind such as `PART_PICKED`.

    Raises:
        InputError: fewer than two runs, or the first, or all others, do not have the event to be aligned by, have no
            common time, or are damaged.
    """
    if len(runs) < 2:
        raise InputError("a comparison needs two runs or more")
    reference, origin = _aligned(runs[0], align)
    kept, summaries, origins = [runs[0]], [reference], [origin]
    differences: list[Difference] = []
    left_out: list[str] = []
    for run in runs[1:]:
        try:
            summary, origin = _aligned(run, align)
            differences.append(_difference(reference, summary))
        except InputError as error:
            left_out.append(str(error))
            continue
        kept.append(run)
        summaries.append(summary)
        origins.append(origin)
    if not differences:
        raise InputError("\n".join(left_out))
    return Comparison(align, tuple(kept), tuple(summaries), tuple(origins), tuple(differences), tuple(left_out))


def _aligned(run: Run, align: str) -> tuple[RunSummary, Origin]:
    run.timebase.origin_ns = 0
    origin = origin_of(run, align)
    run.timebase.origin_ns = origin.ns
    return summarise(run), origin


def origin_of(run: Run, align: str) -> Origin:
    """Aligned zero of a run whose time has not been moved.

    Raises:
        InputError: it has no such event.
    """
    if align == "start":
        return Origin(0, "start")
    if align == "motion":
        return _first_motion(run)
    wanted = align.upper().replace("-", "_").replace(" ", "_")
    kinds: set[str] = set()
    for block in run.blocks(frozenset({"event"})):
        found = block.events[block.events["kind"] == wanted][:1]
        if len(found):
            return Origin(int(run.time_ns(found)[0]), align)
        kinds.update(block.events["kind"])
    raise InputError(f"{run.path}: has no event {wanted}; it has {', '.join(sorted(kinds)) or 'none'}")


def _first_motion(run: Run) -> Origin:
    first = Origin(0, "start")
    for block in run.blocks(frozenset({"state"})):
        states = block.states
        # Before the session the arm may still settle: motion counts from a controller's first command on.
        if first.by == "start":
            commanded = under_command(run, states)
            if not commanded.any():
                continue
            states = states[int(np.argmax(commanded)) :]
            first = Origin(int(run.time_ns(states[:1])[0]), "command")
        moving = states[(np.abs(states["velocity"]) > MOVING).any(axis=1)][:1]
        if len(moving):
            return Origin(int(run.time_ns(moving)[0]), "motion")
    return first


def _difference(reference: RunSummary, other: RunSummary) -> Difference:
    ours, theirs = reference.course, other.course
    low = max(ours.time_s[0], theirs.time_s[0])
    high = min(ours.time_s[-1], theirs.time_s[-1])
    if high - low < SHORTEST_S:
        raise InputError(f"{reference.session} and {other.session} have no common time once they are aligned")
    at = ours.time_s[(ours.time_s >= low) & (ours.time_s <= high)]
    position = _at(theirs, theirs.position, at) - _at(ours, ours.position, at)
    effort = _at(theirs, theirs.effort, at) - _at(ours, ours.effort, at)
    apart_mm = np.linalg.norm(_at(theirs, theirs.tip, at) - _at(ours, ours.tip, at), axis=1) * 1e3
    mine, its = reference.latency.loop_ms, other.latency.loop_ms
    return Difference(
        session=other.session,
        overlap_s=float(high - low),
        position_rms=_four(np.sqrt((position**2).mean(axis=0))),
        position_max=_four(np.abs(position).max(axis=0)),
        tool_rms_mm=float(np.sqrt((apart_mm**2).mean())),
        tool_max_mm=float(apart_mm.max()),
        effort_rms=_four(np.sqrt((effort**2).mean(axis=0))),
        loop_p50_ms=None if mine is None or its is None else its.p50 - mine.p50,
        loop_p99_ms=None if mine is None or its is None else its.p99 - mine.p99,
    )


def _at(course: Course, values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.interp(at, course.time_s, column) for column in values.T], axis=1)


def _four(values: NDArray[np.float64]) -> Four:
    return (float(values[0]), float(values[1]), float(values[2]), float(values[3]))
