"""Decode 8- and 16-bit image files to RGBA pixels."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from psf_cl.errors import InputError
from psf_cl.files import read_file
from psf_cl.scene.model import Texture

# Formats that textures come in; Pillow's other readers, some of which start programs, stay shut.
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "PPM", "TGA", "TIFF")

MAX_PIXELS = 1 << 26

# What Pillow's readers are known to raise on broken files; none of it says more than "broken".
_PILLOW_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    LookupError,
    TypeError,
    EOFError,
    OverflowError,
    MemoryError,
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)


def load_texture(path: Path, srgb: bool = True) -> Texture:
    """Read an image file as a repeating, linearly filtered texture named like the file.

    Raises:
        InputError: the file cannot be read, or ``decode_pixels`` refuses it.
    """
    return Texture(path.name, decode_pixels(read_file(path), str(path)), srgb)


def decode_pixels(data: bytes, source: str) -> np.ndarray:
    """Return the pixels of an encoded image, ``(height, width, 4)`` uint8, first row on top.

    Grey is spread over the colours, palettes are looked up, 16 bits become 8; colour profiles and
    EXIF rotation are ignored, as glTF asks.  Of an animation the first frame is taken.

    Args:
        source: what to call the image in errors.

    Raises:
        InputError: unknown format, broken or truncated data, or more than ``MAX_PIXELS`` pixels.
    """
    try:
        with warnings.catch_warnings():
            # Pillow warns of large images, which are refused below, and of unused metadata.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                width, height = image.size
                if width * height > MAX_PIXELS:
                    raise InputError(
                        f"{source}: unreadable texture: expected at most {MAX_PIXELS} pixels, "
                        f"got {width} x {height}"
                    )
                return _rgba(image, source)
    except _PILLOW_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, Image.UnidentifiedImageError):
            reason = f"expected one of {', '.join(FORMATS)}"
        raise InputError(f"{source}: unreadable texture: {reason}") from None


def _rgba(image: Image.Image, source: str) -> np.ndarray:
    if image.mode == "F":
        raise InputError(f"{source}: unreadable texture: expected 8 or 16 bits, got floats")
    if not image.mode.startswith("I"):
        return np.array(image.convert("RGBA"))
    # Pillow would clip 16-bit grey at 255 instead of scaling it.
    grey = np.clip(np.asarray(image).astype(np.int64), 0, 65535)
    pixels = np.full((*grey.shape, 4), 255, np.uint8)
    pixels[..., :3] = ((grey + 128) // 257)[..., None]
    return pixels


def decoded_srgb(values: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB ones, both from 0 to 1 (IEC 61966-2-1)."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def mean_color(texture: Texture) -> np.ndarray:
    """Return the mean of the texels of a texture, ``(3,)``, linear."""
    codes = np.arange(256) / 255.0
    values = decoded_srgb(codes) if texture.srgb else codes
    counts = [np.bincount(texture.pixels[..., c].ravel(), minlength=256) for c in range(3)]
    return np.stack(counts) @ values / max(texture.pixels[..., 0].size, 1)


def level_sizes(width: int, height: int) -> list[tuple[int, int]]:
    """Return the sizes of the levels of an image below its own, down to one texel."""
    sizes = []
    while max(width, height) > 1:
        width, height = max(width // 2, 1), max(height // 2, 1)
        sizes.append((width, height))
    return sizes


def smaller_levels(texture: Texture) -> list[np.ndarray]:
    """Return the levels of a texture below its own: means over areas, of linear values.

    Each is ``(height, width, 4)`` uint8, coded as the texture is.
    """
    codes = np.arange(256) / 255.0
    decode = (decoded_srgb(codes) if texture.srgb else codes).astype(np.float32)
    planes = [decode[texture.pixels[..., c]] for c in range(3)]
    planes.append(texture.pixels[..., 3] / np.float32(255.0))
    levels = []
    for width, height in level_sizes(texture.pixels.shape[1], texture.pixels.shape[0]):
        planes = [_shrunk(_shrunk(plane, height).T, width).T for plane in planes]
        linear = np.clip(np.stack(planes, axis=-1), 0.0, 1.0)
        if texture.srgb:
            color = linear[..., :3]
            coded = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
            linear = np.concatenate([coded, linear[..., 3:]], axis=-1)
        levels.append(np.rint(255.0 * linear).astype(np.uint8))
    return levels


def _shrunk(rows: np.ndarray, count: int) -> np.ndarray:
    """Return means of ``(n, m)`` rows over ``count`` parts of equal length, n or half of it."""
    n = len(rows)
    if n == count:
        return rows
    if n == 2 * count:
        return 0.5 * (rows[::2] + rows[1::2])
    edges = np.arange(count + 1)[:, None] * (n / count)
    covered = np.clip(edges - np.arange(n), 0.0, 1.0)
    return ((covered[1:] - covered[:-1]) * (count / n)).astype(np.float32) @ rows
