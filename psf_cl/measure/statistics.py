"""Means with 95 % intervals from few runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# 97.5 % quantiles of Student's t for 1 to 10 degrees of freedom; of the normal distribution.
_T = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281)
_Z = 1.959964


@dataclass(frozen=True)
class Interval:
    """An estimate and where the truth lies in 95 of 100 cases; NaN bounds: nobody knows."""

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def known(self) -> bool:
        return math.isfinite(self.low) and math.isfinite(self.high)

    def contains(self, value: float) -> bool:
        return self.low <= value <= self.high


def t_quantile(freedom: float) -> float:
    """Return the 97.5 % quantile of Student's t; linear between whole degrees up to 10.

    Args:
        freedom: degrees of freedom; below 1 counts as 1.

    Source: beyond 10, the expansion in 1/freedom of Fisher and Cornish, "The Percentile Points of
    Distributions Having Known Cumulants", Technometrics 2 (2), 1960; to 1e-4 there.
    """
    if freedom <= len(_T):
        return float(np.interp(freedom, range(1, len(_T) + 1), _T))
    z, n = _Z, freedom
    return (
        z
        + (z**3 + z) / (4.0 * n)
        + (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / (96.0 * n**2)
        + (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / (384.0 * n**3)
    )


def mean_interval(values: Sequence[float]) -> Interval:
    """Return the mean of independent values with Student's interval; of one value, no interval."""
    count = len(values)
    mean = float(np.mean(values))
    if count < 2:
        return Interval(mean)
    half = t_quantile(count - 1) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return Interval(mean, mean - half, mean + half)
