"""The front door: any scene file to a Scene that can be rendered."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from psf_cl.errors import InputError
from psf_cl.scene import mesh, transform
from psf_cl.scene.animation import baked, is_animated, settled
from psf_cl.scene.default_sky import with_default_sky
from psf_cl.scene.environment import load_environment
from psf_cl.scene.gltf import load_gltf
from psf_cl.scene.model import (
    MAX_TRIANGLES,
    TEXTURE_FIELDS,
    Camera,
    Environment,
    Material,
    Mesh,
    Scene,
)
from psf_cl.scene.toml_file import MAX_SIZE, load_toml

DEFAULT_FOV_Y = math.radians(45)

#: In place of a file: no light from infinitely far away.
NO_ENVIRONMENT = "none"

_GLTF = (".gltf", ".glb")
_MESH_FILES = (*_GLTF, *mesh.SUFFIXES)


def load_scene(
    path: str | Path,
    *,
    environment: str | Path | None = None,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    clip: str | None = None,
    time: float | None = None,
    moving: bool = False,
) -> Scene:
    """Read a scene and complete it, so that it has triangles, a camera and light.

    Without a camera the view frames the scene; without light there is a sky of radiance 1, see
    ``with_default_sky``.  Both are told in ``Scene.notes``.

    Args:
        environment: an .exr or .hdr file to use instead of the scene's environment; "none" for no
            sky at all.
        camera: name of the camera to use.
        size: width and height in pixels instead of the scene's.
        clip: name or number of the animation of a glTF file to play; see ``read_curves``.
        time: s; the scene is as its animations have it then.  None for rest, as if it had none.
        moving: whether to keep what moves for a sequence of frames; else all stands still.

    Raises:
        InputError: missing, unknown or malformed file, no triangles or too many, no camera or
            animation of that name, or a size out of range.
    """
    path = Path(path)
    animated = moving or time is not None
    suffixes = set()

    def load_mesh_file(path: Path) -> Scene:
        suffixes.add(path.suffix.lower())
        return _load_mesh_file(path, clip, animated)

    is_toml = _suffix(path) == ".toml"
    scene = load_toml(path, load_mesh_file) if is_toml else load_mesh_file(path)
    if clip is not None and suffixes.isdisjoint(_GLTF):
        raise InputError(f"{path}: clip: expected a scene with a glTF file, which has named clips")
    count = sum(len(shape.mesh.triangles) for shape in scene.shapes)
    if count == 0:
        why = f" ({'; '.join(scene.notes)})" if scene.notes else ""
        raise InputError(f"{path} has no triangles{why}")
    if count > MAX_TRIANGLES:
        raise InputError(f"{path}: expected at most {MAX_TRIANGLES} triangles; got {count}")
    if environment == NO_ENVIRONMENT:
        scene = replace(scene, environment=Environment())
    elif environment is not None:
        image, notes = load_environment(Path(environment))
        scene = replace(
            scene,
            environment=Environment((1.0, 1.0, 1.0), image),
            notes=scene.notes + notes,
            files=(*scene.files, str(environment)),
        )
    scene = _with_camera(_with_size(scene, size), camera, time)
    if environment != NO_ENVIRONMENT:
        scene = with_default_sky(scene, opened=not is_toml)
    if moving and not is_animated(scene):
        note = "nothing in the scene is animated: every frame shows the same"
        scene = replace(scene, notes=(*scene.notes, note))
    scene = settled(scene) if moving else baked(scene, time)
    return _without_unused(scene)


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in (".toml", *_MESH_FILES):
        raise InputError(f"{path}: expected a file ending in .toml, {', '.join(_MESH_FILES)}")
    return suffix


def _load_mesh_file(path: Path, clip: str | None, animated: bool) -> Scene:
    suffix = path.suffix.lower()
    if suffix not in _MESH_FILES:
        raise InputError(f"{path}: expected a file ending in {', '.join(_MESH_FILES)}")
    return load_gltf(path, clip, animated) if suffix in _GLTF else mesh.load_mesh_scene(path)


def _with_size(scene: Scene, size: tuple[int, int] | None) -> Scene:
    if size is None:
        return scene
    width, height = size
    if not (1 <= width <= MAX_SIZE and 1 <= height <= MAX_SIZE):
        raise InputError(f"size: expected 1 to {MAX_SIZE} pixels each; got {width}x{height}")
    return replace(scene, width=width, height=height)


def _with_camera(scene: Scene, name: str | None, time: float | None) -> Scene:
    if name is not None:
        names = [camera.name for camera in scene.cameras]
        if not name or name not in names:
            if any(names):
                hint = f"known: {', '.join(repr(known) for known in names if known)}"
            else:
                hint = "its cameras have no names" if names else "it has no cameras"
            raise InputError(f"{scene.path}: no camera {name!r}; {hint}")
        return replace(scene, camera=names.index(name))
    if scene.cameras:
        return scene
    note = "the file has no camera: the view frames the whole scene"
    view = framing_camera(baked(scene, time))
    return replace(scene, cameras=(view,), camera=0, notes=(*scene.notes, note))


def framing_camera(scene: Scene) -> Camera:
    """Return a view from the front, right and above that shows all finite vertices.

    Raises:
        InputError: no vertex of a triangle is finite.
    """
    boxes: dict[int, np.ndarray] = {}  # Many shapes may share one large mesh.
    for shape in scene.shapes:
        if id(shape.mesh) not in boxes:
            boxes[id(shape.mesh)] = _box_corners(shape.mesh)
    corners = np.concatenate(
        [
            transform.transform_points(shape.transform, boxes[id(shape.mesh)])
            for shape in scene.shapes
        ]
    )
    if not len(corners):
        raise InputError(f"{scene.path} has no triangles with finite vertices")
    low, high = corners.min(axis=0), corners.max(axis=0)
    center = (low + high) / 2
    # A single point still needs a distance, and one that float32 can tell from its position.
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-4 * float(np.abs(center).max()), 1e-6)
    half_y = DEFAULT_FOV_Y / 2
    half_x = math.atan(math.tan(half_y) * scene.width / scene.height)
    distance = radius / math.sin(min(half_x, half_y))
    direction = np.array([0.5, 0.4, 1.0]) / np.linalg.norm([0.5, 0.4, 1.0])
    view = transform.look_at(center + distance * direction, center, (0.0, 1.0, 0.0))
    return Camera(view, DEFAULT_FOV_Y, focus_distance=distance)


def _box_corners(mesh: Mesh) -> np.ndarray:
    """Return the box around the finite vertices that triangles use, ``(8, 3)``, or ``(0, 3)``."""
    used = np.zeros(len(mesh.positions), bool)
    used[mesh.triangles.reshape(-1)] = True
    points = mesh.positions[used & np.isfinite(mesh.positions).all(axis=1)]
    if not len(points):
        return np.zeros((0, 3))
    ends = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
    return ends[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]


def _without_unused(scene: Scene) -> Scene:
    """Return the scene without materials that no shape has and textures that nothing looks up."""
    kept = sorted({shape.material for shape in scene.shapes})
    materials = [_without_idle_textures(scene.materials[index]) for index in kept]
    used = {getattr(material, name) for material in materials for name in TEXTURE_FIELDS}
    order = sorted(used - {-1})
    new_texture = {-1: -1} | {old: new for new, old in enumerate(order)}
    new_material = {old: new for new, old in enumerate(kept)}
    return replace(
        scene,
        textures=tuple(scene.textures[index] for index in order),
        materials=tuple(
            replace(
                material,
                **{name: new_texture[getattr(material, name)] for name in TEXTURE_FIELDS},
            )
            for material in materials
        ),
        shapes=tuple(
            replace(shape, material=new_material[shape.material]) for shape in scene.shapes
        ),
    )


def _without_idle_textures(material: Material) -> Material:
    """Return ``material`` without the textures of what it has not."""
    for strength, names in _TEXTURES_OF.items():
        if not np.any(getattr(material, strength)) and not _is_animated(material, strength):
            material = replace(material, **dict.fromkeys(names, -1))
    return material


def _is_animated(material: Material, strength: str) -> bool:
    return strength == "emission" and material.emission_curve is not None


# A texture multiplies: where this is 0 those have no say.
_TEXTURES_OF = {
    "emission": ("emission_texture",),
    "transmission": ("transmission_texture",),
    "specular": ("specular_texture", "specular_color_texture"),
    "clearcoat": ("clearcoat_texture", "clearcoat_roughness_texture"),
    "sheen_color": ("sheen_color_texture", "sheen_roughness_texture"),
    "anisotropy": ("anisotropy_texture",),
    "normal_scale": ("normal_texture",),
}
