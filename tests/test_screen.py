"""The screen filter against a model in NumPy, closed forms and plain path tracing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import LUMINANCE, build, camera, floor, glowing, lambertian, render, renderer

from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.launches import run
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Material, Texture
from psf_cl.settings import Settings

FILTER = {"screen_filter": "path_space"}
SIZE = (24, 18)
NOISE_UNKNOWN = next(value for name, value, _ in layout.FLOAT_CONSTANTS if name == "NOISE_UNKNOWN")


def room(size=SIZE, matt=True):
    """Return a lamp over a floor with two balls on it."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    left = transform.translation((-0.5, 0.4, 0)) @ transform.scaling(0.4)
    right = transform.translation((0.5, 0.4, 0.2)) @ transform.scaling(0.4)
    ball = primitives.sphere(12, 8)
    coat = {"specular": 0.0} if matt else {"roughness": 0.3}
    metal = lambertian(0.8) if matt else Material(metallic=1.0, roughness=0.2)
    return build(
        [
            floor(3.0, Material(base_color=(0.7, 0.5, 0.3), **coat)),
            (ball, left, metal),
            (ball, right, Material(base_color=(0.3, 0.6, 0.8), **coat)),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=0.2,
    )


@pytest.fixture(scope="module")
def opened(device):
    """Return a renderer whose light and surfaces tests overwrite."""
    opened = renderer(device, room(), **FILTER, screen_radius=6.0)
    yield opened
    opened.close()


def mix_bits(x):
    """Return lowbias32 of uint32 ``x`` (cl/common/rng.h)."""
    x = np.asarray(x, np.uint32).copy()
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x ^= x >> np.uint32(shift)
        x *= np.uint32(factor)
    return x ^ (x >> np.uint32(16))


def unit(x):
    return (x >> np.uint32(8)).astype(np.float64) * 2.0**-24


def one_surface(opened, seen):
    """Return whether pixels see the same surface as others, of their rows and columns."""
    scene = opened.scene
    view = scene.cameras[scene.camera]
    p, ns = seen["p"].astype(np.float64), seen["ns"].astype(np.float64)
    ns /= np.maximum(np.linalg.norm(ns, axis=-1, keepdims=True), 1e-30)
    away = np.linalg.norm(p - view.transform[:3, 3], axis=-1)
    footprint = away * 2 * np.tan(view.fov_y / 2) / scene.height

    def agree(at):
        between = p[at] - p
        agrees = (seen["hits"] > 0) & (seen["hits"][at] > 0) & ((ns * ns[at]).sum(-1) > 0.9)
        agrees &= np.abs((ns * between).sum(-1)) < footprint
        return agrees & (np.abs((ns[at] * between).sum(-1)) < footprint)

    return p, footprint, agree


def arriving(opened, light, seen):
    """Return the light that falls on the bases, and its variance, ``(h, w)``."""
    height, width = light.shape
    y, x = np.mgrid[:height, :width]
    _, _, agree = one_surface(opened, seen)
    reflects = seen["gate"].astype(np.float64) @ LUMINANCE
    safe = np.maximum(reflects, 1e-37)
    light_there = light["base"] @ LUMINANCE / safe
    known = light["noise"] < NOISE_UNKNOWN
    variance = np.where(known, light["noise"] / np.maximum(safe**2, 1e-37), NOISE_UNKNOWN)
    count, total, squares = np.zeros((3, height, width))
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            inside = (x + i >= 0) & (x + i < width) & (y + j >= 0) & (y + j < height)
            at = np.where(inside, y + j, 0), np.where(inside, x + i, 0)
            taken = inside & agree(at) & (reflects[at] > 0)
            value = np.where(taken, light_there[at], 0.0)
            count, total, squares = count + taken, total + value, squares + value**2
    n = np.maximum(count, 4)
    told = ~known & (count >= 4)
    scatter = 2 * (squares - total**2 / n) / (n * (n - 1)) * (1 + 4 / (n - 1))
    return np.where(told, total / n, light_there), np.where(told, scatter, variance)


def model(opened, light, seen):
    """Return the filtered picture ``(h, w, 3)`` of inputs ``(h, w)``; loops over neighbours."""
    settings = opened.settings
    height, width = light.shape
    y, x = np.mgrid[:height, :width]
    p, footprint, agree = one_surface(opened, seen)
    arrives_here, variance = arriving(opened, light, seen)
    radius = settings.screen_radius * np.maximum(light["count"], 1.0) ** -0.25
    random = mix_bits((y * width + x + 0x5BD1E995).astype(np.uint32))
    turned = unit(random)
    weight = light["count"][..., None].astype(np.float64)
    sums = [weight * light["base"], weight * seen["gate"]]
    shared = np.zeros((height, width), bool)
    for k in range(settings.screen_neighbours):
        random = mix_bits(random + np.uint32(0x9E3779B9))
        r = radius * np.sqrt((k + unit(random)) / settings.screen_neighbours)
        random = mix_bits(random + np.uint32(0x9E3779B9))
        turns = turned + k * 0.61803399 + unit(random) / settings.screen_neighbours
        column = np.floor(r * np.cos(2 * np.pi * turns) + 0.5).astype(int) + x
        row = np.floor(r * np.sin(2 * np.pi * turns) + 0.5).astype(int) + y
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        at = np.where(inside, row, 0), np.where(inside, column, 0)
        agrees = inside & ((column != x) | (row != y)) & agree(at)
        agrees &= np.linalg.norm(p[at] - p, axis=-1) < 2 * radius * footprint
        apart = arrives_here - arrives_here[at]
        agrees &= apart**2 <= 3 * (variance + np.minimum(variance[at], 4 * variance))
        for total, values in zip(sums, (light["base"], seen["gate"]), strict=True):
            total += np.where(agrees[..., None], weight[at] * values[at], 0.0)
        shared |= agrees
    arrives = sums[0] / np.where(sums[1] > 0, sums[1], 1.0)
    result = np.maximum(light["rgb"] - light["base"], 0.0) + seen["gate"] * arrives
    return np.where(shared[..., None], result, light["rgb"]), shared


def filtered(opened, light, seen):
    """Return the picture that the device makes of the same."""
    device, order = opened.device, opened.order
    device.write(opened.buffers["light"], light.reshape(-1)[order])
    device.write(opened.buffers["surfaces_seen"], seen.reshape(-1)[order])
    assert len(opened.pictures.finish) == 2
    run(opened.pictures.finish)
    picture = np.zeros((light.size, 4), np.float32)
    picture[order] = device.read(opened.buffers["filtered"]).reshape(-1, 4)
    return picture[:, :3].reshape(*light.shape, 3)


def surfaces(opened, heights):
    """Return what pixels see that look at a plane y = 0 moved by ``heights`` footprints, and light.

    Every base is lit with a radiance of 1 unless a test changes it; reflectances are random.
    """
    scene = opened.scene
    view = scene.cameras[scene.camera].transform
    height, width = scene.height, scene.width
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:height, :width] + 0.5
    scale = np.tan(scene.cameras[scene.camera].fov_y / 2)
    across = (2 * x / width - 1) * scale * width / height
    upward = (1 - 2 * y / height) * scale
    to = across[..., None] * view[:3, 0] + upward[..., None] * view[:3, 1] - view[:3, 2]
    # Planes across the view, for which a pixel is one footprint everywhere.
    footprint = 3.0 * 2 * scale / height
    away = 3.0 + heights * footprint
    seen = np.zeros((height, width), layout.SEEN_MEAN.dtype)
    seen["p"] = view[:3, 3] + to * away[..., None]
    seen["ns"] = view[:3, 2]
    seen["hits"] = seen["count"] = seen["shape"] = 1
    seen["gate"] = rng.random((height, width, 3)) ** 2
    light = np.zeros((height, width), layout.PIXEL_LIGHT.dtype)
    light["base"] = seen["gate"]
    light["rgb"] = seen["gate"] + 0.25
    light["count"] = 1
    light["noise"] = NOISE_UNKNOWN
    return light, seen


