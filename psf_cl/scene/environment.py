"""Environment images: lat-long radiance from OpenEXR (.exr) and Radiance (.hdr) files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import read_file
from psf_cl.image import read_exr
from psf_cl.scene.model import MAX_RADIANCE

SUFFIXES = (".exr", ".hdr")
MAX_PIXELS = 1 << 27


def load_environment(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the radiance of a lat-long image, and notes on texels that had to be mended.

    Returns:
        ``(height, width, 3)`` float32, linear Rec.709, finite, not negative; row 0 is the zenith.
        Negative and NaN texels become 0, infinite ones the largest finite value of the image, but
        none is above ``MAX_RADIANCE``.

    Raises:
        InputError: missing or broken file, no colour channels, or more than ``MAX_PIXELS``.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: expected an environment image, {' or '.join(SUFFIXES)}")
    if suffix == ".exr":
        radiance = read_exr(path).rgb
        _check_size(path, radiance.shape[1], radiance.shape[0])
    else:
        radiance = _read_hdr(path, read_file(path))
    return _mended(path, radiance)


def _mended(path: Path, radiance: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    infinite = np.isposinf(radiance)
    dark = ~(radiance >= 0)
    extreme = np.isfinite(radiance) & (radiance > MAX_RADIANCE)
    if not (infinite.any() or dark.any() or extreme.any()):
        return radiance, ()
    notes = []
    if dark.any():
        notes.append(f"{path}: {dark.any(axis=-1).sum()} negative or NaN texels are set to 0")
    if extreme.any():
        count = extreme.any(axis=-1).sum()
        notes.append(f"{path}: {count} texels above {MAX_RADIANCE:g} are set to that")
        radiance = np.where(extreme, np.float32(MAX_RADIANCE), radiance)
    if infinite.any():
        finite = radiance[np.isfinite(radiance)]
        brightest = max(float(finite.max(initial=0.0)), 1.0)
        count = infinite.any(axis=-1).sum()
        notes.append(f"{path}: {count} infinite texels are set to {brightest:g}")
        radiance = np.where(infinite, np.float32(brightest), radiance)
    return np.where(dark, np.float32(0), radiance), tuple(notes)


def _check_size(path: Path, width: int, height: int) -> None:
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise InputError(f"{path}: size {width}x{height} is not between 1 and {MAX_PIXELS} pixels")


def _read_hdr(path: Path, data: bytes) -> np.ndarray:
    """Return the pixels of a Radiance picture.

    A shared exponent of 0 is black; else a channel is ``mantissa * 2^(exponent - 136)``, so that
    written powers of two come back exactly; a file's ``EXPOSURE`` lines are divided out.

    Source: Ward, "Real Pixels", Graphics Gems II, 1991, and the Radiance file format notes.
    """
    header, blank, rest = data.partition(b"\n\n")
    size_line, newline, body = rest.partition(b"\n")
    lines = header.decode("latin-1").splitlines()
    if not blank or not newline or not lines or not lines[0].startswith("#?"):
        raise InputError(f"{path}: not a Radiance picture (no #? header)")
    exposure = 1.0
    for line in lines[1:]:
        key, _, value = line.partition("=")
        if key == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise InputError(f"{path}: expected FORMAT=32-bit_rle_rgbe; got {value.strip()[:40]!r}")
        if key == "EXPOSURE":
            exposure *= _number(value)
            if not 1e-30 < exposure < 1e30:
                raise InputError(f"{path}: EXPOSURE must be positive; got {value.strip()[:40]!r}")
    match = re.fullmatch(rb"([-+])Y (\d{1,9}) ([-+])X (\d{1,9})\s*", size_line)
    if match is None:
        raise InputError(f"{path}: expected a size like '-Y 512 +X 1024'; got {size_line[:40]!r}")
    width, height = int(match[4]), int(match[2])
    _check_size(path, width, height)
    texels = _rgbe_texels(path, body, width, height)
    scale = np.ldexp(1.0 / exposure, texels[..., 3].astype(np.int32) - 136)
    scale[texels[..., 3] == 0] = 0.0
    # float64 up to here: 255 * 2^119 is the largest mantissa and exponent, and still a float32.
    radiance = (texels[..., :3] * scale[..., None]).clip(0, np.finfo(np.float32).max)
    radiance = radiance.astype(np.float32)
    return radiance[:: -1 if match[1] == b"+" else 1, :: -1 if match[3] == b"-" else 1]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _rgbe_texels(path: Path, body: bytes, width: int, height: int) -> np.ndarray:
    """Return ``(height, width, 4)`` uint8, whatever of the three encodings the file has."""
    if 8 <= width < 32768 and body[:4] == bytes([2, 2, width >> 8, width & 255]):
        texels = np.empty((height, width, 4), np.uint8)
        start = 0
        for row in range(height):
            start = _decode_row(path, body, start, texels[row])
        return texels
    flat = np.frombuffer(body[: 4 * width * height], np.uint8)
    if flat.size < 4:
        raise InputError(f"{path}: the picture is cut short")
    flat = flat[: flat.size // 4 * 4].reshape(-1, 4)
    if (flat[:, :3] == 1).all(axis=1).any():
        flat = _expand_repeats(flat, width * height)
    if len(flat) < width * height:
        raise InputError(f"{path}: the picture is cut short")
    return flat[: width * height].reshape(height, width, 4)


def _decode_row(path: Path, body: bytes, start: int, row: np.ndarray) -> int:
    """Fill one run-length encoded ``row``, ``(width, 4)``; return where the next one starts."""
    width = len(row)
    if body[start : start + 4] != bytes([2, 2, width >> 8, width & 255]):
        raise InputError(f"{path}: the picture is broken or cut short")
    start += 4
    for channel in range(4):
        pixels = bytearray()
        while len(pixels) < width:
            count = body[start] if start < len(body) else 0
            run = count > 128
            used = 1 if run else count
            piece = body[start + 1 : start + 1 + used]
            if count == 0 or len(piece) < used:
                raise InputError(f"{path}: the picture is broken or cut short")
            pixels += piece * (count - 128) if run else piece
            start += 1 + used
        if len(pixels) != width:
            raise InputError(f"{path}: a run of equal pixels leaves its row")
        row[:, channel] = np.frombuffer(bytes(pixels), np.uint8)
    return start


def _expand_repeats(flat: np.ndarray, count: int) -> np.ndarray:
    """Expand the oldest encoding: a texel (1, 1, 1, n) repeats the one before it n times.

    Several in a row are the digits of one count, the lowest first.
    """
    pieces: list[np.ndarray] = []
    last = flat[:1]
    total, shift = 0, 0
    for texel in flat:
        if pieces and (texel[:3] == 1).all():
            repeats = min(int(texel[3]) << shift, count - total)
            shift = min(shift + 8, 32)
        else:
            last, repeats, shift = texel[None], 1, 0
        pieces.append(np.repeat(last, repeats, axis=0))
        total += repeats
        if total >= count:
            break
    return np.concatenate(pieces)
