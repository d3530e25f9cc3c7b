"""4x4 matrices that move points: float64, column vectors (``world = M @ object``)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Vector = Sequence[float] | np.ndarray


def translation(offset: Vector) -> np.ndarray:
    """Return the ``(4, 4)`` float64 matrix that moves points by ``offset``, ``(3,)``."""
    matrix = np.eye(4)
    matrix[:3, 3] = offset
    return matrix


def scaling(factor: float | Vector) -> np.ndarray:
    """Return the ``(4, 4)`` float64 matrix that scales by ``factor``, a number or one an axis."""
    matrix = np.eye(4)
    matrix[[0, 1, 2], [0, 1, 2]] = factor
    return matrix


def rotation_xyz_degrees(angles: Vector) -> np.ndarray:
    """Return the ``(4, 4)`` rotation about the fixed axes X, then Y, then Z, counter-clockwise.

    Args:
        angles: ``(3,)``, degrees, one an axis.
    """
    cos_x, cos_y, cos_z = np.cos(np.radians(np.asarray(angles, float)))
    sin_x, sin_y, sin_z = np.sin(np.radians(np.asarray(angles, float)))
    about_x = np.array([[1, 0, 0], [0, cos_x, -sin_x], [0, sin_x, cos_x]])
    about_y = np.array([[cos_y, 0, sin_y], [0, 1, 0], [-sin_y, 0, cos_y]])
    about_z = np.array([[cos_z, -sin_z, 0], [sin_z, cos_z, 0], [0, 0, 1]])
    return _affine(about_z @ about_y @ about_x)


def rotation_quaternion(quaternion: Vector) -> np.ndarray:
    """Return the ``(4, 4)`` rotation of a quaternion ``(x, y, z, w)`` of any length but zero.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    unit = _unit(np.asarray(quaternion, float), "quaternion")
    return _affine(_rotation(*unit))


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Return ``(n, 3, 3)``, the rotations of ``(n, 4)`` quaternions; NaN for zero ones."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.moveaxis(_rotation(*unit.T), -1, 0)


def _rotation(
    x: np.ndarray | float, y: np.ndarray | float, z: np.ndarray | float, w: np.ndarray | float
) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def look_at(position: Vector, target: Vector, up: Vector) -> np.ndarray:
    """Return the camera-to-world matrix that looks from ``position`` along -Z at ``target``.

    Local +Y is ``up`` made perpendicular to the view direction.

    Raises:
        ValueError: ``position`` is ``target``, ``up`` is zero or along the view, or not finite.
    """
    origin = np.asarray(position, float)
    return translation(origin) @ _facing(origin - np.asarray(target, float), np.asarray(up, float))


def without_scale(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation and translation of ``matrix``, its -Z and, as far as it can, its +Y kept.

    A mirroring is dropped with the scale: -Z and +Y stay, the third axis follows.

    Raises:
        ValueError: the matrix flattens -Z or +Y, or is not finite.
    """
    return translation(matrix[:3, 3]) @ _facing(matrix[:3, 2], matrix[:3, 1])


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return ``(n, 3)`` float64 points moved by the affine ``matrix``."""
    return np.asarray(points, float) @ matrix[:3, :3].T + matrix[:3, 3]


def _facing(back: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the rotation whose +Z is ``back`` and whose +Y is as near to ``up`` as can be."""
    back = _unit(back, "view direction")
    right = np.cross(_unit(up, "up"), back)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError("up must not point along the view direction")
    right = _unit(right, "right")
    return _affine(np.column_stack([right, np.cross(back, right), back]))


def _affine(linear: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def _unit(vector: np.ndarray, name: str) -> np.ndarray:
    # Dividing by the largest component first keeps the squares of tiny and huge vectors finite.
    largest = np.abs(vector).max()
    if not (np.isfinite(largest) and largest > 0.0):
        raise ValueError(f"{name} must be finite and not zero")
    scaled = vector / largest
    return scaled / np.linalg.norm(scaled)


def uv_rows(
    offset: Sequence[float], rotation: float, scale: Sequence[float]
) -> tuple[float, float, float, float, float, float]:
    """Return the first two rows of the matrix that scales, rotates and then moves coordinates.

    Args:
        rotation: radians, counter-clockwise as one sees a picture whose v grows downwards.

    Source: KHR_texture_transform.
    """
    cosine, sine = math.cos(rotation), math.sin(rotation)
    return (
        *(cosine * scale[0], sine * scale[1], offset[0]),
        *(-sine * scale[0], cosine * scale[1], offset[1]),
    )
