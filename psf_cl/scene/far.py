"""Scenes far away from the origin, where single precision has no digits left for their shapes."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from psf_cl.scene import animation, transform
from psf_cl.scene.model import Mesh, Node, Scene, Shape, View

#: A scene is far away if the origin is so many times as far from its middle as its corners are.
#: Coordinates have 24 bits: as far out as this they still have 22 for what is in the scene.
FAR = 4.0


def far_from_origin(scene: Scene) -> np.ndarray | None:
    """Return the middle of a scene that is far away from the origin, ``(3,)`` float64, else None.

    Transforms are double precision, so that a scene loses nothing by being moved; vertices that
    were read as far-away numbers of single precision have lost their digits before.  What moves
    counts where it is at rest.
    """
    world = animation.world_transforms(scene.nodes, None)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    boxes: dict[int, np.ndarray] = {}  # Many shapes may share one large mesh.
    for shape in scene.shapes:
        if id(shape.mesh) not in boxes:
            boxes[id(shape.mesh)] = _box_corners(shape.mesh)
        corners = boxes[id(shape.mesh)]
        if not len(corners):
            continue
        matrices = _matrices(scene, shape, world)
        with np.errstate(all="ignore"):
            placed = corners @ matrices[:, :3, :3].transpose(0, 2, 1) + matrices[:, None, :3, 3]
        if np.isfinite(placed).all():
            low = np.minimum(low, placed.min(axis=(0, 1)))
            high = np.maximum(high, placed.max(axis=(0, 1)))
    if not (low <= high).all():
        return None
    middle, radius = (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0
    return middle if np.linalg.norm(middle) > FAR * radius > 0.0 else None


def _matrices(scene: Scene, shape: Shape, world: np.ndarray) -> np.ndarray:
    """Return what takes a shape to the world, ``(n, 4, 4)``: of a skin, each of its joints."""
    if shape.skin is not None:
        return animation.joint_matrices(scene, shape, world)
    return (shape.transform if shape.node < 0 else world[shape.node])[None]


def _box_corners(mesh: Mesh) -> np.ndarray:
    """Return the corners of the box around the finite vertices, ``(8, 3)``, or ``(0, 3)``."""
    points = mesh.positions[np.isfinite(mesh.positions).all(axis=1)]
    if not len(points):
        return np.zeros((0, 3))
    box = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
    return np.array(list(itertools.product(*box.T)))


def moved(scene: Scene, by: np.ndarray) -> Scene:
    """Return the scene with everything that has a place in it moved ``by`` meters, ``(3,)``."""
    shift = transform.translation(by)
    return replace(
        scene,
        shapes=tuple(
            # Joints take a skin along.
            s if s.skin is not None else replace(s, transform=shift @ s.transform)
            for s in scene.shapes
        ),
        cameras=tuple(
            replace(
                camera,
                transform=shift @ camera.transform,
                view=None if camera.view is None else _moved_view(camera.view, by),
            )
            for camera in scene.cameras
        ),
        lights=tuple(
            replace(light, position=tuple((np.asarray(light.position) + by).tolist()))
            for light in scene.lights
        ),
        nodes=tuple(node if node.parent >= 0 else _moved_node(node, by) for node in scene.nodes),
    )


def _moved_node(node: Node, by: np.ndarray) -> Node:
    if node.matrix is not None:
        return replace(node, matrix=transform.translation(by) @ node.matrix)
    curves = dict(node.curves)
    if "translation" in curves:
        curves["translation"] = curves["translation"].moved(by)
    place = tuple((np.asarray(node.translation) + by).tolist())
    return replace(node, translation=place, curves=curves)


def _moved_view(view: View, by: np.ndarray) -> View:
    return replace(view, position=view.position.moved(by), target=view.target.moved(by))
