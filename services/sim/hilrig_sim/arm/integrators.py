"""Explicit fixed-step Runge–Kutta methods as Butcher tables with stability limits, and a variable-step reference.

The default real-time method is Runge–Kutta–Fehlberg with a fixed step: the fifth-order solution is used, and the
embedded fourth-order solution gives an error estimate. The methods differ in their table only; `stepping` applies it.
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
    """Butcher table of an explicit method with s stages."""

    name: str
    a: tuple[tuple[float, ...], ...]
    """Row i has the i coefficients of the previous stages."""
    b: tuple[float, ...]
    """Weights of the solution, s."""
    embedded: tuple[float, ...] | None = None
    """Weights of the embedded solution of another order, s; None: the method has none."""

    @property
    def stages(self) -> int:
        """Number of evaluations of the right-hand side per step."""
        return len(self.b)

    @property
    def error_weights(self) -> tuple[float, ...]:
        """b minus the embedded weights; zeros without embedded solution."""
        if self.embedded is None:
            return (0.0,) * self.stages
        return tuple(b - e for b, e in zip(self.b, self.embedded, strict=True))

    def negative_real_limit(self, weights: tuple[float, ...] | None = None) -> float:
        """Return the stability limit |hλ| on the negative real axis; `weights`: other weights than b.

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
    """Solve an initial value problem with scipy's variable-step DOP853 (order 8), accurate to about 1e-10.

    Args:
        derivative: right-hand side f(t, y).
        start: y at times[0], (n,).
        times: times of the solution, ascending, s, (m,).
        breaks: times at which the right-hand side is discontinuous: no step crosses one.

    Returns:
        y at `times`, (n, m).
    """
    from scipy.integrate import solve_ivp

    edges = [float(times[0]), *(t for t in breaks if times[0] < t < times[-1]), float(times[-1])]
    result = np.empty((start.size, times.size))
    y = np.asarray(start, dtype=np.float64)
    for begin, end in pairwise(edges):
        # At its two ends, an interval uses the right-hand side of its interior.
        margin = 1e-12 * max(1.0, end)

        def inside(t: float, y: Floats, begin: float = begin + margin, end: float = end - margin) -> Floats:
            return derivative(min(max(t, begin), end), y)

        within = (times >= begin) & (times <= end)
        interval = solve_ivp(inside, (begin, end), y, method="DOP853", rtol=1e-10, atol=1e-13, dense_output=True)
        assert interval.sol is not None
        result[:, within] = interval.sol(times[within])
        y = interval.y[:, -1]
    return result
