"""Scenes that move: the tables of what moves, and what a frame changes on the device."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.scene import animation
from psf_cl.scene.model import Mesh, Scene, Shape, emits, has_tangents
from psf_cl.stages.spec import MovingCounts


def moving_shapes(scene: Scene) -> list[Shape]:
    """Return the visible shapes whose triangles move; they are the last ones."""
    if not scene.nodes:
        return []
    return [shape for shape in tables.visible_shapes(scene) if animation.moves(scene, shape)]


def count_moving(scene: Scene) -> MovingCounts | None:
    """Return the sizes of the tables of what moves, or None if nothing does."""
    shapes = moving_shapes(scene)
    if not shapes:
        return None
    vertices = [_vertex_count(scene, shape) for shape in shapes]
    targets = [animation.target_count(shape.mesh) for shape in shapes]
    return MovingCounts(
        triangles=sum(len(shape.mesh.triangles) for shape in shapes),
        vertices=sum(vertices),
        influences=sum(vertices) * max(_influence_count(shape) for shape in shapes),
        deltas=sum(count * of for count, of in zip(vertices, targets, strict=True)),
        matrices=sum(_matrix_count(shape) for shape in shapes),
        weights=sum(targets),
    )


def _vertex_count(scene: Scene, shape: Shape) -> int:
    if _has_corner_tangents(scene, shape):
        return 3 * len(shape.mesh.triangles)
    return len(shape.mesh.positions)


def _has_corner_tangents(scene: Scene, shape: Shape) -> bool:
    """Return whether the tangents of a vertex differ from triangle to triangle."""
    return has_tangents(scene.materials[shape.material])


def _influence_count(shape: Shape) -> int:
    return 1 if shape.skin is None or shape.mesh.joints is None else shape.mesh.joints.shape[1]


def _matrix_count(shape: Shape) -> int:
    return 1 if shape.skin is None else len(shape.skin.joints)


@dataclass(frozen=True)
class MovingTables:
    """What moves, at rest; v vertices, t triangles, k influences a vertex.

    Attributes:
        first_triangle: of the scene, from which on all move.
        rest: ``(v,)`` layout.REST_VERTEX.
        influences: ``(v, k, 2)`` uint32: index of a matrix, and the bits of a float32 weight.
        deltas: ``(d,)`` layout.MORPH_DELTA.
        faces: ``(t, 3)`` uint32.
    """

    first_triangle: int
    rest: np.ndarray
    influences: np.ndarray
    deltas: np.ndarray
    faces: np.ndarray

    @property
    def influence_count(self) -> int:
        return self.influences.shape[1]


def moving_tables(scene: Scene) -> MovingTables:
    """Return the tables of what moves in ``scene``."""
    shapes = moving_shapes(scene)
    total = sum(len(shape.mesh.triangles) for shape in tables.visible_shapes(scene))
    count = max((_influence_count(shape) for shape in shapes), default=1)
    rest, influences, deltas, faces = [], [], [], []
    vertex_start = matrix_start = weight_start = delta_start = 0
    for shape in shapes:
        mesh, tangents = _with_tangents(scene, shape)
        size = len(mesh.positions)
        targets = animation.target_count(mesh)
        vertices = np.zeros(size, layout.REST_VERTEX.dtype)
        vertices["p"] = mesh.positions
        if mesh.normals is not None:
            vertices["n"] = mesh.normals
        if tangents is not None:
            vertices["t"] = tangents
        vertices["first_delta"] = delta_start + targets * np.arange(size)
        vertices["delta_count"] = targets
        rest.append(vertices)
        joints, weights = np.zeros((size, count), np.uint32), np.zeros((size, count), np.float32)
        if shape.skin is None or mesh.joints is None or mesh.weights is None:
            weights[:, 0] = 1.0
        else:
            joints[:, : mesh.joints.shape[1]] = mesh.joints
            weights[:, : mesh.joints.shape[1]] = mesh.weights
        joints += np.uint32(matrix_start)
        influences.append(np.stack([joints, weights.view(np.uint32)], axis=-1))
        deltas.append(_deltas(mesh, targets, weight_start))
        faces.append(mesh.triangles + np.uint32(vertex_start))
        vertex_start += size
        matrix_start += _matrix_count(shape)
        weight_start += targets
        delta_start += size * targets
    all_faces = np.concatenate(faces)
    return MovingTables(
        total - len(all_faces),
        np.concatenate(rest),
        np.concatenate(influences),
        np.concatenate(deltas),
        all_faces,
    )


def _deltas(mesh: Mesh, targets: int, weight_start: int) -> np.ndarray:
    """Return the differences of all targets, vertex by vertex."""
    size = len(mesh.positions)
    table = np.zeros((size, targets), layout.MORPH_DELTA.dtype)
    if mesh.morphs is None or not targets:
        return table.reshape(-1)
    table["weight"] = weight_start + np.arange(targets)
    for name, part in (
        ("p", mesh.morphs.positions),
        ("n", mesh.morphs.normals),
        ("t", mesh.morphs.tangents),
    ):
        if part is not None:
            table[name] = part.transpose(1, 0, 2)
    return table.reshape(-1)


def _with_tangents(scene: Scene, shape: Shape) -> tuple[Mesh, np.ndarray | None]:
    """Return the mesh, with a vertex for every corner if it needs tangents, and these."""
    mesh = shape.mesh
    if not _has_corner_tangents(scene, shape):
        return mesh, None
    corners = mesh.triangles.reshape(-1)

    def at_corners(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[corners]

    morphs = mesh.morphs
    if morphs is not None:
        parts = (morphs.positions, morphs.normals, morphs.tangents)
        morphs = type(morphs)(*(None if part is None else part[:, corners] for part in parts))
    tangents = np.stack(tables.object_tangents(scene, shape), axis=1).reshape(-1, 4)
    split = replace(
        mesh,
        positions=mesh.positions[corners],
        triangles=np.arange(len(corners), dtype=np.uint32).reshape(-1, 3),
        normals=at_corners(mesh.normals),
        joints=at_corners(mesh.joints),
        weights=at_corners(mesh.weights),
        morphs=morphs,
    )
    return split, tangents


def pose(scene: Scene, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices, ``(m, 12)``, and morph weights, ``(w,)``, of a frame; float32.

    Raises:
        InputError: a transform is not finite.
    """
    world = animation.checked_transforms(scene, time)
    matrices, weights = [np.zeros((0, 3, 4))], [np.zeros(0)]
    for shape in moving_shapes(scene):
        if shape.skin is not None:
            matrices.append(animation.joint_matrices(scene, shape, world)[:, :3])
        else:
            matrix = world[shape.node] if shape.node >= 0 else shape.transform
            matrices.append(matrix[None, :3])
        if shape.mesh.morphs is not None:
            weights.append(animation.morph_weights(scene, shape, time))
    return (
        np.concatenate(matrices).reshape(-1, 12).astype(np.float32),
        np.concatenate(weights).astype(np.float32),
    )


