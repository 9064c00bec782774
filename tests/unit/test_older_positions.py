"""Estimate of the age of the positions that torques answer, from gains of the rounding errors."""

import numpy as np
import pytest

from hilrig_replay.analysis.client_role.older_positions import older_positions
from hilrig_replay.analysis.feedback import MAX_POLLS, RoundingGains

STEP_NS = 20_000_000
OLDER = np.arange(MAX_POLLS + 1, dtype=float)


def gains(*of_polls: float, statistic: float = 400.0) -> RoundingGains:
    """Gains of joint 2, and none of the others."""
    values, statistics = np.zeros((4, MAX_POLLS + 1)), np.zeros((4, MAX_POLLS + 1))
    values[1] = of_polls
    statistics[1] = statistic * (values[1] / np.abs(values[1]).max()) ** 2
    return RoundingGains(values, statistics, OLDER)


@pytest.mark.parametrize(
    ("of_polls", "mean_ms"),
    [
        ((-0.2, 0.0, 0.0, 0.0), 0.0),
        ((0.0, -0.2, 0.0, 0.0), 20.0),
        ((-0.1, -0.1, 0.0, 0.0), 10.0),
        ((-0.1, -0.1, 0.05, 0.0), 10.0),
        ((0.0, -0.1, -0.1, 0.1), 30.0),
    ],
)
def test_mean_age_of_the_answered_positions(of_polls: tuple[float, ...], mean_ms: float) -> None:
    found = older_positions(gains(*of_polls), STEP_NS)
    assert found is not None
    assert found.mean_ms == pytest.approx(mean_ms)
    assert 10.0 <= found.error_ms <= 14.0


def test_torques_without_rounding_errors_show_nothing() -> None:
    assert older_positions(gains(-0.1, 0.0, 0.0, 0.0, statistic=1.0), STEP_NS) is None
