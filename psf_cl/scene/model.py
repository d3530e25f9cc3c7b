"""A scene as plain NumPy data: read-only, no files, no OpenCL.

Meters, Y up, right-handed.  Radiance, candela and lux are linear Rec.709 triples, taken as numbers.
Every reader (TOML, glTF, OBJ, PLY, STL) fills these records and nothing else.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

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
    """

    name: str
    pixels: np.ndarray
    srgb: bool = True
    wrap: tuple[str, str] = ("repeat", "repeat")
    filter: str = "linear"


@dataclass(frozen=True)
class Material:
    """Parameters of the one BSDF; the names are glTF's.

    Attributes:
        base_color: linear RGB in [0, 1]; multiplied by ``base_color_texture`` where that is set.
        base_color_texture, emission_texture: index into ``Scene.textures``; -1 for none.
        alpha, alpha_cutoff: with ``alpha_mode == "mask"`` a point is there if
            ``alpha * texture alpha >= alpha_cutoff``; ``"opaque"`` ignores both.
        roughness: GGX alpha is its square.
        specular: strength of the dielectric reflection; 0 makes a pure Lambertian surface.
        transmission: 0 for opaque, 1 for glass.
        emission: radiance (emissive factor times strength), multiplied by ``emission_texture``.
        double_sided: whether both sides *emit*; surfaces always reflect on both sides.
    """

    name: str = "default"
    base_color: tuple[float, float, float] = (0.8, 0.8, 0.8)
    base_color_texture: int = -1
    alpha: float = 1.0
    alpha_mode: str = "opaque"
    alpha_cutoff: float = 0.5
    metallic: float = 0.0
    roughness: float = 1.0
    specular: float = 1.0
    ior: float = 1.5
    transmission: float = 0.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_texture: int = -1
    double_sided: bool = False


@dataclass(frozen=True)
class Mesh:
    """Triangles in their own space.

    Attributes:
        positions: ``(n, 3)`` float32.
        triangles: ``(m, 3)`` uint32, every index below ``n`` (readers check it).
        normals: ``(n, 3)`` float32 unit shading normals, or None for flat shading.
        uvs: ``(n, 2)`` float32, or None.
    """

    name: str
    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None


@dataclass(frozen=True)
class Shape:
    """One placing of a mesh.

    Attributes:
        transform: ``(4, 4)`` float64, object to world, column vectors (``world = M @ object``).
            A negative determinant mirrors the mesh: its front stays the front.
        material: index into ``Scene.materials``.
    """

    name: str
    mesh: Mesh
    transform: np.ndarray
    material: int


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
    """

    kind: str
    intensity: tuple[float, float, float]
    name: str = ""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    range: float = float("inf")
    inner_angle: float = 0.0
    outer_angle: float = 0.7853981633974483


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


@dataclass(frozen=True)
class Camera:
    """A perspective camera; it looks along its local -Z, its local +Y is up.

    Attributes:
        transform: ``(4, 4)`` float64, camera to world, rotation and translation only.
        fov_y: vertical field of view, radians.
        lens_radius: meters; 0 is a pinhole.
        focus_distance: meters along the view direction that are sharp; used if lens_radius > 0.
    """

    transform: np.ndarray
    fov_y: float
    name: str = ""
    lens_radius: float = 0.0
    focus_distance: float = 1.0


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


def limited(radiance: Iterable[float]) -> tuple[float, float, float]:
    """Return an RGB triple with no component above ``MAX_RADIANCE``."""
    red, green, blue = (min(float(value), MAX_RADIANCE) for value in radiance)
    return red, green, blue


def emits(material: Material) -> bool:
    """Return whether ``material`` is a light."""
    return max(material.emission) > 0.0


def is_cut_out(material: Material) -> bool:
    """Return whether hits on ``material`` must look up its alpha."""
    return material.alpha_mode == "mask" and material.base_color_texture >= 0


def is_invisible(material: Material) -> bool:
    """Return whether ``material`` is cut out everywhere: its shapes are not there."""
    return (
        material.alpha_mode == "mask"
        and material.base_color_texture < 0
        and material.alpha < material.alpha_cutoff
    )


def shines(light: Light) -> bool:
    """Return whether ``light`` gives any light."""
    return max(light.intensity) > 0.0


def has_environment(environment: Environment) -> bool:
    """Return whether any light comes from infinitely far away."""
    if max(environment.radiance) <= 0.0:
        return False
    return environment.image is None or bool((environment.image > 0.0).any())
