"""Photons: what becomes of them, and images that do not depend on them."""

import numpy as np
import planes
import pytest
from scene_builder import build, camera, floor, glowing, inside_out, lambertian, render, z_scores
from scene_builder import renderer as open_renderer
from scipy import stats
from test_light_tree import check_against_table, many_kinds

from psf_cl.device import layout
from psf_cl.plan import MANY_LIGHTS, make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light
from psf_cl.settings import Settings

PLACES = layout.CONSTANT["PARTICLE_PLACES"]
SIZES = layout.CONSTANT["PARTICLE_SIZES"]


def read_map(opened):
    """Return keys, counts and words of the places, ``(cells, PLACES)`` each."""
    names = ("particle_keys", "particle_counts", "particle_words")
    return [opened.device.read(opened.buffers[name]).reshape(-1, PLACES) for name in names]


def closed_room():
    """Return a box with two lamps under its ceiling; the second has a quarter of the power."""
    down = inside_out(primitives.quad())

    def at(x, size):
        return transform.translation((x, 0.9, 0.0)) @ transform.scaling(size)

    parts = [
        (inside_out(primitives.box()), np.eye(4), lambertian(0.5)),
        (down, at(-0.5, 0.1), glowing(40.0)),
        (down, at(0.5, 0.1), glowing(10.0)),
    ]
    return build(parts, camera((0, 0, 0.9), (0, -0.3, 0), 70), (16, 16))


@pytest.fixture(scope="module")
def opened(device):
    made = open_renderer(device, closed_room(), light_sampling="photon", photons=70000)
    made.render(spp=1)
    yield made
    made.close()


def test_every_photon_is_accounted_for(opened):
    counts = opened.photon_map.counts()
    # One epoch of a pass: 70,000 were drawn, and from a closed room none escapes.
    assert counts["emitted"] == counts["stored"] == 70000
    assert counts["escaped"] == counts["dark"] == counts["rejected"] == 0
    keys, stored, _ = read_map(opened)
    assert stored.sum() == SIZES * 70000
    np.testing.assert_array_equal(stored > 0, keys < 0xFFFFFFFF)
    # Keys tell photons apart: one that came alone is in one cell of each size at most.
    alone = keys[stored == 1]
    assert np.unique(alone, return_counts=True)[1].max() <= SIZES


def test_photons_are_shared_out_by_the_power_of_the_lamps(opened):
    _, counts, words = read_map(opened)
    bits = int(opened.params[0]["node_bits"])
    node = words & np.uint32((1 << bits) - 1)
    groups = opened.device.read(opened.buffers["light_groups"])["node"]
    assert len(np.unique(groups)) == 4  # Two lamps of two triangles each.
    first = counts[(counts > 0) & np.isin(node, groups[:2])].sum()
    # Sobol' points alone are far closer: where two share a place, one stands for both.
    assert first / counts.sum() == pytest.approx(0.8, abs=0.01)


def test_the_same_photons_leave_the_same_map_and_the_same_image(device, opened):
    again = open_renderer(device, closed_room(), light_sampling="photon", photons=70000)
    again.render(spp=1)
    for first, second in zip(read_map(opened), read_map(again), strict=True):
        np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(opened.image().rgb, again.image().rgb)
    again.close()


