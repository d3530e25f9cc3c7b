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
