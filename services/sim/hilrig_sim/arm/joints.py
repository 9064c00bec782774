"""The joints: their names, and the units in which they are displayed."""

import math
from typing import Final

JOINT_NAMES: Final = ("theta1", "theta2", "d3", "theta4")
JOINT_SCALE: Final = (math.degrees(1.0), math.degrees(1.0), 1e3, math.degrees(1.0))
"""Factors from rad and m to the displayed ° and mm."""
