"""Static geometry of the scenes: ground, table and trays, and the height of the surface under a disc."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_sim.arm.model import SceneParameters

Floats = NDArray[np.float64]
Rigs = NDArray[np.int64] | slice
"""Indices of rigs, or a slice of all rigs."""

FAR_AWAY_M: Final = 1e9
"""Coordinate of the unused parts and trays of a rig, m."""
CONTACT_TOLERANCE_M: Final = 1e-9
"""Largest distance of two surfaces that touch, m."""
TABLE_ABOVE_GROUND_M: Final = 0.75
"""Height of the table top above the ground, m."""


class StaticGeometry:
    """Ground, tables and trays of N rigs."""

    def __init__(self, scenes: Sequence[SceneParameters], reach: float) -> None:
        count = len(scenes)
        self._table = np.array([scene.table_height for scene in scenes])
        self._table_center = np.array([scene.table_centre for scene in scenes]).T.copy()
        self._table_half = np.array([scene.table_size for scene in scenes]).T / 2
        edge = self._table_half - np.abs(self._table_center)
        magnet_reach = max(scene.magnet_reach for scene in scenes)
        self._is_table_everywhere = bool(np.all(edge >= reach + magnet_reach))
        """Whether nothing within reach of the arm can be beside a table."""
        rows = max(len(scene.trays) for scene in scenes)
        self._tray = np.zeros((5, rows, count))
        self._tray[0] = FAR_AWAY_M
        self._half = np.zeros((2, rows, count))
        for rig, scene in enumerate(scenes):
            for row, tray in enumerate(scene.trays):
                top = tray.position[2] + tray.size[2]
                self._tray[:, row, rig] = (*tray.position[:2], np.cos(tray.yaw), np.sin(tray.yaw), top)
                self._half[:, row, rig] = tray.size[0] / 2, tray.size[1] / 2
        self._rows = rows
        self.highest = np.maximum(self._table, self._tray[4].max(axis=0, initial=-np.inf, where=self._half[0] > 0))
        """World z of the highest surface, m, (N,)."""

    def under(
        self, rigs: Rigs, x: Floats, y: Floats, radius: Floats, bottom: Floats, *, in_reach: bool = True
    ) -> Floats:
        """Return the height of the highest surface, m, (K,), that a disc overlaps and that is not above `bottom`.

        `in_reach`: whether the discs are within reach of the arm.
        """
        height = table = self._table[rigs]
        if not (in_reach and self._is_table_everywhere):
            half_x, half_y = self._table_half[:, rigs]
            center_x, center_y = self._table_center[:, rigs]
            beside = (np.abs(x - center_x) > half_x + radius) | (np.abs(y - center_y) > half_y + radius)
            height = np.where(beside | (table > bottom + CONTACT_TOLERANCE_M), table - TABLE_ABOVE_GROUND_M, table)
        if not self._rows:
            return height
        tray_x, tray_y, c, s, top = self._tray[:, :, rigs]
        half_u, half_v = self._half[:, :, rigs]
        dx, dy = x - tray_x, y - tray_y
        u = np.maximum(np.abs(c * dx + s * dy) - half_u, 0.0)
        v = np.maximum(np.abs(c * dy - s * dx) - half_v, 0.0)
        under = (u * u + v * v <= radius * radius) & (top <= bottom + CONTACT_TOLERANCE_M)
        return np.asarray(np.maximum(height, np.where(under, top, -np.inf).max(axis=0)))
