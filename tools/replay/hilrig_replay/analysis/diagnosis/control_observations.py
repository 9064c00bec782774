"""Control observations: properties of the motion and the torques under a controller, each with its figure.

The set point of a controller is not recorded. A steady-state error is therefore found only where the run has a task
with poses, and a periodic set point of more than `MIN_FREQUENCY_HZ` looks like a limit cycle.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np

from hilrig_replay.analysis.diagnosis.evidence import Evidence, Finding, Floats, controlled
from hilrig_replay.io.columns import Rows
from hilrig_sim.arm.joints import JOINT_SCALE
from hilrig_sim.arm.kinematics import forward

Observe = Callable[[Evidence, Sequence[Finding]], Iterator[Finding]]

EFFORT_UNITS: Final = ("N·m", "N·m", "N", "N·m")
POSITION_UNITS: Final = ("°", "°", "mm", "°")

MIN_SATURATED_SHARE: Final = 0.05
MIN_SATURATED_EFFORT: Final = 0.05
"""N·m or N."""
MIN_ENTRIES: Final = 3
"""Times that a saturated effort reaches its largest value."""
MIN_ENTRY_CHANGE: Final = 0.005
"""Change of the effort, as a share of the largest, with which it reaches saturation: at rest it changes less."""
MIN_ENTRY_COUNTS: Final = 0.0035
"""The same, N·m or N: the registers resolve 0.001."""

MIN_FREQUENCY_HZ: Final = 0.7
"""Slower oscillations are set points, unless the effort is saturated."""
MIN_SATURATED_FREQUENCY_HZ: Final = 0.15
MAX_FREQUENCY_HZ: Final = 12.0
MIN_AMPLITUDE: Final = 0.4
"""° or mm; the registers cause limit cycles of up to 0.2°."""
MIN_PERIODS: Final = 3.0
PIECE_S: Final = 5.0
"""Pieces of the motion that are examined for an oscillation; at least half of them must contain it."""
MIN_PIECE_ROWS: Final = 20
"""Fewer states show no oscillation; a lab's step is at most 1 s."""
MAX_REST_SHARE: Final = 0.15
"""Largest share of the time with less than a twentieth of the largest speed, not on a stop: 3 % of a sine, more of
moves from pose to pose."""
STOP_FLAGS: Final = 0b1_0001
"""Flags of the lower and the upper stop of joint 1; those of the next joints are shifted by one each."""
MIN_BAND_SHARE: Final = 0.6
"""Smallest share of the variance at the frequency and its harmonics."""
MAX_GROWTH: Final = 2.5
"""Largest ratio of the amplitudes of the two halves of a piece."""
MIN_SWING_RATIO: Final = 0.85
"""Smallest median ratio of consecutive swings: those after a move decay."""
MIN_SWING_SHARE: Final = 0.2
"""Smallest swing, as a share of the amplitude."""

MIN_STOP_SHARE: Final = 0.05

REST_SPEED: Final = 1.0
"""°/s or mm/s; a joint that is slower is at rest."""
REST_S: Final = 0.1
"""A joint that rests for this time before a turning point does not oscillate."""
REST_SHARE: Final = 0.06
"""Share of the largest speed of a move; a joint that is slower at its end rests."""
MIN_REST_SHARE: Final = 0.12
"""Shortest rest before a move, as a share of the move's duration: a sum of sines is slow for 4 % of a swing."""
MIN_MOVES: Final = 3
MIN_MOVE: Final = 8.0
"""° or mm."""
MIN_TURN: Final = 0.1
"""Smallest distance of turning points, ° or mm: the registers cause small oscillations."""
MAX_RETURN: Final = 0.8
"""Largest return after a move, as a share of the move; a longer one is another move."""
MAX_POSITION: Final = 1e5
MIN_OVERSHOOT: Final = 0.1

NEAR_POSE_MM: Final = 100.0
"""A rest that is farther from each pose of the task belongs to none."""
MIN_REST_S: Final = 0.5

MIN_NOISE: Final = 0.1
"""Standard deviation of the torque that the rounding causes, N·m or N."""


def _observation(code: str, text: str, remedy: str, **values: float) -> Finding:
    return Finding("control", code, text, remedy, None, values)


