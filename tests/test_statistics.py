"""Intervals and the split into bias and variance, on synthetic images whose truth is known."""

import numpy as np
import pytest
from scipy import ndimage, stats

from psf_cl.measure.bias import block_size, split_error
from psf_cl.measure.statistics import mean_interval, t_quantile

SIDE = 48


def truth_image():
    """Return a smooth picture with a dark and a bright part."""
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    grey = 0.1 + 2.0 * x * y + (x > 0.7)
    return np.stack([grey, 0.8 * grey, 0.5 * grey], axis=-1)


def noisy(rng, truth, sigma, correlated):
    """Return ``truth`` with skewed noise of mean 0, the same for the channels of a pixel.

    The noise grows with the value; if correlated, neighbours share it, as after a filter.
    """
    noise = rng.gamma(0.5, 1.0, truth.shape[:2]) / 0.5 - 1.0
    if correlated:
        noise = 3.0 * ndimage.uniform_filter(noise, 3, mode="wrap")
    return truth * (1.0 + sigma * noise[..., None])


def test_quantiles_of_t_are_those_of_scipy():
    freedoms = [*range(1, 11), 10.5, 12, 17.3, 30, 100, 1e4, np.inf]
    computed = [t_quantile(freedom) for freedom in freedoms]
    expected = [stats.t.ppf(0.975, freedom) for freedom in freedoms]
    assert computed == pytest.approx(expected, abs=6e-4)
    assert t_quantile(0.1) == t_quantile(1)


def test_intervals_of_means_cover_the_truth_in_95_of_100_cases():
    rng = np.random.default_rng(5)
    covered = [mean_interval(rng.normal(3.0, 2.0, 4)).contains(3.0) for _ in range(2000)]
    # 3 sigma of a binomial of 2000 around 0.95.
    assert np.mean(covered) == pytest.approx(0.95, abs=0.015)
    assert not mean_interval([1.0]).known


def test_the_split_is_the_textbook_one():
    rng = np.random.default_rng(1)
    truth = truth_image()
    images = [noisy(rng, truth, 0.3, False) + 0.1 for _ in range(5)]
    weights = rng.random(truth.shape)
    variance = 1e-3 * truth
    split = split_error(images, truth, weights, variance)
    spread = np.var(images, axis=0, ddof=1)
    bias2 = weights * ((np.mean(images, axis=0) - truth) ** 2 - spread / 5 - variance)
    assert split.bias2.value == pytest.approx(bias2.mean(), rel=1e-9)
    assert split.variance.value == pytest.approx((weights * spread).mean(), rel=1e-9)


@pytest.mark.parametrize("correlated", [False, True], ids=["independent", "correlated"])
@pytest.mark.parametrize("bias", [0.0, 0.02], ids=["unbiased", "biased by 2 %"])
@pytest.mark.parametrize("runs", [0, 8], ids=["exact reference", "noisy reference"])
def test_intervals_of_bias_cover_the_truth_in_95_of_100_cases(correlated, bias, runs):
    rng = np.random.default_rng(2)
    truth = truth_image()
    weights = 1.0 / (truth**2 + 0.01)
    # The bias is in one half only: blocks differ.
    offset = truth * bias * (np.arange(SIDE) < SIDE // 2)[:, None, None]
    true_bias2 = float((weights * offset**2).mean())
    covered, values = [], []
    for _ in range(200):
        images = [noisy(rng, truth + offset, 0.15, correlated) for _ in range(4)]
        reference, variance = truth, None
        if runs:
            samples = [noisy(rng, truth, 0.1, False) for _ in range(runs)]
            reference = np.mean(samples, axis=0)
            variance = np.var(samples, axis=0, ddof=1) / runs
        split = split_error(images, reference, weights, variance, runs)
        covered.append(split.bias2.contains(true_bias2))
        values.append(split.bias2.value)
    # 3 sigma of a binomial of 200 around 0.95; the estimate itself is unbiased.
    assert np.mean(covered) == pytest.approx(0.95, abs=0.047)
    mean = mean_interval(values)
    assert abs(mean.value - true_bias2) < 2.0 * (mean.high - mean.value)


def test_few_images_have_wider_intervals_that_still_cover():
    rng = np.random.default_rng(3)
    truth = truth_image()
    weights = np.ones_like(truth)
    for count in (2, 3):
        splits = [
            split_error([noisy(rng, truth, 0.2, False) for _ in range(count)], truth, weights)
            for _ in range(100)
        ]
        assert np.mean([split.bias2.contains(0.0) for split in splits]) > 0.9
    with pytest.raises(ValueError, match="at least 2"):
        split_error([truth], truth, weights)


def test_blocks_are_32_pixels_and_smaller_in_small_pictures():
    assert block_size(512, 512) == block_size(480, 640) == 32
    assert block_size(128, 128) == 16
    assert block_size(16, 16) == 4