def test_a_filter_that_is_off_leaves_nothing_behind():
    plan = make_plan(room(), Settings())
    assert plan.features["SEEN"].value == plan.features["BASE"].value == 0
    assert not {"seen", "screen"} & {stage.name for stage in plan.stages}
    assert dict(plan.left_out)["base"] == "screen_filter is off"
    on = make_plan(room(), Settings(**FILTER))
    assert {"seen", "screen"} <= {stage.name for stage in on.stages}
    assert on.features["BASE"].value == 1
    assert make_plan(room(matt=False), Settings(**FILTER)).features["BASE"].value == 2


def test_the_filter_equals_a_model_of_it(opened):
    rng = np.random.default_rng(3)
    heights = np.cumsum(rng.normal(0, 0.3, SIZE[::-1]), axis=1)
    light, seen = surfaces(opened, heights)
    tilted = seen["ns"] + rng.normal(0, 0.15, seen["ns"].shape)
    seen["ns"] = tilted / np.linalg.norm(tilted, axis=-1, keepdims=True)
    seen["hits"][rng.random(seen.shape) < 0.1] = 0
    seen["gate"][rng.random(seen.shape) < 0.1] = 0
    light["base"] = seen["gate"] * rng.exponential(1.0, seen["gate"].shape)
    light["rgb"] = light["base"] + rng.random(seen["gate"].shape)
    light["count"] = rng.integers(1, 9, seen.shape)
    known = rng.random(seen.shape) < 0.7
    light["noise"][known] = (rng.exponential(0.5, seen.shape) * (seen["gate"] @ LUMINANCE) ** 2)[
        known
    ]
    expected, shared = model(opened, light, seen)
    found = filtered(opened, light, seen)
    assert 0.5 < shared.mean() < 1.0
    # A neighbour that just agrees for one and just does not for the other: rounding decides.
    close = np.isclose(found, expected, rtol=1e-4, atol=1e-5).all(axis=-1)
    assert close.mean() > 0.99
    assert np.abs(expected - light["rgb"]).mean() > 0.1


