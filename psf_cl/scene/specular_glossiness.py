"""Turn colours of KHR_materials_pbrSpecularGlossiness into those of a metallic material."""

from __future__ import annotations

import numpy as np

from psf_cl.scene.texture import decoded_srgb

#: Reflectance at normal incidence of what is no metal.
DIELECTRIC = 0.04

#: Rows of a picture that are computed at once, to need little memory beside it.
_ROWS = 64


def to_metallic(diffuse: np.ndarray, specular: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return base colours ``(..., 3)`` and metallic strengths ``(...)``.

    The diffuse albedo is ``diffuse * (1 - max(specular))``; the metallic material has
    ``base * (1 - m)`` and reflects ``0.04 (1 - m) + base * m``.  Both equations in the mean of the
    channels make one quadratic equation for ``m``; the base colour follows from the diffuse part
    where ``m`` is small and from the specular part where it is large.

    Args:
        diffuse, specular: linear RGB, ``(..., 3)``, 0 to 1.
    """
    albedo = diffuse * (1.0 - specular.max(axis=-1, keepdims=True)) / (1.0 - DIELECTRIC)
    d, s = albedo.mean(axis=-1), specular.mean(axis=-1)
    half = 0.5 * (d + s - 2.0 * DIELECTRIC)
    root = np.sqrt(np.maximum(half**2 + DIELECTRIC * (s - DIELECTRIC), 0.0))
    metallic = np.where(s > DIELECTRIC, np.clip((root - half) / DIELECTRIC, 0.0, 1.0), 0.0)
    m = metallic[..., None]
    from_diffuse = albedo / np.maximum(1.0 - m, 1e-4)
    from_specular = (specular - DIELECTRIC * (1.0 - m)) / np.maximum(m, 1e-4)
    base = from_diffuse + (from_specular - from_diffuse) * m**2
    return np.clip(base, 0.0, 1.0), metallic


def convert_pictures(
    diffuse: np.ndarray,
    diffuse_factor: np.ndarray,
    specular: np.ndarray,
    factors: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pictures of the base colour and of roughness (green) and metallic strength (blue).

    Args:
        diffuse, specular: ``(h, w, 4)`` uint8; colours are sRGB, alpha is opacity and glossiness.
            They may differ in size: the results are as fine along each axis as the finer one.
        diffuse_factor: ``(3,)``, linear; the opacity's is left to the material.
        factors: ``(4,)``, of the specular colour and the glossiness.
    """
    height, width = (int(n) for n in np.maximum(diffuse.shape[:2], specular.shape[:2]))
    base = np.empty((height, width, 4), np.uint8)
    rough = np.full((height, width, 4), 255, np.uint8)
    for top in range(0, height, _ROWS):
        rows = np.arange(top, min(top + _ROWS, height))
        d, s = (_rows(picture, rows, height, width) for picture in (diffuse, specular))
        color, metallic = to_metallic(
            _linear(d[..., :3]) * diffuse_factor, _linear(s[..., :3]) * factors[:3]
        )
        base[rows, :, :3] = np.rint(_encoded(color) * 255.0)
        base[rows, :, 3] = d[..., 3]
        rough[rows, :, 1] = np.rint(255.0 - s[..., 3] * factors[3])
        rough[rows, :, 2] = np.rint(metallic * 255.0)
    return base, rough


def _rows(picture: np.ndarray, rows: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return rows of ``picture`` stretched to a size, by the nearest texel."""
    own_height, own_width = picture.shape[:2]
    columns = np.arange(width) * own_width // width
    return picture[(rows * own_height // height)[:, None], columns[None, :]]


def _linear(code: np.ndarray) -> np.ndarray:
    return decoded_srgb(np.arange(256) / 255.0).astype(np.float32)[code]


def _encoded(linear: np.ndarray) -> np.ndarray:
    bright = 1.055 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, bright)
