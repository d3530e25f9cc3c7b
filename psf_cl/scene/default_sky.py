"""When a model comes without light, or with too little to be seen: a sky.

Most models wait for the light of a viewer, and a lamp on a bottle does not change that; a room that
its lamps light is to stay dark outside.  What tells them apart is how much of what glows comes back
to the surfaces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psf_cl.scene.model import (
    LUMINANCE,
    Environment,
    Material,
    Scene,
    emits,
    has_environment,
    is_invisible,
    lets_through,
    shines,
)
from psf_cl.scene.texture import mean_color
from psf_cl.scene.transform import transform_points

#: Radiance of the default sky: in its middle, and what a unit toward ``SKY_TOWARD`` adds.  White
#: surfaces stand out before it, and sides that face elsewhere are told apart: a matt surface of
#: reflectance 1 shows 0.6 + 0.4 (2 / 3) dot(n, SKY_TOWARD) where nothing is in the way.
SKY_MIDDLE, SKY_SLOPE = 0.6, 0.4

#: Up, and to the left and front of who looks along -Z; unit length.
SKY_TOWARD = (-0.48, 0.768, 0.424)

_SKY_ROWS = 128

#: Light by what glows, over that by a sky of radiance 1, from which on a scene counts as lit.
#: Rooms with lamps have 0.05 and more, models with lamps or labels on them 0.02 and less.
LIT = 0.03

_RAYS = 128
_MOST_TESTS = 1 << 22
_MOST_TRIANGLES = 1 << 18
_CHUNK = 1 << 12


def with_default_sky(scene: Scene, opened: bool) -> Scene:
    """Return the scene with a sky if it has no light, and a note that says so.

    Args:
        opened: whether it is a model file and no ``.toml``, whose author says what light there is:
            then what glows counts only if it lights the scene, ``glow_share`` of ``LIT`` or more.
    """
    if has_environment(scene.environment) or any(map(shines, scene.lights)):
        return scene
    why = "the scene has no light"
    if any(_glows(scene.materials[shape.material]) for shape in scene.shapes):
        if not opened or (share := glow_share(scene)) >= LIT:
            return scene
        why = (
            f"the scene is hardly lit by what glows ({100 * share:.2g} % of what a sky would bring)"
        )
    low, high = SKY_MIDDLE - SKY_SLOPE, SKY_MIDDLE + SKY_SLOPE
    note = (
        f"{why}: a sky of radiance {low:.1f} to {high:.1f} is added (none with --environment none)"
    )
    return replace(scene, environment=default_sky(), notes=(*scene.notes, note))


def default_sky() -> Environment:
    """Return a white sky that is brightest toward ``SKY_TOWARD`` and darkest on the other side."""
    v, u = np.mgrid[:_SKY_ROWS, : 2 * _SKY_ROWS] + 0.5
    polar, azimuth = v * np.pi / _SKY_ROWS, u * np.pi / _SKY_ROWS
    across = np.sin(polar)
    direction = np.stack(
        [across * np.sin(azimuth), np.cos(polar), -across * np.cos(azimuth)], axis=-1
    )
    radiance = SKY_MIDDLE + SKY_SLOPE * (direction @ SKY_TOWARD)
    image = np.repeat(radiance[..., None], 3, axis=-1).astype(np.float32)
    return Environment((1.0, 1.0, 1.0), image)


def glow_share(scene: Scene) -> float:
    """Return how much light what glows brings to the surfaces, over that of a sky of radiance 1.

    That is pi B r A' / (pi A): B the mean radiance of what glows, A' its area (both sides, if both
    glow), A the area of all surfaces, r the share of its rays that come to a surface which is no
    glass, by rays from random places.  A sky that nothing is in the way of brings pi A.  Of more
    than 2^18 triangles, and where that is below ``LIT`` already, r is taken for 1.
    """
    corners, normals, material = _triangles(scene)
    area = np.linalg.norm(normals, axis=1) / 2
    bright = np.array([_brightness(scene, m) for m in scene.materials])[material]
    power = area * bright
    total, glow = float(area.sum()), float(power.sum())
    if not (0.0 < total < np.inf and 0.0 < glow < np.inf):
        return 0.0 if not glow > 0.0 else np.inf
    if glow / total < LIT or len(corners) > _MOST_TRIANGLES:
        return glow / total
    stops = np.array([not lets_through(m) for m in scene.materials])[material]
    count = min(_RAYS, max(_MOST_TESTS // len(corners), 1))
    chance = np.random.default_rng(1)
    start = chance.choice(len(corners), count, p=power / glow)
    u, v = chance.random((2, count, 1))
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u), np.where(over, 1.0 - v, v)
    a, b, c = np.moveaxis(corners[start], 1, 0)
    origins = a + u * (b - a) + v * (c - a)
    normal = normals[start] / (2.0 * area[start, None])
    both = np.array([m.double_sided for m in scene.materials])[material[start]]
    normal[both & (chance.random(count) < 0.5)] *= -1.0
    # A point of the unit sphere on top of the normal: directions by the cosine.
    sphere = chance.normal(size=(count, 3))
    directions = normal + sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hit = _meets(origins, directions, corners[stops])
    return float(hit.mean()) * glow / total


def _glows(material: Material) -> bool:
    return emits(material) and not is_invisible(material)


def _brightness(scene: Scene, material: Material) -> float:
    """Return the mean luminance that ``material`` emits, of both sides together."""
    if not _glows(material):
        return 0.0
    color = np.asarray(material.emission, np.float64)
    if material.emission_texture >= 0:
        color = color * mean_color(scene.textures[material.emission_texture])
    return float(color @ LUMINANCE) * (2.0 if material.double_sided else 1.0)


def _triangles(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners ``(n, 3, 3)``, normals ``(n, 3)`` and materials ``(n,)`` of what is there.

    Normals point to the front and are twice as long as the area.  The longest side of the box
    around all is 1, so that nothing overflows.
    """
    corners, normals, materials = [], [], []
    with np.errstate(all="ignore"):
        for shape in scene.shapes:
            if is_invisible(scene.materials[shape.material]):
                continue
            placed = transform_points(shape.transform, shape.mesh.positions.astype(np.float64))
            found = placed[shape.mesh.triangles]
            found = found[np.isfinite(found).all(axis=(1, 2))]
            mirrored = np.linalg.det(shape.transform[:3, :3]) < 0.0
            corners.append(found[:, [0, 2, 1]] if mirrored else found)
            materials.append(np.full(len(found), shape.material))
        points = np.concatenate(corners) if corners else np.zeros((0, 3, 3))
        if len(points):
            low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
            points = (points - low) / max(float((high - low).max()), 1e-30)
        normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return points, normals, np.concatenate(materials) if materials else np.zeros(0, int)


