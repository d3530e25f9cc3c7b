"""A scene at a moment: nodes to matrices, curves to values, vertices to where joints put them.

What moves keeps its curves in a ``posed`` scene; ``baked`` makes a scene of it that stands still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psf_cl.errors import InputError
from psf_cl.scene import transform
from psf_cl.scene.model import Camera, Light, Material, Mesh, Node, Scene, Shape


def world_transforms(nodes: Sequence[Node], time: float | None) -> np.ndarray:
    """Return ``(n, 4, 4)`` float64, node to world.

    Args:
        time: s; None for rest.
    """
    world = np.zeros((len(nodes), 4, 4))
    with np.errstate(over="ignore", invalid="ignore"):
        for index, node in enumerate(nodes):
            local = _local_transform(node, time)
            world[index] = world[node.parent] @ local if node.parent >= 0 else local
    return world


def _local_transform(node: Node, time: float | None) -> np.ndarray:
    if node.matrix is not None:
        return node.matrix
    rotation = node_value(node, "rotation", time)
    if len(rotation) == 3:
        local = transform.rotation_xyz_degrees(rotation)
    else:
        local = transform.rotation_quaternion(rotation)
    local[:3, :3] *= node_value(node, "scale", time)
    local[:3, 3] = node_value(node, "translation", time)
    return local


def node_value(node: Node, name: str, time: float | None) -> np.ndarray:
    """Return translation, rotation, scale or weights of a node at ``time``, or at rest."""
    if time is None or name not in node.curves:
        return np.asarray(getattr(node, name), float)
    return node.curves[name].at(time)


def moves(scene: Scene, shape: Shape) -> bool:
    """Return whether the triangles of ``shape`` are elsewhere at another time."""
    if shape.skin is not None and any(_node_moves(scene, joint) for joint in shape.skin.joints):
        return True
    if shape.node < 0:
        return False
    if shape.mesh.morphs is not None and "weights" in scene.nodes[shape.node].curves:
        return True
    return shape.skin is None and _node_moves(scene, shape.node)


def _node_moves(scene: Scene, index: int) -> bool:
    while index >= 0:
        node = scene.nodes[index]
        if node.curves.keys() - {"weights"}:
            return True
        index = node.parent
    return False


def is_animated(scene: Scene) -> bool:
    """Return whether anything in ``scene`` depends on the time."""
    return (
        any(node.curves for node in scene.nodes)
        or any(material.emission_curve is not None for material in scene.materials)
        or any(light.intensity_curve is not None for light in scene.lights)
        or any(camera.view is not None for camera in scene.cameras)
    )


def posed(scene: Scene, time: float | None) -> Scene:
    """Return ``scene`` with all transforms, cameras, lights and emission as they are at ``time``.

    Vertices stay as the file has them, for ``deformed`` or the device to move.

    Args:
        time: s; None for rest.

    Raises:
        InputError: a transform is not finite, or a camera or light has no direction then.
    """
    if not (scene.nodes or is_animated(scene)):
        return scene
    world = checked_transforms(scene, time)
    return replace(
        scene,
        shapes=tuple(_posed_shape(shape, world) for shape in scene.shapes),
        cameras=tuple(_posed_camera(scene, camera, world, time) for camera in scene.cameras),
        lights=tuple(_posed_light(scene, light, world, time) for light in scene.lights),
        materials=tuple(_posed_material(material, time) for material in scene.materials),
    )


def checked_transforms(scene: Scene, time: float | None) -> np.ndarray:
    """Return ``world_transforms`` of a scene's nodes.

    Raises:
        InputError: one is not finite.
    """
    world = world_transforms(scene.nodes, time)
    if not np.isfinite(world).all():
        raise InputError(f"{scene.path}: a transform is not finite {_when(time)}")
    return world


def _when(time: float | None) -> str:
    return "at rest" if time is None else f"at {time:g} s"


def _posed_shape(shape: Shape, world: np.ndarray) -> Shape:
    if shape.skin is not None or shape.node < 0:
        return shape
    return replace(shape, transform=world[shape.node])


def _posed_camera(scene: Scene, camera: Camera, world: np.ndarray, time: float | None) -> Camera:
    try:
        if camera.view is not None and time is not None:
            view = camera.view
            matrix = transform.look_at(view.position.at(time), view.target.at(time), view.up)
        elif camera.node >= 0:
            matrix = transform.without_scale(world[camera.node])
        else:
            return camera
    except ValueError as error:
        raise InputError(f"{scene.path}: camera {camera.name!r} {_when(time)}: {error}") from None
    return replace(camera, transform=matrix)


def _posed_light(scene: Scene, light: Light, world: np.ndarray, time: float | None) -> Light:
    if light.intensity_curve is not None and time is not None:
        red, green, blue = np.maximum(light.intensity_curve.at(time), 0.0).tolist()
        light = replace(light, intensity=(red, green, blue))
    if light.node < 0:
        return light
    matrix = world[light.node]
    position = tuple(matrix[:3, 3].tolist())
    if light.kind == "point":
        return replace(light, position=position)
    length = np.linalg.norm(matrix[:3, 2])
    if length == 0.0:
        raise InputError(f"{scene.path}: light {light.name!r} has no direction {_when(time)}")
    direction = tuple((-matrix[:3, 2] / length).tolist())
    return replace(light, position=position, direction=direction)


def _posed_material(material: Material, time: float | None) -> Material:
    if material.emission_curve is None or time is None:
        return material
    red, green, blue = np.maximum(material.emission_curve.at(time), 0.0).tolist()
    return replace(material, emission=(red, green, blue))


def joint_matrices(scene: Scene, shape: Shape, world: np.ndarray) -> np.ndarray:
    """Return ``(j, 4, 4)`` float64, from the mesh's space to the world, a joint of the skin."""
    assert shape.skin is not None
    return world[list(shape.skin.joints)] @ shape.skin.inverse_bind


