"""Fixed-step Runge–Kutta methods as tables, with their limits of stability; the variable-step reference by scipy.

The real-time method is Runge–Kutta–Fehlberg with a fixed step: the fifth-order solution goes on, and the fourth-order
one beside it says how far off the step may be. A table is all that distinguishes the methods; `plant` applies it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Tableau:
    """A Butcher table of an explicit method with s stages."""

    name: str
    a: tuple[tuple[float, ...], ...]
    """Row i has the i coefficients of the stages before it."""
    b: tuple[float, ...]
    """Weights of the solution, s."""
    embedded: tuple[float, ...] | None = None
    """Weights of the embedded solution of another order, s; None: the method has none."""

    @property
    def stages(self) -> int:
        """Evaluations of the right-hand side in a step."""
        return len(self.b)

    @property
    def error_weights(self) -> tuple[float, ...]:
        """b less the embedded weights; zeros where there are none."""
        if self.embedded is None:
            return (0.0,) * self.stages
        return tuple(b - e for b, e in zip(self.b, self.embedded, strict=True))

    def negative_real_limit(self, weights: tuple[float, ...] | None = None) -> float:
        """Largest |hλ| on the negative real axis up to which the method is stable, for other weights if given.

        The stability function of an explicit method is the polynomial 1 + Σ z^k bᵀA^(k-1)1; the limit is the
        first x > 0 where |R(-x)| = 1.
        """
        a = np.zeros((self.stages, self.stages))
        for i, row in enumerate(self.a):
            a[i, :i] = row
        b = np.array(self.b if weights is None else weights)
        stage = np.ones(self.stages)
        coefficients = [1.0]
        for _ in range(self.stages):
            coefficients.append(float(b @ stage))
            stage = a @ stage
        signed = np.array([c * (-1.0) ** k for k, c in enumerate(coefficients)])
        crossings = []
        for level in (1.0, -1.0):
            shifted = signed.copy()
            shifted[0] -= level
            roots = np.polynomial.polynomial.polyroots(shifted)
            real = roots[np.abs(roots.imag) < 1e-7 * np.maximum(1.0, np.abs(roots))].real
            crossings.extend(real[real > 1e-6].tolist())
        return float(min(crossings))


EULER: Final = Tableau("euler", a=((),), b=(1.0,))

RK4: Final = Tableau("rk4", a=((), (1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0)), b=(1 / 6, 1 / 3, 1 / 3, 1 / 6))

RKF45: Final = Tableau(
    "rkf45",
    a=(
        (),
        (1 / 4,),
        (3 / 32, 9 / 32),
        (1932 / 2197, -7200 / 2197, 7296 / 2197),
        (439 / 216, -8.0, 3680 / 513, -845 / 4104),
        (-8 / 27, 2.0, -3544 / 2565, 1859 / 4104, -11 / 40),
    ),
    b=(16 / 135, 0.0, 6656 / 12825, 28561 / 56430, -9 / 50, 2 / 55),
    embedded=(25 / 216, 0.0, 1408 / 2565, 2197 / 4104, -1 / 5, 0.0),
)

TABLEAUS: Final = {table.name: table for table in (EULER, RK4, RKF45)}


def reference_solution(
    derivative: Callable[[float, Floats], Floats], start: Floats, times: Floats, *, breaks: tuple[float, ...] = ()
) -> Floats:
    """Dormand–Prince of order 8 with a variable step (scipy's DOP853), accurate to about 1e-10.

    Args:
        derivative: right-hand side f(t, y).
        start: y at times[0], (n,).
        times: where the solution is wanted, ascending, s, (m,).
        breaks: times at which the right-hand side jumps: no step goes across one.

    Returns:
        y at `times`, (n, m).
    """
    from scipy.integrate import solve_ivp

    edges = [float(times[0]), *(t for t in breaks if times[0] < t < times[-1]), float(times[-1])]
    result = np.empty((start.size, times.size))
    y = np.asarray(start, dtype=np.float64)
    for begin, end in pairwise(edges):
        # The right-hand side of a piece is that of its inside, also at its two ends.
        margin = 1e-12 * max(1.0, end)

        def inside(t: float, y: Floats, begin: float = begin + margin, end: float = end - margin) -> Floats:
            return derivative(min(max(t, begin), end), y)

        within = (times >= begin) & (times <= end)
        piece = solve_ivp(inside, (begin, end), y, method="DOP853", rtol=1e-10, atol=1e-13, dense_output=True)
        assert piece.sol is not None
        result[:, within] = piece.sol(times[within])
        y = piece.y[:, -1]
    return result
