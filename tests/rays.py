"""Triangles and rays for tests of the tracing, and the truth by brute force in double precision."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device.layout import CONSTANT

NO_HIT = CONSTANT["NO_HIT"]


def soup(count: int, seed: int = 0, size: float = 0.3) -> np.ndarray:
    """Return triangles here and there, ``(count, 3, 3)``."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-1, 1, (count, 1, 3))
    return (centers + size * rng.normal(size=(count, 3, 3))).astype(np.float32)


def make_rays(origins: Any, directions: Any, t_max: Any = np.inf) -> np.ndarray:
    """Return rays, ``(n, 7)``: origin, direction, t_max."""
    origins, directions = np.broadcast_arrays(origins, directions)
    ends = np.broadcast_to(np.float32(t_max), (len(origins),))[:, None]
    return np.concatenate([origins, directions, ends], axis=1).astype(np.float32)


def rays_through(count: int, seed: int = 1, scale: float = 1.0) -> np.ndarray:
    """Return rays from all around toward points near the origin."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-2, 2, (count, 3))
    targets = rng.uniform(-1, 1, (count, 3))
    return make_rays(scale * origins, scale * (targets - origins))


def all_hits(triangles: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return t, u, v of every ray with every triangle in float64, and how near the edge it passes.

    Where there is no hit, t is inf.

    Source: Moeller, Trumbore, "Fast, Minimum Storage Ray-Triangle Intersection", 1997.
    """
    p = triangles.astype(np.float64)
    origin, direction, t_max = np.split(rays.astype(np.float64)[:, None], [3, 6], axis=2)
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    with np.errstate(all="ignore"):
        q = np.cross(direction, e2)
        inverse = 1.0 / np.sum(q * e1, axis=2)
        from_corner = origin - p[:, 0]
        u = np.sum(from_corner * q, axis=2) * inverse
        r = np.cross(from_corner, e1)
        v = np.sum(direction * r, axis=2) * inverse
        t = np.sum(e2 * r, axis=2) * inverse
        inside = np.minimum(np.minimum(u, v), 1.0 - u - v)
        hit = (inside >= 0) & (t > 0) & (t < t_max[:, :, 0]) & np.isfinite(inside)
        margin = np.where(t > 0, np.abs(inside), np.inf)
    return np.where(hit, t, np.inf), u, v, np.where(np.isfinite(margin), margin, np.inf)


def check_against_brute_force(
    traced: Any, rays: np.ndarray, margin: float = 1e-4
) -> tuple[np.ndarray, np.ndarray]:
    """Compare every ray that passes no edge within ``margin`` (barycentric).

    ``traced`` has ``triangles`` and finds ``closest`` hits; return what it finds.
    """
    found, distances = traced.closest(rays)
    blocked = traced.any(rays)
    clear = np.ones(len(rays), bool)
    expected_t = np.full(len(rays), np.inf)
    expected = np.full(len(rays), NO_HIT, np.uint32)
    if len(traced.triangles):
        t, _, _, edge = all_hits(traced.triangles, rays)
        clear = edge.min(axis=1) > margin
        expected_t = t.min(axis=1)
        expected = np.where(np.isfinite(expected_t), t.argmin(axis=1), NO_HIT)
    assert clear.mean() > 0.5
    np.testing.assert_array_equal(found[clear], expected[clear])
    np.testing.assert_array_equal(blocked[clear], expected[clear] != NO_HIT)
    hit = clear & (expected != NO_HIT)
    np.testing.assert_allclose(distances[hit, 0], expected_t[hit], rtol=1e-4, atol=1e-6)
    return found, distances


def closed_sphere(rings: int, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Return corners ``(n, 3)`` and faces of a lumpy, closed sphere around the origin."""
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2 * np.pi * np.arange(segments) / segments
    theta, phi = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    radius = 1 + 0.2 * np.sin(5 * theta) * np.cos(3 * phi) + 0.05 * np.sin(17 * phi + 9 * theta)
    directions = np.stack(
        [np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=1
    )
    points = np.concatenate([directions * radius[:, None], [[0, 1, 0], [0, -1, 0]]])
    ring, segment = np.divmod(np.arange((rings - 2) * segments), segments)
    a = ring * segments + segment
    b = ring * segments + (segment + 1) % segments
    c, d = a + segments, b + segments
    top, bottom = len(points) - 2, len(points) - 1
    rim, following = np.arange(segments), (np.arange(segments) + 1) % segments
    last = (rings - 2) * segments
    faces = np.concatenate(
        [
            np.stack([a, b, c], axis=1),
            np.stack([b, d, c], axis=1),
            np.stack([np.full(segments, top), following, rim], axis=1),
            np.stack([np.full(segments, bottom), last + rim, last + following], axis=1),
        ]
    )
    return points, faces


def rays_at_edges(
    points: np.ndarray, faces: np.ndarray, origins: np.ndarray, seed: int
) -> np.ndarray:
    """Aim at corners and at points of edges, a third of them the middles."""
    rng = np.random.default_rng(seed)
    count = len(origins)
    corners = points[faces[rng.integers(0, len(faces), count)]]
    first = rng.integers(0, 3, count)
    a = corners[np.arange(count), first]
    b = corners[np.arange(count), (first + 1) % 3]
    part = np.select(
        [np.arange(count) % 3 == 0, np.arange(count) % 3 == 1],
        [np.zeros(count), np.full(count, 0.5)],
        rng.random(count),
    ).astype(np.float32)
    return make_rays(origins, a + part[:, None] * (b - a) - origins)
