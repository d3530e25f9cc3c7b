"""How far an image is from its reference: per pixel, and per block for what noise must not hide."""

from __future__ import annotations

import importlib
from dataclasses import asdict, dataclass

import numpy as np

from psf_cl.errors import InputError
from psf_cl.image import Image
from psf_cl.scene.model import LUMINANCE

# Keeps the relative error finite in black pixels; in units of the mean luminance, squared.
_RELATIVE_FLOOR = 0.01
_TRIMMED_SHARE = 0.001
# Below this, in units of the mean luminance, halves that differ are no sign of an outlier.
_OUTLIER_FLOOR = 0.05


@dataclass(frozen=True)
class Errors:
    """Metrics of an image, both images divided by the reference's mean luminance before.

    Attributes:
        mse: mean over pixels and channels of ``(x - r)^2``.
        relmse: mean of ``(x - r)^2 / (r^2 + 0.01)``.
        relmse_trimmed: the same without the 0.1 % of pixels (rounded down) that are worst in it.
        mae: mean of ``|x - r|``.
        flip: mean HDR-FLIP, or None where flip_evaluator is not installed or was not asked for.
        nonfinite: pixels of the image with an infinity or a NaN.  The metrics are over the others
            and mean nothing if this is not 0; infinite if no pixel is left.

    Source of FLIP: Andersson et al., "Visualizing Errors in Rendered High Dynamic Range Images",
    Eurographics Short Papers, 2021.
    """

    mse: float
    relmse: float
    relmse_trimmed: float
    mae: float
    flip: float | None
    nonfinite: int

    def as_dict(self) -> dict[str, float | int]:
        """Return the metrics that there are, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True)
class BlockAgreement:
    """How two images agree after averaging over blocks, without any normalisation.

    Attributes:
        correlation: Pearson's, over all blocks and channels; NaN if one of them is constant.
        share_within: share of blocks whose luminance is within the tolerance of the reference's.
        mean_ratio: mean luminance of the image over that of the reference.
    """

    correlation: float
    share_within: float
    mean_ratio: float


def matching_part(reference: Image, image: Image, name: str = "reference") -> Image:
    """Return the part of ``reference`` that shows what ``image`` shows.

    Raises:
        InputError: ``reference`` (called ``name``) has another size, or does not cover a crop.
    """
    if reference.covers(image):
        return reference.cropped(image.x, image.y, image.width, image.height)
    same_size = (reference.width, reference.height) == (image.width, image.height)
    if same_size and not (_place(reference) and _place(image)):
        return reference  # One of them does not say that it is a crop; other programs never do.
    raise InputError(
        f"{name}: expected {_size(image)} pixels{_place(image)}; "
        f"got {_size(reference)}{_place(reference)}"
    )


def compare(image: np.ndarray, reference: np.ndarray, *, flip: bool = False) -> Errors:
    """Measure ``image`` against ``reference``, both ``(h, w, 3)`` linear Rec.709.

    Args:
        flip: also compute FLIP, which takes seconds for a large image.

    Raises:
        InputError: the sizes differ, or the reference is black or not finite.
    """
    image, reference = _checked_pair(image, reference)
    scale = 1.0 / mean_luminance(reference)
    finite = np.isfinite(image).all(axis=-1)
    nonfinite = int(finite.size - np.count_nonzero(finite))
    if nonfinite == finite.size:
        inf = float("inf")
        return Errors(inf, inf, inf, inf, None, nonfinite)
    x, r = image[finite] * scale, reference[finite] * scale
    squared = (x - r) ** 2
    relative = (squared * relative_weights(r)).mean(axis=-1)
    kept = relative.size - int(relative.size * _TRIMMED_SHARE)
    return Errors(
        mse=float(squared.mean()),
        relmse=float(relative.mean()),
        relmse_trimmed=float(np.partition(relative, kept - 1)[:kept].mean()),
        mae=float(np.abs(x - r).mean()),
        flip=_flip(image * scale, reference * scale) if flip and not nonfinite else None,
        nonfinite=nonfinite,
    )


def relative_weights(reference: np.ndarray) -> np.ndarray:
    """Return what relMSE multiplies squared differences with, for a normalised reference."""
    return 1.0 / (reference**2 + _RELATIVE_FLOOR)


def mean_luminance(reference: np.ndarray) -> float:
    """Return the mean luminance of a reference, by which it can be divided.

    Raises:
        InputError: it is black, or has pixels that are not finite.
    """
    bad = int(np.count_nonzero(~np.isfinite(reference).all(axis=-1)))
    if bad:
        raise InputError(f"the reference has {bad} pixels that are not finite")
    mean = float((reference.astype(np.float64) @ LUMINANCE).mean())
    if mean <= 0.0:
        raise InputError("the reference is black: there is nothing to measure an error by")
    return mean


def block_means(image: np.ndarray, blocks_across: int = 32) -> np.ndarray:
    """Return the means over about square blocks, ``(blocks_down, blocks_across, 3)`` float64.

    Every pixel belongs to one block; where the size does not divide, blocks differ by a pixel.

    Raises:
        InputError: the image is narrower than ``blocks_across`` pixels.
    """
    height, width = image.shape[:2]
    if not 1 <= blocks_across <= width:
        raise InputError(f"expected 1 to {width} blocks across; got {blocks_across}")
    blocks_down = min(max(round(height * blocks_across / width), 1), height)
    rows = np.arange(blocks_down) * height // blocks_down
    columns = np.arange(blocks_across) * width // blocks_across
    sums = np.add.reduceat(np.add.reduceat(image.astype(np.float64), rows, axis=0), columns, axis=1)
    row_counts = np.diff(rows, append=height)
    column_counts = np.diff(columns, append=width)
    return sums / (row_counts[:, None] * column_counts)[..., None]


def block_agreement(
    image: np.ndarray, reference: np.ndarray, blocks_across: int = 32, tolerance: float = 0.15
) -> BlockAgreement:
    """Compare block means; the images may differ in resolution, but not in shape.

    Raises:
        InputError: the numbers of block rows differ, or the reference is black or not finite.
    """
    mean = mean_luminance(reference)
    x, r = block_means(image, blocks_across), block_means(reference, blocks_across)
    if x.shape != r.shape:
        raise InputError(
            f"shapes differ: {x.shape[0]} and {r.shape[0]} rows of {blocks_across} blocks"
        )
    x_luminance, r_luminance = x @ LUMINANCE, r @ LUMINANCE
    within = np.abs(x_luminance - r_luminance) <= tolerance * r_luminance
    with np.errstate(invalid="ignore", divide="ignore"):
        x_spread, r_spread = x - x.mean(), r - r.mean()
        norm = np.sqrt((x_spread**2).sum() * (r_spread**2).sum())
        correlation = (x_spread * r_spread).sum() / norm
    ratio = float((image.astype(np.float64) @ LUMINANCE).mean()) / mean
    return BlockAgreement(float(correlation), float(within.mean()), ratio)


def error_of_halves(first: np.ndarray, second: np.ndarray, share: float) -> float:
    """Estimate the relMSE of a mean from the means of two parts of its samples.

    The difference of independent parts has the variance of both; that of the whole is
    ``share (1 - share)`` times it.  In the denominators the whole counts at most about twice the
    smaller part: a bright outlier, which is in one part only, would hide its own error there.  The
    error of such pixels still comes out up to four times too small.

    Args:
        first, second: ``(h, w, 3)``.
        share: of the samples that are in the second part, in (0, 1).

    Returns:
        Infinite if pixels are not finite, 0 for black.
    """
    whole = (1.0 - share) * first + share * second
    if not np.isfinite(whole).all():
        return float("inf")
    mean = float((whole @ LUMINANCE).mean())
    if mean <= 0.0:
        return 0.0
    limit = 2.0 * np.minimum(first, second) / mean + _OUTLIER_FLOOR
    weights = relative_weights(np.minimum(whole / mean, limit))
    variance = share * (1.0 - share) * (first - second) ** 2
    return float((weights * variance).mean() / mean**2)


def _checked_pair(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if image.shape != reference.shape:
        (h, w), (rh, rw) = image.shape[:2], reference.shape[:2]
        raise InputError(f"sizes differ: the image has {w}x{h} pixels, the reference {rw}x{rh}")
    return image.astype(np.float64), reference.astype(np.float64)


def _flip(image: np.ndarray, reference: np.ndarray) -> float | None:
    try:
        flip_evaluator = importlib.import_module("flip_evaluator")  # No dependency of ours.
    except ImportError:
        return None
    # FLIP wants values that are not negative.
    x, r = (np.ascontiguousarray(np.maximum(a, 0.0), np.float32) for a in (image, reference))
    _, mean, _ = flip_evaluator.evaluate(r, x, "HDR", applyMagma=False)
    return float(mean)


def _size(image: Image) -> str:
    return f"{image.width}x{image.height}"


def _place(image: Image) -> str:
    if (image.width, image.height) == (image.full_width, image.full_height):
        return ""
    return f" at {image.x},{image.y} of {image.full_width}x{image.full_height}"