def test_constant_light_stays_constant_whatever_the_reflectances(opened):
    light, seen = surfaces(opened, np.zeros(SIZE[::-1]))
    np.testing.assert_allclose(filtered(opened, light, seen), light["rgb"], rtol=1e-5)


@pytest.mark.parametrize("step", [1.5, 4.0, 1000.0])
def test_nothing_crosses_a_depth_edge(opened, step):
    near = np.arange(SIZE[0]) < SIZE[0] // 2
    light, seen = surfaces(opened, np.where(near, 0.0, step) * np.ones(SIZE[::-1]))
    light["base"] *= np.where(near, 1.0, 0.0)[None, :, None]
    light["rgb"] = light["base"]
    found = filtered(opened, light, seen)
    np.testing.assert_allclose(found, light["rgb"], rtol=1e-5)
    # It does where there is no edge.
    light, seen = surfaces(opened, np.zeros(SIZE[::-1]))
    light["base"] *= np.where(near, 1.0, 0.0)[None, :, None]
    light["rgb"] = light["base"]
    assert np.abs(filtered(opened, light, seen) - light["rgb"]).max() > 0.1


def test_the_edge_of_a_shadow_stays_where_it_stands_out_of_the_noise(opened):
    lit = np.arange(SIZE[0]) < SIZE[0] // 2
    light, seen = surfaces(opened, np.zeros(SIZE[::-1]))
    light["base"] *= np.where(lit, 1.0, 0.1)[None, :, None]
    light["rgb"] = light["base"]
    for deviation, moved in ((0.01, False), (2.0, True)):
        light["noise"] = (deviation * (seen["gate"] @ LUMINANCE)) ** 2
        found = filtered(opened, light, seen)
        assert (np.abs(found - light["rgb"]).max() > 0.1) == moved


