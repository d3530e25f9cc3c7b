"""Points, slopes and ratios of synthetic curves; planted faults show up as what they are."""

import dataclasses
import math

import numpy as np
import pytest

from psf_cl.errors import InputError
from psf_cl.image import Image
from psf_cl.measure.curves import (
    Reference,
    Run,
    Snapshot,
    measure_runs,
    reference_of,
    slope,
    speed_ratio,
    time_to_error,
)

SIDE = 48
SEEDS = 4


def truth_image():
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return np.repeat((0.2 + x + y)[..., None], 3, axis=-1)


def runs_of(change=lambda image, rng: image, exponent=-1.0, times=(0.1, 1.0, 2.0, 4.0), rate=1.0):
    """Return runs whose squared noise is 0.01 (rate t)^exponent, each picture changed at the end.

    Noise of the picture at 4 s is new, not that of 2 s: real ones share samples, which no
    estimate here depends on.
    """
    truth = truth_image()
    runs = []
    for seed in range(SEEDS):
        rng = np.random.default_rng([7, seed])
        snapshots = []
        for mark, seconds in enumerate(times):
            sigma = 0.1 * (rate * seconds) ** (exponent / 2.0)
            noise = sigma * rng.standard_normal(truth.shape[:2])[..., None]
            image = change(truth + noise, rng)
            snapshots.append(Snapshot(mark, seconds, seconds + 0.5, 1, lambda image=image: image))
        runs.append(Run(seed, tuple(snapshots)))
    return runs


@pytest.fixture(scope="module")
def plain():
    return measure_runs(runs_of(), Reference(truth_image()))


def test_points_have_means_intervals_and_no_bias_where_none_is(plain):
    assert [point.seconds for point in plain] == [0.1, 1.0, 2.0, 4.0]
    assert plain[1].process_seconds == 1.5
    # Luminance and channels are equal: MSE is sigma^2 over the squared mean.
    expected = 0.01 / truth_image().mean() ** 2
    assert plain[1].metrics["mse"].value == pytest.approx(expected, rel=0.05)
    for point in plain:
        assert point.metrics["relmse"].low < point.metrics["relmse"].value
        assert point.split.bias2.contains(0.0)
        total = point.split.bias2.value + point.split.variance.value
        assert total == pytest.approx(point.metrics["relmse"].value, rel=1e-9)
        assert point.worst_share < 0.2


def test_a_planted_bias_of_2_percent_is_bias(plain):
    reference = Reference(truth_image())
    last = measure_runs(runs_of(lambda image, rng: 1.02 * image), reference)[-1]
    relative = truth_image() / truth_image().mean()
    expected = float((0.02**2 * relative**2 / (relative**2 + 0.01)).mean())
    assert not last.split.bias2.contains(0.0)
    assert last.split.bias2.contains(expected)
    assert last.split.variance.value == pytest.approx(plain[-1].split.variance.value, rel=0.1)


def test_a_planted_firefly_is_variance_and_is_in_the_worst_thousandth(plain):
    def plant(image, rng):
        image[rng.integers(SIDE), rng.integers(SIDE)] += 100.0
        return image

    last = measure_runs(runs_of(plant), Reference(truth_image()))[-1]
    before = plain[-1]
    assert last.worst_share > 0.9
    assert last.metrics["relmse_trimmed"].value == pytest.approx(
        before.metrics["relmse_trimmed"].value, rel=0.05
    )
    assert last.split.bias2.contains(0.0)
    assert last.split.variance.value > 10.0 * before.split.variance.value


def test_pixels_that_are_not_finite_are_counted_and_stop_all_claims():
    def plant(image, rng):
        image[3, 4, 1] = math.nan
        return image

    points = measure_runs(runs_of(plant), Reference(truth_image()))
    assert points[-1].nonfinite == SEEDS and points[-1].split is None
    assert slope(points) is None
    assert speed_ratio(points, points, 1.0) is None


