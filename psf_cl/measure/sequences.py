"""How far the frames of a sequence are from their references: error, lag and flicker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psf_cl.measure.errors import mean_luminance, relative_weights

#: A sequence has caught up when its error is at most so many times that of a fresh start.
CAUGHT_UP = 1.1

#: Frames for which it has to be, for one may be near by chance.
HELD = 4

#: Pixels whose references differ by less, relative as in relMSE, rest from one frame to the next.
REST = 0.05


@dataclass(frozen=True)
class Truth:
    """The references of a sequence.

    Attributes:
        frames: ``(n, h, w, 3)`` float64, divided by their mean luminance.
        scale: what they were divided by is ``1 / scale``.
    """

    frames: np.ndarray
    scale: float

    @classmethod
    def of(cls, pictures: Sequence[np.ndarray]) -> Truth:
        """Divide all by the mean luminance of all together, for some may be dark.

        Raises:
            InputError: all are black, or one has pixels that are not finite.
        """
        frames = np.stack(pictures).astype(np.float64)
        scale = 1.0 / mean_luminance(frames.reshape(1, -1, 3))
        return cls(frames * scale, scale)

    def largest_change(self) -> int:
        """Return the frame that differs most from the one before; 0 if there is but one."""
        if len(self.frames) < 2:
            return 0
        squared = np.diff(self.frames, axis=0) ** 2 * relative_weights(self.frames[1:])
        return 1 + int(squared.mean(axis=(1, 2, 3)).argmax())


def frame_errors(pictures: Sequence[np.ndarray], truth: Truth, first: int = 0) -> np.ndarray:
    """Return the relMSE of each picture; ``first`` is the frame of the first of them."""
    frames = np.stack(pictures).astype(np.float64) * truth.scale
    expected = truth.frames[first : first + len(frames)]
    return ((frames - expected) ** 2 * relative_weights(expected)).mean(axis=(1, 2, 3))


def flicker(pictures: Sequence[np.ndarray], truth: Truth) -> float:
    """Return the variance from frame to frame where nothing changes, relative as in relMSE.

    It is half the mean square of successive differences, which a slow drift does not enter.

    Source: von Neumann, Kent, Bellinson, Hart, "The Mean Square Successive Difference", Annals of
    Mathematical Statistics 12 (2), 1941.

    Returns:
        NaN where no pixel rests.
    """
    frames = np.stack(pictures).astype(np.float64) * truth.scale
    weights = relative_weights(truth.frames[1:])
    moved = (np.diff(truth.frames, axis=0) ** 2 * weights).mean(axis=-1)
    rests = moved <= REST**2
    if not rests.any():
        return float("nan")
    squared = (np.diff(frames, axis=0) ** 2 * weights).mean(axis=-1)
    return float(0.5 * squared[rests].mean())


def lag(errors: np.ndarray, fresh: np.ndarray) -> int | None:
    """Return in which frame since a change the error has caught up with a fresh start.

    It has when it is within the bound for ``HELD`` frames, or for all that are left.

    Args:
        errors: of the frames since the change, its own first.
        fresh: of a start in the frame of the change; as many.

    Returns:
        1 for the frame of the change itself; None if it never has.
    """
    within = errors <= CAUGHT_UP * fresh
    held = [bool(within[frame : frame + HELD].all()) for frame in range(len(within))]
    return held.index(True) + 1 if any(held) else None