def corner_labels(scene: Scene) -> np.ndarray | None:
    """Return for each corner of the scene which moving vertex it is; -1 where nothing moves.

    Vertices that always move alike have one label, that of the first.

    Returns:
        ``(triangles, 3)`` int64, or None if nothing moves.
    """
    if not moving_shapes(scene):
        return None
    moving = moving_tables(scene)
    rows = [moving.rest["p"].view(np.uint32), moving.influences.reshape(len(moving.rest), -1)]
    labels = np.full((moving.first_triangle, 3), -1, np.int64)
    targets = int(moving.rest["delta_count"].max(initial=0))
    own = np.zeros((len(moving.rest), targets, 4), np.float32)
    for k in range(targets):
        has = moving.rest["delta_count"] > k
        delta = moving.deltas[moving.rest["first_delta"][has] + k]
        own[has, k, :3] = delta["p"]
        own[has, k, 3] = delta["weight"] + 1
    rows.append(own.reshape(len(moving.rest), -1).view(np.uint32))
    _, first, index = np.unique(
        np.concatenate(rows, axis=1), axis=0, return_index=True, return_inverse=True
    )
    return np.concatenate([labels, first[index.reshape(-1)][moving.faces]])


class Reach:
    """How far what moves may be from a point: by boxes that each matrix takes along."""

    def __init__(self, scene: Scene) -> None:
        corners, slack, weights = [], [], []
        weight_start = 0
        for shape in moving_shapes(scene):
            points = shape.mesh.positions[np.isfinite(shape.mesh.positions).all(axis=1)]
            ends = np.array([[0.0] * 3] * 2)
            if len(points):
                ends = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
            box = ends[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]
            targets = animation.target_count(shape.mesh)
            span = np.zeros(targets)
            if shape.mesh.morphs is not None and shape.mesh.morphs.positions is not None:
                span = np.linalg.norm(shape.mesh.morphs.positions, axis=2).max(axis=1)
            count = _matrix_count(shape)
            corners += [box] * count
            slack += [span] * count
            weights += [weight_start] * count
            weight_start += targets
        self.corners = np.array(corners)
        self.slack = slack
        self.starts = weights

    def at(self, center: np.ndarray, matrices: np.ndarray, weights: np.ndarray) -> float:
        """Return the largest distance from ``center`` under what ``pose`` returned."""
        rows = matrices.reshape(-1, 3, 4).astype(np.float64)
        points = np.einsum("mij,mcj->mci", rows[:, :, :3], self.corners) + rows[:, None, :, 3]
        far = np.linalg.norm(points - center, axis=2).max(axis=1)
        stretch = np.linalg.norm(rows[:, :, :3], axis=(1, 2))
        for index, (span, start) in enumerate(zip(self.slack, self.starts, strict=True)):
            far[index] += stretch[index] * float(np.abs(weights[start : start + len(span)]) @ span)
        return float(far.max(initial=0.0))


def lights_change(scene: Scene) -> bool:
    """Return whether what shines, or where, depends on the time."""
    return (
        any(light.node >= 0 or light.intensity_curve is not None for light in scene.lights)
        or any(material.emission_curve is not None for material in scene.materials)
        or any(emits(scene.materials[shape.material]) for shape in moving_shapes(scene))
    )


def lights_at(
    scene: Scene, time: float, sampling: str, radius: float, before: np.ndarray
) -> np.ndarray:
    """Return what ``tables.light_table`` does for ``scene`` at ``time``, in the same order.

    Args:
        radius: of the scene, m.
        before: the table at another time, which says which triangles these are.
    """
    emitting = [
        shape for shape in tables.visible_shapes(scene) if emits(scene.materials[shape.material])
    ]
    at = animation.shaped(replace(scene, shapes=tuple(emitting)), time)
    lights = tables.light_table(at, replace(tables.flatten(at), radius=radius), sampling)
    lights["triangle"] = before["triangle"]
    return lights
