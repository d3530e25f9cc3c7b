"""Images with named channels: what a render returns, and their EXR and PNG files."""

from __future__ import annotations

import contextlib
import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import PIL.Image

import psf_cl
from psf_cl.errors import InputError
from psf_cl.files import read_file, write_whole
from psf_cl.settings import AOVS as AOVS

# Channel letters in the file, where they are not those that the number of components implies.
_LETTERS = {"normal": "XYZ", "guide": "XYZ", "depth": "Z"}
_LETTERS_BY_COUNT = {1: "Y", 2: "XY", 3: "RGB", 4: "RGBA"}
_LETTER_ORDER = "RGBAXYZ"

# Half floats count to 2048 only; these stay float.
_ALWAYS_FLOAT = (
    "depth",
    "samples",
    "cell_count",
    "cell_variance",
    "light_pmf",
    "photons",
    "visits",
)
_HALF_MAX = 65504.0

# Stats that are the same for the same render, so that equal images are equal files.
_HEADER_STATS = (
    "scene",
    "settings",
    "seed",
    "spp",
    "device",
    "scene_digest",
    "spp_per_seed",
    "noise",
)

# Numbers in one file: a damaged header must not ask for more memory than this times 4 bytes.
_MAX_VALUES = 1 << 30


@dataclass
class Image:
    """One picture and what is known about it.

    Attributes:
        aovs: name to ``(height, width, c)`` float32; ``"rgb"`` is always there, linear Rec.709.
            Row 0 is the top.
        stats: as ``--stats`` writes it; of a file that was read, only what its header has.
        x, y: where the top left pixel lies in the full picture; not 0 for a crop.
        full_width, full_height: size of the full picture; 0 (the default) means the arrays' size.
    """

    aovs: dict[str, np.ndarray]
    stats: dict[str, Any] = field(default_factory=dict)
    x: int = 0
    y: int = 0
    full_width: int = 0
    full_height: int = 0

    def __post_init__(self) -> None:
        for name, pixels in self.aovs.items():
            if pixels.ndim != 3 or pixels.shape[:2] != self.rgb.shape[:2]:
                raise ValueError(f"{name}: shape {pixels.shape}, rgb: {self.rgb.shape}")
        self.full_width = self.full_width or self.width
        self.full_height = self.full_height or self.height

    @property
    def rgb(self) -> np.ndarray:
        return self.aovs["rgb"]

    @property
    def width(self) -> int:
        return self.rgb.shape[1]

    @property
    def height(self) -> int:
        return self.rgb.shape[0]

    def covers(self, other: Image) -> bool:
        """Say whether ``other`` is this picture or a crop that lies within it."""
        return (
            (self.full_width, self.full_height) == (other.full_width, other.full_height)
            and self.x <= other.x
            and self.y <= other.y
            and other.x + other.width <= self.x + self.width
            and other.y + other.height <= self.y + self.height
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> Image:
        """Return a part; ``x`` and ``y`` count in the full picture.  The arrays are views.

        Raises:
            ValueError: this image does not cover that part.
        """
        left, top = x - self.x, y - self.y
        right, bottom = left + width, top + height
        if not (0 <= left <= right <= self.width and 0 <= top <= bottom <= self.height):
            raise ValueError(f"crop {x},{y},{width},{height} leaves the image")
        part = np.s_[top:bottom, left:right]
        aovs = {name: pixels[part] for name, pixels in self.aovs.items()}
        return Image(aovs, self.stats, x, y, self.full_width, self.full_height)


def output_paths(out: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Return the paths of the EXR and of the PNG beside it.

    Raises:
        InputError: ``out`` does not end in ``.exr``.
    """
    exr = Path(out)
    if exr.suffix.lower() != ".exr":
        raise InputError(f"{out}: expected a name that ends in .exr (the .png goes beside it)")
    return exr, exr.with_suffix(".png")


def write_exr(path: str | os.PathLike[str], image: Image, half: bool = False) -> None:
    """Write all AOVs into one EXR file, whole or not at all.

    ``rgb`` has the channels R, G, B; another AOV has ``name.`` and a letter: ``albedo.R``,
    ``normal.X``, ``depth.Z``, ``samples.Y``.  A crop is the data window inside the display window.
    String attributes ``psf_cl.*`` (JSON) hold version, settings, seed, samples and device.

    Args:
        half: 16-bit floats; values beyond 65504 become 65504, depth and samples stay 32-bit.

    Raises:
        InputError: the file cannot be written.
    """
    channels = {}
    for name, pixels in image.aovs.items():
        letters = _LETTERS.get(name, _LETTERS_BY_COUNT.get(pixels.shape[2], ""))
        if len(letters) != pixels.shape[2]:
            raise ValueError(f"{name}: no channel names for {pixels.shape[2]} components")
        prefix = "" if name == "rgb" else f"{name}."
        for index, letter in enumerate(letters):
            plane = pixels[..., index].astype(np.float32)
            if half and name not in _ALWAYS_FLOAT:
                limited = np.clip(plane, -_HALF_MAX, _HALF_MAX)
                plane = np.where(np.isfinite(plane), limited, plane).astype(np.float16)
            # OpenEXR 3.5.3 ignores strides and would write other pixels, without a word.
            channels[prefix + letter] = np.ascontiguousarray(plane)
    header: dict[str, Any] = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "dataWindow": _box(image.x, image.y, image.width, image.height),
        "displayWindow": _box(0, 0, image.full_width, image.full_height),
    }
    known = {name: image.stats[name] for name in _HEADER_STATS if name in image.stats}
    for name, value in {"version": psf_cl.__version__, **known}.items():
        header[f"psf_cl.{name}"] = json_text(value)
    # To memory first: OpenEXR does not notice that a disk is full.
    buffer = io.BytesIO()
    with OpenEXR.File(header, channels) as file:
        file.write(buffer)
    write_whole(path, buffer.getvalue())


def read_exr(path: str | os.PathLike[str]) -> Image:
    """Read half, float and integer channels in any order, of the first part of an EXR file.

    Channels ``layer.R``, ``layer.G``, ... become one AOV ``layer``; a file with only Y is grey.

    Raises:
        InputError: missing, not an EXR file, damaged, or of a kind that has no plain pixels.
    """
    data = read_file(Path(path))
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise InputError(f"{path}: expected an OpenEXR image")
    try:
        with _library_silenced():
            with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True) as file:
                header = dict(file.header())  # Leaving the block empties the file's own.
            _check_size(header, path)
            with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
                planes = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError, OverflowError, MemoryError) as error:
        raise InputError(f"{path}: damaged or truncated OpenEXR image") from error

    (x, y), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
    (left, top), (full_right, full_bottom) = (c.tolist() for c in header["displayWindow"])
    shape = (bottom - y + 1, right - x + 1)
    for name, plane in planes.items():
        if plane is None or plane.dtype.kind not in "fu" or plane.shape != shape:
            raise InputError(f"{path}: channel {name} is deep or subsampled; expected plain pixels")
    if "Y" in planes and not planes.keys() & set("RGB"):
        planes |= dict.fromkeys("RGB", planes.pop("Y"))
    if not planes.keys() >= set("RGB"):
        listed = ", ".join(sorted(planes)[:12]) or "none"
        raise InputError(f"{path}: expected channels R, G, B or Y; there are: {listed}")

    layers: dict[str, list[tuple[int, str]]] = {}
    for name in planes:
        layer, _, letter = name.rpartition(".")
        known = letter in _LETTER_ORDER and len(letter) == 1 and (layer or letter in "RGB")
        order = _LETTER_ORDER.index(letter) if known else 0
        layers.setdefault((layer or "rgb") if known else name, []).append((order, name))
    aovs = {
        layer: np.stack([planes[name].astype(np.float32) for _, name in sorted(members)], axis=-1)
        for layer, members in layers.items()
    }
    stats = {
        name.removeprefix("psf_cl."): _parsed(value)
        for name, value in header.items()
        if name.startswith("psf_cl.") and isinstance(value, str)
    }
    return Image(aovs, stats, x - left, y - top, full_right - left + 1, full_bottom - top + 1)


def tone_map(rgb: np.ndarray, exposure_ev: float = 0.0) -> np.ndarray:
    """Return display pixels, uint8 in sRGB, for linear Rec.709 ``(h, w, 3)``.

    Multiplies by ``2^exposure_ev``; leaves colours up to 0.8 as they are; compresses what is
    brighter by its largest component, so that hue holds, and turns it slowly to white.  Pixels that
    are not finite come out magenta, to be seen.

    Source: the highlight part of the Khronos PBR Neutral tone mapper, 2024 (its toe, made for base
    colours under a given light, is left out); sRGB encoding of IEC 61966-2-1.
    """
    knee, desaturation = 0.8, 0.15
    finite = np.isfinite(rgb).all(axis=-1, keepdims=True)
    scaled = np.where(finite, np.maximum(rgb, 0.0), 0.0) * np.float64(2.0) ** exposure_ev
    peak = np.maximum(scaled.max(axis=-1, keepdims=True), knee)
    new_peak = 1.0 - (1.0 - knee) ** 2 / (peak + 1.0 - 2.0 * knee)
    whiteness = 1.0 - 1.0 / (desaturation * (peak - new_peak) + 1.0)
    linear = scaled * (new_peak / peak)
    linear += (new_peak - linear) * whiteness
    low = linear * 12.92
    high = 1.055 * np.maximum(linear, 1e-9) ** (1.0 / 2.4) - 0.055
    encoded = np.where(linear <= 0.0031308, low, high)
    return np.where(finite, np.rint(encoded * 255.0), (255, 0, 255)).astype(np.uint8)


def write_png(path: str | os.PathLike[str], image: Image, exposure_ev: float = 0.0) -> None:
    """Write ``rgb`` as ``tone_map`` shows it.

    Raises:
        InputError: the file cannot be written.
    """
    write_png_pixels(path, tone_map(image.rgb, exposure_ev))


def write_png_pixels(path: str | os.PathLike[str], pixels: np.ndarray) -> None:
    """Write ``(h, w, 3)`` uint8, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    buffer = io.BytesIO()
    PIL.Image.fromarray(pixels).save(buffer, format="png")
    write_whole(path, buffer.getvalue())


def json_text(value: Any, indent: int | None = None) -> str:
    """Return strict JSON: NumPy numbers as numbers, what is not finite as null."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False, default=str)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (np.generic, np.ndarray)):
        return _plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):  # Some other program's idea of the attribute.
        return text


def _box(x: int, y: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def _check_size(header: dict[str, Any], path: str | os.PathLike[str]) -> None:
    low, high = (corner.astype(np.int64) for corner in header["dataWindow"])
    width, height = (high - low + 1).tolist()
    count = len(header["channels"])
    if width * height * count > _MAX_VALUES:
        raise InputError(f"{path}: {width}x{height} pixels of {count} channels are too many")


@contextlib.contextmanager
def _library_silenced() -> Iterator[None]:
    """Keep OpenEXR's own messages off the terminal: it prints to both streams before it raises."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
        saved = os.dup(2)
        stack.callback(os.close, saved)
        null = os.open(os.devnull, os.O_WRONLY)
        stack.callback(os.close, null)
        os.dup2(null, 2)
        stack.callback(os.dup2, saved, 2)
        yield
