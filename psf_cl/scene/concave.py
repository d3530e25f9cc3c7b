"""Polygons whose fan from the first corner would fold over are cut into triangles by their ears.

Source: Meisters, "Polygons Have Ears", American Mathematical Monthly 82 (6), 1975.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

#: Polygons with more corners stay fans: the time grows at worst with the cube of their number.
MAX_CORNERS = 1000


def folded(points: np.ndarray) -> np.ndarray:
    """Return ``(n,)`` bool: whose fan has a triangle that turns against its polygon.

    Args:
        points: ``(n, corners, 3)`` positions, polygons of one size.
    """
    if not 3 < points.shape[1] <= MAX_CORNERS:
        return np.zeros(len(points), bool)
    edges = points[:, 1:].astype(np.float64) - points[:, :1]
    with np.errstate(invalid="ignore", over="ignore"):
        normals = np.cross(edges[:, :-1], edges[:, 1:])
        # Their sum is twice the area of the polygon, by Newell's method.
        whole = normals.sum(axis=1)
        turns = np.einsum("nti,ni->nt", normals, whole)
        # Corners on a line give triangles of no area, with any sign.
        return (turns < -1e-6 * np.einsum("ni,ni->n", whole, whole)[:, None]).any(axis=1)


def ears(points: np.ndarray) -> np.ndarray:
    """Return ``(corners - 2, 3)`` places in ``points`` of the triangles of a folded polygon.

    What crosses itself has no such triangles: from where no ear is left the rest is a fan.

    Args:
        points: ``(corners, 3)``, at least 4.
    """
    if len(points) == 4:
        # Only one other way is there to cut it.
        return np.array([[1, 2, 3], [1, 3, 0]])
    edges = points.astype(np.float64) - points[0]
    whole = np.cross(edges[:-1], edges[1:]).sum(axis=0)
    axis = int(np.abs(whole).argmax())
    flat = np.delete(edges, axis, axis=1)
    # The two axes that are left, with the polygon counterclockwise in them.
    if (whole[axis] < 0) != (axis == 1):
        flat = flat[:, ::-1]
    left = list(range(len(flat)))
    triangles = []
    at = 0
    misses = 0
    while len(left) > 3 and misses < len(left):
        place = (left[at - 1], left[at], left[(at + 1) % len(left)])
        if _is_ear(flat, left, place):
            triangles.append(place)
            del left[at]
            misses = 0
        else:
            at += 1
            misses += 1
        at %= len(left)
    triangles += [(left[0], a, b) for a, b in pairwise(left[1:])]
    return np.array(triangles)


def _is_ear(flat: np.ndarray, left: list[int], place: tuple[int, int, int]) -> bool:
    """Return whether the triangle at ``place`` turns left and has no other corner in it."""
    corners = flat[list(place)]
    if not _sides(corners, corners[1])[2] > 0:
        return False
    others = flat[[i for i in left if i not in place]]
    inside = (_sides(corners, others) >= 0).all(axis=0)
    # Corners that a polygon with a bridge to its hole meets twice are in nobody's way.
    inside &= (others[:, None] != corners).any(axis=2).all(axis=1)
    return not bool(inside.any())


def _sides(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return ``(3, ...)``: positive where ``points`` lie to the left of the edges of a triangle."""
    along = np.roll(corners, -1, axis=0) - corners
    shape = (3,) + (1,) * (points.ndim - 1)
    toward = points[None] - corners.reshape(*shape, 2)
    return along[:, 0].reshape(shape) * toward[..., 1] - along[:, 1].reshape(shape) * toward[..., 0]
