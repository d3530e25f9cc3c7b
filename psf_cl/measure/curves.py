"""Error over time of several contestants: points, slopes, and time to equal error."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from psf_cl.errors import InputError
from psf_cl.image import Image
from psf_cl.measure.bias import Split, split_error
from psf_cl.measure.errors import Errors, compare, mean_luminance, relative_weights
from psf_cl.measure.statistics import Interval, mean_interval

#: Metrics that have a curve each.
METRICS = ("relmse", "relmse_trimmed", "mse", "mae")

#: A point is for no claim if its error is below this many times the reference's own.
NOISE_MARGIN = 10.0


@dataclass(frozen=True)
class Reference:
    """A reference picture and how far it may itself be from the truth.

    Attributes:
        rgb: ``(h, w, 3)``.
        variance: of its values, the same shape; None if nobody knows.
        runs: independent renders that the variance was estimated from; 0 if nobody knows.
    """

    rgb: np.ndarray
    variance: np.ndarray | None = None
    runs: int = 0

    @property
    def noise(self) -> float:
        """Its own relMSE; 0 if its variance is not known."""
        if self.variance is None:
            return 0.0
        scale = 1.0 / mean_luminance(self.rgb)
        weights = relative_weights(self.rgb * scale)
        return float((weights * self.variance * scale**2).mean())


def reference_of(image: Image, name: str) -> Reference:
    """Return the reference in an image, with its variance if it has that AOV.

    Raises:
        InputError: the image (called ``name``) is black or not finite, or its variance is not one.
    """
    rgb = image.rgb.astype(np.float64)
    try:
        mean_luminance(rgb)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    if "variance" not in image.aovs:
        return Reference(rgb)
    variance = image.aovs["variance"].astype(np.float64)
    if variance.shape[2] not in (1, 3) or not (np.isfinite(variance) & (variance >= 0.0)).all():
        raise InputError(
            f"{name}: variance: expected 1 or 3 channels of finite numbers, 0 or above"
        )
    seeds = image.stats.get("seed")
    runs = len(seeds) if isinstance(seeds, list) else 0
    return Reference(rgb, np.broadcast_to(variance, rgb.shape), runs)


@dataclass(frozen=True)
class Snapshot:
    """One image on the way of one run.

    Attributes:
        mark: index of the point in the list of marks.
        seconds: spent on rendering; process_seconds: on everything.
        spp: samples a pixel; 0 if nobody knows.
        load: returns the picture, ``(h, w, 3)``.
    """

    mark: int
    seconds: float
    process_seconds: float
    spp: int
    load: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Run:
    """What one contestant did with one seed."""

    seed: int
    snapshots: tuple[Snapshot, ...]


@dataclass(frozen=True)
class Point:
    """One contestant after one budget, over all its runs.

    Attributes:
        seconds, process_seconds, spp: means over the runs.
        errors: one for each run.
        metrics: name to mean and interval over the runs.
        split: of the relMSE; None with one run or where pixels are not finite.  mse_split: of the
            MSE.
        below_noise: the error is not far enough above the reference's own for any claim.
    """

    mark: int
    seconds: float
    process_seconds: float
    spp: float
    seeds: tuple[int, ...]
    run_seconds: tuple[float, ...]
    errors: tuple[Errors, ...]
    metrics: dict[str, Interval]
    split: Split | None
    mse_split: Split | None
    below_noise: bool

    @property
    def nonfinite(self) -> int:
        return sum(errors.nonfinite for errors in self.errors)

    @property
    def worst_share(self) -> float:
        """Share of the relMSE in the worst thousandth of the pixels: large with fireflies."""
        relmse = self.metrics["relmse"].value
        return 1.0 - self.metrics["relmse_trimmed"].value / relmse if relmse > 0.0 else 0.0


@dataclass(frozen=True)
class Ratio:
    """How many times faster one contestant reaches an error than another.

    Attributes:
        bound: "", or "at least" or "at most" where the faster or slower one never showed more.
    """

    value: Interval
    bound: str = ""


def measure_runs(runs: Sequence[Run], reference: Reference) -> list[Point]:
    """Measure all runs of one contestant; points that no run reached are left out."""
    scale = 1.0 / mean_luminance(reference.rgb)
    truth = reference.rgb * scale
    variance = None if reference.variance is None else reference.variance * scale**2
    weights = relative_weights(truth)
    noise = reference.noise

    points = []
    for mark in sorted({snapshot.mark for run in runs for snapshot in run.snapshots}):
        taken = list(_at_mark(runs, mark))
        images = [snapshot.load() for _, snapshot in taken]
        errors = tuple(compare(image, reference.rgb) for image in images)
        finite = all(error.nonfinite == 0 for error in errors)
        metrics = {
            name: mean_interval([getattr(error, name) for error in errors]) for name in METRICS
        }
        split = mse_split = None
        if finite and len(images) > 1:
            scaled = [image * scale for image in images]
            split, mse_split = (
                split_error(scaled, truth, w, variance, reference.runs)
                for w in (weights, np.ones_like(weights))
            )
        points.append(
            Point(
                mark,
                float(np.mean([snapshot.seconds for _, snapshot in taken])),
                float(np.mean([snapshot.process_seconds for _, snapshot in taken])),
                float(np.mean([snapshot.spp for _, snapshot in taken])),
                tuple(run.seed for run, _ in taken),
                tuple(snapshot.seconds for _, snapshot in taken),
                errors,
                metrics,
                split,
                mse_split,
                metrics["relmse"].value < NOISE_MARGIN * noise,
            )
        )
    return points


def _at_mark(runs: Sequence[Run], mark: int) -> Iterator[tuple[Run, Snapshot]]:
    for run in runs:
        for snapshot in run.snapshots:
            if snapshot.mark == mark:
                yield run, snapshot


def slope(points: Sequence[Point], metric: str = "relmse") -> Interval | None:
    """Return the exponent p of error ~ time^p, over the runs; None with less than two points.

    A line through the logarithms by least squares, one for each run.  The first point is left out
    if two others are there: it has the start-up in it.  So are points that are for no claim.
    """
    usable = [point for point in points if not point.below_noise and point.nonfinite == 0]
    usable = [point for point in usable if point.mark > 0] if len(usable) > 2 else usable
    slopes = []
    for seed in sorted({seed for point in usable for seed in point.seeds}):
        times, errors = _curve_of(usable, metric, seed)
        if len(times) >= 2 and times[-1] > times[0] and min(errors) > 0.0:
            slopes.append(float(np.polyfit(np.log(times), np.log(errors), 1)[0]))
    return mean_interval(slopes) if slopes else None


def speed_ratio(
    base: Sequence[Point], other: Sequence[Point], level: float, metric: str = "relmse"
) -> Ratio | None:
    """Return how many times faster ``other`` reaches the error ``level`` than ``base``.

    Where every run of both reaches it, the ratios of runs of the same seed, which stand next to
    each other in time, are averaged (as logarithms); else the mean curves are compared, without an
    interval.  None where ``base`` does not reach it.
    """
    base, other = ([p for p in points if p.nonfinite == 0] for points in (base, other))
    if not base or not other:
        return None
    shared = sorted(
        set.intersection(*({seed for p in points for seed in p.seeds} for points in (base, other)))
    )
    logs = []
    for seed in shared:
        ours, theirs = (
            time_to_error(*_curve_of(points, metric, seed), level) for points in (other, base)
        )
        if ours[1] or theirs[1]:
            logs = []
            break
        logs.append(math.log(theirs[0] / ours[0]))
    if len(logs) > 1:
        mean = mean_interval(logs)
        return Ratio(Interval(math.exp(mean.value), math.exp(mean.low), math.exp(mean.high)))
    base_time, base_bound = time_to_error(*_curve_of(base, metric), level)
    time, bound = time_to_error(*_curve_of(other, metric), level)
    if base_bound == "never":
        return None
    if base_bound and bound:
        return None
    words = {"": "", "never": "at most", "at once": "at least"}[bound]
    if base_bound == "at once":
        words = "at most"
    return Ratio(Interval(base_time / time), words)


def time_to_error(
    times: Sequence[float], errors: Sequence[float], level: float
) -> tuple[float, str]:
    """Return when a curve first comes down to ``level``, on straight lines between logarithms.

    Returns:
        The time and "", or the last time and "never", or the first time and "at once".
    """
    if errors[0] <= level:
        return times[0], "" if errors[0] == level else "at once"
    for i in range(1, len(times)):
        if errors[i] <= level:
            if errors[i] <= 0.0:
                return times[i], ""
            part = math.log(errors[i - 1] / level) / math.log(errors[i - 1] / errors[i])
            return times[i - 1] * (times[i] / times[i - 1]) ** part, ""
    return times[-1], "never"


def _curve_of(
    points: Sequence[Point], metric: str, seed: int | None = None
) -> tuple[list[float], list[float]]:
    """Return times and errors of one run, or of the mean over all."""
    if seed is None:
        return [p.seconds for p in points], [p.metrics[metric].value for p in points]
    times, errors = [], []
    for point in points:
        if seed in point.seeds:
            index = point.seeds.index(seed)
            times.append(point.run_seconds[index])
            errors.append(getattr(point.errors[index], metric))
    return times, errors
