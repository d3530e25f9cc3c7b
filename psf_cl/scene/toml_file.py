"""Read a ``.toml`` scene: tables for film, cameras, environment, materials, shapes and lights.

What each table may hold is said once, in the schemas below; the readers under them only build
records from values that are already known to be sound.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import read_file
from psf_cl.scene import transform
from psf_cl.scene.curve import Curve
from psf_cl.scene.environment import load_environment
from psf_cl.scene.model import (
    COLOR_TEXTURES,
    MAX_RADIANCE,
    TEXTURE_FIELDS,
    Camera,
    Environment,
    Light,
    Material,
    Mesh,
    Node,
    Scene,
    Shape,
    Skin,
    Texture,
    View,
)
from psf_cl.scene.primitives import PRIMITIVES
from psf_cl.scene.schema import (
    Key,
    Place,
    Schema,
    either,
    flag,
    integer,
    matrix,
    number,
    read_table,
    table,
    tables,
    text,
    vector,
)
from psf_cl.scene.texture import load_texture
from psf_cl.scene.toml_animation import Animations, read_animations

MAX_SIZE = 16384
MAX_LENGTH = 1e18

_POINT = vector(3, -MAX_LENGTH, MAX_LENGTH)
_DIRECTION = vector(3)
_RGB = vector(3, 0, MAX_RADIANCE)
_UNIT = number(0, 1)
_ANGLES = vector(3, -1e6, 1e6)

SCENE: Schema = {
    "film": Key(table()),
    "camera": Key(table()),
    "cameras": Key(tables()),
    "environment": Key(table()),
    "render": Key(table()),
    "materials": Key(table(), "one table a material: [materials.NAME]"),
    "shapes": Key(tables()),
    "lights": Key(tables()),
    "animation": Key(tables()),
}

FILM: Schema = {
    "width": Key(integer(1, MAX_SIZE), "pixels"),
    "height": Key(integer(1, MAX_SIZE), "pixels"),
}

CAMERA: Schema = {
    "name": Key(text()),
    "from": Key(text(), "name of a camera in a glTF file of the scene"),
    "position": Key(_POINT, "meters"),
    "target": Key(_POINT, "the point looked at, meters"),
    "up": Key(_DIRECTION, "a direction"),
    "fov_y": Key(number(0.001, 179), "vertical field of view, degrees"),
    "height": Key(number(above=0, high=MAX_LENGTH), "meters from bottom to top, for parallel rays"),
    "lens_radius": Key(number(0, MAX_LENGTH), "meters; 0 is a pinhole"),
    "focus_distance": Key(number(above=0, high=MAX_LENGTH), "meters"),
}

ENVIRONMENT: Schema = {
    "radiance": Key(_RGB, "linear RGB"),
    "image": Key(text(), "a lat-long .exr or .hdr file"),
    "scale": Key(either(number(0, MAX_RADIANCE), _RGB), "factor of the image"),
    "rotation": Key(either(_ANGLES, matrix(3), matrix(4)), "degrees about X, Y, Z, or a rotation"),
}

MATERIAL: Schema = {
    "base_color": Key(vector(3, 0, 1), "linear RGB"),
    "metallic": Key(_UNIT),
    "roughness": Key(_UNIT),
    "ior": Key(number(1, 100)),
    "specular": Key(_UNIT),
    "specular_color": Key(vector(3, 0, 1), "linear RGB"),
    "transmission": Key(_UNIT),
    "thin_walled": Key(flag(), "whether light goes through unbent"),
    "attenuation_color": Key(vector(3, 0, 1), "linear RGB"),
    "attenuation_distance": Key(number(above=0), "meters"),
    "clearcoat": Key(_UNIT),
    "clearcoat_roughness": Key(_UNIT),
    "sheen_color": Key(vector(3, 0, 1), "linear RGB"),
    "sheen_roughness": Key(_UNIT),
    "anisotropy": Key(_UNIT),
    "anisotropy_rotation": Key(number(-1e6, 1e6), "degrees"),
    "normal_scale": Key(number(-1e6, 1e6)),
    "emission": Key(_RGB, "radiance, linear RGB"),
    "alpha": Key(_UNIT),
    "alpha_mode": Key(text("opaque", "mask", "blend")),
    "alpha_cutoff": Key(_UNIT),
    "double_sided": Key(flag(), "whether both sides emit and are seen"),
    "unlit": Key(flag(), "whether to show the base colour as it is"),
    **{name: Key(either(text(), table()), "an image file, or a table") for name in TEXTURE_FIELDS},
}

TEXTURE: Schema = {
    "file": Key(text(), "an image file", required=True),
    "uv_set": Key(integer(0, 1)),
    "offset": Key(vector(2, -1e6, 1e6)),
    "rotation": Key(number(-1e6, 1e6), "degrees"),
    "scale": Key(either(number(-1e6, 1e6), vector(2, -1e6, 1e6))),
    "wrap": Key(text("repeat", "clamp", "mirror")),
    "filter": Key(text("linear", "nearest")),
}

SHAPE: Schema = {
    "name": Key(text()),
    "mesh": Key(text(), "a .gltf, .glb, .obj, .ply or .stl file"),
    "primitive": Key(text(*PRIMITIVES)),
    "material": Key(text(), "the NAME of a [materials.NAME]"),
    "transform": Key(tables(), "steps, applied in this order"),
    "emission": Key(_RGB, "radiance, linear RGB"),
    "two_sided": Key(flag(), "whether both sides emit"),
}

STEP: Schema = {
    "scale": Key(either(number(-1e9, 1e9), vector(3, -1e9, 1e9)), "not 0"),
    "rotate": Key(_ANGLES, "degrees about X, then Y, then Z"),
    "translate": Key(_POINT, "meters"),
    "matrix": Key(matrix(4), "row by row, the last row 0 0 0 1"),
}

LIGHT: Schema = {
    "type": Key(text("point", "spot", "directional"), required=True),
    "name": Key(text()),
    "position": Key(_POINT, "meters"),
    "direction": Key(_DIRECTION, "the way the light travels"),
    "color": Key(_RGB, "linear RGB"),
    "intensity": Key(number(0, MAX_RADIANCE), "candela; lux for a directional light"),
    "range": Key(number(above=0, high=MAX_LENGTH), "meters"),
    "inner_angle": Key(number(0, 90), "half angle of the full cone, degrees"),
    "outer_angle": Key(number(above=0, high=90), "half angle of the whole cone, degrees"),
}

# Which keys a light of a type must have, and which it may have besides those of all types.
_LIGHT_KEYS = {
    "point": ({"position"}, {"range"}),
    "spot": ({"position", "direction"}, {"range", "inner_angle", "outer_angle"}),
    "directional": ({"direction"}, set()),
}


def load_toml(path: Path, load_mesh_file: Callable[[Path], Scene]) -> Scene:
    """Return the scene of a TOML file; the files it names are relative to its folder.

    Args:
        load_mesh_file: reads a mesh file of any known format.

    Raises:
        InputError: the file or one it names is missing or broken, or a key is unknown, has a value
            of another kind, or contradicts another key.  One line names the file and the key.
    """
    place = Place(str(path))
    raw = read_table(_parse(path), SCENE, place)
    animations = read_animations(raw.get("animation", []), place.key("animation"))
    assembly = _Assembly(path.parent, load_mesh_file, animations)
    film = read_table(raw.get("film", {}), FILM, place.key("film"))
    _read_materials(raw.get("materials", {}), place.key("materials"), assembly)
    for index, shape in enumerate(raw.get("shapes", [])):
        _read_shape(shape, place.key("shapes").item(index), assembly)
    lights = place.key("lights")
    for index, light in enumerate(raw.get("lights", [])):
        assembly.lights.append(_read_light(light, lights.item(index), assembly))
    environment = _read_environment(raw.get("environment", {}), place.key("environment"), assembly)
    cameras = _read_cameras(raw, place, assembly)
    animations.check_all_used()
    for name in assembly.overrides.keys() - assembly.used_overrides:
        assembly.notes.append(f"nothing in {path} uses the material {name}")
    return Scene(
        path=str(path),
        **film,
        cameras=cameras,
        textures=tuple(assembly.textures),
        materials=tuple(assembly.materials) or (Material(),),
        shapes=tuple(assembly.shapes),
        lights=tuple(assembly.lights),
        environment=environment,
        render=raw.get("render", {}),
        notes=tuple(assembly.notes),
        files=(str(path), *assembly.read_files),
        nodes=tuple(animations.nodes),
    )


def _parse(path: Path) -> dict[str, Any]:
    data = read_file(path)
    try:
        return tomllib.loads(data.decode("utf-8"))
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected UTF-8 text") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None


@dataclass
class _Assembly:
    """The scene while it grows.

    Attributes:
        overrides: by material name, the fields that ``[materials.NAME]`` sets.
        own: by material name, the index of the material made of those fields alone.
        files: by path, a mesh file's scene and the indices of its materials in this scene.
        read_files: the path of every file read.
        emitters: copies of materials made for ``emission`` on a shape, by what they copy.
    """

    folder: Path
    load_mesh_file: Callable[[Path], Scene]
    animations: Animations
    textures: list[Texture] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    file_cameras: list[Camera] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    used_overrides: set[str] = field(default_factory=set)
    own: dict[str, int] = field(default_factory=dict)
    files: dict[str, tuple[Scene, list[int]]] = field(default_factory=dict)
    read_files: list[str] = field(default_factory=list)
    images: dict[str, Texture] = field(default_factory=dict)
    texture_indices: dict[tuple[Any, ...], int] = field(default_factory=dict)
    emitters: dict[tuple[int, Material], int] = field(default_factory=dict)
    primitives: dict[str, Mesh] = field(default_factory=dict)

    def file(self, name: str, place: Place) -> Path:
        """Return the path of a file that the scene names.

        Raises:
            InputError: there is no such file.
        """
        path = self.folder / name
        if os.path.isdir(path):
            raise place.error(f"expected a file; {path} is a folder")
        if not os.path.isfile(path):
            raise place.error(f"no such file: {path}")
        self.read_files.append(str(path))
        return path

    def add_material(self, material: Material) -> int:
        self.materials.append(material)
        return len(self.materials) - 1

    def own_material(self, name: str) -> int:
        """Return the index of the material that ``[materials.NAME]``, if any, alone describes."""
        self.used_overrides.add(name)
        if name not in self.own:
            material = Material(**{"name": name} | self.overrides.get(name, {}))
            self.own[name] = self.add_material(material)
        return self.own[name]

    def primitive(self, name: str) -> Mesh:
        """Return the mesh of a primitive; all shapes of it share one."""
        if name not in self.primitives:
            self.primitives[name] = PRIMITIVES[name]()
        return self.primitives[name]

    def emitter(self, material: int, changes: dict[str, Any]) -> int:
        """Return the index of a copy of ``material`` with ``changes``; equal copies are shared."""
        copy = replace(self.materials[material], **changes)
        key = (material, copy)
        if key not in self.emitters:
            self.emitters[key] = self.add_material(copy)
        return self.emitters[key]

    def mesh_file(self, name: str, place: Place) -> tuple[Scene, list[int]]:
        """Load a mesh file once, add its textures and materials, overridden where asked for."""
        path = self.file(name, place)
        key = os.path.realpath(path)
        if key not in self.files:
            try:
                scene = self.load_mesh_file(path)
            except InputError as error:
                raise place.error(str(error)) from None
            offset = len(self.textures)
            self.textures.extend(scene.textures)
            indices = []
            for material in scene.materials:
                shifted = {
                    key: getattr(material, key) + offset
                    for key in TEXTURE_FIELDS
                    if getattr(material, key) >= 0
                }
                changes = self.overrides.get(material.name, {})
                if changes:
                    self.used_overrides.add(material.name)
                indices.append(self.add_material(replace(material, **(shifted | changes))))
            self.notes.extend(scene.notes)
            self.read_files.extend(scene.files)
            self.files[key] = (scene, indices)
        return self.files[key]


def _read_materials(raw: dict[str, Any], place: Place, assembly: _Assembly) -> None:
    for name, values in raw.items():
        here = place.key(name)
        changes = read_table(values, MATERIAL, here)
        for key in TEXTURE_FIELDS:
            if key in changes:
                changes[key] = _texture(
                    changes[key], here.key(key), assembly, key in COLOR_TEXTURES
                )
        if "anisotropy_rotation" in changes:
            changes["anisotropy_rotation"] = math.radians(changes["anisotropy_rotation"])
        if "double_sided" in changes:
            changes["back_hidden"] = not changes["double_sided"]
        for track in assembly.animations.of("material", name).values():
            changes["emission_curve"] = track.curve
        assembly.overrides[name] = changes


def _texture(value: str | dict[str, Any], place: Place, assembly: _Assembly, srgb: bool) -> int:
    """Return the index of the texture that ``value``, a file name or a table, describes."""
    values: dict[str, Any] = {"file": value}
    named = place
    if isinstance(value, dict):
        values = read_table(value, TEXTURE, place)
        named = place.key("file")
    path = assembly.file(values["file"], named)
    image = os.path.realpath(path)
    if image not in assembly.images:
        try:
            assembly.images[image] = load_texture(path)
        except InputError as error:
            raise named.error(str(error)) from None
    across, down = np.broadcast_to(values.get("scale", 1.0), 2).tolist()
    wrap = values.get("wrap", "repeat")
    texture = replace(
        assembly.images[image],
        srgb=srgb,
        wrap=(wrap, wrap),
        filter=values.get("filter", "linear"),
        uv_set=values.get("uv_set", 0),
        transform=transform.uv_rows(
            values.get("offset", (0.0, 0.0)),
            math.radians(values.get("rotation", 0.0)),
            (across, down),
        ),
    )
    key = (image, srgb, texture.wrap, texture.filter, texture.uv_set, texture.transform)
    if key not in assembly.texture_indices:
        assembly.texture_indices[key] = len(assembly.textures)
        assembly.textures.append(texture)
    return assembly.texture_indices[key]


def _read_shape(raw: dict[str, Any], place: Place, assembly: _Assembly) -> None:
    shape = read_table(raw, SHAPE, place)
    if ("mesh" in shape) == ("primitive" in shape):
        raise place.error("expected either mesh or primitive")
    matrix_of_shape = _read_transform(shape.get("transform", []), place.key("transform"))
    own = None
    if "material" in shape:
        name = shape["material"]
        if name not in assembly.overrides:
            known = ", ".join(assembly.overrides) or "none"
            raise place.key("material").error(f"no [materials.{name}] in this file; known: {known}")
        own = assembly.own_material(name)

    tracks = assembly.animations.of("shape", shape.get("name"))
    root = assembly.animations.placed(tracks, matrix_of_shape)
    if "primitive" in shape:
        name = shape["primitive"]
        parts = [Shape(name, assembly.primitive(name), np.eye(4), 0)]
        indices = [assembly.own_material(Material().name) if own is None else own]
    else:
        scene, indices = assembly.mesh_file(shape["mesh"], place.key("mesh"))
        scene = _below(scene, root, matrix_of_shape, assembly.animations)
        parts = list(scene.shapes)
        assembly.lights.extend(_moved_light(light, matrix_of_shape) for light in scene.lights)
        for camera in scene.cameras:
            assembly.file_cameras.append(_moved_camera(camera, matrix_of_shape, place))
    changes: dict[str, Any] = {}
    if "emission" in shape:
        changes = {"emission": shape["emission"], "emission_texture": -1, "double_sided": False}
    if "emission" in tracks:
        changes |= {"emission_texture": -1, "emission_curve": tracks["emission"].curve}
    if "two_sided" in shape:
        changes["double_sided"] = shape["two_sided"]
        if shape["two_sided"]:
            changes["back_hidden"] = False
    for part in parts:
        material = own if own is not None else indices[part.material]
        if changes:
            material = assembly.emitter(material, changes)
        assembly.shapes.append(
            Shape(
                name=shape.get("name", part.name),
                mesh=part.mesh,
                # Joints put vertices into the world.
                transform=np.eye(4) if part.skin else matrix_of_shape @ part.transform,
                material=material,
                node=root if part.node < 0 and "primitive" in shape else part.node,
                skin=part.skin,
            )
        )


def _below(scene: Scene, root: int, matrix: np.ndarray, animations: Animations) -> Scene:
    """Return the scene of a mesh file with its nodes among those of the scene it is part of.

    Args:
        root: the node that moves all of the file; -1 if it stands at ``matrix``.
    """
    if root < 0 and not scene.nodes:
        return scene
    if root < 0:
        root = animations.add(Node(matrix=matrix))
        is_moving = False
    else:
        is_moving = True
    start = len(animations.nodes)
    for node in scene.nodes:
        parent = root if node.parent < 0 else start + node.parent
        animations.add(replace(node, parent=parent))
    skins: dict[int, Skin] = {}

    def follow(node: int, place: np.ndarray) -> int:
        if node >= 0:
            return start + node
        return animations.add(Node(root, matrix=place)) if is_moving else -1

    shapes = []
    for shape in scene.shapes:
        if shape.skin is not None:
            joints = tuple(start + joint for joint in shape.skin.joints)
            skins.setdefault(id(shape.skin), Skin(joints, shape.skin.inverse_bind))
            node = start + shape.node if shape.node >= 0 else -1
            shapes.append(replace(shape, node=node, skin=skins[id(shape.skin)]))
        else:
            shapes.append(replace(shape, node=follow(shape.node, shape.transform)))
    return replace(
        scene,
        shapes=tuple(shapes),
        cameras=tuple(
            replace(camera, node=follow(camera.node, camera.transform)) for camera in scene.cameras
        ),
        lights=tuple(
            replace(light, node=follow(light.node, _light_matrix(light))) for light in scene.lights
        ),
    )


def _read_transform(steps: list[dict[str, Any]], place: Place) -> np.ndarray:
    """Return the product of the steps, ``(4, 4)`` float64; the first step is applied first."""
    total = np.eye(4)
    for index, raw in enumerate(steps):
        here = place.item(index)
        step = read_table(raw, STEP, here)
        if len(step) != 1:
            raise here.error(f"expected exactly one of {', '.join(STEP)}")
        ((kind, value),) = step.items()
        if kind == "scale":
            if not np.all(np.abs(value) >= 1e-9):
                raise here.key(kind).error(f"expected factors from 1e-9 to 1e9; got {value}")
            total = transform.scaling(value) @ total
        elif kind == "rotate":
            # Rounding makes right angles exact, so that walls turned by them meet without a crack.
            total = np.round(transform.rotation_xyz_degrees(value), 15) @ total
        elif kind == "translate":
            total = transform.translation(value) @ total
        else:
            total = _affine(value, here.key(kind)) @ total
    if not np.abs(total).max() <= MAX_LENGTH:
        raise place.error(f"the product of the steps exceeds {MAX_LENGTH:g}")
    return total


def _affine(rows: tuple[tuple[float, ...], ...], place: Place) -> np.ndarray:
    """Return the rows as a matrix, checked to move points and to keep volumes from vanishing."""
    affine = np.array(rows)
    if not np.array_equal(affine[3], [0, 0, 0, 1]):
        raise place.error("expected the last row 0 0 0 1")
    if np.abs(affine).max() > MAX_LENGTH or np.linalg.matrix_rank(affine[:3, :3]) < 3:
        raise place.error(f"expected an invertible matrix of numbers up to {MAX_LENGTH:g}")
    return affine


def _moved_light(light: Light, matrix_of_shape: np.ndarray) -> Light:
    """Return a light of a mesh file where the shape's transform puts it; its strength stays."""
    direction = _normalised(matrix_of_shape[:3, :3] @ np.array(light.direction))
    position = transform.transform_points(matrix_of_shape, np.array([light.position]))[0]
    return replace(light, position=_triple(position), direction=_triple(direction))


