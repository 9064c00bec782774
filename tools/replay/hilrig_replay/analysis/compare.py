"""Comparison of runs: aligns them in time and computes their differences in motion, torque and latency.

The first run is the reference. Runs are aligned by their first state, by the first motion of the arm, or by the first
event of a kind. Every other run is then interpolated at the times of the reference, over their common time. A run that
can't be aligned is skipped.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.analysis.summary import RunSummary, Trajectory, summarize, under_command
from hilrig_replay.io.columns import JointValues, joint_values
from hilrig_replay.io.isolation import isolated
from hilrig_replay.io.run import Run
from hilrig_runtime.errors import HilrigError, InputError

MOTION_THRESHOLD: Final = (0.01, 0.01, 0.005, 0.01)
"""Minimum speed of a moving joint; rad/s, rad/s, m/s, rad/s."""
MIN_OVERLAP_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of a run from the reference over their common time."""

    session: str
    overlap_s: float
    position_rms: JointValues
    """Root mean square of the position difference; rad, rad, m, rad."""
    position_max: JointValues
    """Largest magnitude of the position difference; rad, rad, m, rad."""
    tool_rms_mm: float
    """Root mean square of the distance between the tools, mm."""
    tool_max_mm: float
    effort_rms: JointValues
    """Root mean square of the effort difference; N·m, N·m, N, N·m."""
    loop_p50_ms: float | None
    """Median loop latency minus that of the reference, ms; None: one of the runs has no samples."""
    loop_p99_ms: float | None
    age_p50_ms: float | None
    """Median age of the acting torque's basis minus that of the reference, ms; None: one of the runs has no age."""
    age_p99_ms: float | None


@dataclass(frozen=True, slots=True)
class Origin:
    """Time zero of an aligned run."""

    ns: int
    """On the run's own time axis."""
    by: str
    """Criterion: `motion`, `command` (no motion under command), `start` (no command either), or a kind of event."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Aligned runs, and their differences from the first."""

    aligned_by: str
    """The requested criterion."""
    runs: tuple[Run, ...]
    summaries: tuple[RunSummary, ...]
    """Trajectories are on the aligned time axis."""
    origins: tuple[Origin, ...]
    differences: tuple[Difference, ...]
    """One per run after the first."""
    left_out: tuple[str, ...] = ()
    """Error message of each skipped run."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
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
    """Compare runs with the first one.

    Args:
        runs: two or more; their time axes are shifted (`timebase.origin_ns`) to the aligned zero.
        align: `motion`, `start`, or a kind of event such as `PART_PICKED`.

    Raises:
        InputError: there are fewer than two runs, or the first run or all others can't be aligned, have no common time,
            or are damaged.
    """
    if len(runs) < 2:
        raise InputError(f"a comparison requires at least two runs, got {len(runs)}")
    with isolated(runs[0].path):
        reference, origin = _aligned(runs[0], align)
    kept, summaries, origins = [runs[0]], [reference], [origin]
    differences: list[Difference] = []
    left_out: list[str] = []
    for run in runs[1:]:
        try:
            with isolated(run.path):
                summary, origin = _aligned(run, align)
                differences.append(_difference(reference, summary))
        except HilrigError as error:
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
    origin = find_origin(run, align)
    run.timebase.origin_ns = origin.ns
    return summarize(run), origin


def find_origin(run: Run, align: str) -> Origin:
    """Time zero of a run for a criterion; the time axis of the run must not be shifted.

    Raises:
        InputError: the run has no such event.
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
    raise InputError(f"{run.path}: no event {wanted}; its events: {', '.join(sorted(kinds)) or 'none'}")


def _first_motion(run: Run) -> Origin:
    first = Origin(0, "start")
    for block in run.blocks(frozenset({"state"})):
        states = block.states
        # The arm can still settle before the session: motion counts from the first command of a controller.
        if first.by == "start":
            commanded = under_command(run, states)
            if not commanded.any():
                continue
            states = states[int(np.argmax(commanded)) :]
            first = Origin(int(run.time_ns(states[:1])[0]), "command")
        moving = states[(np.abs(states["velocity"]) > MOTION_THRESHOLD).any(axis=1)][:1]
        if len(moving):
            return Origin(int(run.time_ns(moving)[0]), "motion")
    return first


def _difference(reference: RunSummary, other: RunSummary) -> Difference:
    ours, theirs = reference.trajectory, other.trajectory
    low = max(ours.time_s[0], theirs.time_s[0])
    high = min(ours.time_s[-1], theirs.time_s[-1])
    if high - low < MIN_OVERLAP_S:
        raise InputError(f"{reference.session} and {other.session}: no common time after alignment")
    at = ours.time_s[(ours.time_s >= low) & (ours.time_s <= high)]
    position = _at(theirs, theirs.position, at) - _at(ours, ours.position, at)
    effort = _at(theirs, theirs.effort, at) - _at(ours, ours.effort, at)
    apart_mm = np.linalg.norm(_at(theirs, theirs.tip, at) - _at(ours, ours.tip, at), axis=1) * 1e3
    mine, its = reference.latency.loop_ms, other.latency.loop_ms
    my_age, its_age = reference.latency.age_ms, other.latency.age_ms
    return Difference(
        session=other.session,
        overlap_s=float(high - low),
        position_rms=joint_values(np.sqrt((position**2).mean(axis=0))),
        position_max=joint_values(np.abs(position).max(axis=0)),
        tool_rms_mm=float(np.sqrt((apart_mm**2).mean())),
        tool_max_mm=float(apart_mm.max()),
        effort_rms=joint_values(np.sqrt((effort**2).mean(axis=0))),
        loop_p50_ms=None if mine is None or its is None else its.p50 - mine.p50,
        loop_p99_ms=None if mine is None or its is None else its.p99 - mine.p99,
        age_p50_ms=None if my_age is None or its_age is None else its_age.p50 - my_age.p50,
        age_p99_ms=None if my_age is None or its_age is None else its_age.p99 - my_age.p99,
    )


def _at(trajectory: Trajectory, values: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.interp(at, trajectory.time_s, column) for column in values.T], axis=1)
