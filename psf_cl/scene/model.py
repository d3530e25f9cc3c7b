"""A scene as plain NumPy data: read-only, no files, no OpenCL.

Meters, Y up, right-handed.  Radiance, candela and lux are linear Rec.709 triples, taken as numbers.
Every reader (TOML, glTF, OBJ, PLY, STL) fills these records and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from psf_cl.scene.curve import Curve

#: Triangles that a scene may have.  A file's size does not bound them: one mesh has many places.
MAX_TRIANGLES = 1 << 27

#: The greatest radiance, candela and lux: what is multiplied with it stays a float32.
MAX_RADIANCE = 1e20

#: Relative luminance of linear Rec.709, by component (ITU-R BT.709-6 section 3).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
LUMINANCE.setflags(write=False)


@dataclass(frozen=True)
class Texture:
    """An image to be looked up by ``uv``.

    Attributes:
        pixels: ``(height, width, 4)`` uint8; colour is sRGB-encoded if ``srgb``, alpha is linear.
            Row 0 is ``v = 0`` (the glTF convention: ``v`` grows downwards).
        srgb: whether the three colour channels are to be decoded from sRGB.
        wrap: how ``u`` and ``v`` leave [0, 1]: ``"repeat"``, ``"clamp"`` or ``"mirror"``.
        filter: ``"linear"`` or ``"nearest"``.
        uv_set: 0 for ``Mesh.uvs``, 1 for ``Mesh.uvs1``.
        transform: the first two rows of a matrix; it is looked up at ``transform @ (u, v, 1)``.
    """

    name: str
    pixels: np.ndarray
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    filter: str = "linear"
    uv_set: int = 0
    transform: tuple[float, float, float, float, float, float] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Material:
    """Parameters of the one BSDF; the names are glTF's.

    A ``..._texture`` is an index into ``Scene.textures``, -1 for none; it multiplies its parameter.
    Strengths and roughnesses are from 0 to 1, colours linear RGB.

    Attributes:
        base_color: diffuse albedo, reflectance of a metal, or tint of what goes through.
        base_color_texture: its alpha multiplies ``alpha``.
        alpha, alpha_cutoff: with ``alpha_mode == "mask"`` a point is there if its alpha is at least
            ``alpha_cutoff``; with ``"blend"`` it is there for that share of the light;
            ``"opaque"`` ignores both.
        metallic_roughness_texture: roughness in green, metallic in blue.
        roughness: GGX alpha is its square.
        specular: strength of the dielectric reflection; 0 makes a pure Lambertian surface.
        specular_color: tint of the dielectric reflection at normal incidence.
        specular_texture: strength in alpha.
        transmission: 0 for opaque, 1 for glass; texture in red.
        thin_walled: whether the surface is a sheet: light that goes through is not bent.
        attenuation_color, attenuation_distance: what is left of white light after that many meters
            inside; never inside of a thin wall.
        clearcoat: strength of a clear coat of index 1.5; textures in red, and green for its
            roughness.
        sheen_color, sheen_roughness: fuzz on top; the roughness' texture in alpha.
        anisotropy: stretches highlights along a direction that is ``anisotropy_rotation`` (radians,
            counter-clockwise) from the tangent; texture: direction in red and green, strength in
            blue.
        normal_texture, normal_scale: tangent-space normals, and the factor of their x and y.
        emission: radiance (emissive factor times strength).
        double_sided: whether both sides *emit*; surfaces always reflect on both sides.
        back_hidden: whether the camera looks through it from behind, as glTF has it of what is not
            double-sided; glass is seen all the same.  For all other rays it is there.
        unlit: whether to show the base colour as it is, without light.
        emission_curve: what ``emission`` becomes over time, or None.
    """

    name: str = "default"
    base_color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    base_color_texture: int = -1
    alpha: float = 1.0
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5
    metallic: float = 0.0
    roughness: float = 1.0
    metallic_roughness_texture: int = -1
    specular: float = 1.0
    specular_texture: int = -1
    specular_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    specular_color_texture: int = -1
    ior: float = 1.5
    transmission: float = 0.0
    transmission_texture: int = -1
    thin_walled: bool = False
    attenuation_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    attenuation_distance: float = float("inf")
    clearcoat: float = 0.0
    clearcoat_texture: int = -1
    clearcoat_roughness: float = 0.0
    clearcoat_roughness_texture: int = -1
    sheen_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sheen_color_texture: int = -1
    sheen_roughness: float = 0.0
    sheen_roughness_texture: int = -1
    anisotropy: float = 0.0
    anisotropy_rotation: float = 0.0
    anisotropy_texture: int = -1
    normal_texture: int = -1
    normal_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: int = -1
    double_sided: bool = False
    back_hidden: bool = False
    unlit: bool = False
    emission_curve: Curve | None = None


#: The parameters of a material that are textures.
TEXTURE_FIELDS = tuple(item.name for item in fields(Material) if item.name.endswith("_texture"))

#: Those whose picture is of colours, in sRGB; the others' are of numbers.
COLOR_TEXTURES = (
    "base_color_texture",
    "emission_texture",
    "specular_color_texture",
    "sheen_color_texture",
)


@dataclass(frozen=True, eq=False)
class Node:
    """A place that moves, in the space of another one.

    Attributes:
        parent: index into ``Scene.nodes``, less than its own; -1 for the world.
        translation, rotation, scale: at rest; rotation is a quaternion (x, y, z, w).
        matrix: ``(4, 4)`` float64 instead of these three, or None.
        weights: of the morph targets, at rest.
        curves: by name (translation, rotation, scale, weights), what these become over time; a
            rotation of three numbers is in degrees about X, then Y, then Z.
    """

    parent: int = -1
    translation: tuple[float, ...] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, ...] = (1.0, 1.0, 1.0)
    matrix: np.ndarray | None = None
    weights: tuple[float, ...] = ()
    curves: dict[str, Curve] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Skin:
    """What moves the vertices of a mesh with joints.

    Attributes:
        joints: indices into ``Scene.nodes``.
        inverse_bind: ``(j, 4, 4)`` float64, from the mesh's space to each joint's.
    """

    joints: tuple[int, ...]
    inverse_bind: np.ndarray


@dataclass(frozen=True, eq=False)
class Morphs:
    """Other forms of a mesh, as differences: ``(t, n, 3)`` float32 each, or None for no change."""

    positions: np.ndarray | None
    normals: np.ndarray | None
    tangents: np.ndarray | None


@dataclass(frozen=True)
class Mesh:
    """Triangles in their own space.

    Attributes:
        positions: ``(n, 3)`` float32.
        triangles: ``(m, 3)`` uint32, every index below ``n`` (readers check it).
        normals: ``(n, 3)`` float32 unit shading normals, or None for flat shading.
        uvs, uvs1: ``(n, 2)`` float32, or None.
        colors: ``(n, 4)`` float32, linear RGB and alpha that multiply the base colour, or None.
        tangents: ``(n, 4)`` float32: where u grows, and 1 or -1, the sign of the bitangent that is
            normal x tangent; None to derive them from the normal map's coordinates.
        morphs: what the weights of ``Shape.node`` add, or None.
        joints, weights: ``(n, k)`` uint32 and float32 (each row's sum is 1): how far each joint of
            ``Shape.skin`` moves a vertex; None without a skin.
    """

    name: str
    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    uvs1: np.ndarray | None = None
    colors: np.ndarray | None = None
    tangents: np.ndarray | None = None
    morphs: Morphs | None = None
    joints: np.ndarray | None = None
    weights: np.ndarray | None = None


@dataclass(frozen=True)
class Shape:
    """One placing of a mesh.

    Attributes:
        transform: ``(4, 4)`` float64, object to world, column vectors (``world = M @ object``).
            A negative determinant mirrors the mesh: its front stays the front.
        material: index into ``Scene.materials``.
        node: index into ``Scene.nodes`` of what the transform follows over time; -1 for none.
        skin: what moves the vertices instead of the transform, or None.
    """

    name: str
    mesh: Mesh
    transform: np.ndarray
    material: int
    node: int = -1
    skin: Skin | None = None


@dataclass(frozen=True)
class Light:
    """A light without extent.

    Attributes:
        kind: ``"point"``, ``"spot"`` or ``"directional"``.
        intensity: ``(3,)``; candela for point and spot, lux for directional.
        position: ``(3,)``; unused by directional.
        direction: ``(3,)`` unit, the way the light travels; unused by point.
        range: meters at which the light has faded out as KHR_lights_punctual says; inf for none.
        inner_angle, outer_angle: half angles of the cone, radians.
        node: index into ``Scene.nodes`` of what position and direction (its -Z) follow; -1: none.
        intensity_curve: what ``intensity`` becomes over time, or None.
    """

    kind: str
    intensity: tuple[float, float, float]
    name: str = ""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    range: float = float("inf")
    inner_angle: float = 0.0
    outer_angle: float = 0.7853981633974483
    node: int = -1
    intensity_curve: Curve | None = None


@dataclass(frozen=True)
class Environment:
    """Light from infinitely far away.

    Attributes:
        radiance: ``(3,)``; the whole sky, or the factor of ``image``.
        image: ``(h, w, 3)`` float32 lat-long radiance, finite and not negative, or None.  Local
            direction ``(x, y, z)`` is at ``u = atan2(x, -z) / 2 pi`` (wrapped to [0, 1)) and
            ``v = acos(y) / pi``; row 0 is the zenith.
        rotation: ``(3, 3)`` float64, local to world, orthonormal.
    """

    radiance: tuple[float, float, float] = (0.0, 0.0, 0.0)
    image: np.ndarray | None = None
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))


@dataclass(frozen=True, eq=False)
class View:
    """Where a camera is over time, by two points."""

    position: Curve
    target: Curve
    up: tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """A perspective or orthographic camera; it looks along its local -Z, its local +Y is up.

    Attributes:
        transform: ``(4, 4)`` float64, camera to world, rotation and translation only.
        fov_y: vertical field of view, radians.
        lens_radius: meters; 0 is a pinhole.
        focus_distance: meters along the view direction that are sharp; used if lens_radius > 0.
        height: meters from the bottom of the film to its top if rays are parallel, which start in
            the camera's plane and know no lens; 0 if they start in a point.
        node: index into ``Scene.nodes`` of what the transform follows over time; -1 for none.
        view: what the transform becomes over time instead, or None.
    """

    transform: np.ndarray
    fov_y: float = 0.7853981633974483
    name: str = ""
    lens_radius: float = 0.0
    focus_distance: float = 1.0
    height: float = 0.0
    node: int = -1
    view: View | None = None


@dataclass(frozen=True)
class Scene:
    """All that a scene file says.

    Attributes:
        path: the file it came from, as the user wrote it.
        width, height: pixels, from the file or the defaults.
        camera: index into ``cameras`` of the one to use unless another is asked for.
        render: the ``[render]`` table, unchecked (``settings.resolve`` checks it).
        notes: what the reader assumed or left out, one sentence each, to be told to the user.
        files: every file that was read for it.
        nodes: what things move with.
    """

    path: str
    width: int = 512
    height: int = 512
    cameras: tuple[Camera, ...] = ()
    camera: int = 0
    textures: tuple[Texture, ...] = ()
    materials: tuple[Material, ...] = (Material(),)
    shapes: tuple[Shape, ...] = ()
    lights: tuple[Light, ...] = ()
    environment: Environment = Environment()
    render: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    nodes: tuple[Node, ...] = ()


def limited(radiance: Iterable[float]) -> tuple[float, float, float]:
    """Return an RGB triple with no component above ``MAX_RADIANCE``."""
    red, green, blue = (min(float(value), MAX_RADIANCE) for value in radiance)
    return red, green, blue


def emits(material: Material) -> bool:
    """Return whether ``material`` is a light, if not now then at another time."""
    return (max(material.emission) > 0.0 or material.emission_curve is not None) and (
        not material.unlit
    )


def is_cut_out(material: Material, mesh: Mesh | None = None) -> bool:
    """Return whether hits on ``material``, on ``mesh`` if given, must look up their alpha."""
    if material.alpha_mode == "opaque" or is_invisible(material):
        return False
    if material.base_color_texture >= 0:
        return True
    if mesh is not None and mesh.colors is not None and bool((mesh.colors[:, 3] < 1.0).any()):
        return True
    return material.alpha_mode == "blend" and material.alpha < 1.0


def is_invisible(material: Material) -> bool:
    """Return whether ``material`` is cut out everywhere: its shapes are not there."""
    least = {"mask": material.alpha_cutoff, "blend": 1e-6}.get(material.alpha_mode, 0.0)
    return material.alpha < least


def lets_through(material: Material) -> bool:
    """Return whether light passes ``material`` somewhere: where it is not metal."""
    not_metal = material.metallic < 1.0 or material.metallic_roughness_texture >= 0
    return material.transmission > 0.0 and not_metal


def hides_back(material: Material) -> bool:
    """Return whether the camera looks through ``material`` from behind."""
    return material.back_hidden and not lets_through(material)


def has_tangents(material: Material) -> bool:
    """Return whether directions along the surface matter to ``material``."""
    return material.normal_texture >= 0 or material.anisotropy > 0.0


def has_layers(material: Material) -> bool:
    """Return whether ``material`` has more than metal, glass and a plain coat over a base."""
    return (
        material.clearcoat > 0.0
        or max(material.sheen_color) > 0.0
        or material.anisotropy > 0.0
        or material.specular_color != (1.0, 1.0, 1.0)
        or material.specular_texture >= 0
        or material.specular_color_texture >= 0
    )


def shines(light: Light) -> bool:
    """Return whether ``light`` gives any light, if not now then at another time."""
    return max(light.intensity) > 0.0 or light.intensity_curve is not None


def has_environment(environment: Environment) -> bool:
    """Return whether any light comes from infinitely far away."""
    if max(environment.radiance) <= 0.0:
        return False
    return environment.image is None or bool((environment.image > 0.0).any())