def _found(findings: Sequence[Finding], code: str) -> set[int]:
    """Joints, from 0, of the observations with a code."""
    return {round(finding.evidence["joint"]) - 1 for finding in findings if finding.code == code}


def saturation(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:  # noqa: ARG001
    """Efforts that are limited at the largest value used, by the program or by the registers."""
    stretches = controlled(evidence)
    worst: tuple[float, int, float, bool] | None = None
    for joint in range(4):
        efforts = [stretch["effort"][:, joint] for stretch in stretches]
        largest = max((float(np.abs(effort).max()) for effort in efforts), default=0.0)
        if not MIN_SATURATED_EFFORT <= largest < np.inf:
            continue
        entries = limited = total = 0
        signs: set[float] = set()
        for effort in efforts:
            at = np.abs(effort) >= largest * (1 - 1e-9)
            change = np.abs(np.diff(effort, prepend=effort[:1]))
            # A step from one limit to the other is an entry, too.
            entry = at & (change > max(MIN_ENTRY_CHANGE * largest, MIN_ENTRY_COUNTS))
            entries += int(entry.sum())
            total += len(effort)
            # Only steps that follow an entry without a break.
            begin = np.maximum.accumulate(np.where(entry, np.arange(len(at)), -1))
            left = np.maximum.accumulate(np.where(~at, np.arange(len(at)), -1))
            counted = at & (begin > left)
            limited += int(counted.sum())
            signs.update(np.sign(effort[counted]).tolist())
        share = limited / max(total, 1)
        # A largest value that is held for a step only is a peak.
        if entries >= MIN_ENTRIES and limited >= 1.5 * entries and share >= MIN_SATURATED_SHARE:
            worst = (
                max(worst, (share, joint, largest, len(signs) > 1))
                if worst
                else (share, joint, largest, len(signs) > 1)
            )
    if worst is not None:
        share, joint, largest, both = worst
        limit = f"{'±' if both else ''}{largest:g} {EFFORT_UNITS[joint]}"
        yield _observation(
            "saturation",
            f"joint {joint + 1} is saturated at {limit} for {share:.0%} of the run",
            "a smaller gain, or slower set points",
            joint=joint + 1.0,
            limit=largest,
            saturated_share=share,
        )


def limit_cycle(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:
    """Sustained oscillations of a joint."""
    saturated = _found(found, "saturation")
    step_s = evidence.step_ns / 1e9
    if step_s * MIN_PIECE_ROWS > PIECE_S:
        return
    best: tuple[float, int, float] | None = None
    for joint in range(4):
        lowest_hz = MIN_SATURATED_FREQUENCY_HZ if joint in saturated else MIN_FREQUENCY_HZ
        pieces, oscillating = 0, []
        for stretch in controlled(evidence):
            count = int(len(stretch) * step_s / PIECE_S)
            pieces += count
            for piece in np.array_split(stretch, count) if count else ():
                speed = np.abs(piece["velocity"][:, joint])
                on_stop = piece["limit_flags"] & STOP_FLAGS << joint != 0
                if ((speed <= 0.05 * speed.max()) & ~on_stop).mean() <= MAX_REST_SHARE:
                    swing = _oscillation(piece["position"][:, joint] * JOINT_SCALE[joint], step_s, lowest_hz)
                    oscillating += [] if swing is None else [swing]
        if not oscillating or len(oscillating) < 0.5 * pieces:
            continue
        frequency_hz, amplitude = (float(np.median([row[at] for row in oscillating])) for at in (0, 1))
        if best is None or amplitude > best[0]:
            best = amplitude, joint, frequency_hz
    if best is not None:
        amplitude, joint, frequency_hz = best
        yield _observation(
            "limit_cycle",
            f"joint {joint + 1} oscillates at {frequency_hz:.2g} Hz, ±{amplitude:.2g} {POSITION_UNITS[joint]}",
            "a smaller gain, more damping, or a smaller age",
            joint=joint + 1.0,
            frequency_hz=frequency_hz,
            amplitude=amplitude,
        )


def _oscillation(position: Floats, step_s: float, lowest_hz: float) -> tuple[float, float] | None:
    """Frequency, Hz, and amplitude of a sustained oscillation of a signal; None: not found."""
    count = len(position)
    time = np.linspace(-1.0, 1.0, count)
    if not np.isfinite(position).all():
        return None
    moved = position - np.polyval(np.polyfit(time, position, 1), time)
    low, high = np.percentile(moved, (5, 95))
    amplitude = float(high - low) / 2
    if not MIN_AMPLITUDE <= amplitude < 1e6:
        return None
    first, second = (float(half.std()) for half in (moved[: count // 2], moved[count // 2 :]))
    if min(first, second) * MAX_GROWTH < max(first, second):
        return None
    turns = np.flatnonzero(np.diff(np.sign(np.diff(moved))) != 0) + 1
    swings = np.abs(np.diff(moved[turns]))
    swings = swings[swings > MIN_SWING_SHARE * amplitude]
    if len(swings) < 2 or np.median(swings[1:] / swings[:-1]) < MIN_SWING_RATIO:
        return None
    power = np.abs(np.fft.rfft(moved * np.hanning(count))) ** 2
    frequency = np.fft.rfftfreq(count, step_s)
    power[0] = 0.0
    peak = int(np.argmax(power))
    line = slice(max(peak - 2, 0), peak + 3)
    found_hz = float((power[line] * frequency[line]).sum() / power[line].sum())
    if not max(lowest_hz, MIN_PERIODS / (count * step_s)) <= found_hz <= MAX_FREQUENCY_HZ:
        return None
    # The Hann window spreads a line over two bins to each side; harmonics of a clipped oscillation count.
    near = np.abs(np.arange(len(power))[:, np.newaxis] - peak * np.arange(1, 6)) <= 2
    if power[near.any(axis=1)].sum() < MIN_BAND_SHARE * power.sum():
        return None
    return found_hz, amplitude


def joint_on_stop(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:  # noqa: ARG001
    """A joint that rests on its stop."""
    stretches = controlled(evidence)
    flags = np.concatenate([np.empty(0, np.uint16), *(stretch["limit_flags"] for stretch in stretches)])
    if not len(flags):
        return
    shares = ((flags[:, np.newaxis] >> np.arange(8).astype(np.uint16)) & 1).mean(axis=0)
    bit = int(np.argmax(shares))
    if shares[bit] < MIN_STOP_SHARE:
        return
    side = "upper" if bit >= 4 else "lower"
    yield _observation(
        "joint_on_stop",
        f"joint {bit % 4 + 1} is on its {side} stop for {shares[bit]:.0%} of the run",
        "a set point within the limits, and a torque that carries the weight of joint 3",
        joint=bit % 4 + 1.0,
        upper=float(bit >= 4),
        stop_share=float(shares[bit]),
    )


def steady_state_error(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:
    """A tool that rests beside a pose of the task."""
    if not evidence.poses or any(finding.code in ("limit_cycle", "joint_on_stop") for finding in found):
        return
    goals = np.array([pose.position_mm for pose in evidence.poses], np.float64)
    tolerances = np.array([pose.tolerance_mm for pose in evidence.poses])
    step_s = evidence.step_ns / 1e9
    worst: tuple[float, int] | None = None
    for stretch in controlled(evidence):
        speed = np.abs(stretch["velocity"] * JOINT_SCALE).max(axis=1)
        for begin, end in _stretches(speed < REST_SPEED):
            if (end - begin) * step_s < MIN_REST_S:
                continue
            rest = stretch["position"][begin + (end - begin) // 2 : end].mean(axis=0)
            if not np.isfinite(rest).all():
                continue
            tool_mm = forward(evidence.arm, rest[:, np.newaxis])[:3, 0] * 1e3
            apart = np.linalg.norm(goals - tool_mm, axis=1)
            near = int(np.argmin(apart))
            if tolerances[near] < apart[near] < NEAR_POSE_MM and (worst is None or apart[near] > worst[0]):
                worst = float(apart[near]), near
    if worst is not None:
        error_mm, near = worst
        yield _observation(
            "steady_state_error",
            f"the tool rests {error_mm:.1f} mm from pose {evidence.poses[near].name}, whose tolerance is "
            f"{tolerances[near]:g} mm",
            "carry the weight of joint 3 with a constant force, or add an integral part",
            error_mm=error_mm,
            tolerance_mm=float(tolerances[near]),
        )


def overshoot(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:
    """Moves that pass their end."""
    oscillating, step_s = _found(found, "limit_cycle"), evidence.step_ns / 1e9
    best: tuple[float, int, int] | None = None
    for joint in sorted({0, 1, 2, 3} - oscillating):
        shares = [share for stretch in controlled(evidence) for share in _overshoots(stretch, joint, step_s)]
        median = float(np.median(shares)) if len(shares) >= MIN_MOVES else 0.0
        if median >= MIN_OVERSHOOT and (best is None or median > best[0]):
            best = median, joint, len(shares)
    if best is not None:
        share, joint, moves = best
        yield _observation(
            "overshoot",
            f"joint {joint + 1} overshoots by {share:.0%} of its move (median of {moves} moves)",
            "more damping, a smaller gain, or slower set points",
            joint=joint + 1.0,
            overshoot_share=share,
            moves=float(moves),
        )


def _overshoots(stretch: Rows, joint: int, step_s: float) -> Iterator[float]:
    """Overshoot of each move of a joint, as a share of the move.

    The end of a move follows from the next two turning points, for a decaying oscillation around it.
    """
    position = stretch["position"] * JOINT_SCALE
    moved = position[:, joint]
    speed = stretch["velocity"][:, joint] * JOINT_SCALE[joint]
    if not np.isfinite(position).all() or np.abs(position).max(initial=0.0) > MAX_POSITION:
        return
    turns = np.flatnonzero(np.diff(np.sign(speed)) != 0)
    turns = turns[np.append(np.abs(np.diff(moved[turns])) > MIN_TURN, True)] if len(turns) else turns
    ends = np.append(turns, len(moved) - 1)
    swings = np.diff(moved[ends])
    for number in range(len(swings) - 2):
        move, returned, again = swings[number : number + 3].tolist()
        before, peak = ends[number : number + 2]
        last = abs(swings[number - 1]) if number else 0.0
        if abs(move) < max(MIN_MOVE, 1.2 * last) or move * returned >= 0 or abs(returned) > MAX_RETURN * abs(move):
            continue
        if abs(again) >= abs(returned):
            # Not a decaying oscillation: another set point.
            again = 0.0
        other = 1 - joint if joint < 2 else joint
        if abs(move) < 0.5 * abs(position[peak, other] - position[before, other]):
            # Joints 1 and 2 move each other.
            continue
        fastest = float(np.abs(speed[before:peak]).max(initial=0.0))
        if _rest(np.abs(speed), int(before), REST_SHARE * fastest) < MIN_REST_SHARE * (peak - before):
            # It did not rest before: a periodic set point.
            continue
        slow = max(REST_SPEED, REST_SHARE * fastest)
        if (np.abs(speed[max(int(peak - REST_S / step_s), 0) : peak]) < slow).all():
            # It rested, and then turned to another set point.
            continue
        beyond = abs(returned) / (1 + abs(again) / abs(returned))
        yield beyond / (abs(move) - beyond)


def _rest(speed: Floats, at: int, slow: float) -> int:
    """Number of consecutive rows around a row, (n,), with less than a speed."""
    fast = np.flatnonzero(speed >= slow)
    after = int(np.searchsorted(fast, at))
    begin = int(fast[after - 1]) + 1 if after else 0
    end = int(fast[after]) if after < len(fast) else len(speed)
    return end - begin


def noise_amplification(evidence: Evidence, found: Sequence[Finding]) -> Iterator[Finding]:  # noqa: ARG001
    """Torques that contain the rounding of the positions, amplified: above all by an unfiltered derivative."""
    noise = evidence.gains.noise
    joint = int(np.argmax(noise))
    if MIN_NOISE <= noise[joint] < np.inf:
        unit, resolution = EFFORT_UNITS[joint], f"0.01 {POSITION_UNITS[joint]}".replace(" °", "°")
        yield _observation(
            "noise_amplification",
            f"the rounding of the position to {resolution} causes a noise of {noise[joint]:.2g} {unit} in the torque "
            f"of joint {joint + 1}",
            "filter the derivative, or use the velocities of the input registers",
            joint=joint + 1.0,
            noise=float(noise[joint]),
        )


def _stretches(marked: np.ndarray) -> list[tuple[int, int]]:
    """Begin and end of each run of marked values, shape (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], marked, [False])).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


OBSERVATIONS: Final[tuple[Observe, ...]] = (
    saturation,
    limit_cycle,
    joint_on_stop,
    steady_state_error,
    overshoot,
    noise_amplification,
)
