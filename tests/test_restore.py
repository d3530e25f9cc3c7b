"""What averages per cell lost goes back: against a model in NumPy, and plain path tracing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import LUMINANCE, render, renderer
from test_cells import FILTER, room

from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.settings import Settings, preset_values

SIZE = (38, 26)
RESTORE = {**FILTER, "filter_vertex": "1", "filter_restore": True, "cell_shrink": False}


def windows(image, radius):
    """Return the sums of ``image`` over windows cut at its edges, and their pixels."""
    sums, counts = np.zeros_like(image), np.zeros(image.shape[:2])
    height, width = image.shape[:2]
    for y in range(height):
        for x in range(width):
            part = image[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            sums[y, x] = part.sum(axis=(0, 1))
            counts[y, x] = part.shape[0] * part.shape[1]
    return sums, counts


def model(opened, positive=True):
    """Return the picture that the film and what it lost make."""
    width, height = SIZE
    film, lost = (opened.device.read(opened.buffers[name]) for name in ("film", "film_lost"))
    lost, excess = np.split(lost, 2)

    def picture(values):
        image = np.zeros((width * height, values.shape[-1]))
        image[opened.order] = values
        return image.reshape(height, width, -1)

    count = film["count"].astype(np.float64)[:, None]
    image = picture((film["sum"] - film["lost"]) / count)
    mean = (lost["rgb"].astype(np.float64) - excess["rgb"]) / count
    # Runs of about sqrt(pass) passes take turns between the halves.
    passes = np.arange(int(count[0, 0]))
    runs = 2 ** (np.floor(np.log2(np.maximum(passes, 1))).astype(int) // 2)
    first = 1 - 2 * (passes // runs % 2).mean()
    apart = lost["difference"].astype(np.float64) - excess["difference"]
    difference = apart[:, None] / count - first * (mean @ LUMINANCE)[:, None]
    lifted = np.zeros((height, width))
    left, variance = picture(mean), picture(difference**2 / (1 - first**2) * (1 + 4 / (count - 1)))
    # Two variances are noise at first, and ever less of them after 32 passes.
    cautious = 1 + min(1, 32 / len(passes))

    def put_back(image, left, back):
        if positive:
            back = np.maximum(back, -np.maximum(image, 0))
        return image + back, left - back

    # Nothing looks surer, for the light that it shares, than five by five tiles of pixels around.
    shared = picture(opened.device.read(opened.buffers["film_shared"])[:, None] / count)[..., 0]
    light = np.minimum(np.maximum(image @ LUMINANCE, 0), 4 * shared)
    tile = layout.CONSTANT["RESTORE_TILE"]
    ys, xs = np.mgrid[:height, :width] // tile
    for y in range(-(-height // tile)):
        for x in range(-(-width // tile)):
            noise = squares = roots = 0.0
            pixels = 0
            for j in range(y - 2, y + 3):
                for i in range(x - 2, x + 3):
                    inside = (ys == j) & (xs == i)
                    noise += variance[inside].sum()
                    roots += np.sqrt(variance[inside]).sum()
                    pixels += inside.sum()
                    squares += light[inside].sum() ** 2 / max(inside.sum(), 1)
            here = (ys == y) & (xs == x)
            # The more pixels have a part in the noise, the more those are believed that do not.
            noisy = roots**2 / (noise * pixels)
            relative = np.clip(0.1 / noisy, 0.2, 1.0) * noise / squares
            lifted[here] = np.maximum(variance[here, 0], relative * light[here] ** 2)
    variance = lifted[..., None]

    for radius in (8, 2) if len(passes) < 16 else (8, 4, 2, 1):
        sums, counts = windows(np.concatenate([left, variance], axis=-1), radius)
        means = sums[..., :3] / counts[..., None]
        square = (means @ LUMINANCE) ** 2
        noise = cautious * sums[..., 3] / counts**2
        back = (np.maximum(square - noise, 0) / np.maximum(square, 1e-37))[..., None] * means
        image, left = put_back(image, left, back)
        if radius == 8:
            variance = np.maximum(variance, sums[..., 3:] / counts[..., None] / 2)
    # At the edges of the picture a neighbour that is missing is the pixel at the edge, once more.
    both = np.stack([(left @ LUMINANCE) ** 2, variance[..., 0]], axis=-1)
    padded = np.pad(both, [(1, 1), (1, 1), (0, 0)], mode="edge")
    near = sum(padded[y : y + height, x : x + width] for y in range(3) for x in range(3))
    part = np.maximum(near[..., 0] - cautious * near[..., 1], 0) / np.maximum(near[..., 0], 1e-37)
    return put_back(image, left, part[..., None] * left)[0]


def error(image, truth):
    return float(((image - truth) ** 2).mean())


def test_filter_that_stays_as_it_is_leaves_nothing_to_restore():
    plan = make_plan(room(), Settings(**FILTER))
    assert plan.features["RESTORE"].value == 0
    assert not {"film_lost", "restored"} & {buffer.name for buffer in plan.buffers}
    assert make_plan(room(), Settings(**RESTORE)).features["RESTORE"].value == 1
    assert make_plan(room(), Settings(filter_restore=True)).features["RESTORE"].value == 0
    assert preset_values("psf")["filter_restore"] is True


@pytest.mark.parametrize("spp", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_the_picture_equals_a_model_in_numpy(lane_device, spp):
    opened = renderer(lane_device, room(SIZE), **RESTORE, cell_size=16.0)
    opened.render(spp=spp)
    image, expected = opened.image().rgb, model(opened)
    film = opened.device.read(opened.buffers["film"])
    opened.close()
    averages = np.zeros((SIZE[0] * SIZE[1], 3))
    averages[opened.order] = film["sum"] / film["count"][:, None]
    assert error(expected, averages.reshape(image.shape)) > 1e-6
    np.testing.assert_allclose(image, expected, rtol=1e-3, atol=1e-4)


def test_no_pixel_is_made_negative(lane_device):
    """As where a bright sample that others had is missing: a pixel has much less than its cell."""
    opened = renderer(lane_device, room(SIZE), **RESTORE)
    opened.render(spp=4)
    lost = opened.device.read(opened.buffers["film_lost"])
    lost["rgb"][: SIZE[0] * SIZE[1] // 3] -= 8.0
    opened.device.write(opened.buffers["film_lost"], lost)
    image, expected, unbounded = opened.image().rgb, model(opened), model(opened, positive=False)
    opened.close()
    assert unbounded.min() < -1.0
    assert image.min() >= 0.0
    np.testing.assert_allclose(image, expected, rtol=1e-3, atol=1e-4)


def test_what_was_lost_is_summed_as_exactly_as_the_film(device):
    """The averages and what they lost are the samples: those of path tracing, to the last sum."""
    opened = renderer(device, room(SIZE), **RESTORE, cell_size=16.0)
    opened.render(spp=64)
    film, lost = (opened.device.read(opened.buffers[name]) for name in ("film", "film_lost"))
    opened.close()
    plain = renderer(device, room(SIZE))
    plain.render(spp=64)
    truth = plain.device.read(plain.buffers["film"])
    plain.close()
    lost, excess = np.split(lost, 2)
    assert excess["rgb"].any()
    both = (film["sum"] - film["lost"] + lost["rgb"] - excess["rgb"].astype(np.float64)) / 64
    expected = (truth["sum"] - truth["lost"].astype(np.float64)) / 64
    np.testing.assert_allclose(both, expected, rtol=1e-5, atol=1e-6)


def test_light_reflected_more_than_once_is_the_rest_of_the_restored_picture(device):
    opened = renderer(device, room(SIZE), ("direct", "indirect"), **RESTORE, cell_size=16.0)
    opened.render(spp=8)
    image = opened.image()
    opened.close()
    rest = image.rgb - image.aovs["direct"]
    np.testing.assert_array_equal(image.aovs["indirect"], rest)


def test_no_error_is_estimated_of_what_goes_back():
    with pytest.raises(InputError, match="--noise: what filter_restore"):
        make_plan(room(), Settings(**RESTORE), halves=True)


def test_with_ever_more_samples_nothing_of_the_blur_is_left(device):
    """Cells as large as the room: averages alone stay wrong, and the rest goes back.

    Bias of up to twice the variance hides in noise: three times the error of path tracing.
    """
    truth = render(device, room(SIZE), 1024, seed=7).rgb
    settings = {**RESTORE, "cell_size": 1000.0}
    plain = {spp: error(render(device, room(SIZE), spp).rgb, truth) for spp in (4, 256)}
    blurred = render(device, room(SIZE), 256, (), **(settings | {"filter_restore": False})).rgb
    opened = renderer(device, room(SIZE), **settings)
    errors = {}
    for spp in (4, 256):
        opened.render(spp=spp)
        errors[spp] = error(opened.image().rgb, truth)
    opened.close()
    assert error(blurred, truth) > 20 * plain[256]
    assert errors[256] < 3 * plain[256]
    assert errors[4] < plain[4]


@pytest.mark.parametrize("slots", [128, 1024])
def test_same_bits_for_any_pool_with_what_is_restored(device, slots):
    truth = render(device, room(SIZE), 9, **RESTORE)
    small = open_device(traits=replace(device.traits, slots=slots))
    assert render(small, room(SIZE), 9, **RESTORE).rgb.tobytes() == truth.rgb.tobytes()


def test_one_sample_is_not_judged(device):
    """Nothing is known of the noise of one: the averages are the picture."""
    settings = RESTORE | {"filter_restore": False}
    np.testing.assert_allclose(
        render(device, room(SIZE), 1, **RESTORE).rgb,
        render(device, room(SIZE), 1, **settings).rgb,
        rtol=1e-6,
    )
