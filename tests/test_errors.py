"""Error metrics against values computed by hand or by plain loops."""

import numpy as np
import pytest

from psf_cl.errors import InputError
from psf_cl.image import Image
from psf_cl.measure.errors import block_agreement, block_means, compare, matching_part


def grey(values):
    return np.repeat(np.asarray(values, np.float32)[..., None], 3, axis=-1)


def test_metrics_of_two_pixels_are_those_computed_by_hand():
    # The mean luminance of the reference is 2: divided, x = (1, 1) and r = (0.5, 1.5).
    errors = compare(grey([[2.0, 2.0]]), grey([[1.0, 3.0]]))
    assert errors.mse == pytest.approx(0.25)
    assert errors.mae == pytest.approx(0.5)
    assert errors.relmse == pytest.approx((0.25 / 0.26 + 0.25 / 2.26) / 2.0)
    assert errors.relmse_trimmed == errors.relmse  # 0.1 % of two pixels is none.
    assert errors.nonfinite == 0


def test_luminance_weights_the_channels():
    # Pure green of 1: mean luminance 0.7152.
    reference = np.zeros((1, 1, 3), np.float32)
    reference[..., 1] = 1.0
    assert compare(2.0 * reference, reference).mse == pytest.approx(1.0 / 0.7152**2 / 3.0)


def test_metrics_do_not_depend_on_the_unit_of_radiance():
    rng = np.random.default_rng(1)
    image, reference = rng.random((2, 16, 16, 3)).astype(np.float32)
    base, scaled = compare(image, reference), compare(image * 1024.0, reference * 1024.0)
    for name, value in base.as_dict().items():
        assert scaled.as_dict()[name] == pytest.approx(value, rel=1e-12), name


def test_trimming_leaves_out_the_worst_thousandth():
    reference = np.ones((40, 50, 3), np.float32)
    image = reference * 1.1
    image[3, 4] = image[7, 8] = 1e4
    errors = compare(image, reference)
    plain = np.float64(np.float32(1.1) - 1.0) ** 2 / 1.01
    assert errors.relmse_trimmed == pytest.approx(plain, rel=1e-5)
    assert errors.relmse == pytest.approx(2.0 * 9999.0**2 / 1.01 / 2000.0, rel=1e-4)


def test_pixels_that_are_not_finite_are_counted_and_left_out():
    reference = grey([[1.0, 1.0, 1.0, 1.0]])
    image = grey([[2.0, np.nan, np.inf, 1.0]])
    image[0, 3, 1] = -np.inf
    errors = compare(image, reference)
    assert errors.nonfinite == 3
    assert errors.mse == pytest.approx(1.0)
    nothing_left = compare(np.full_like(reference, np.nan), reference)
    assert nothing_left.nonfinite == 4 and nothing_left.relmse == np.inf


def test_bad_references_and_sizes_are_refused():
    ones = np.ones((4, 4, 3), np.float32)
    with pytest.raises(InputError, match="black"):
        compare(ones, np.zeros_like(ones))
    with pytest.raises(InputError, match="16 pixels that are not finite"):
        compare(ones, ones * np.nan)
    with pytest.raises(InputError, match="4x4 pixels, the reference 4x3"):
        compare(ones, ones[:3])


def test_flip_is_measured_where_it_is_installed():
    pytest.importorskip("flip_evaluator")
    rng = np.random.default_rng(2)
    reference = rng.random((32, 32, 3)).astype(np.float32)
    assert compare(reference, reference, flip=True).flip == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < compare(reference[::-1], reference, flip=True).flip <= 1.0


@pytest.mark.parametrize("shape", [(32, 32), (33, 70), (100, 37), (1, 40), (97, 32)])
def test_block_means_equal_plain_loops_and_use_every_pixel_once(shape):
    rng = np.random.default_rng(3)
    image = rng.random((*shape, 3)).astype(np.float32)
    means = block_means(image, 32)
    down, across = means.shape[:2]
    assert across == 32 and down == max(round(shape[0] * 32 / shape[1]), 1)
    rows = [i * shape[0] // down for i in range(down)] + [shape[0]]
    columns = [i * shape[1] // across for i in range(across)] + [shape[1]]
    for i in range(down):
        for j in range(across):
            block = image[rows[i] : rows[i + 1], columns[j] : columns[j + 1]].astype(np.float64)
            assert np.allclose(means[i, j], block.mean(axis=(0, 1)), rtol=1e-12, atol=0.0)


def test_block_agreement_sees_scale_and_shape():
    rng = np.random.default_rng(4)
    reference = rng.random((64, 64, 3)) + 0.5
    same = block_agreement(reference, reference, 8)
    assert same.correlation == pytest.approx(1.0) and same.share_within == 1.0
    assert same.mean_ratio == pytest.approx(1.0)
    brighter = block_agreement(reference * 1.2, reference, 8)
    assert brighter.correlation == pytest.approx(1.0) and brighter.share_within == 0.0
    assert brighter.mean_ratio == pytest.approx(1.2)
    inverted = block_agreement(2.0 - reference, reference, 8)
    assert inverted.correlation == pytest.approx(-1.0)
    # Swapped channels keep the grey picture nearly, but not the colours.
    red = np.ones((8, 8, 3))
    red[:, :4] = (1.0, 0.2, 0.1)
    red[:, 4:] = (0.1, 0.2, 1.0)
    assert block_agreement(red[:, ::-1], red, 8).correlation < 0.0


def test_block_agreement_counts_the_blocks_within_the_tolerance():
    reference = np.ones((8, 8, 3))
    image = reference.copy()
    image[:, :2] = 1.14
    image[:, 2:6] = 0.84
    assert block_agreement(image, reference, 8).share_within == 0.5
    assert block_agreement(image, reference, 8, tolerance=0.1).share_within == 0.25
    assert np.isnan(block_agreement(image, reference, 8).correlation)


def test_block_agreement_takes_two_resolutions_but_not_two_shapes():
    rng = np.random.default_rng(6)
    small = rng.random((8, 16, 3)) + 0.1
    large = small.repeat(4, axis=0).repeat(4, axis=1)
    assert block_agreement(large, small, 16).correlation == pytest.approx(1.0)
    with pytest.raises(InputError, match="rows of 16 blocks"):
        block_agreement(large[:16], small, 16)
    with pytest.raises(InputError, match="blocks across"):
        block_agreement(large, small, 32)


def window(x, y, width, height, full_width=0, full_height=0):
    rng = np.random.default_rng(7)
    full = rng.random((full_height or height, full_width or width, 3)).astype(np.float32)
    pixels = full[y : y + height, x : x + width]
    return Image({"rgb": pixels}, {}, x, y, full_width, full_height)


def test_a_reference_is_cut_to_what_the_crop_shows():
    full, crop = window(0, 0, 20, 10), window(3, 2, 5, 4, 20, 10)
    assert np.array_equal(matching_part(full, crop).rgb, crop.rgb)
    # Files of other programs do not say that they are crops.
    plain = window(0, 0, 5, 4)
    assert matching_part(plain, crop) is plain


def test_a_reference_of_another_size_or_place_is_refused():
    crop = window(3, 2, 5, 4, 20, 10)
    for other in (window(0, 0, 20, 11), window(4, 2, 5, 4, 20, 10), window(0, 0, 5, 4, 20, 10)):
        with pytest.raises(InputError, match=r"ref\.exr: expected 5x4 pixels at 3,2 of 20x10; got"):
            matching_part(other, crop, "ref.exr")