@pytest.mark.parametrize("sampling", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_image_is_the_same_as_with_a_table(device, sampling):
    guided, _ = check_against_table(device, "photon", sampling)
    counts = guided.stats["photons"]
    assert counts["emitted"] == counts["stored"] + counts["escaped"] > 0
    assert counts["escaped"] > 0  # The sky's photons go past the floor, too.


@pytest.mark.slow
def test_light_that_no_photon_saw_is_still_found(device):
    # 20 of 70,000 photons: hardly a cell has both lamps, and most cells have none.
    common = {"sampler": "random", "direct_sampling": "light", "outputs": ["variance"]}
    guided = render(device, closed_room(), 4096, light_sampling="photon", photons=20, **common)
    table = render(device, closed_room(), 4096, light_sampling="power", seed=1, **common)
    z = z_scores(guided, table, 4)
    assert np.abs(z).max() < 4.0
    assert stats.chi2.sf((z**2).sum(), z.size) > 1e-4


def test_chances_of_all_lights_sum_to_one_in_a_thousand_cells(device):
    """And lights are drawn with the chances that a ray that finds them by chance is told of."""
    opened = open_renderer(device, many_kinds(), light_sampling="photon", photons=3000)
    opened.render(spp=1)
    lights = len(opened.lights)
    rng = np.random.default_rng(11)
    normal = rng.normal(size=(3, 1000))
    normal[:, :700] = np.array([[0.0], [1.0], [0.0]])
    normal /= np.linalg.norm(normal, axis=0)
    points = np.concatenate([rng.uniform(-2, 2, (3, 1000)), normal]).astype(np.float32)
    points[1, :700] = 1e-4  # On the floor, where photons are.
    names = ("params", "lights", "light_pairs", "light_places", "light_groups", "particle_table")
    given = {name: opened.buffers[name] for name in names}
    defines = {name: feature.value for name, feature in opened.plan.features.items()}

    def run(kernel, inputs, outputs):
        file = "light_choice_test.cl"
        return planes.run(device, file, kernel, inputs, outputs, defines, **given)

    inputs = {
        "points": np.repeat(points, lights, axis=1),
        "light": np.tile(np.arange(lights, dtype=np.uint32), 1000),
    }
    outputs = {"chances": (np.float32, 1), "known": (np.uint32, 1)}
    chances, known = run("list_chances", inputs, outputs)
    chances = chances.reshape(1000, lights).astype(np.float64)
    assert 300 < known.reshape(1000, lights)[:, 0].sum() < 1000
    np.testing.assert_allclose(chances.sum(axis=1), 1.0, atol=2e-5)
    bits = rng.integers(0, 1 << 32, 1000, dtype=np.uint32)
    outputs = {"drawn": (np.uint32, 1), "chances": (np.float32, 1)}
    drawn, chance = run("draw_lights", {"points": points, "bits": bits}, outputs)
    np.testing.assert_allclose(chance, chances[np.arange(1000), drawn], rtol=2e-5)
    opened.close()


def test_many_lights_have_photons_unless_something_else_is_asked_for():
    def lit_by(count):
        lights = [Light("point", (1.0, 1.0, 1.0), position=(0, 1, 0.01 * k)) for k in range(count)]
        return build([floor(1.0, lambertian(0.5))], camera((0, 1, 3), (0, 0, 0)), lights=lights)

    def sampling(count, **values):
        return make_plan(lit_by(count), Settings(**values)).features["LIGHT_SAMPLING"].value

    assert sampling(2) == sampling(MANY_LIGHTS - 1) == 0
    assert sampling(MANY_LIGHTS) == 2
    assert sampling(MANY_LIGHTS, integrator="metropolis") == 1
    assert sampling(MANY_LIGHTS, light_sampling="power") == 0


def test_one_light_needs_no_photons():
    scene = build(
        [floor(1.0, lambertian(0.5))],
        camera((0, 1, 3), (0, 0, 0)),
        lights=[Light("point", (1.0, 1.0, 1.0), position=(0, 1, 0))],
    )
    alone = make_plan(scene, Settings(light_sampling="photon"))
    assert "photons" not in {stage.name for stage in alone.stages} and not alone.in_epochs
    both = make_plan(many_kinds(), Settings(light_sampling="photon"))
    assert "photons" in {stage.name for stage in both.stages} and both.in_epochs
    tree = make_plan(many_kinds(), Settings(light_sampling="hierarchy"))
    assert not tree.in_epochs and tree.total_bytes < both.total_bytes
