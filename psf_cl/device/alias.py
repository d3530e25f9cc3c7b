"""Alias tables: an index is drawn by its weight with one look-up."""

from __future__ import annotations

import numpy as np


def alias_table(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a table that draws index ``i`` with chance ``weights[i] / sum(weights)``.

    To draw: take a slot ``i`` uniformly and ``u`` in [0, 1), then keep ``i`` if ``u < keep[i]`` and
    take ``other[i]`` if not.

    Args:
        weights: ``(n,)``, finite, none negative, not all zero.

    Returns:
        ``keep``, ``(n,)`` float32 in [0, 1] in steps of 2^-24, the step of the device's ``u``
        (rounded up, so that nothing with a weight is lost), and ``other``, ``(n,)`` uint32.

    Source: the sweep of Huebschle-Schneider, Sanders, "Parallel Weighted Random Sampling", 2019,
    section 4.2, with its two running positions found by search in the running sums.
    """
    weights = np.asarray(weights, np.float64)
    scaled = weights * (len(weights) / weights.sum())
    keep = np.ones(len(weights))
    other = np.arange(len(weights), dtype=np.uint32)
    is_heavy = scaled >= 1.0
    is_heavy[np.argmax(scaled)] = True  # Equal weights may all round to less than 1.
    light, heavy = np.flatnonzero(~is_heavy), np.flatnonzero(is_heavy)
    lack = np.cumsum(1.0 - scaled[light])
    excess = np.cumsum(scaled[heavy] - 1.0)
    # A light slot is filled up by the heavy one that still has something left when its turn comes.
    filler = np.searchsorted(excess, lack - (1.0 - scaled[light]), side="left")
    keep[light] = scaled[light]
    other[light] = heavy[np.minimum(filler, len(heavy) - 1)]
    # A heavy slot that gave too much is filled up by the next heavy one.
    emptied = np.searchsorted(lack, excess, side="right")
    gave = emptied < len(lack)
    gave[-1:] = False
    keep[heavy[gave]] = 1.0 + excess[gave] - lack[emptied[gave]]
    other[heavy[:-1]] = heavy[1:]
    return (np.ceil(np.clip(keep, 0.0, 1.0) * 2.0**24) / 2.0**24).astype(np.float32), other


def alias_chances(keep: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the chance with which an alias table draws each index, ``(n,)`` float64.

    Not quite the weights that it was made from: a density that divides samples has to be this one,
    or a light of a millionth of the power would come out too bright by the rounding of ``keep``.
    """
    chance = keep.astype(np.float64)
    np.add.at(chance, other, 1.0 - keep.astype(np.float64))
    return chance / len(keep)