def _moved_camera(camera: Camera, matrix_of_shape: np.ndarray, place: Place) -> Camera:
    try:
        moved = transform.without_scale(matrix_of_shape @ camera.transform)
    except ValueError as error:
        raise place.key("transform").error(f"camera {camera.name!r}: {error}") from None
    return replace(camera, transform=moved)


def _light_matrix(light: Light) -> np.ndarray:
    """Return a matrix that puts a light at its position and its -Z along its direction."""
    position, direction = np.array(light.position), np.array(light.direction)
    up = (1.0, 0.0, 0.0) if abs(direction[1]) > 0.9 else (0.0, 1.0, 0.0)
    matrix = transform.look_at((0.0, 0.0, 0.0), direction, up)
    matrix[:3, 3] = position
    return matrix


def _read_light(raw: dict[str, Any], place: Place, assembly: _Assembly) -> Light:
    light = read_table(raw, LIGHT, place)
    kind = light.pop("type")
    needed, more = _LIGHT_KEYS[kind]
    for key in sorted(needed - light.keys()):
        raise place.key(key).error(f"missing; a {kind} light needs {LIGHT[key].kind.expects}")
    for key in sorted(light.keys() - needed - more - {"name", "color", "intensity"}):
        raise place.key(key).error(f"a {kind} light has no {key}")
    color, intensity = light.pop("color", (1.0, 1.0, 1.0)), light.pop("intensity", 1.0)
    values = np.array(color) * intensity
    if values.max() > MAX_RADIANCE:
        raise place.key("intensity").error(f"color times intensity exceeds {MAX_RADIANCE:g}")
    if "direction" in light:
        light["direction"] = _triple(_direction(light["direction"], place.key("direction")))
    if kind == "spot":
        inner, outer = light.get("inner_angle", 0.0), light.get("outer_angle", 45.0)
        if not inner < outer:
            raise place.key("inner_angle").error(
                f"expected less than outer_angle, {outer:g} degrees; got {inner:g}"
            )
        light |= {"inner_angle": math.radians(inner), "outer_angle": math.radians(outer)}
    read = Light(kind=kind, intensity=_triple(values), **light)
    tracks = assembly.animations.of("light", read.name or None)
    node = assembly.animations.placed(tracks, _light_matrix(read))
    if "position" in tracks:
        if node >= 0:
            raise tracks["position"].place.error("expected either position or translation")
        curves = {"translation": tracks["position"].curve}
        moved = assembly.animations.add(Node(translation=read.position, curves=curves))
        matrix = _light_matrix(replace(read, position=(0.0, 0.0, 0.0)))
        node = assembly.animations.add(Node(moved, matrix=matrix))
    curve = tracks["intensity"].curve.scaled(color) if "intensity" in tracks else None
    return replace(read, node=node, intensity_curve=curve)


