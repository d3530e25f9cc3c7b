"""Range search against brute force in NumPy, plain path tracing, and the bias of cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, lambertian, render, renderer

from psf_cl import load_scene
from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.measure.bias import split_error
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light, Material
from psf_cl.settings import Settings
from psf_cl.stages import cells

SEARCH = {"path_filter": "range_search", "filter_vertex": "1"}
CORNELL_BOX = Path(__file__).parents[1] / "scenes" / "cornell_box.toml"


def room(size=(40, 32), material=None):
    """Return a lamp over a floor with a box on it: sides, shadows, and light between surfaces."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    turned = transform.translation((0, 0.4, 0)) @ transform.rotation_xyz_degrees((0, 30, 0))
    return build(
        [
            floor(3.0, material or lambertian((0.7, 0.5, 0.3))),
            (primitives.box(), turned @ transform.scaling(0.4), lambertian((0.3, 0.6, 0.8))),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=0.2,
    )


def sides_of(packed):
    """Return the side of the cube that each packed direction points to."""
    x, y = (packed & 0xFFFF) / 32767.0 - 1.0, (packed >> 16) / 32767.0 - 1.0
    z = 1.0 - np.abs(x) - np.abs(y)
    fold = np.maximum(-z, 0.0)
    n = np.stack([x - np.sign(x) * fold, y - np.sign(y) * fold, z], axis=-1)
    axis = np.abs(n).argmax(axis=-1)
    return 2 * axis + (np.take_along_axis(n, axis[:, None], axis=-1)[:, 0] < 0)


def radii_squared(width, jitter):
    """Return the squares of the radii, from the variance of what a cell of a random edge joins."""
    low = 2.0 ** np.floor(np.log2(width))
    chance = width / low - 1.0
    edge2 = (1.0 - chance) * low**2 + chance * (2.0 * low) ** 2
    uniform = 1.0 / 12.0
    # Moved twice and cut off twice, or only cut off twice; of a disk it is a quarter of r^2.
    return 4.0 * edge2 * uniform * (4 if jitter else 2)


@pytest.mark.parametrize(("vertex", "jitter", "size"), [("1", False, 6.0), ("2", True, 30.0)])
def test_averages_are_those_of_brute_force(device, vertex, jitter, size):
    settings = SEARCH | {"filter_vertex": vertex, "cell_jitter": jitter, "cell_size": size}
    opened = renderer(device, room(), **settings)
    opened.render(spp=1)
    pixels = opened.image().rgb.reshape(-1, 3)[opened.order]
    count = len(pixels)
    plain = render(device, room(), 1).rgb.reshape(-1, 3)[opened.order]
    beyond, vertices = (
        opened.device.read(opened.buffers[name])[:count] for name in ("beyond", "vertices")
    )
    slope = float(opened.params[0]["cell_width"])
    opened.close()
    there = np.flatnonzero(beyond["vertex"])
    assert len(there) > 80
    place = vertices["p"][there].astype(np.float64)
    near = beyond["vertex"][there] >> 31
    side = sides_of(vertices["ng"][there]) + 8 * near
    assert len(np.unique(side)) >= 3 and 0 < near.mean() < 1
    gate, own = vertices["gate"][there].astype(np.float64), beyond["radiance"][there]
    light = own / gate
    r2 = radii_squared(vertices["length"][there].astype(np.float64) * slope, jitter)
    distance2 = ((place[:, None] - place[None]) ** 2).sum(axis=-1)
    close = (distance2 <= r2[:, None]) & (side[:, None] == side[None])
    assert 5 < close.sum(axis=1).mean() < 0.5 * len(there)
    mean = (close @ light) / close.sum(axis=1)[:, None]
    expected = plain.astype(np.float64)
    expected[there] += gate * mean - own
    # Pairs whose distance is the radius but for rounding may be told apart otherwise.
    right = np.isclose(pixels, expected, rtol=2e-4, atol=2e-5).all(axis=1)
    assert right.mean() > 0.99
    assert np.abs(pixels[there] - plain[there]).mean() > 0.1 * plain[there].mean()


@pytest.mark.parametrize(
    ("material", "screen"),
    [
        (None, "off"),
        pytest.param(
            Material(base_color=(0.7, 0.5, 0.3), roughness=0.3),
            "path_space",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_balls_without_size_give_the_image_of_plain_path_tracing(device, material, screen):
    settings = {"screen_filter": screen}
    expected = render(device, room(material=material), 4, **settings).rgb
    image = render(device, room(material=material), 4, **settings, **SEARCH, cell_size=1e-3).rgb
    # Light is divided and multiplied by the reflectance once.
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=2e-6)


def test_a_ball_around_everything_gives_each_side_one_light(device):
    scene = build(
        [floor(50.0, lambertian((0.2, 0.5, 0.8)))],
        camera((0, 2, 0.001), (0, 0, 0), 40),
        (16, 16),
        environment=1.0,
    )
    settings = {"direct_sampling": "bsdf", "cell_size": 1e5}
    rgb = render(device, scene, 1, **settings, **SEARCH).rgb
    np.testing.assert_allclose(rgb, np.broadcast_to((0.2, 0.5, 0.8), rgb.shape), rtol=1e-5)


def test_same_bits_for_any_pool(device):
    truth = render(device, room(), 12, **SEARCH, cell_size=4.0).rgb
    small = open_device(traits=replace(device.traits, slots=256))
    assert render(small, room(), 12, **SEARCH, cell_size=4.0).rgb.tobytes() == truth.tobytes()


def test_an_interrupted_first_pass_shows_what_it_has(device):
    small = open_device(traits=replace(device.traits, slots=128))
    opened = renderer(small, room((64, 64)), ["samples"], **SEARCH)
    done = np.zeros(1)
    while not done.any():
        opened.scheduler.bounces = 1
        opened.render(spp=1, progress=lambda now: False)
        image = opened.image()
        done = image.aovs["samples"][..., 0] > 0
    assert opened.scheduler.passes == 0 and 0.01 < done.mean() < 1
    opened.close()
    expected = render(device, room((64, 64)), 1).rgb
    np.testing.assert_allclose(image.rgb[done], expected[done], rtol=1e-5, atol=1e-6)


def test_the_plan_has_either_cells_or_balls():
    plan = make_plan(room(), Settings(**SEARCH, filter_restore=True))
    names = [stage.name for stage in plan.stages]
    assert "range_search" in names and "cells" not in names and "restore" not in names
    assert "range_search" in plan.features["CELLS"].reason
    assert "balls" in dict(plan.left_out)["restore"]


def bias_of(device, scene, spp, seeds, part, **settings):
    """Return the squared bias of either filter in ``part`` of the picture."""
    found = {}
    plain = [render(device, scene, spp, seed=seed).rgb for seed in range(seeds)]
    for name in ("hash_grid", "range_search"):
        values = {**SEARCH, "path_filter": name, "cell_shrink": False, "cell_walls": False}
        values |= settings
        # Of the same seeds: much of the noise of both images is the same.
        images = [
            (render(device, scene, spp, seed=seed, **values).rgb - plain[seed])[part]
            for seed in range(seeds)
        ]
        split = split_error(images, np.zeros_like(images[0]), np.ones_like(images[0]))
        found[name] = split.bias2.value
    return found


@pytest.mark.slow
def test_balls_are_as_biased_as_cells_where_light_changes_smoothly(device):
    scene = build(
        [floor(3.0, lambertian(0.5))],
        # From so far away that all balls are alike.
        camera((0, 200, 0.001), (0, 0, 0), 0.8),
        (64, 64),
        lights=[Light("point", (1.0, 1.0, 1.0), position=(0.1, 0.7, 0.05))],
    )
    inner = np.s_[16:48, 16:48]
    bias = bias_of(device, scene, 32, 4, inner, cell_size=6.0)
    assert bias["hash_grid"] == pytest.approx(bias["range_search"], rel=0.25), bias


@pytest.mark.slow
def test_balls_are_up_to_twice_as_biased_as_cells_at_the_borders_of_walls(device):
    """A half disk of that radius looks 0.49 edges away from the border, a cell 0.36 (squared: 2).

    By integrating over the bias near a border, with all places of the grid: 0.0770 to 0.0360.
    """
    bias = bias_of(device, load_scene(CORNELL_BOX, size=(64, 64)), 64, 4, np.s_[:], cell_size=8.0)
    assert 0.4 < bias["hash_grid"] / bias["range_search"] < 1.0, bias


def cell_averages(opened, number, values):
    """Return the averages per cell of ``values`` (n, 3) in place of the light of a pass."""
    device, buffers, index = opened.device, opened.buffers, layout.COUNTER_INDEX
    count, place = opened.plan.pixel_count, number & (opened.plan.ring - 1)
    own = np.s_[place * count : (place + 1) * count]
    beyond, gate = (
        device.read(buffers["beyond"])[own],
        device.read(buffers["vertices"])[own]["gate"],
    )
    beyond["radiance"] = gate * values
    device.write(buffers["beyond"], beyond, place * count)
    device.write(buffers["samples"], np.zeros(4 * count, np.float32), 4 * place * count)

    def set_counters(first, finished):
        for at, value in ((index["film_pass"], first), (index["finished"] + place, finished)):
            device.write(buffers["counters"], np.array([value], np.uint32), at)

    set_counters(number, count)
    for launch, items in opened.cells.share:
        launch(items)
    opened.cells.clear(cells.buckets(count))
    found = device.read(buffers["samples"]).reshape(-1, 4)[own, :3].astype(np.float64)
    set_counters(number + 1, 0)
    return found / np.maximum(gate, 1e-9)


def ball_averages(values, place, side, radius2):
    """Return the averages of ``values`` over the vertices of each one's ball, by brute force."""
    found = np.empty_like(values)
    for first in range(0, len(place), 256):
        part = np.s_[first : first + 256]
        apart = ((place[part, None] - place[None]) ** 2).sum(axis=-1)
        inside = (apart <= radius2[part, None]) & (side[part, None] == side[None])
        found[part] = inside @ values / inside.sum(axis=1, keepdims=True)
    return found


@pytest.mark.slow
def test_cells_are_no_more_biased_than_balls_that_average_as_far_away_at_borders_too(device):
    """The mean square of the distance, measured place by place, is that of the balls: r^2 / 2.

    At a border alone, light growing with the distance from it, the quotient is 0.91 by integration.
    """
    size, passes, balls = (48, 48), 48, 8
    scene = load_scene(CORNELL_BOX, size=size)
    plain = [render(device, scene, 256, ["albedo"], seed=seed) for seed in range(2)]
    emitted = render(device, scene, 256, max_depth=0).rgb
    values = {"cell_shrink": False, "cell_walls": False, "cell_near": False, "cell_size": 6.0}
    opened = renderer(device, scene, path_filter="hash_grid", filter_vertex="1", **values)

    def light_of(image):
        """Return what arrives at the pixels in the order of the renderer, (n, 3)."""
        albedo, rgb = (
            values.reshape(-1, 3)[opened.order].astype(np.float64)
            for values in (image.aovs["albedo"], np.maximum(image.rgb - emitted, 0.0))
        )
        return np.where(albedo > 0.02, rgb / np.maximum(albedo, 0.02), 0.0)

    lights = [light_of(image) for image in plain]
    count = len(lights[0])
    moment, vertices, bias = np.zeros(count), [], np.zeros((2, count, 3))
    for number in range(passes):
        opened.render(spp=number + 1)
        first = (number & (opened.plan.ring - 1)) * count
        beyond, vertex = (
            opened.device.read(opened.buffers[name])[first : first + count]
            for name in ("beyond", "vertices")
        )
        there = beyond["vertex"] != 0
        # Shifted, for cells take no negative numbers.
        place = np.where(there[:, None], vertex["p"] + 2.0, 0.0).astype(np.float64)
        mean, square = (cell_averages(opened, number, v) for v in (place, place**2))
        apart = (square - 2 * place * mean + place**2).sum(axis=1)
        moment += np.where(there, apart, 0.0) / passes
        light = lights[number & 1]
        blurred = cell_averages(opened, number, light) - light
        bias[number & 1] += np.where(there[:, None], blurred, 0.0) * 2 / passes
        # What has no vertex is on a side of its own.
        vertices.append((place, np.where(there, sides_of(vertex["ng"]), 6 + np.arange(count))))
    opened.close()
    searched = np.zeros((2, count, 3))
    for number, (place, side) in enumerate(vertices[:balls]):
        light = lights[number & 1]
        blurred = ball_averages(light, place, side, 2 * np.maximum(moment, 0.0)) - light
        searched[number & 1] += blurred * 2 / balls
    # Products of independent halves, of independent light, hold no noise.
    cell_bias, ball_bias = (np.mean(parts[0] * parts[1]) for parts in (bias, searched))
    assert ball_bias > 0
    assert 0.55 < cell_bias / ball_bias < 1.25
