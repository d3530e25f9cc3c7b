"""What part of an error stays when one waits, and what part is noise: bias and variance apart."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psf_cl.measure.statistics import Interval, mean_interval, t_quantile

# Pixels of a filtered image depend on their neighbours; blocks of this many hardly do.
_BLOCK = 32
# Smaller pictures have smaller blocks: the interval needs about this many, and no block less than
# the least size.
_BLOCKS_WANTED = 64
_LEAST_BLOCK = 4


@dataclass(frozen=True)
class Split:
    """The expected squared error of one image = ``bias2`` + ``variance``.

    Attributes:
        bias2: squared bias; may come out negative where there is none.
        variance: of a single image.
    """

    bias2: Interval
    variance: Interval


def split_error(
    images: Sequence[np.ndarray],
    reference: np.ndarray,
    weights: np.ndarray,
    reference_variance: np.ndarray | None = None,
    reference_runs: int = 0,
) -> Split:
    """Split the weighted squared error into squared bias and variance.

    With ``d_k = x_k - r``, the mean of ``d_j d_k`` over pairs ``j != k`` of independent images
    holds no noise of the images; it equals ``(mean x - r)^2 - s^2 / K``.  What the reference's
    noise adds is taken off as ``reference_variance``.

    The interval of ``bias2``: the variance of such a mean over pairs, a U-statistic, follows from
    the products of pairs that share an image, both, or none, each of which the data gives without
    bias from 4 images on.  It is estimated for blocks of 32x32 pixels (smaller in small pictures),
    since filtered pixels are correlated, and added up.  With 2 or 3 images the spread between
    blocks takes its place, which is too wide where the bias differs between blocks.

    Args:
        images: K at least 2 independent images, ``(h, w, 3)``, finite.
        weights: ``(h, w, 3)``; all ones for the mean squared error.
        reference_variance: ``(h, w, 3)``, of the reference's values; None: it has no noise.
        reference_runs: how many independent renders that variance was estimated from; 0: it is
            known exactly.

    Source: Hoeffding, "A Class of Statistics with Asymptotically Normal Distribution", Annals of
    Mathematical Statistics 19 (3), 1948, for the variance of a U-statistic; Satterthwaite, "An
    Approximate Distribution of Estimates of Variance Components", Biometrics Bulletin 2 (6), 1946,
    for its degrees of freedom.
    """
    count = len(images)
    if count < 2:
        raise ValueError("expected at least 2 images")
    height, width = reference.shape[:2]
    size = block_size(height, width)
    differences = [image.astype(np.float64) - reference for image in images]
    weights = weights / weights.size * weights.shape[0] * weights.shape[1]
    pairs = {
        (j, k): _block_sums((weights * differences[j] * differences[k]).sum(axis=-1), size)
        for j, k in itertools.combinations_with_replacement(range(count), 2)
    }
    products = np.empty((count, count, pairs[0, 0].size))
    for (j, k), sums in pairs.items():
        products[j, k] = products[k, j] = sums.ravel() / (height * width)

    off_diagonal = ~np.eye(count, dtype=bool)
    block_bias2 = products[off_diagonal].mean(axis=0)
    bias2 = float(block_bias2.sum())
    variances = [_own_variance(products, k) for k in range(count)]
    if count >= 4:
        spread, freedom = _sum_with_freedom(_pair_mean_variance(products))
    else:
        blocks = len(block_bias2)
        spread = float(np.var(block_bias2, ddof=1)) * blocks if blocks > 1 else math.nan
        freedom = blocks - 1

    if reference_variance is not None:
        noise = (weights * reference_variance).sum(axis=-1)
        mean_difference = np.mean(differences, axis=0)
        own = sum((d - mean_difference) ** 2 for d in differences) / (count - 1)
        squared = (weights * (mean_difference**2 - own / count - reference_variance)).sum(axis=-1)
        bias2 -= float(noise.mean())
        # As if the channels of a pixel were one: their noise comes from the same paths.
        doubt = 1.0 + (1.0 / (reference_runs - 1) if reference_runs > 1 else 0.0)
        extra = float((4.0 * squared * noise + 2.0 * doubt * noise**2).sum())
        spread += max(extra, 0.0) / noise.size**2
    half = t_quantile(freedom) * math.sqrt(max(spread, 0.0))
    return Split(Interval(bias2, bias2 - half, bias2 + half), mean_interval(variances))


def block_size(height: int, width: int) -> int:
    """Return the side in pixels of the blocks that count as independent."""
    fitting = math.isqrt(height * width // _BLOCKS_WANTED)
    return min(max(fitting, _LEAST_BLOCK), _BLOCK)


def _own_variance(products: np.ndarray, k: int) -> float:
    """Return an estimate of the variance of image ``k``; their mean over k is the usual one."""
    count = len(products)
    total = products.sum(axis=-1)
    others = [j for j in range(count) if j != k]
    mean_pair = (total.sum() - np.trace(total)) / (count * (count - 1))
    # |d_k|^2 less the squared bias, with the part of the cross terms that belongs to image k.
    return float(total[k, k] - 2.0 * total[k, others].mean() + mean_pair)


def _pair_mean_variance(products: np.ndarray) -> np.ndarray:
    """Return, for each block, an estimate of the variance of the mean over pairs.

    Without bias, but for this: what pairs that share one image have in common cannot be negative,
    and is left out if its sum over the blocks comes out so.

    Args:
        products: ``(count, count, blocks)``, symmetric, count at least 4.
    """
    count = len(products)
    h = np.where(np.eye(count, dtype=bool)[..., None], 0.0, products)
    ordered = count * (count - 1)
    rows = h.sum(axis=1)
    both = (h**2).sum(axis=(0, 1))
    shared = (rows**2).sum(axis=0) - both
    none = rows.sum(axis=0) ** 2 - 2.0 * both - 4.0 * shared
    mean_both = both / ordered
    mean_shared = shared / (ordered * (count - 2))
    mean_none = none / (ordered * (count - 2) * (count - 3))
    common = mean_shared - mean_none
    if common.sum() < 0.0:
        common = np.zeros_like(common)
    return (4.0 * (count - 2) * common + 2.0 * (mean_both - mean_none)) / ordered


def _sum_with_freedom(block_variances: np.ndarray) -> tuple[float, float]:
    """Return the sum of estimated variances, and Satterthwaite's degrees of freedom of it."""
    total, blocks = float(block_variances.sum()), len(block_variances)
    if blocks < 2 or total <= 0.0:
        return max(total, 0.0), 1.0
    doubt = blocks * float(np.var(block_variances, ddof=1))
    return total, 2.0 * total**2 / doubt if doubt > 0.0 else math.inf


def _block_sums(values: np.ndarray, size: int) -> np.ndarray:
    height, width = values.shape
    rows, columns = np.arange(0, height, size), np.arange(0, width, size)
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
