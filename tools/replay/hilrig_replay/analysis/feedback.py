"""Test whether torques follow the positions that were served: feedback, or an open loop beside a reader.

Smooth torques and the positions that they cause are always related, so a good fit of a control law is no evidence. The
positions in the registers, however, are rounded to 0.01° or 0.01 mm. The rounding error of a served position is known
from the recording, and unrelated to everything that a program without these positions can know. Torques that contain it
were computed from them. The statistic is that of a generalized least-squares fit in blocks of commands, each with its
own trend in time and its own gains; for comparison it is computed with the rounding errors of other times.

The same errors show which poll the torques were computed from: the first poll whose rounding errors they contain.

With a small gain, rounding hides in the resolution of the torque registers. There, a law that restores a set point and
explains each torque register to its resolution is evidence, too.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr

from hilrig_replay.io.columns import Rows, last_of_each_read
from hilrig_sim.arm.joints import JOINT_SCALE

Floats = NDArray[np.float64]
Series = tuple[Floats, Floats, Floats]
"""Time of each command, s, (n,); positions that were served before it, 0.01° or 0.01 mm, not rounded, (n, 4); torques,
mN·m or mN, (n, 4)."""

BLOCK_COMMANDS: Final = 16
LAGS: Final = 3
"""Number of polls whose positions a torque may contain."""
MIN_BLOCKS: Final = 3
COMPARISONS: Final = 40
"""Number of other times whose rounding errors are compared."""
MIN_STATISTIC: Final = 20.0
"""With three lags and no feedback, one in 10,000 joints exceeds it (chi-squared distribution)."""
MIN_RATIO: Final = 2.0
"""Required ratio to the largest statistic of the other times."""
ROUNDING_VARIANCE: Final = 1 / 12
GAIN_BLOCK_COMMANDS: Final = 24
MIN_GAIN_BLOCKS: Final = 5
MIN_ERROR_VARIANCE: Final = 0.002
"""Smallest variance of the rounding errors of a block; that of a moving joint is 1/12."""
MAX_POLLS: Final = 3
"""Number of earlier polls that are compared with the newest one."""
KNOWN_POLLS: Final = 6
"""Number of polls whose exact positions explain a torque: a law of the previous poll with a velocity over three polls
needs five. Polls answer states at irregular distances, so a trend in time does not replace the positions."""
MIN_GAIN_STATISTIC: Final = 20.0
"""Squared ratio of the largest gain to its standard error from which the gains are significant: of torques without
rounding errors, one run in 8,000 exceeds it in one of its 16 gains (normal distribution)."""
MIN_GAIN_RATIO: Final = 0.4
"""Gain of the first poll that the torques contain, as a share of the largest gain."""
LAW_COMMANDS: Final = 24
"""Commands of a segment in which one law is fitted."""
MIN_SEGMENTS: Final = 2
LAW_RESIDUAL: Final = 0.75
"""Largest root mean square of the unexplained torque, mN·m: the registers resolve 1 mN·m."""
LAW_TORQUE_RANGE: Final = 40.0
"""Smallest range of the torque in a segment that is examined, mN·m."""


def follows_positions(windows: Iterable[tuple[Rows, Rows]]) -> bool:
    """Whether the torques of a controller contain the positions that it was served.

    Args:
        windows: states and commands of parts of a run, fields as `STATE_DTYPE` and `COMMAND_DTYPE`.
    """
    series = [found for states, commands in windows for found in _series(states, commands)]
    return contains_rounding_errors(series) or is_restoring_law(series)


def _series(states: Rows, commands: Rows) -> Iterator[Series]:
    """The first command after each poll, with the positions of its basis, by incarnation of the simulation."""
    based, safe = commands["basis_step"] > 0, commands["safe"]
    commands = commands[based & ~safe]
    for incarnation in np.unique(states["incarnation"]):
        known = states[states["incarnation"] == incarnation]
        chosen = commands[commands["basis_incarnation"] == incarnation]
        chosen = chosen[np.diff(chosen["basis_step"].astype(np.int64), prepend=0) > 0]
        at = np.minimum(np.searchsorted(known["step"], chosen["basis_step"]), len(known) - 1)
        found = known["step"][at] == chosen["basis_step"]
        chosen, at = chosen[found], at[found]
        if len(chosen):
            position = known["position"][at] * JOINT_SCALE * 100
            yield chosen["write_arrived_ns"] / 1e9, position, chosen["effort"] * 1e3


@dataclass(frozen=True, slots=True)
class RoundingGains:
    """Gains with which torques contain the rounding errors of the positions in the registers."""

    gains: Floats
    """By joint and poll, the newest first: N·m per 0.01°, joint 3 N per 0.01 mm, (4, MAX_POLLS + 1)."""
    statistics: Floats
    """Squared ratios of the gains to their standard errors, same shape; 0: the joint shows nothing."""
    older_steps: Floats
    """Mean number of steps by which the state of each poll is older than the newest one, (MAX_POLLS + 1,)."""

    @property
    def noise(self) -> Floats:
        """Standard deviation of the torques that is caused by the rounding, N·m or N, (4,); 0: not significant."""
        shown = np.where(self.statistics >= MIN_GAIN_STATISTIC, self.gains, 0.0)
        return np.asarray(np.sqrt((shown**2).sum(axis=1) * ROUNDING_VARIANCE))

    @property
    def polls_behind(self) -> int | None:
        """Polls between the newest one and that which the torques were computed from; None: they do not show it."""
        joint = int(np.argmax(self.statistics.max(axis=1)))
        statistics, gains = self.statistics[joint], np.abs(self.gains[joint])
        if not statistics.max() >= MIN_GAIN_STATISTIC:
            return None
        used = (gains >= MIN_GAIN_RATIO * gains.max()) & (statistics >= MIN_GAIN_STATISTIC / 2)
        # Older gains may contain those of still older polls, but not a smaller error.
        return int(np.argmax(used | (statistics == statistics.max())))


def rounding_gains(windows: Iterable[tuple[Rows, Rows]]) -> RoundingGains:
    """Estimate the gains of the rounding errors, by generalized least squares in blocks of commands.

    Args:
        windows: states and commands of parts of a run, fields as `STATE_DTYPE` and `COMMAND_DTYPE`.
    """
    blocks: list[list[tuple[Floats, Floats]]] = [[], [], [], []]
    """By joint: normal matrices and right-hand sides of its blocks."""
    older: list[NDArray[np.int64]] = [np.zeros((MAX_POLLS + 1, 0), np.int64)]
    for states, commands in windows:
        for basis_step, (time_s, position, torque) in _polls(states, commands):
            steps = np.diff(basis_step, prepend=basis_step[0])
            lagged = np.stack([basis_step - _lagged(basis_step, lag) for lag in range(MAX_POLLS + 1)])
            older.append(lagged[:, MAX_POLLS:])
            # A poll that returned the state of the one before can't be distinguished from it.
            fresh = np.flatnonzero(steps > 0)
            fresh = fresh[fresh >= KNOWN_POLLS - 1]
            error = np.rint(position) - position
            for joint in range(4):
                # A torque at its upper or lower limit contains no errors, but those between two limited ones do.
                used = torque[:, joint]
                free = fresh[(used[fresh] > used.min() + 0.5) & (used[fresh] < used.max() - 0.5)]
                rows = free[: len(free) // GAIN_BLOCK_COMMANDS * GAIN_BLOCK_COMMANDS].reshape(-1, GAIN_BLOCK_COMMANDS)
                if not len(rows):
                    continue
                known = _basis_of_known(time_s[rows], [position[rows - lag, joint] for lag in range(KNOWN_POLLS)])
                unexplained = _without(known, torque[rows, joint])
                errors = _without(known, np.stack([error[rows - lag, joint] for lag in range(MAX_POLLS + 1)], axis=-1))
                # The variance without the part that the errors explain, which may be most of it.
                variance = _residual_variance(unexplained, errors, GAIN_BLOCK_COMMANDS - known.shape[2])
                weight = np.where((unexplained**2).sum(axis=1) > 1e-6, 1 / (variance + ROUNDING_VARIANCE), 0.0)
                # A joint at rest has no errors that change.
                weight *= (errors**2).mean(axis=(1, 2)) > MIN_ERROR_VARIANCE
                normal = np.einsum("b,bli,blj->bij", weight, errors, errors)
                blocks[joint].append((normal, np.einsum("b,bli,bl->bi", weight, errors, unexplained)))
    fits = [_fit(of_joint) for of_joint in blocks]
    gains, statistics = np.stack([fit[0] for fit in fits]), np.stack([fit[1] for fit in fits])
    steps_of_polls = np.concatenate(older, axis=1)
    mean_steps = steps_of_polls.mean(axis=1) if steps_of_polls.shape[1] else np.zeros(MAX_POLLS + 1)
    return RoundingGains(gains / 1e3, statistics, mean_steps)


def _fit(blocks: list[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Gains and their statistics of a joint, (MAX_POLLS + 1,) each, from normal matrices and right-hand sides.

    The standard error is the larger one of the model and of the jackknife over blocks, so that a single block, or a few
    with a limited torque or a step of the set point, show nothing.
    """
    size = MAX_POLLS + 1
    normals = np.concatenate([np.zeros((0, size, size)), *(normal for normal, _ in blocks)])
    rights = np.concatenate([np.zeros((0, size)), *(right for _, right in blocks)])
    used = np.diagonal(normals, axis1=1, axis2=2).any(axis=1)
    normals, rights, count = normals[used], rights[used], int(used.sum())
    if count < MIN_GAIN_BLOCKS:
        return np.zeros(size), np.zeros(size)
    inverse = np.linalg.pinv(normals.sum(axis=0), rcond=1e-9, hermitian=True)
    gains = inverse @ rights.sum(axis=0)
    others = np.linalg.pinv(normals.sum(axis=0) - normals, rcond=1e-9, hermitian=True)
    without_one = np.einsum("bij,bj->bi", others, rights.sum(axis=0) - rights)
    scatter = without_one.var(axis=0) * (count - 1)
    variances = np.maximum(np.maximum(np.diagonal(inverse), scatter), 1e-300)
    ratios = np.abs(gains) / np.sqrt(variances)
    # A standard error of few blocks is itself uncertain: the normal deviate that is as rare as Student's t.
    return gains, np.minimum(ratios, -ndtri(stdtr(count - 1, -ratios))) ** 2


