"""Pixels that few samples speak for are dimmed: against a model in NumPy, and with ever more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import LUMINANCE, render, renderer
from test_cells import FILTER, room

from psf_cl.device.device import open_device
from psf_cl.errors import InputError
from psf_cl.launches import run
from psf_cl.plan import make_plan
from psf_cl.settings import Settings, preset_values

SIZE = (38, 26)
DIM = {"filter_fireflies": True}
#: Light that paths find by chance alone.
NOISY = {"direct_sampling": "bsdf"}
ENOUGH = 6.0


def rows(opened, values):
    """Return what pixels have, in the order of the queue, as an image."""
    width, height = opened.plan.crop[2:]
    image = np.zeros((width * height, *values.shape[1:]))
    image[opened.order] = values
    return image.reshape(height, width, *values.shape[1:])


def parts_held(sums, mean, square):
    """Return which part of each pixel is held back, by its samples' sum, mean and mean square."""
    height, width = sums.shape
    # The pixel beyond an edge is the one on this side of it; where there is none, the pixel itself.
    for axis, extent in enumerate((height, width)):
        pad = [(1, 1) if k == axis else (0, 0) for k in range(2)]
        sums = np.pad(sums, pad, mode="reflect" if extent > 1 else "edge")
    around = sum(sums[y : y + height, x : x + width] for y in range(3) for x in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = around / (square / mean) - 1
    return np.where(mean > 0, 1 - np.clip(alike / ENOUGH, 0, 1), 0)


def held_of_film(opened):
    """Return the parts that the model holds back of the film as it is."""
    film = opened.device.read(opened.buffers["film"])
    mean = rows(opened, film["mean"].astype(np.float64))
    count = rows(opened, film["count"].astype(np.float64))
    squares = rows(opened, film["squares"].astype(np.float64))
    return parts_held(mean * count, mean, squares / count + mean**2)


def planted(device, size, samples, **settings):
    """Return an open renderer of a picture whose pixels have these samples' luminances.

    Args:
        samples: ``(h, w, n)`` numbers.
    """
    opened = renderer(device, room(size), **DIM, **settings)
    opened.render(spp=samples.shape[-1])
    film = opened.device.read(opened.buffers["film"])
    mean = samples.mean(axis=-1).reshape(-1)[opened.order]
    squares = ((samples - samples.mean(axis=-1, keepdims=True)) ** 2).sum(axis=-1)
    film["sum"] = (mean * samples.shape[-1])[:, None]
    film["lost"] = 0.0
    film["mean"], film["squares"] = mean, squares.reshape(-1)[opened.order]
    opened.device.write(opened.buffers["film"], film)
    return opened


def picture(device, samples, **settings):
    """Return the luminance of what is handed out of such a picture."""
    height, width, _ = samples.shape
    opened = planted(device, (width, height), samples, **settings)
    image = opened.image().rgb @ LUMINANCE
    opened.close()
    return image


@pytest.mark.parametrize("spp", [1, 5])
def test_the_picture_equals_a_model_in_numpy(device, spp):
    opened = renderer(device, room(SIZE), ("direct",), **DIM, **NOISY)
    opened.render(spp=spp)
    image, held = opened.image(), held_of_film(opened)
    stats = opened.stats()["fireflies"]
    film = opened.device.read(opened.buffers["film"])
    opened.close()
    plain = render(device, room(SIZE), spp, ("direct",), **NOISY)
    kept = 1 - held[..., None]
    assert 0.01 < (held > 0).mean() < 0.9
    np.testing.assert_allclose(image.rgb, plain.rgb * kept, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(
        image.aovs["direct"], plain.aovs["direct"] * kept, rtol=1e-3, atol=1e-5
    )
    assert stats["pixels"] == pytest.approx((held > 0).mean(), abs=2e-3)
    mean = film["mean"].astype(np.float64)
    lost = (held * rows(opened, mean)).sum() / mean.sum()
    assert stats["light"] == pytest.approx(lost, rel=1e-3)


def test_one_bright_sample_falls_to_what_is_around(device):
    samples = np.ones((9, 9, 4))
    samples[4, 4, 1] = 1e4
    image = picture(device, samples)
    # Of samples like the others its neighbours have 32, and moments make six of its own three.
    assert image[4, 4] == pytest.approx((32 + 6) / ENOUGH / 4, rel=1e-3)
    image[4, 4] = 1.0
    np.testing.assert_allclose(image, 1.0, rtol=1e-6)


@pytest.mark.parametrize("at", [(0, 0), (0, 4), (8, 8), (4, 8)])
def test_it_does_so_at_the_edges_too(device, at):
    samples = np.ones((9, 9, 1))
    samples[at] = 1e6
    assert picture(device, samples)[at] == pytest.approx(8 / ENOUGH, rel=1e-3)


def test_what_every_sample_of_a_pixel_sees_is_believed(device):
    """A lamp that is one pixel in size: seven samples of it are enough."""
    few, enough = np.zeros((9, 9, 4)), np.zeros((9, 9, 7))
    few[4, 4] = enough[4, 4] = 50.0
    assert picture(device, few)[4, 4] == pytest.approx(50.0 * 3 / ENOUGH, rel=1e-3)
    assert picture(device, enough)[4, 4] == pytest.approx(50.0, rel=1e-6)


def test_bright_samples_that_others_have_too_are_kept(device):
    samples = np.zeros((9, 9, 1))
    samples[3:6, 3:6] = 20.0
    image = picture(device, samples)
    assert image[4, 4] == pytest.approx(20.0)
    assert image[3, 3] == pytest.approx(20.0 * 3 / ENOUGH)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2)])