def _read_environment(raw: dict[str, Any], place: Place, assembly: _Assembly) -> Environment:
    values = read_table(raw, ENVIRONMENT, place)
    if "image" in values and "radiance" in values:
        raise place.key("radiance").error("expected either image or radiance; scale dims an image")
    if "scale" in values and "image" not in values:
        raise place.key("scale").error("is the factor of an image, and there is no image")
    rotation = np.eye(3)
    if "rotation" in values:
        rotation = _rotation(values["rotation"], place.key("rotation"))
    if "image" not in values:
        return Environment(values.get("radiance", (0.0, 0.0, 0.0)), rotation=rotation)
    here = place.key("image")
    path = assembly.file(values["image"], here)
    try:
        image, notes = load_environment(path)
    except InputError as error:
        raise here.error(str(error)) from None
    assembly.notes.extend(notes)
    scale = np.broadcast_to(values.get("scale", 1.0), 3)
    if float(image.max()) * scale.max() > np.float32(MAX_RADIANCE):
        raise place.key("scale").error(f"the image times scale exceeds {MAX_RADIANCE:g}")
    return Environment(_triple(scale), image, rotation)


def _rotation(value: tuple[Any, ...], place: Place) -> np.ndarray:
    """Return ``(3, 3)``: angles, or the linear part of a matrix made exactly orthonormal."""
    if np.ndim(value) == 1:
        return transform.rotation_xyz_degrees(value)[:3, :3]
    linear = np.array(value)[:3, :3]
    left, sizes, right = np.linalg.svd(linear)
    if np.abs(sizes - 1).max() > 1e-3:
        raise place.error("expected a rotation: rows of length 1, perpendicular to each other")
    return left @ right