def _meets(origins: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return which rays, ``(r, 3)``, meet any of the triangles, ``(n, 3, 3)``: ``(r,)`` bool.

    A line passes a triangle where it passes the same side of all edges (Pluecker coordinates).
    """
    met = np.zeros(len(origins), bool)
    for first in range(0, len(corners), _CHUNK):
        left = np.flatnonzero(~met)
        origin, direction = origins[left], directions[left]
        moment = np.cross(origin, direction)
        some = corners[first : first + _CHUNK]
        sides = []
        for k in range(3):
            a, b = some[:, k], some[:, (k + 1) % 3]
            sides.append(direction @ np.cross(a, b).T + moment @ (b - a).T)
        low = np.minimum(np.minimum(sides[0], sides[1]), sides[2])
        high = np.maximum(np.maximum(sides[0], sides[1]), sides[2])
        normal = np.cross(some[:, 1] - some[:, 0], some[:, 2] - some[:, 0])
        above = (some[:, 0] * normal).sum(axis=1) - origin @ normal.T
        along = direction @ normal.T
        # Not where the ray starts: the box is 1 wide.
        ahead = above * np.sign(along) > 1e-6 * np.abs(along)
        met[left] = (((low > 0.0) | (high < 0.0)) & ahead).any(axis=1)
    return met