def _lagged(values: NDArray[np.int64], lag: int) -> NDArray[np.int64]:
    return np.concatenate((values[:lag], values))[: len(values)]


def _polls(states: Rows, commands: Rows) -> Iterator[tuple[NDArray[np.int64], Series]]:
    """Steps of the bases of consecutive polls, and their series, by incarnation of the simulation."""
    commands = last_of_each_read(commands)
    for incarnation in np.unique(states["incarnation"]):
        known = states[states["incarnation"] == incarnation]
        chosen = commands[commands["basis_incarnation"] == incarnation]
        at = np.minimum(np.searchsorted(known["step"], chosen["basis_step"]), len(known) - 1)
        found = known["step"][at] == chosen["basis_step"]
        chosen, at = chosen[found], at[found]
        if len(chosen) > MAX_POLLS:
            position = known["position"][at] * JOINT_SCALE * 100
            series = chosen["write_arrived_ns"] / 1e9, position, chosen["effort"] * 1e3
            yield chosen["basis_step"].astype(np.int64), series


def _residual_variance(unexplained: Floats, errors: Floats, freedom: int) -> Floats:
    """Variance of the torques of each block, (blocks,), without their best fit by the errors of that block."""
    left, sizes, _ = np.linalg.svd(errors, full_matrices=False)
    left = left * (sizes > 1e-9)[:, np.newaxis, :]
    rest = unexplained - np.einsum("bli,bi->bl", left, np.einsum("bli,bl->bi", left, unexplained))
    return np.asarray((rest**2).sum(axis=1) / max(freedom - errors.shape[2], 1))