@pytest.mark.parametrize("exponent", [-1.0, -0.5])
def test_the_slope_is_the_exponent(exponent):
    fitted = slope(measure_runs(runs_of(exponent=exponent), Reference(truth_image())))
    assert fitted.contains(exponent) or fitted.value == pytest.approx(exponent, abs=0.02)
    assert fitted.high - fitted.low < 0.3


def test_points_near_the_noise_of_the_reference_are_for_no_claim(plain):
    level = plain[2].metrics["relmse"].value
    scale = truth_image().mean() ** 2
    variance = np.full((SIDE, SIDE, 3), 1e-3)
    noise = Reference(truth_image(), variance).noise
    normalised = truth_image() ** 2 / scale
    assert noise == pytest.approx(float((1e-3 / scale / (normalised + 0.01)).mean()))
    # So that ten times the noise lies between the errors at 1 s and at 2 s.
    noisy = Reference(truth_image(), variance * (1.5 * level / 10.0) / noise, 8)
    below = [point.below_noise for point in measure_runs(runs_of(), noisy)]
    assert below == [False, False, True, True]


def test_ratios_tell_how_many_times_faster(plain):
    faster = measure_runs(runs_of(rate=3.0), Reference(truth_image()))
    # An error that every run of both reaches between its points.
    level = float(np.sqrt(plain[1].metrics["relmse"].value * plain[2].metrics["relmse"].value))
    ratio = speed_ratio(plain, faster, level)
    assert ratio.bound == "" and ratio.value.contains(3.0)
    assert ratio.value.high / ratio.value.low < 1.5
    inverse = speed_ratio(faster, plain, level)
    assert inverse.value.value == pytest.approx(1.0 / ratio.value.value)


def test_ratios_are_bounds_where_a_curve_ends(plain):
    much = measure_runs(runs_of(rate=1e4), Reference(truth_image()))
    level = plain[2].metrics["relmse"].value
    at_least = speed_ratio(plain, much, level)
    assert at_least.bound == "at least" and at_least.value.value == pytest.approx(2.0 / 0.1)
    assert not at_least.value.known
    assert speed_ratio(much, plain, much[2].metrics["relmse"].value).bound == "at most"
    assert speed_ratio(plain, plain, 1e-12) is None


def test_time_to_an_error_lies_on_the_line_between_logarithms():
    times, errors = [1.0, 4.0, 16.0], [1.0, 0.25, 0.0625]
    assert time_to_error(times, errors, 0.5) == (pytest.approx(2.0), "")
    assert time_to_error(times, errors, 0.0625) == (pytest.approx(16.0), "")
    assert time_to_error(times, errors, 0.01) == (16.0, "never")
    assert time_to_error(times, errors, 2.0) == (1.0, "at once")


def test_runs_that_stopped_early_have_fewer_points():
    runs = runs_of()
    runs[0] = dataclasses.replace(runs[0], snapshots=runs[0].snapshots[:2])
    points = measure_runs(runs, Reference(truth_image()))
    assert [len(point.errors) for point in points] == [4, 4, 3, 3]


def test_a_reference_brings_its_variance_and_the_number_of_its_runs():
    rgb = truth_image().astype(np.float32)
    image = Image({"rgb": rgb, "variance": np.full_like(rgb, 0.5)}, {"seed": [1, 2, 3]})
    reference = reference_of(image, "ref.exr")
    assert reference.runs == 3 and reference.variance.shape == rgb.shape
    grey = Image({"rgb": rgb, "variance": np.full((SIDE, SIDE, 1), 0.5, np.float32)}, {"seed": 1})
    assert reference_of(grey, "ref.exr").variance.shape == rgb.shape
    assert reference_of(Image({"rgb": rgb}), "ref.exr").noise == 0.0
    with pytest.raises(InputError, match=r"ref\.exr: variance: expected 1 or 3 channels"):
        reference_of(Image({"rgb": rgb, "variance": -rgb}), "ref.exr")
    with pytest.raises(InputError, match=r"ref\.exr: the reference is black"):
        reference_of(Image({"rgb": 0.0 * rgb}), "ref.exr")
