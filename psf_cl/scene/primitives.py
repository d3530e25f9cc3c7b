"""Simple shapes as triangle meshes, for scene files that need no mesh file.

Every front (counter-clockwise side) faces outwards; ``quad`` and ``disk`` lie in the XZ plane and
face +Y, so that without a transform they are a floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from psf_cl.scene.model import Mesh

SPHERE_COLUMNS = 64
SPHERE_ROWS = 32
DISK_SEGMENTS = 64


def quad() -> Mesh:
    """Return the square ``[-1, 1]^2`` in the XZ plane, facing +Y; u grows with x, v with z."""
    positions = [[-1, 0, -1], [-1, 0, 1], [1, 0, 1], [1, 0, -1]]
    uvs = [[0, 0], [0, 1], [1, 1], [1, 0]]
    return _mesh("quad", positions, [[0, 1, 2], [0, 2, 3]], uvs=uvs)


def box() -> Mesh:
    """Return the cube ``[-1, 1]^3``: six flat faces of four vertices, each with u, v in [0, 1]."""
    # Each row: the face's normal, then the directions in which its u and -v grow.
    faces = [
        ([1, 0, 0], [0, 0, -1], [0, 1, 0]),
        ([-1, 0, 0], [0, 0, 1], [0, 1, 0]),
        ([0, 1, 0], [1, 0, 0], [0, 0, -1]),
        ([0, -1, 0], [1, 0, 0], [0, 0, 1]),
        ([0, 0, 1], [1, 0, 0], [0, 1, 0]),
        ([0, 0, -1], [-1, 0, 0], [0, 1, 0]),
    ]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    positions = []
    for normal, right, up in np.array(faces):
        positions.append(normal + corners[:, :1] * right + corners[:, 1:] * up)
    uvs = np.tile((corners * [1, -1] + 1) / 2, (6, 1))
    triangles = 4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return _mesh("box", np.concatenate(positions), triangles, uvs=uvs)


def sphere(columns: int = SPHERE_COLUMNS, rows: int = SPHERE_ROWS) -> Mesh:
    """Return the unit sphere with smooth normals, its vertices on the sphere, its poles on Y.

    u goes once around (to the right as seen from outside, +Z at 0.5), v from +Y (0) to -Y (1).
    """
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    azimuth, polar = (2 * u - 1) * np.pi, v * np.pi
    sine = np.sin(polar)
    points = np.stack([sine * np.sin(azimuth), np.cos(polar), sine * np.cos(azimuth)], axis=-1)
    # The seam and the poles must meet exactly: sin(pi) is not 0 in floating point.
    points[:, -1] = points[:, 0]
    points[0], points[-1] = [0, 1, 0], [0, -1, 0]
    points = points.reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    corner = row * (columns + 1) + column
    below = corner + columns + 1
    # At a pole one of the two triangles of each cell would be empty.
    upper = np.stack([corner, below + 1, corner + 1], axis=-1)[1:]
    lower = np.stack([corner, below, below + 1], axis=-1)[:-1]
    triangles = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return _mesh("sphere", points, triangles, uvs=uvs, normals=points)


def disk(segments: int = DISK_SEGMENTS) -> Mesh:
    """Return the disk of radius 1 in the XZ plane, facing +Y; u, v as on ``quad``."""
    angle = 2 * np.pi * np.arange(segments) / segments
    rim = np.stack([np.sin(angle), np.zeros(segments), np.cos(angle)], axis=-1)
    positions = np.concatenate([[[0, 0, 0]], rim])
    index = np.arange(segments)
    triangles = np.stack([0 * index, 1 + index, 1 + (index + 1) % segments], axis=-1)
    return _mesh("disk", positions, triangles, uvs=(positions[:, [0, 2]] + 1) / 2)


PRIMITIVES = {"quad": quad, "box": box, "sphere": sphere, "disk": disk}


def _mesh(
    name: str,
    positions: ArrayLike,
    triangles: ArrayLike,
    uvs: ArrayLike | None = None,
    normals: ArrayLike | None = None,
) -> Mesh:
    return Mesh(
        name=name,
        positions=np.asarray(positions, np.float32),
        triangles=np.asarray(triangles, np.uint32).reshape(-1, 3),
        normals=None if normals is None else np.asarray(normals, np.float32),
        uvs=None if uvs is None else np.asarray(uvs, np.float32),
    )