def contains_rounding_errors(series: Iterable[Series]) -> bool:
    """Whether the torques contain the rounding errors of the positions in the registers."""
    statistics = np.zeros((4, COMPARISONS + 1))
    for time_s, position, torque in series:
        error = np.rint(position) - position
        blocks = np.arange(LAGS - 1, len(time_s) - BLOCK_COMMANDS + 1, BLOCK_COMMANDS)
        if len(blocks) < MIN_BLOCKS:
            continue
        rows = blocks[:, np.newaxis] + np.arange(BLOCK_COMMANDS)
        shifts = np.linspace(LAGS, len(time_s) - LAGS, COMPARISONS + 1).astype(int)[:-1]
        for joint in range(4):
            known = _basis_of_known(time_s[rows], [position[rows - lag, joint] for lag in range(2)])
            unexplained = _without(known, torque[rows, joint])
            variance = (unexplained**2).sum(axis=1) / (BLOCK_COMMANDS - known.shape[2])
            # A constant torque contains nothing.
            weight = np.where(variance > 1e-9, 1 / (variance + ROUNDING_VARIANCE), 0.0)
            for number, shift in enumerate((0, *shifts.tolist())):
                shifted = np.roll(error[:, joint], shift)
                errors = _without(known, np.stack([shifted[rows - lag] for lag in range(LAGS)], axis=-1))
                statistics[joint, number] += _explained(unexplained, errors, weight)
    tested = np.vstack((statistics, statistics.sum(axis=0)))
    enough = np.maximum(MIN_STATISTIC, MIN_RATIO * tested[:, 1:].max(axis=1))
    return bool((tested[:4, 0] >= enough[:4]).any() or tested[4, 0] >= 2 * enough[4] / MIN_RATIO + MIN_STATISTIC)


