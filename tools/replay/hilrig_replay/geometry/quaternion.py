"""Operations on unit quaternions in the order x, y, z, w."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def multiply(left: Floats, right: Floats) -> Floats:
    """Product of two quaternions, (…, 4): the rotation `right` followed by `left`."""
    x1, y1, z1, w1 = np.moveaxis(left, -1, 0)
    x2, y2, z2, w2 = np.moveaxis(right, -1, 0)
    return np.stack(
        (
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ),
        axis=-1,
    )


def rotate(quaternion: Floats, vectors: Floats) -> Floats:
    """Rotate a vector, (3,), or several, (n, 3), by a quaternion, (4,)."""
    u, w = quaternion[:3], quaternion[3]
    return np.asarray(vectors + 2 * np.cross(u, np.cross(u, vectors) + w * vectors))


def about_z(angles: float | Floats) -> Floats:
    """Quaternions, (…, 4), of rotations about z by angles, (…), rad."""
    zero, half = np.zeros_like(angles), np.asarray(angles) / 2
    return np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)


def from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """Quaternion, (4,), of a URDF's `rpy` angles, rad: rotations about the fixed axes x, y and z, in this order."""
    about_x = np.array([np.sin(roll / 2), 0.0, 0.0, np.cos(roll / 2)])
    about_y = np.array([0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2)])
    return multiply(about_z(yaw), multiply(about_y, about_x))