def _read_cameras(raw: dict[str, Any], place: Place, assembly: _Assembly) -> tuple[Camera, ...]:
    """Return the scene's cameras, then those of its mesh files whose names are still free."""
    if "camera" in raw and "cameras" in raw:
        raise place.key("cameras").error("expected either [camera] or [[cameras]]")
    tables_of_cameras = [(raw["camera"], place.key("camera"))] if "camera" in raw else []
    for index, camera in enumerate(raw.get("cameras", [])):
        tables_of_cameras.append((camera, place.key("cameras").item(index)))
    cameras: list[Camera] = []
    for values, here in tables_of_cameras:
        camera = _read_camera(values, here, assembly)
        if camera.name and any(camera.name == other.name for other in cameras):
            raise here.key("name").error(f"another camera is called {camera.name!r}")
        cameras.append(camera)
    names = {camera.name for camera in cameras}
    return (*cameras, *(camera for camera in assembly.file_cameras if camera.name not in names))


def _read_camera(raw: dict[str, Any], place: Place, assembly: _Assembly) -> Camera:
    values = read_table(raw, CAMERA, place)
    # The one camera of a scene may do without a name.
    tracks = assembly.animations.of("camera", values.get("name", "camera"))
    kept = ("name", "height", "lens_radius", "focus_distance")
    if "height" in values and "fov_y" in values:
        raise place.key("height").error("expected either height or fov_y")
    changes = {key: values[key] for key in kept if key in values}
    if "fov_y" in values:
        changes["fov_y"] = math.radians(values["fov_y"])
    if "from" in values:
        for key in ("position", "target", "up"):
            if key in values:
                raise place.key(key).error("expected either from or position, target and up")
        for camera in assembly.file_cameras:
            if camera.name == values["from"]:
                for track in tracks.values():
                    raise track.place.error("a camera of a mesh file moves as the file says")
                return replace(camera, **changes)
        known = ", ".join(repr(camera.name) for camera in assembly.file_cameras) or "none"
        raise place.key("from").error(f"no camera {values['from']!r} in the meshes; known: {known}")
    for key in ("position", "target"):
        if key not in values:
            raise place.key(key).error(f"missing; expected {CAMERA[key].kind.expects}")
    position, target = np.array(values["position"]), np.array(values["target"])
    try:
        view = transform.look_at(position, target, values.get("up", (0.0, 1.0, 0.0)))
    except ValueError as error:
        raise place.error(f"position, target and up do not make a view: {error}") from None
    sharp = float(np.linalg.norm(target - position))
    defaults = {"transform": view, "fov_y": math.radians(45), "focus_distance": sharp}
    changes["node"] = assembly.animations.placed(tracks, view)
    if "position" in tracks or "target" in tracks:
        if changes["node"] >= 0:
            raise place.error("animated: expected either position and target, or translation")
        still = {"position": position, "target": target}
        curves = [
            tracks[name].curve if name in tracks else Curve(np.zeros(1), point[None])
            for name, point in still.items()
        ]
        changes["view"] = View(*curves, values.get("up", (0.0, 1.0, 0.0)))
    return Camera(**(defaults | changes))


def _direction(value: tuple[float, ...], place: Place) -> np.ndarray:
    if not np.any(value):
        raise place.error("expected a direction; got zero length")
    return _normalised(np.array(value))


def _normalised(vector_: np.ndarray) -> np.ndarray:
    scaled = vector_ / np.abs(vector_).max()
    return scaled / np.linalg.norm(scaled)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
