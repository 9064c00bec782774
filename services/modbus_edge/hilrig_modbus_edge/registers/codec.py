"""Converts between SI units and registers: scaled int16 for the paper's map, 32-bit floats for the extended map.

A register is big-endian; of two registers the more significant one is first. A value beyond int16 saturates
symmetrically at ±32767, and the function returns that it did.
"""

import math
from collections.abc import Sequence
from typing import Final

from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_modbus_edge.registers.map import PAPER_END, POSITION_ADDRESS, REGISTERS, TORQUE_ADDRESS, struct_of

_JOINTS: Final = ("theta1", "theta2", "d3", "theta4")
_PER_SI_UNIT: Final = {"°": (180, math.pi), "mm": (1000, 1)}
"""A register's unit per rad or m, as a fraction: one rounding instead of two."""


def _per_si_unit(name: str) -> float:
    row = REGISTERS[name]
    numerator, denominator = _PER_SI_UNIT[row.unit]
    return row.scale * numerator / denominator


COUNTS_PER_UNIT: Final = tuple(_per_si_unit(joint) for joint in _JOINTS)
"""Counts of the position registers per rad, rad, m, rad."""
FULL_SCALE: Final = 32767

_DISPLAY: Final = tuple(_per_si_unit(f"position_{joint}") for joint in _JOINTS)
EFFORT_SCALE: Final = REGISTERS["tau1"].scale
"""Counts of the torque registers per N·m or N."""
_EFFORTS: Final = struct_of(RegisterTable.HOLDING_REGISTER, TORQUE_ADDRESS, POSITION_ADDRESS)
_POSITIONS: Final = struct_of(RegisterTable.HOLDING_REGISTER, POSITION_ADDRESS, PAPER_END)


def effort_of(words: bytes | bytearray) -> tuple[float, float, float, float]:
    """Return the efforts of four torque registers (8 bytes); N·m, N·m, N, N·m."""
    t1, t2, t3, t4 = _EFFORTS.unpack(words)
    # Division, unlike a factor of 0.001, gives the float nearest to the decimal fraction of the register.
    return t1 / EFFORT_SCALE, t2 / EFFORT_SCALE, t3 / EFFORT_SCALE, t4 / EFFORT_SCALE


def words_of_effort(effort: Sequence[float]) -> tuple[bytes, bool]:
    """Return four torque registers (8 bytes) of efforts (N·m, N·m, N, N·m), and whether one saturated."""
    return _saturate([value * EFFORT_SCALE for value in effort])


def words_of_position(position: Sequence[float]) -> tuple[bytes, bool]:
    """Return four position registers (8 bytes) of a joint vector (rad, rad, m, rad), and whether one saturated."""
    c1, c2, c3, c4 = COUNTS_PER_UNIT
    q1, q2, q3, q4 = position
    q1, q2, q3, q4 = q1 * c1, q2 * c2, q3 * c3, q4 * c4
    limit = FULL_SCALE
    if -limit <= q1 <= limit and -limit <= q2 <= limit and -limit <= q3 <= limit and -limit <= q4 <= limit:
        # Fast path without saturation: this runs for each rig at each step.
        return _POSITIONS.pack(round(q1), round(q2), round(q3), round(q4)), False
    return _saturate([q1, q2, q3, q4])


def position_of(words: bytes | bytearray) -> tuple[float, float, float, float]:
    """Return the joint vector (rad, rad, m, rad) of four position registers (8 bytes)."""
    c1, c2, c3, c4 = COUNTS_PER_UNIT
    n1, n2, n3, n4 = _POSITIONS.unpack(words)
    return n1 / c1, n2 / c2, n3 / c3, n4 / c4


def display_of(values: Sequence[float]) -> tuple[float, float, float, float]:
    """Return four joint values or rates in SI as ° and mm or °/s and mm/s."""
    u1, u2, u3, u4 = _DISPLAY
    q1, q2, q3, q4 = values
    return q1 * u1, q2 * u2, q3 * u3, q4 * u4


def _saturate(values: Sequence[float]) -> tuple[bytes, bool]:
    try:
        counts = [round(value) for value in values]
    except (ValueError, OverflowError):
        # NaN is encoded as zero, infinity as full scale.
        counts = [0 if math.isnan(v) else round(max(-1e6, min(1e6, v))) for v in values]
        return _POSITIONS.pack(*map(_clip, counts)), True
    if min(counts) >= -FULL_SCALE and max(counts) <= FULL_SCALE:
        return _POSITIONS.pack(*counts), False
    return _POSITIONS.pack(*map(_clip, counts)), True


def _clip(count: int) -> int:
    return max(-FULL_SCALE, min(FULL_SCALE, count))