def morph_weights(scene: Scene, shape: Shape, time: float | None) -> np.ndarray:
    """Return the weight of each morph target of ``shape`` at ``time``, ``(t,)`` float64."""
    assert shape.mesh.morphs is not None
    if shape.node < 0:
        return np.zeros(target_count(shape.mesh))
    return node_value(scene.nodes[shape.node], "weights", time)


def target_count(mesh: Mesh) -> int:
    """Return how many morph targets ``mesh`` has."""
    if mesh.morphs is None:
        return 0
    parts = (mesh.morphs.positions, mesh.morphs.normals, mesh.morphs.tangents)
    return next((len(part) for part in parts if part is not None), 0)


def baked(scene: Scene, time: float | None) -> Scene:
    """Return what ``scene`` is at ``time``, as a scene that knows nothing of time.

    Raises:
        InputError: as ``posed``.
    """
    if not (scene.nodes or is_animated(scene)):
        return scene
    at = posed(scene, time)
    world = world_transforms(scene.nodes, time)
    return replace(
        at,
        shapes=tuple(
            replace(shape, mesh=deformed(at, shape, world, time), node=-1, skin=None)
            for shape in at.shapes
        ),
        cameras=tuple(replace(camera, node=-1, view=None) for camera in at.cameras),
        lights=tuple(replace(light, node=-1, intensity_curve=None) for light in at.lights),
        materials=tuple(replace(material, emission_curve=None) for material in at.materials),
        nodes=(),
    )


def shaped(scene: Scene, time: float | None) -> Scene:
    """Return ``posed`` with its vertices moved too; what moves still knows that it does."""
    at = posed(scene, time)
    world = world_transforms(scene.nodes, time)
    shapes = (replace(shape, mesh=deformed(at, shape, world, time)) for shape in at.shapes)
    return replace(at, shapes=tuple(shapes)) if scene.nodes else at


