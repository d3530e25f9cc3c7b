"""Scenes in memory for tests: a few lines each, no files."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import (
    Camera,
    Environment,
    Light,
    Material,
    Mesh,
    Scene,
    Shape,
    Texture,
)
from psf_cl.settings import Settings

if TYPE_CHECKING:
    from psf_cl.device.device import Device
    from psf_cl.image import Image

Vector = Sequence[float] | np.ndarray
#: Traits of devices that trace up to so much without a tree.
SMALL = {"few_triangles": 160, "few_corners": 128, "few_plates": 160}

IDENTITY = np.eye(4)


def lambertian(reflectance: float | Vector, **values: Any) -> Material:
    """Return a material without a coat: f = reflectance / pi."""
    return Material(base_color=grey(reflectance), specular=0.0, **values)


def glowing(radiance: float | Vector, reflectance: float | Vector = 0.0, **values: Any) -> Material:
    """Return a Lambertian material that emits."""
    return lambertian(reflectance, emission=grey(radiance), **values)


def grey(value: float | Vector) -> tuple[float, float, float]:
    """Return a colour from one number, or from three."""
    red, green, blue = np.broadcast_to(np.asarray(value, float), 3).tolist()
    return red, green, blue


def camera(
    position: Vector,
    target: Vector,
    fov_y_degrees: float = 40.0,
    up: Vector = (0.0, 1.0, 0.0),
    **values: Any,
) -> Camera:
    """Return a camera that looks from ``position`` at ``target``."""
    return Camera(
        transform.look_at(position, target, up), float(np.radians(fov_y_degrees)), **values
    )


def build(
    parts: Iterable[tuple[Mesh, np.ndarray, Material]],
    view: Camera,
    size: tuple[int, int] = (8, 8),
    *,
    lights: Sequence[Light] = (),
    environment: float | Environment = 0.0,
    textures: Sequence[Texture] = (),
) -> Scene:
    """Return a scene of ``(mesh, object to world, material)`` parts.

    Args:
        size: width and height, pixels.
        environment: a record, or the radiance of a constant grey sky.
    """
    parts = list(parts)
    if not isinstance(environment, Environment):
        environment = Environment(grey(environment))
    return Scene(
        path="test scene",
        width=size[0],
        height=size[1],
        cameras=(view,),
        textures=tuple(textures),
        materials=tuple(material for _, _, material in parts) or (Material(),),
        shapes=tuple(
            Shape(mesh.name, mesh, np.asarray(matrix, float), index)
            for index, (mesh, matrix, _) in enumerate(parts)
        ),
        lights=tuple(lights),
        environment=environment,
    )


def floor(half_size: float, material: Material) -> tuple[Mesh, np.ndarray, Material]:
    """Return a square in the plane y = 0 that faces +Y."""
    return primitives.quad(), transform.scaling(half_size), material


def inside_out(mesh: Mesh) -> Mesh:
    """Return ``mesh`` with its front on the other side; flat."""
    return dataclasses.replace(mesh, triangles=mesh.triangles[:, ::-1].copy(), normals=None)


def flat(mesh: Mesh) -> Mesh:
    """Return ``mesh`` without shading normals."""
    return dataclasses.replace(mesh, normals=None)


def dented_bowl(columns: int = 24, rows: int = 12) -> Mesh:
    """Return an open, non-convex cup around the origin, about 1 in size, its opening towards +Y."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    azimuth = 2 * np.pi * u
    polar = np.radians(50) + v * np.radians(130)
    radius = 1 + 0.25 * np.sin(3 * azimuth) * np.sin(2 * polar) - 0.4 * np.cos(polar / 2) ** 8
    points = radius[..., None] * np.stack(
        [np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], axis=-1
    )
    points[:, -1] = points[:, 0]
    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    corner = row * (columns + 1) + column
    below = corner + columns + 1
    triangles = np.concatenate(
        [
            np.stack([corner, corner + 1, below + 1], axis=-1).reshape(-1, 3),
            np.stack([corner, below + 1, below], axis=-1)[:-1].reshape(-1, 3),
        ]
    )
    return Mesh("bowl", points.reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))


def renderer(
    device: Device, scene: Scene, outputs: Iterable[str] = (), crop: Any = None, **settings: Any
) -> Renderer:
    """Return a renderer of ``scene`` with ``settings`` over the defaults."""
    return Renderer(scene, Settings(**settings), device, outputs, crop)


def render(
    device: Device,
    scene: Scene,
    spp: int,
    outputs: Iterable[str] = (),
    crop: Any = None,
    **settings: Any,
) -> Image:
    """Return the image of ``spp`` samples a pixel, with ``outputs`` and the statistics."""
    opened = renderer(device, scene, outputs, crop, **settings)
    try:
        opened.render(spp=spp)
        return opened.image()
    finally:
        opened.close()


def film_points(view: Camera, size: tuple[int, int], sub: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return camera rays through a ``sub`` x ``sub`` grid of midpoints in every pixel.

    Returns:
        origin, ``(3,)``, and unit directions, ``(height, width, sub * sub, 3)``; world space.
    """
    width, height = size
    scale = np.tan(view.fov_y / 2)
    x = (np.arange(width * sub) + 0.5) / (width * sub) * 2 - 1
    y = 1 - (np.arange(height * sub) + 0.5) / (height * sub) * 2
    px, py = np.meshgrid(x * scale * width / height, y * scale)
    local = np.stack([px, py, -np.ones_like(px)], axis=-1)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    world = local @ view.transform[:3, :3].T
    grid = world.reshape(height, sub, width, sub, 3).transpose(0, 2, 1, 3, 4)
    return view.transform[:3, 3], grid.reshape(height, width, sub * sub, 3)


def floor_points(view: Camera, size: tuple[int, int], sub: int = 4) -> np.ndarray:
    """Return where those rays meet the plane y = 0: ``(height, width, sub * sub, 3)``."""
    origin, directions = film_points(view, size, sub)
    return origin - directions * (origin[1] / directions[..., 1:2])


def block_means(image: np.ndarray, blocks: int) -> np.ndarray:
    """Return the means over ``blocks`` x ``blocks`` equal parts of ``(height, width, c)``."""
    height, width, channels = image.shape
    parts = image.astype(np.float64).reshape(
        blocks, height // blocks, blocks, width // blocks, channels
    )
    return parts.mean(axis=(1, 3))


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def assert_blocks_equal(image: Image, truth: Any, tolerance: float, blocks: int = 4) -> None:
    """Check every block of ``rgb`` against ``truth``, within a relative ``tolerance``."""
    np.testing.assert_allclose(
        block_means(image.rgb, blocks), np.broadcast_to(truth, (blocks, blocks, 3)), rtol=tolerance
    )


def luminance_blocks(image: Image, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Return means of luminance over blocks and their variances, both ``(blocks, blocks)``.

    Of independent samples only.
    """
    pixels_per_block = image.width * image.height / blocks**2
    means = block_means(image.rgb, blocks) @ LUMINANCE
    variances = block_means(image.aovs["variance"], blocks)[..., 0] / pixels_per_block
    return means, variances


def z_scores(image: Image, truth: Image | float, blocks: int) -> np.ndarray:
    """Return the deviations of luminance blocks from ``truth`` in standard errors."""
    means, variances = luminance_blocks(image, blocks)
    if not isinstance(truth, float):
        truth, more = luminance_blocks(truth, blocks)
        variances = variances + more
    return (means - truth) / np.sqrt(variances)
