"""Coats and metals share what they reflect where that is wide, by kind and by direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planes
import pytest
from scene_builder import build, camera, floor, glowing, lambertian, render, renderer
from test_cells import FILTER, image_of, patched

from psf_cl.device import layout
from psf_cl.device.device import open_device
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Material
from psf_cl.settings import Settings
from psf_cl.stages.cells import parameters

LAYERS = {**FILTER, "filter_vertex": "1", "filter_direct": False, "cell_layers": True}
PARTED = {**LAYERS, "cell_directions": 4}
METAL = Material(base_color=(0.9, 0.7, 0.4), metallic=1.0, roughness=0.7)
COATED = Material(base_color=(0.3, 0.6, 0.8), roughness=0.6)


def room(*materials, size=(48, 32)):
    """Return a lamp over a floor and a box."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    box = transform.translation((0, 0.4, 0)) @ transform.scaling(0.4)
    return build(
        [
            floor(3.0, materials[0]),
            (primitives.box(), box, materials[-1]),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=0.2,
    )


def octahedron(wo):
    """Return where unit vectors lie in the square of the unfolded octahedron, 0 to 1."""
    x, y, z = wo / np.abs(wo).sum(axis=0)
    fold_x = (1 - np.abs(y)) * np.where(x >= 0, 1, -1)
    fold_y = (1 - np.abs(x)) * np.where(y >= 0, 1, -1)
    return (np.where(z < 0, [fold_x, fold_y], [x, y]) + 1) / 2


@pytest.mark.parametrize("side", [0, 1, 4, 16])
def test_parts_of_directions_are_those_of_a_model_and_keys_tell_them_apart(lane_device, side):
    rng = np.random.default_rng(7)
    wo = rng.normal(size=(3, 4096))
    wo = (wo / np.linalg.norm(wo, axis=0)).astype(np.float32)
    # 0 moves directions by half a part down, nothing else.
    random = np.zeros(4096, np.uint32)
    tagged, keys = planes.run(
        lane_device,
        "cells_test.cl",
        "tag_directions",
        {"wo": wo, "random": random},
        {"tagged": (np.uint32, 1), "keys": (np.uint32, 1)},
        side=side,
    )
    parts = np.stack([tagged & 15, tagged >> 16 & 15])
    exact = np.clip(octahedron(wo.astype(np.float64)) * side - 0.5, 0, max(side - 1, 0))
    low, high = np.floor(np.clip(exact + np.array([[[-1e-3]], [[1e-3]]]), 0, max(side - 1, 0)))
    assert ((parts == low) | (parts == high)).all()
    assert len(np.unique(keys)) == len(np.unique(parts, axis=1).T) == max(side, 1) ** 2
    assert (keys != 0).all()
    # The normal keeps all but the bits of the parts.
    assert len(np.unique(tagged & ~np.uint32(0x000F000F))) == 1


def test_layers_that_nothing_asks_for_are_left_out_and_the_plan_says_why():
    glossy, matt = room(COATED), room(lambertian(0.5))
    for scene, settings, why in (
        (glossy, Settings(**{**LAYERS, "cell_layers": False}), "cell_layers is false"),
        (glossy, Settings(cell_layers=True), "path_filter is off"),
        (matt, Settings(**LAYERS), "every material is matt"),
    ):
        assert why in dict(make_plan(scene, settings).left_out)["cell_layers"]
    assert make_plan(glossy, Settings(**LAYERS)).features["CELL_LAYERS"].value == 1


@pytest.mark.parametrize("direct", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_samples_with_cells_of_their_own_give_the_image_of_plain_path_tracing(device, direct):
    scene = room(COATED, METAL)
    expected = render(device, scene, 8).rgb
    ways = {**PARTED, "filter_direct": direct, "cell_jitter": False, "cell_shrink": False}
    opened = renderer(device, scene, **ways, cell_size=1.0)
    identity = layout.CONSTANT["CELL_IDENTITY"]
    image = image_of(patched(opened, cell_flags=identity), 8)
    np.testing.assert_allclose(image.rgb, expected, rtol=1e-4, atol=1e-5)
    assert image.stats["cells"]["rejected_cells"] == 0


def test_metal_is_shared_by_direction_and_only_with_layers(device):
    """One place for all: a cell of metal for every part of directions, none of diffuse light."""
    scene = build([floor(50.0, METAL)], camera((0, 2, 0.001), (0, 0, 0), 60), environment=1.0)
    stored = {}
    for name, ways in (("none", {"cell_layers": False}), ("one", LAYERS), ("parts", PARTED)):
        settings = {**FILTER, "filter_vertex": "1", **ways, "roulette_depth": 64}
        opened = patched(
            renderer(device, scene, **settings), cell_width=1e30, cell_alpha=0.0, cell_flags=0
        )
        stored[name] = image_of(opened, 4).stats["cells"]["cells_per_pass"]
    assert stored["none"] == 0
    # Beyond the floor is the sky: with that light from afar, in one level.
    assert stored["one"] == 1
    assert 4 <= stored["parts"] <= 16


def test_a_path_that_goes_on_by_a_coat_shares_at_a_later_vertex(device):
    """Its light is none of the first base's: both are shared, and the sum stays the same."""
    scene = room(COATED)
    truth = render(device, scene, 512, seed=3).rgb
    ways = {**LAYERS, "cell_layers": False, "cell_size": 4.0}
    image = render(device, scene, 64, **ways).rgb
    assert image.mean() == pytest.approx(truth.mean(), rel=0.02)


def test_a_cell_is_narrow_beside_reflections_that_are_shared():
    scene = build([floor(1.0, COATED)], camera((0, 1, 3), (0, 0, 0), 60), (512, 512))
    told = parameters(scene, Settings(cell_size=24.0), 512 * 512)
    # One and a half of the angle of a cell: 24 pixels of 60 degrees in 512.
    assert told["cell_alpha"] ** 0.5 == pytest.approx(0.285, abs=1e-3)
    wide = build([floor(1.0, COATED)], camera((0, 1, 3), (0, 0, 0), 60), (512, 256))
    assert parameters(wide, Settings(), 1)["cell_alpha"] == pytest.approx(
        2 * parameters(scene, Settings(), 1)["cell_alpha"]
    )


def test_matt_surfaces_have_no_parts_of_directions(device):
    """One cell for all of a matt floor, whatever is told apart of the metal beside it."""
    parts = [(floor(50.0, lambertian(0.5)))]
    far = transform.translation((0, -900.0, 0))
    scene = build(
        [*parts, (primitives.quad(), far, METAL)],
        camera((0, 2, 0.001), (0, 0, 0), 60),
        environment=1.0,
    )
    opened = renderer(device, scene, **{**PARTED, "cell_jitter": False})
    opened = patched(opened, cell_width=1e30, cell_alpha=0.01, cell_flags=0)
    assert image_of(opened, 4).stats["cells"]["cells_per_pass"] == 1


def test_kinds_of_surfaces_have_cells_of_their_own(lane_device):
    alpha = np.exp2(np.linspace(-9, 0, 256, dtype=np.float32))
    metal = (np.arange(256) % 2).astype(np.float32)
    keys = planes.run(
        lane_device,
        "cells_test.cl",
        "tag_gloss",
        {"alpha": alpha, "metal": metal},
        {"keys": (np.uint32, 1)},
    )[0]
    kinds = np.clip(np.floor(np.log2(alpha)) + 8, 0, 7) + 8 * metal
    assert len(np.unique(kinds)) == 16
    both = np.unique(np.stack([kinds, keys]), axis=1)
    assert both.shape[1] == len(np.unique(keys)) == 16


def error_of(device, scene, truth, **settings):
    """Return the relative squared error of a picture of 4 samples, a mean over two seeds."""
    floor = 1e-2 * truth.mean() ** 2
    images = (render(device, scene, 4, **LAYERS | settings, seed=seed).rgb for seed in (5, 6))
    return np.mean([((image - truth) ** 2 / (truth**2 + floor)).mean() for image in images])


@pytest.mark.slow
@pytest.mark.parametrize("material", [replace(COATED, base_color=(0.03, 0.05, 0.06)), METAL])
def test_sharing_what_is_glossy_takes_noise_away(device, material):
    """A lamp that is found by chance alone: nearly all noise is in what the cells may share."""
    scene = room(replace(material, roughness=0.7), size=(96, 64))
    truth = render(device, scene, 2048, seed=9).rgb
    ways = {"filter_direct": True, "direct_sampling": "bsdf", "cell_size": 8.0}
    error = error_of(device, scene, truth, **ways)
    assert error < 0.7 * error_of(device, scene, truth, **ways, cell_layers=False)


def test_reflections_that_are_sharper_than_a_cell_stay_with_their_pixels(device):
    scene = room(COATED)
    ways = {**LAYERS, "filter_restore": False, "cell_jitter": False}
    images = [
        image_of(patched(renderer(device, scene, **ways), cell_alpha=least), 2).rgb
        for least in (0.0, 0.36, 0.37, 1.0)
    ]
    # The GGX alpha of COATED is 0.36.
    assert images[0].tobytes() == images[1].tobytes() != images[2].tobytes()
    assert images[2].tobytes() == images[3].tobytes()


@pytest.mark.parametrize("layers", [False, True])
def test_the_screen_filter_gets_what_bases_reflect_of_shared_light(device, layers):
    """Nothing is lost between what bases reflect, which is averaged, and the rest."""
    scene = room(COATED, METAL)
    ways = {**LAYERS, "cell_layers": layers, "filter_restore": False, "cell_size": 4.0}
    plain = render(device, scene, 16, **ways).rgb
    ways |= {"screen_filter": "path_space"}
    filtered = render(device, scene, 16, **ways).rgb
    assert filtered.mean() == pytest.approx(plain.mean(), rel=0.02)
    # Averaged over nothing but themselves, both parts are together what pixels were.
    alone = render(device, scene, 16, **ways, screen_radius=0.0).rgb
    np.testing.assert_allclose(alone, plain, rtol=1e-5, atol=1e-6)


def test_same_bits_for_any_pool(device):
    scene = room(COATED, METAL, size=(24, 16))
    truth = render(device, scene, 6, **PARTED).rgb
    assert not np.array_equal(truth, render(device, scene, 6, **LAYERS).rgb)
    for slots in (128, 1024):
        small = open_device(traits=replace(device.traits, slots=slots))
        assert render(small, scene, 6, **PARTED).rgb.tobytes() == truth.tobytes()
