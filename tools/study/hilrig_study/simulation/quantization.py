"""Quantization of positions and efforts by the int16 registers: vectorized form of the register codec."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_modbus_edge.registers.codec import COUNTS_PER_UNIT, EFFORT_SCALE, FULL_SCALE

Floats = NDArray[np.float64]

_COUNTS: Final = np.array(COUNTS_PER_UNIT)[:, np.newaxis]


def position(values: Floats) -> Floats:
    """Quantize joint positions (rad, rad, m, rad), (4, N), as a controller reads them from registers 5-8."""
    return np.asarray(np.clip(np.rint(values * _COUNTS), -FULL_SCALE, FULL_SCALE) / _COUNTS)


def effort(values: Floats) -> Floats:
    """Quantize efforts (N·m, N·m, N, N·m), (4, N), as the simulation gets them from registers 1-4; NaN becomes 0."""
    counts = np.clip(np.rint(values * EFFORT_SCALE), -FULL_SCALE, FULL_SCALE)
    return np.asarray(np.where(np.isnan(counts), 0.0, counts) / EFFORT_SCALE)
