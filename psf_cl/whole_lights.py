"""Which triangles are one light: rectangles, disks and spheres that stand still and glow evenly."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from psf_cl.device import layout
from psf_cl.scene import primitives
from psf_cl.scene.model import Material, Mesh, Scene, Shape, emits

#: By how much, relative to their sizes, triangles may miss the shape that they are taken for.
SLACK = 1e-5

#: More triangles than these are not looked through for rectangles: each of them is small.
MOST_IN_RECTANGLES = 4096


@dataclass(frozen=True)
class WholeLight:
    """A light that several triangles make, which follow one another.

    Attributes:
        first, count: which of the triangles that emit.
        flag: in layout.LIGHT, of its kind.
        position, e1, e2, direction: ``(3,)`` float64, the fields of its record.
        brightest: what it sends along its brightest direction, over what a flat light of its area
            does.
    """

    first: int
    count: int
    flag: int
    position: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    direction: np.ndarray
    brightest: float = 1.0


def lights_move(scene: Scene) -> bool:
    """Return whether the table of lights is another one at another time."""
    glow = any(material.emission_curve is not None for material in scene.materials)
    return (
        bool(scene.nodes)
        or glow
        or any(light.intensity_curve is not None for light in scene.lights)
    )


def glows_evenly(material: Material) -> bool:
    """Return whether a material sends out the same everywhere."""
    return emits(material) and material.alpha_mode == "opaque" and material.emission_texture < 0


def find_whole_lights(
    scene: Scene,
    shapes: Sequence[Shape],
    surfaces: np.ndarray,
    triangles: np.ndarray,
    kinds: Collection[str],
) -> list[WholeLight]:
    """Return the lights that are more than a triangle; none in scenes whose lights move.

    Args:
        shapes: what ``shape`` of the surfaces counts.
        surfaces: ``(m,)`` layout.SURFACE of all triangles.
        triangles: ``(n,)`` indices of those that emit, ascending.
        kinds: which are wanted, of ``"rectangles"`` (disks too) and ``"spheres"``.
    """
    if lights_move(scene):
        return []
    found = _spheres(scene, shapes, surfaces, triangles) if "spheres" in kinds else []
    if "rectangles" in kinds:
        found += _disks(scene, shapes, surfaces, triangles)
        free = np.ones(len(triangles), bool)
        for light in found:
            free[light.first : light.first + light.count] = False
        places = np.flatnonzero(free)
        for light in _rectangles(scene, surfaces, triangles[free]):
            found.append(replace(light, first=int(places[light.first])))
    return found


def _spheres(
    scene: Scene, shapes: Sequence[Shape], surfaces: np.ndarray, triangles: np.ndarray
) -> list[WholeLight]:
    """Return the spheres of scene.primitives that are round in the world."""
    spheres = []
    for first, shape in _whole_shapes(shapes, surfaces, triangles):
        if is_round(scene, shape):
            x, y, z = shape.transform[:3, :3].T
            center, axis = shape.transform[:3, 3], y / np.linalg.norm(y)
            flag, count = layout.CONSTANT["LIGHT_SPHERE"], len(shape.mesh.triangles)
            # Seen from afar a sphere is a disk with a quarter of its area.
            spheres.append(WholeLight(first, count, flag, center, x, z, axis, 0.25))
    return spheres


def _disks(
    scene: Scene, shapes: Sequence[Shape], surfaces: np.ndarray, triangles: np.ndarray
) -> list[WholeLight]:
    """Return the disks of scene.primitives, and ellipses whose axes are the disk's."""
    disks = []
    for first, shape in _whole_shapes(shapes, surfaces, triangles):
        x, _, z = shape.transform[:3, :3].T
        lengths = np.linalg.norm(x) * np.linalg.norm(z)
        if (
            glows_evenly(scene.materials[shape.material])
            and _is_mesh(shape.mesh, _model("disk"))
            and abs(x @ z) <= SLACK * lengths
        ):
            corner = shape.transform[:3, 3] - x - z
            flag = layout.CONSTANT["LIGHT_RECTANGLE"] | layout.CONSTANT["LIGHT_DISK"]
            normal, count = surfaces["ng"][triangles[first]], len(shape.mesh.triangles)
            disks.append(WholeLight(first, count, flag, corner, 2 * x, 2 * z, normal))
    return disks