def test_the_edge_of_a_shadow_stays_where_no_samples_tell_the_noise(opened):
    """One sample a pixel: what is around tells how far the light scatters, which it does not."""
    lit = np.arange(SIZE[0]) < SIZE[0] // 2
    light, seen = surfaces(opened, np.zeros(SIZE[::-1]))
    light["base"] *= np.where(lit, 1.0, 0.1)[None, :, None]
    light["rgb"] = light["base"]
    found = filtered(opened, light, seen)
    edge = np.abs(np.arange(SIZE[0]) - SIZE[0] // 2 + 0.5) < 2.0
    # At the border of the picture six pixels tell less.
    np.testing.assert_allclose(found[7:-7, ~edge], light["rgb"][7:-7, ~edge], atol=1e-5)
    assert np.abs(found - light["rgb"])[:, ~edge].mean() < 2e-3
    # Where it scatters by chance it is averaged.
    scatter = np.random.default_rng(5).exponential(1.0, (*SIZE[::-1], 1))
    light["base"] = light["rgb"] = seen["gate"] * scatter
    apart = (filtered(opened, light, seen) / seen["gate"]).std()
    assert apart < 0.5 * scatter.std()


def test_noise_is_that_of_the_mean_of_the_samples(device):
    """Of independent samples: the scatter of renders that differ by their seeds."""
    means, noises = [], []
    for seed in range(24):
        opened = renderer(device, room(), **FILTER, sampler="random", seed=seed)
        opened.render(spp=8)
        opened.image()
        light = opened.device.read(opened.buffers["light"])
        means.append(light["base"] @ LUMINANCE)
        noises.append(light["noise"])
        opened.close()
    # Of 8 samples a variance counts 1 + 4 / 7 times.
    np.testing.assert_allclose(
        np.mean(noises) * 7 / 11, np.var(means, axis=0, ddof=1).mean(), rtol=0.1
    )


@pytest.mark.slow
def test_a_rendered_texture_under_an_even_sky_stays_as_it_is(device):
    """Without shadow rays the sky is all that is found: each sample is the reflectance."""
    texels = np.random.default_rng(2).integers(20, 255, (64, 64, 4)).astype(np.uint8)
    view = camera((0, 2, 0.001), (0, 0, 0), 40)
    material = lambertian(1.0, base_color_texture=0)
    scene = build([floor(2.0, material)], view, environment=1.0, textures=[Texture("t", texels)])
    settings = {"direct_sampling": "bsdf"}
    plain = render(device, scene, 4, **settings)
    assert plain.rgb.std() > 0.05
    image = render(device, scene, 4, **settings, **FILTER)
    np.testing.assert_allclose(image.rgb, plain.rgb, rtol=1e-5)


@pytest.mark.parametrize("matt", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_filter_of_no_width_changes_no_bit(device, matt):
    plain = render(device, room(matt=matt), 4)
    image = render(device, room(matt=matt), 4, **FILTER, screen_radius=0.0)
    np.testing.assert_array_equal(image.rgb, plain.rgb)


@pytest.mark.slow
def test_metal_stays_sharp(device):
    """A metal has no diffuse base: nothing of its pixels is averaged."""
    sky = Environment((1, 1, 1), np.random.default_rng(1).random((8, 16, 3), np.float32))
    shape = floor(3.0, Material(base_color=(0.9, 0.8, 0.7), metallic=1.0, roughness=0.2))
    scene = build([shape], camera((0, 1.5, 3), (0, 0.5, 0), 45), SIZE, environment=sky)
    image = render(device, scene, 2, **FILTER)
    np.testing.assert_array_equal(image.rgb, render(device, scene, 2).rgb)


def bases(device, matt, identity=False, **settings):
    """Return the sums of what bases reflect, and of all light."""
    opened = renderer(device, room(matt=matt), **FILTER, **settings)
    if identity:
        params = opened.device.read(opened.buffers["params"])
        params["cell_flags"] = layout.CONSTANT["CELL_IDENTITY"]
        opened.device.write(opened.buffers["params"], params)
    opened.render(spp=4)
    opened.image()
    light = opened.device.read(opened.buffers["light"])
    opened.close()
    return light["base"], light["rgb"]


@pytest.mark.parametrize(
    ("matt", "vertex", "direct"),
    [
        (True, "1", False),
        pytest.param(True, "2", True, marks=pytest.mark.slow),
        pytest.param(False, "2", True, marks=pytest.mark.slow),
        pytest.param(False, "1", True, marks=pytest.mark.slow),
        pytest.param(False, "1", False, marks=pytest.mark.slow),
        pytest.param(False, "auto", False, marks=pytest.mark.slow),
    ],
)
def test_light_that_goes_through_cells_is_split_as_that_of_plain_paths(
    device, matt, vertex, direct
):
    """Samples with cells of their own give back what they shared."""
    base, light = bases(device, matt)
    assert 0.3 * light.sum() < base.sum() < 0.98 * light.sum()
    settings = {"path_filter": "hash_grid", "filter_vertex": vertex, "filter_direct": direct}
    again = bases(device, matt, identity=True, cell_jitter=False, **settings)
    np.testing.assert_allclose(again[1], light, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(again[0], base, rtol=2e-5, atol=2e-6)


def test_matt_surfaces_reflect_all_but_what_is_seen_to_shine(device):
    """In a matt scene the rest is the light that camera rays find themselves."""
    scene = room()
    opened = renderer(device, scene, **FILTER)
    opened.render(spp=4)
    opened.image()
    light = opened.device.read(opened.buffers["light"])[np.argsort(opened.order)]
    opened.close()
    seen = render(device, scene, 4, max_depth=0).rgb.reshape(-1, 3)
    np.testing.assert_allclose(light["rgb"] - light["base"], seen, rtol=1e-4, atol=1e-6)
    assert seen.max() > 0.1


def test_same_bits_for_any_pool_and_any_number_of_looks(device):
    truth = render(device, room(), 6, **FILTER)
    small = open_device(traits=replace(device.traits, slots=128))
    opened = renderer(small, room(), **FILTER)
    for _ in range(6):
        opened.step()
        opened.snapshot()
    image = opened.image()
    opened.close()
    np.testing.assert_array_equal(image.rgb, truth.rgb)


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 8])
def test_lane_widths_agree_on_the_filter(device, lanes):
    traits = replace(device.traits, lanes=lanes, block=max(lanes, 8), slots=512)
    image = render(open_device(traits=traits), room(matt=False), 2, **FILTER)
    truth = render(device, room(matt=False), 2, **FILTER)
    close = np.isclose(image.rgb, truth.rgb, rtol=1e-4, atol=1e-5).all(axis=-1)
    assert close.mean() > 0.98


def test_one_sample_becomes_much_better(device):
    scene = room((96, 72))
    truth = render(device, scene, 256).rgb

    def error(image):
        return np.mean((image.rgb - truth) ** 2 / (truth**2 + 0.01))

    # What is left is mostly at edges, which one sample does not smooth.
    assert error(render(device, scene, 1, **FILTER)) < 0.5 * error(render(device, scene, 1))


def test_an_interrupted_first_pass_shows_what_it_has(device):
    small = open_device(traits=replace(device.traits, slots=128))
    opened = renderer(small, room((64, 64)), ["samples"], **FILTER)
    done = np.zeros(1)
    while not done.any():
        opened.scheduler.bounces = 1
        opened.render(spp=1, progress=lambda now: False)
        image = opened.image()
        done = image.aovs["samples"][..., 0] > 0
    assert opened.scheduler.passes == 0 and 0.01 < done.mean() < 1
    expected = render(device, room((64, 64)), 1).rgb
    np.testing.assert_array_equal(image.rgb[done], expected[done])
    opened.render(spp=1)
    whole = opened.image().rgb
    opened.close()
    np.testing.assert_array_equal(whole, render(device, room((64, 64)), 1, **FILTER).rgb)
