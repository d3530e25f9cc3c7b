"""Curves over time: keyframes, and what is between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

INTERPOLATIONS = ("step", "linear", "cubic")

# Below this angle (as 1 - cosine) an arc and its chord are the same in float32.
_STRAIGHT = 1e-9


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity over time; before the first key and after the last it stands still.

    Attributes:
        times: ``(k,)`` float64, s, growing.
        values: ``(k, n)`` float64; for cubic curves ``(k, 3, n)``: the slope in which the curve
            arrives at each key, the value there, and the slope in which it leaves, per s.
        interpolation: one of ``INTERPOLATIONS``.
        turning: whether the values are quaternions (x, y, z, w).

    Source: Khronos Group, "glTF 2.0 Specification", appendix C.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "linear"
    turning: bool = False

    def at(self, time: float) -> np.ndarray:
        """Return the value at ``time``, ``(n,)`` float64; a quaternion is not zero."""
        index = int(np.searchsorted(self.times, time, side="right")) - 1
        keys = self.values[:, 1] if self.interpolation == "cubic" else self.values
        if index < 0 or index == len(self.times) - 1 or self.interpolation == "step":
            return keys[max(index, 0)]
        span = self.times[index + 1] - self.times[index]
        share = (time - self.times[index]) / span
        start, end = keys[index], keys[index + 1]
        if self.interpolation == "cubic":
            value = _hermite(share, start, self.values[index, 2] * span, end,
                             self.values[index + 1, 0] * span)  # fmt: skip
            # Of a quaternion that vanishes on the way, the last one is the best guess.
            return start if self.turning and not value.any() else value
        return _slerp(start, end, share) if self.turning else start + share * (end - start)

    def peak(self) -> np.ndarray:
        """Return the largest value of each component, ``(n,)``, of cubic curves nearly so."""
        if self.interpolation != "cubic":
            return self.values.max(axis=0)
        steps = np.linspace(self.times[:-1], self.times[1:], 17).ravel()
        return np.max([self.at(time) for time in [self.times[0], *steps]], axis=0)

    def moved(self, by: np.ndarray) -> Curve:
        """Return the curve with ``by`` added to its values."""
        # Slopes stay as they are.
        shift = np.outer((0.0, 1.0, 0.0), by) if self.interpolation == "cubic" else by
        return Curve(self.times, self.values + shift, self.interpolation)

    def scaled(self, factor: Sequence[float] | np.ndarray) -> Curve:
        """Return the curve times ``factor``, one number a component."""
        return Curve(self.times, self.values * np.asarray(factor, float), self.interpolation)


def smooth_curve(times: np.ndarray, keys: np.ndarray, turning: bool = False) -> Curve:
    """Return the cubic curve through ``keys``, ``(k, n)``, with slopes from their neighbours.

    Inside they are those of the parabola through three keys, at the ends those of the chord: the
    Catmull-Rom spline where times are even.
    """
    if turning:
        # A quaternion and its negative are the same rotation: take the shorter way.
        signs = np.where((keys[1:] * keys[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
        keys = keys * np.append(1.0, np.cumprod(signs))[:, None]
    slopes = np.zeros_like(keys)
    if len(times) > 1:
        spans = np.diff(times)[:, None]
        chords = np.diff(keys, axis=0) / spans
        slopes[0], slopes[-1] = chords[0], chords[-1]
        before, after = spans[:-1], spans[1:]
        slopes[1:-1] = (chords[:-1] * after + chords[1:] * before) / (before + after)
    return Curve(times, np.stack([slopes, keys, slopes], axis=1), "cubic", turning)


def _hermite(
    share: float, start: np.ndarray, leaving: np.ndarray, end: np.ndarray, arriving: np.ndarray
) -> np.ndarray:
    """Return the cubic with these ends and slopes per span, at ``share`` of the way."""
    square, cube = share * share, share**3
    return (
        (2 * cube - 3 * square + 1) * start
        + (cube - 2 * square + share) * leaving
        + (3 * square - 2 * cube) * end
        + (cube - square) * arriving
    )


def _slerp(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Return the quaternion at ``share`` of the shorter arc, both ends of length 1.

    Source: Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985.
    """
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    cosine = float(start @ end)
    if cosine < 0.0:
        end, cosine = -end, -cosine
    if cosine > 1.0 - _STRAIGHT:
        return start + share * (end - start)
    angle = np.arccos(cosine)
    return (np.sin((1 - share) * angle) * start + np.sin(share * angle) * end) / np.sin(angle)