@pytest.mark.parametrize("spp", [1, 3])
def test_pictures_of_one_light_stay_as_they_are(device, size, spp):
    width, height = size
    np.testing.assert_array_equal(picture(device, np.full((height, width, spp), 3.0)), 3.0)


@pytest.mark.parametrize("light", [0.0, -1.0, 1e-30, 1e30])
def test_numbers_at_the_ends_of_their_range_stay_what_they_are(device, light):
    image = picture(device, np.full((5, 5, 2), light))
    np.testing.assert_allclose(image, np.float32(light), rtol=1e-6)


def test_with_more_samples_ever_less_is_held_back(device):
    opened = renderer(device, room(SIZE), **DIM, **NOISY)
    held = []
    for spp in (1, 4, 8, 64):
        opened.render(spp=spp)
        opened.image()
        held.append(opened.stats()["fireflies"]["light"])
    opened.close()
    assert held[0] > held[1] > held[2]
    assert held[3] == 0.0


def test_cells_restore_what_they_lost_on_top(device):
    """The rest of the picture is what it would be, but for noise that is told by its light."""
    ways = {**FILTER, "filter_vertex": "1", "filter_restore": True, "cell_shrink": False}
    samples = np.ones((26, 38, 8))
    samples[13, 20, 3] = 1e5
    image = picture(device, samples, **ways)
    opened = renderer(device, room(SIZE), **ways)
    opened.render(spp=8)
    averages = render(device, room(SIZE), 8, **ways | {"filter_restore": False}).rgb
    back = opened.image().rgb - averages
    opened.close()
    assert image[13, 20] < 20.0
    assert np.abs(back).max() > 1e-3


@pytest.mark.parametrize(
    "ways",
    [
        {"screen_filter": "path_space"},
        {"temporal": "cumulative"},
        {"screen_filter": "path_space", "temporal": "adaptive"},
    ],
)
def test_light_of_frames_is_dimmed_before_it_is_filtered(device, ways):
    """As the model does, by what pixels have before."""
    opened = renderer(device, room(SIZE), **ways, **DIM, **NOISY)
    opened.render(spp=4)
    run(opened.pictures.blend)
    light = opened.device.read(opened.buffers["light"])
    mean = rows(opened, light["rgb"].astype(np.float64) @ LUMINANCE)
    square = rows(opened, light["square"].astype(np.float64))
    means = rows(opened, light["means"].astype(np.float64))
    expected = parts_held(mean * means, mean, np.maximum(square, mean**2))
    opened.image()
    held = 1 - rows(opened, opened.device.read(opened.buffers["kept"]))
    dimmed = opened.device.read(opened.buffers["light"])
    opened.close()
    assert (held > 0).any()
    assert np.unique(means) == (1.0 if "temporal" in ways else 4.0)
    np.testing.assert_allclose(held, expected, atol=1e-3)
    factor = (1 - expected)[..., None]
    for name in ("rgb", "base"):
        before = rows(opened, light[name].astype(np.float64))
        after = rows(opened, dimmed[name].astype(np.float64))
        np.testing.assert_allclose(after, before * factor, rtol=1e-2, atol=1e-4)


def test_histories_keep_what_is_held_back(device):
    """Only the picture is dimmed: with more frames the light comes back."""
    opened = renderer(device, room(SIZE), temporal="cumulative", **DIM, **NOISY)
    held = []
    for frame in range(24):
        opened.set_frame(frame / 25)
        opened.render(spp=1)
        opened.image()
        held.append(opened.stats()["fireflies"]["light"])
    opened.close()
    assert held[-1] < 0.1 * held[0]


@pytest.mark.parametrize("slots", [128, 1024])
def test_same_bits_for_any_pool(device, slots):
    settings = preset_values("psf")
    truth = render(device, room(SIZE), 5, **settings)
    small = open_device(traits=replace(device.traits, slots=slots))
    assert render(small, room(SIZE), 5, **settings).rgb.tobytes() == truth.rgb.tobytes()


def test_what_is_off_is_left_out():
    plan = make_plan(room(), Settings())
    assert plan.features["FIREFLIES"].value == 0
    assert "kept" not in {buffer.name for buffer in plan.buffers}
    assert "fireflies" in dict(plan.left_out)
    assert preset_values("psf")["filter_fireflies"] is True
    assert "filter_fireflies" not in preset_values("pt")


def test_what_cannot_go_with_it_is_refused():
    with pytest.raises(InputError, match="--noise: what filter_fireflies"):
        make_plan(room(), Settings(**DIM), halves=True)
    with pytest.raises(InputError, match="integrator=metropolis needs filter_fireflies=False"):
        make_plan(room(), Settings(**DIM, integrator="metropolis"))
