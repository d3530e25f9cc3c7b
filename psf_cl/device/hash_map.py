"""Sizes of the hash map of cells (``cl/common/hash_map.h``), and what its sums can hold."""

from __future__ import annotations

import math

from psf_cl.device.layout import CONSTANT

#: Bits of a sum that samples may fill.
SUM_BITS = 63

#: Slots of a table that is halved at least, where there is too little room.
LEAST_SLOTS = 1 << 12


def slots_for(keys: int) -> int:
    """Return the least power of two that has room for ``keys`` distinct keys."""
    return 1 << max(keys - 1, 0).bit_length()


def smaller(slots: int, halvings: int) -> int:
    """Return the slots of a table of ``slots`` that was halved so often, down to LEAST_SLOTS."""
    return max(slots >> halvings, min(slots, LEAST_SLOTS))


def buckets_of(slots: int) -> int:
    """Return the buckets of a table of ``slots``, a power of two."""
    return max(slots // CONSTANT["BUCKET_SLOTS"], 1)


def fixed_point(largest: float, samples: int) -> float:
    """Return the steps per unit, a power of two, of sums that no ``samples`` can overflow.

    Args:
        largest: bound of one sample; a sum of ``samples`` of them stays below 2^63 steps.
    """
    bits = SUM_BITS - max(samples - 1, 0).bit_length() - math.ceil(math.log2(largest))
    # Both steps and values times steps stay numbers of single precision.
    return 2.0 ** min(max(bits, -100), 100)