def _basis_of_known(time_s: Floats, positions: list[Floats]) -> Floats:
    """Orthonormal basis of a cubic trend in time and of exact positions, by block, (blocks, commands, k)."""
    since = time_s - time_s.mean(axis=1, keepdims=True)
    since /= np.maximum(np.abs(since).max(axis=1, keepdims=True), 1e-9)
    moved = [position - position.mean(axis=1, keepdims=True) for position in positions]
    columns = np.stack([since**0, since, since**2, since**3, *moved], axis=-1)
    columns /= np.maximum(np.linalg.norm(columns, axis=1, keepdims=True), 1e-9)
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left * (sizes > 1e-6 * sizes[:, :1])[:, np.newaxis, :])


def _without(known: Floats, values: Floats) -> Floats:
    """Remainder of values, (blocks, commands) or (blocks, commands, k), after projection on `known`."""
    columns = values if values.ndim == 3 else values[..., np.newaxis]
    rest = columns - known @ (known.transpose(0, 2, 1) @ columns)
    return rest if values.ndim == 3 else rest[..., 0]


def _explained(unexplained: Floats, errors: Floats, weight: Floats) -> float:
    """Weighted sum of squares that the errors explain, with the same gains in all blocks."""
    normal = np.einsum("b,bli,blj->ij", weight, errors, errors)
    right = np.einsum("b,bli,bl->i", weight, errors, unexplained)
    gains, *_ = np.linalg.lstsq(normal, right, rcond=1e-9)
    return float(right @ gains)


def is_restoring_law(series: Iterable[Series]) -> bool:
    """Whether one law of the positions in the registers, which restores a set point, explains a torque exactly.

    The gains of torques that merely drive the arm have the opposite sign: they are in phase with its velocity.
    """
    passed, moved = np.zeros(4, np.int64), np.zeros(4, np.int64)
    for time_s, position, torque in series:
        for start in range(1, len(time_s) - LAW_COMMANDS + 1, LAW_COMMANDS):
            rows = np.arange(start, start + LAW_COMMANDS)
            for joint in range(4):
                newest, previous = np.rint(position[rows, joint]), np.rint(position[rows - 1, joint])
                if np.ptp(torque[rows, joint]) < LAW_TORQUE_RANGE:
                    continue
                moved[joint] += 1
                law = np.column_stack((newest, previous, np.ones(LAW_COMMANDS)))
                gains, *_ = np.linalg.lstsq(law, torque[rows, joint], rcond=None)
                residual = torque[rows, joint] - law @ gains
                restores = gains[0] + gains[1] < 0 and (gains[0] < 0 or abs(gains[0]) < 0.05 * abs(gains[1]))
                passed[joint] += int(restores and np.sqrt((residual**2).mean()) <= LAW_RESIDUAL)
    return bool(((passed >= MIN_SEGMENTS) & (passed >= 0.5 * moved)).any())
