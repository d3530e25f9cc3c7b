"""A reference as the mean of independent renders, with its variance, and a check of that variance.

The variance comes from the spread between the renders.  That assumes nothing of the samples within
one, which Sobol' points make dependent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from psf_cl.image import Image

#: Sides of the blocks over which the two halves are compared, in pixels.
BLOCK = 8


@dataclass(frozen=True)
class HalvesAgreement:
    """How the means of every other render differ, in sigmas of the stated variance.

    Attributes:
        rms: root mean square over blocks and channels; about 1.
        beyond_three: share beyond 3 sigma; about 0.003.
    """

    rms: float
    beyond_three: float


class RunningReference:
    """The mean of renders that come one by one.

    Attributes:
        count: renders so far.
        mean: ``(h, w, 3)`` float64.
        half: mean of the renders 0, 2, 4, ...
    """

    def __init__(self, height: int, width: int) -> None:
        self.count = 0
        self.mean = np.zeros((height, width, 3))
        self.half = np.zeros((height, width, 3))
        self._squares = np.zeros((height, width, 3))

    @classmethod
    def from_image(cls, image: Image, count: int) -> RunningReference:
        """Go on where ``aovs`` of ``count`` renders, at least 2, left off.

        Raises:
            ValueError: the image does not have them.
        """
        one = cls(image.height, image.width)
        shapes = {image.aovs[name].shape for name in ("variance", "half") if name in image.aovs}
        if count < 2 or "half" not in image.aovs or shapes != {one.mean.shape}:
            raise ValueError("not an image of a running reference")
        one.count = count
        one.mean = image.rgb.astype(np.float64)
        one.half = image.aovs["half"].astype(np.float64)
        one._squares = image.aovs["variance"].astype(np.float64) * count * (count - 1)
        return one

    def add(self, rgb: np.ndarray) -> None:
        """Add a render, ``(h, w, 3)``.

        Source: Welford, "Note on a Method for Calculating Corrected Sums of Squares and Products",
        Technometrics 4 (3), 1962.
        """
        rgb = rgb.astype(np.float64)
        if self.count % 2 == 0:
            self.half += (rgb - self.half) / (self.count // 2 + 1)
        self.count += 1
        delta = rgb - self.mean
        self.mean += delta / self.count
        self._squares += delta * (rgb - self.mean)

    @property
    def variance(self) -> np.ndarray:
        """Variance of the mean, ``(h, w, 3)``; needs 2 renders."""
        return self._squares / (self.count - 1) / self.count

    def aovs(self) -> dict[str, np.ndarray]:
        """Return the channels of a file: ``rgb``, ``variance`` and ``half``, float32."""
        planes = {"rgb": self.mean, "variance": self.variance, "half": self.half}
        return {name: plane.astype(np.float32) for name, plane in planes.items()}

    def halves_agreement(self) -> HalvesAgreement:
        """Compare the mean of every other render with the mean of the rest; needs 2 renders.

        Blocks average the noise of pixels.  So this fails if pixels, or renders, are not
        independent, or if rare bright samples make the variance look smaller than it is.
        """
        evens = (self.count + 1) // 2
        odds = self.count - evens
        other = (self.count * self.mean - evens * self.half) / odds
        scale = self.count * (1.0 / evens + 1.0 / odds)
        difference = _block_sums(self.half - other)
        sigma = np.sqrt(_block_sums(self.variance * scale))
        seen = sigma > 0.0
        if not seen.any():
            return HalvesAgreement(math.nan, math.nan)
        z = difference[seen] / sigma[seen]
        return HalvesAgreement(float(np.sqrt((z**2).mean())), float((np.abs(z) > 3.0).mean()))


def _block_sums(values: np.ndarray) -> np.ndarray:
    rows, columns = (np.arange(0, size, BLOCK) for size in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)