def settled(scene: Scene) -> Scene:
    """Return ``scene`` with everything baked that never moves, and the shapes that do move last.

    Keeping them together lets what follows know them by the numbers of their triangles.
    """
    world = world_transforms(scene.nodes, None)
    moving = [shape for shape in scene.shapes if moves(scene, shape)]
    still = [
        replace(shape, mesh=deformed(scene, shape, world, None), node=-1, skin=None)
        for shape in _at_rest(scene, world)
        if not moves(scene, shape)
    ]
    return replace(scene, shapes=(*still, *moving))


def _at_rest(scene: Scene, world: np.ndarray) -> list[Shape]:
    return [_posed_shape(shape, world) for shape in scene.shapes]


def deformed(scene: Scene, shape: Shape, world: np.ndarray, time: float | None) -> Mesh:
    """Return the mesh of ``shape`` as its morph targets and joints form it at ``time``.

    Args:
        world: of ``world_transforms`` at that time.
    """
    mesh = shape.mesh
    if mesh.morphs is None and shape.skin is None:
        return mesh
    positions, triangles = mesh.positions.astype(np.float64), mesh.triangles
    normals = None if mesh.normals is None else mesh.normals.astype(np.float64)
    tangents = None if mesh.tangents is None else mesh.tangents.astype(np.float64)
    if mesh.morphs is not None:
        weights = morph_weights(scene, shape, time)
        positions = _added(positions, mesh.morphs.positions, weights)
        normals = _added(normals, mesh.morphs.normals, weights)
        if tangents is not None:
            tangents[:, :3] = _added(tangents[:, :3], mesh.morphs.tangents, weights)
    if shape.skin is not None and mesh.joints is not None and mesh.weights is not None:
        matrices = joint_matrices(scene, shape, world)[:, :3]
        blended = np.zeros((len(positions), 3, 4))
        for column in range(mesh.joints.shape[1]):
            share = mesh.weights[:, column, None, None].astype(np.float64)
            blended += share * matrices[mesh.joints[:, column]]
        linear = blended[:, :, :3]
        # Where joints mirror, corners go round the other way; the front stays the front.
        mirrored = np.linalg.det(linear)[mesh.triangles[:, 0]] < 0.0
        triangles = np.where(mirrored[:, None], triangles[:, [0, 2, 1]], triangles)
        positions = np.einsum("nij,nj->ni", linear, positions) + blended[:, :, 3]
        if normals is not None:
            normals = np.einsum("nij,nj->ni", cofactors(linear), normals)
        if tangents is not None:
            tangents[:, :3] = np.einsum("nij,nj->ni", linear, tangents[:, :3])
    return replace(
        mesh,
        positions=positions.astype(np.float32),
        triangles=triangles,
        normals=None if normals is None else _unit(normals).astype(np.float32),
        tangents=None if tangents is None else tangents.astype(np.float32),
        morphs=None,
        joints=None,
        weights=None,
    )


def _added(
    base: np.ndarray | None, differences: np.ndarray | None, weights: np.ndarray
) -> np.ndarray | None:
    if base is None or differences is None:
        return base
    return base + np.tensordot(weights, differences.astype(np.float64), axes=1)


def cofactors(linear: np.ndarray) -> np.ndarray:
    """Return what turns normals where ``linear``, ``(n, 3, 3)``, turns directions, up to scale.

    It is the inverse transposed times the determinant, without the sign of that.
    """
    a, b, c = linear[:, 0], linear[:, 1], linear[:, 2]
    cofactor = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    sign = np.where(np.einsum("ni,ni->n", a, cofactor[:, 0]) < 0.0, -1.0, 1.0)
    return cofactor * sign[:, None, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1; zero where there is no direction."""
    with np.errstate(all="ignore"):
        unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    unit[~np.isfinite(unit).all(axis=1)] = 0.0
    return unit
