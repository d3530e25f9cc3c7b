"""Random numbers: exact where they are digits, statistics where they are random."""

import numpy as np
import planes
import pytest
from scipy import stats

from psf_cl.device.layout import CONSTANT

SOBOL, RANDOM = CONSTANT["SAMPLER_SOBOL"], CONSTANT["SAMPLER_RANDOM"]

#: A right sampler fails a test once in ten thousand; the numbers are fixed, so it never does again.
P_MIN = 1e-4


def run(device, kernel, inputs, outputs, **arguments):
    return planes.run(device, "rng_test.cl", kernel, inputs, outputs, **arguments)


def draw(device, pixel, index, pair, sampler=SOBOL, seed=0):
    """Return bits and numbers, each ``(2, n)``, for every combination in order."""
    grid = np.meshgrid(pixel, index, pair, indexing="ij")
    pixel, index, pair = (np.asarray(axis, np.uint32).ravel() for axis in grid)
    return run(
        device,
        "draw_samples",
        {"pixel": pixel, "index": index, "pair": pair},
        {"bits": (np.uint32, 2), "units": (np.float32, 2)},
        seed=seed,
        sampler=sampler,
    )


def test_mixing_is_the_published_hash(lane_device):
    """Wellons' lowbias32, digit by digit in Python integers."""

    def lowbias32(x):
        x ^= x >> 16
        x = x * 0x7FEB352D % 2**32
        x ^= x >> 15
        x = x * 0x846CA68B % 2**32
        return x ^ x >> 16

    x = np.random.default_rng(0).integers(0, 2**32, 2000, np.uint32)
    x[:3] = 0, 1, 2**32 - 1
    (mixed,) = run(lane_device, "mix_numbers", {"x": x}, {"mixed": (np.uint32, 1)})
    np.testing.assert_array_equal(mixed, [lowbias32(int(v)) for v in x])


def test_mixing_never_maps_two_numbers_to_one_and_spreads_every_bit(device):
    x = np.arange(1 << 18, dtype=np.uint32)
    (mixed,) = run(device, "mix_numbers", {"x": x}, {"mixed": (np.uint32, 1)})
    assert len(np.unique(mixed)) == len(x)

    x = np.random.default_rng(1).integers(0, 2**32, 1 << 13, np.uint32)
    flipped = (x ^ (np.uint32(1) << np.arange(32, dtype=np.uint32))[:, None]).ravel()
    (before,) = run(device, "mix_numbers", {"x": x}, {"mixed": (np.uint32, 1)})
    (after,) = run(device, "mix_numbers", {"x": flipped}, {"mixed": (np.uint32, 1)})
    change = after.reshape(32, -1) ^ before
    digits = (change[..., None] >> np.arange(32, dtype=np.uint32)) & 1
    # 2^13 throws of a coin for each of 1024 pairs of bits: five deviations are 0.028.
    assert abs(digits.mean(axis=1) - 0.5).max() < 0.03


def pascal_matrix():
    """Return C(j, k) modulo 2 by Pascal's rule, ``(32, 32)``: row k, column j."""
    c = np.zeros((32, 32), np.uint8)
    c[0] = 1
    for j in range(1, 32):
        for k in range(1, j + 1):
            c[k, j] = (c[k, j - 1] + c[k - 1, j - 1]) % 2
    return c


def joe_kuo_second_dimension(index):
    """Return the second Sobol' dimension of ``index`` from its direction numbers, 32 bits.

    Joe, Kuo: Constructing Sobol' Sequences with Better Two-Dimensional Projections, 2008: the
    primitive polynomial x + 1 with m_1 = 1 gives m_k = 2 m_(k-1) xor m_(k-1).
    """
    m, value = 1, 0
    for k in range(32):
        if index >> k & 1:
            value ^= m << (31 - k)
        m = (2 * m) ^ m
    return value


def test_digits_are_those_of_the_sobol_sequence(lane_device):
    x = np.random.default_rng(2).integers(0, 2**32, 2000, np.uint32)
    x[:34] = [0, 2**32 - 1, *(1 << k for k in range(32))]
    backwards, second = run(
        lane_device,
        "reverse_numbers",
        {"x": x},
        {"reversed": (np.uint32, 1), "second_dimension": (np.uint32, 1)},
    )
    digits = (x[:, None] >> np.arange(32, dtype=np.uint32)) & 1
    place = np.uint32(1) << np.arange(32, dtype=np.uint32)
    np.testing.assert_array_equal(backwards, (digits * place[::-1]).sum(axis=1))
    by_pascal = (digits @ pascal_matrix().T.astype(np.uint32)) % 2
    np.testing.assert_array_equal(second, (by_pascal * place).sum(axis=1))
    expected = [int(f"{joe_kuo_second_dimension(int(v)):032b}"[::-1], 2) for v in x]
    np.testing.assert_array_equal(second, expected)