def _whole_shapes(
    shapes: Sequence[Shape], surfaces: np.ndarray, triangles: np.ndarray
) -> Iterator[tuple[int, Shape]]:
    """Yield the shapes all of whose triangles emit, and the first of these."""
    shape_of = surfaces["shape"][triangles]
    for number, shape in enumerate(shapes):
        first, end = np.searchsorted(shape_of, [number, number + 1])
        if end > first and end - first == len(shape.mesh.triangles):
            yield int(first), shape


def is_round(scene: Scene, shape: Shape) -> bool:
    """Return whether a shape is a sphere that glows evenly."""
    if not glows_evenly(scene.materials[shape.material]):
        return False
    if not _is_mesh(shape.mesh, _model("sphere")):
        return False
    linear = shape.transform[:3, :3].astype(np.float64)
    squares = linear.T @ linear
    size = np.trace(squares) / 3.0
    # float32 holds neither the squares of others nor their areas.
    return bool(1e-24 < size < 1e24 and np.abs(squares - size * np.eye(3)).max() <= SLACK * size)


@cache
def _model(name: str) -> Mesh:
    return primitives.PRIMITIVES[name]()


def _is_mesh(mesh: Mesh, model: Mesh) -> bool:
    return np.array_equal(mesh.positions, model.positions) and np.array_equal(
        mesh.triangles, model.triangles
    )


def _rectangles(scene: Scene, surfaces: np.ndarray, triangles: np.ndarray) -> list[WholeLight]:
    """Return the pairs of triangles that make rectangles; of very many lights none.

    They follow one another in a mesh, share an edge, face one way and glow evenly.  No triangle is
    in two.
    """
    if not 2 <= len(triangles) <= MOST_IN_RECTANGLES:
        return []
    even = np.array([glows_evenly(material) for material in scene.materials])
    a, b = surfaces[triangles[:-1]], surfaces[triangles[1:]]
    together = (a["shape"] == b["shape"]) & (triangles[1:] == triangles[:-1] + 1)
    together &= even[a["material"]] & ((a["ng"] * b["ng"]).sum(axis=1) > 0.999)
    found: list[WholeLight] = []
    for first in np.flatnonzero(together):
        if found and found[-1].first == first - 1:
            continue
        corners = _rectangle(a[first], b[first])
        if corners is not None:
            flag = layout.CONSTANT["LIGHT_RECTANGLE"]
            found.append(WholeLight(int(first), 2, flag, *corners, a[first]["ng"]))
    return found


def _rectangle(a: np.void, b: np.void) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return a corner and the edges from it of the rectangle that two triangles make, if any."""
    one, other = (
        np.stack([t["p0"], t["p0"] + t["e1"], t["p0"] + t["e2"]]).astype(np.float64) for t in (a, b)
    )
    size = np.ptp(np.concatenate([one, other]), axis=0).max()
    same = np.abs(one[:, None] - other[None]).max(axis=2) <= SLACK * size
    # One corner of each triangle is none of the other's; the two others are, each one of them.
    apart, beyond = np.flatnonzero(~same.any(axis=1)), np.flatnonzero(~same.any(axis=0))
    if same.sum() != 2 or len(apart) != 1 or len(beyond) != 1:
        return None
    k = int(apart[0])
    corner = one[k]
    e1, e2 = one[(k + 1) % 3] - corner, one[(k + 2) % 3] - corner
    misses = np.abs(corner + e1 + e2 - other[beyond[0]]).max()
    lengths = np.linalg.norm(e1) * np.linalg.norm(e2)
    if misses > SLACK * size or abs(e1 @ e2) > SLACK * lengths:
        return None
    return corner, e1, e2