def test_unit_numbers_are_below_one_and_keep_24_bits(lane_device):
    x = np.array([0, 255, 256, 2**31, 2**32 - 257, 2**32 - 256, 2**32 - 1], np.uint32)
    (units,) = run(lane_device, "to_unit_floats", {"x": x}, {"units": (np.float32, 1)})
    np.testing.assert_array_equal(units, (x >> 8) / 2.0**24)
    assert units.max() < 1


@pytest.mark.parametrize("seed", [0, 12345])
def test_every_elementary_interval_holds_one_point(lane_device, seed):
    """The first 2^k samples of a pixel, and each later run of 2^k: what a (0, 2)-sequence is."""
    pixels, pairs = [0, 77, 123456], [0, 2, 3, 41]
    count = 1 << 10
    bits, _ = draw(lane_device, pixels, np.arange(4 * count), pairs, seed=seed)
    bits = bits.reshape(2, len(pixels), 4 * count, len(pairs)).astype(np.uint64)
    for k in range(11):
        blocks = bits.reshape(2, len(pixels), -1, 1 << k, len(pairs))
        for along_x in range(k + 1):
            i, j = blocks[0] >> np.uint64(32 - along_x), blocks[1] >> np.uint64(32 - k + along_x)
            interval = np.sort((i << np.uint64(k - along_x)) | j, axis=2)
            expected = np.arange(1 << k)[:, None]
            np.testing.assert_array_equal(interval, np.broadcast_to(expected, interval.shape))


def test_scrambling_leaves_no_digit_alone(device):
    """Over many pixels the first sample of a pair is anywhere, in both dimensions."""
    bits, units = draw(device, np.arange(1 << 14), [0], [2])
    digits = (bits[:, :, None] >> np.arange(32, dtype=np.uint32)) & 1
    assert abs(digits.mean(axis=1) - 0.5).max() < 5 * 0.5 / 128
    cells = (units[0] * 16).astype(int) * 16 + (units[1] * 16).astype(int)
    assert stats.chisquare(np.bincount(cells, minlength=256)).pvalue > P_MIN


def uniform_in_square(x, y, cells=16):
    """Return the p-value that the points are uniform in the unit square."""
    at = (x * cells).astype(int) * cells + (y * cells).astype(int)
    return stats.chisquare(np.bincount(at.ravel(), minlength=cells**2)).pvalue


@pytest.mark.parametrize("sampler", [SOBOL, RANDOM], ids=["sobol", "random"])
def test_neighbours_pairs_and_seeds_are_independent(lane_device, sampler):
    pixels, pairs = np.arange(1 << 12), [0, 1, 2, 3]
    _, units = draw(lane_device, pixels, [0, 5], pairs, sampler)
    units = units.reshape(2, len(pixels), 2, len(pairs))
    first, second = units[0], units[1]
    # Neighbouring pixels, the row below at two film widths, and next pairs of one pixel.
    for distance in (1, 2, 640, 1024):
        assert uniform_in_square(first[:-distance], first[distance:]) > P_MIN
        assert uniform_in_square(second[:-distance], second[distance:]) > P_MIN
        assert uniform_in_square(first[:-distance], second[distance:]) > P_MIN
    for k in range(len(pairs) - 1):
        assert uniform_in_square(first[..., k], first[..., k + 1]) > P_MIN
        assert uniform_in_square(second[..., k], second[..., k + 1]) > P_MIN
        assert uniform_in_square(first[..., k], second[..., k + 1]) > P_MIN
    _, other = draw(lane_device, pixels, [0, 5], pairs, sampler, seed=1)
    other = other.reshape(units.shape)
    assert uniform_in_square(first, other[0]) > P_MIN
    assert uniform_in_square(second, other[1]) > P_MIN


def test_pairs_of_one_pixel_are_not_correlated_over_its_samples(device):
    """Shuffled apart: two pairs of 256 samples fill the four-dimensional cube like chance does."""
    _, units = draw(device, np.arange(64), np.arange(256), [2, 3])
    x = units.reshape(2, 64, 256, 2)
    for a in range(2):
        for b in range(2):
            correlation = [
                np.corrcoef(x[a, p, :, 0], x[b, p, :, 1])[0, 1] for p in range(x.shape[1])
            ]
            # 64 coefficients of deviation 1/16 each.
            assert abs(np.mean(correlation)) < 4 / 16 / 8
            assert np.max(np.abs(correlation)) < 5 / 16


def test_random_numbers_are_uniform_along_a_pixel(lane_device):
    _, units = draw(lane_device, [0, 9999], np.arange(1 << 15), [0, 7], RANDOM)
    x, y = units.reshape(2, 2, 1 << 15, 2)
    for p in range(2):
        for k in range(2):
            assert uniform_in_square(x[p, :, k], y[p, :, k], 32) > P_MIN
            assert uniform_in_square(x[p, :-1, k], x[p, 1:, k], 32) > P_MIN
            assert stats.kstest(x[p, :, k], "uniform").pvalue > P_MIN
    assert units.max() < 1 and units.min() >= 0
