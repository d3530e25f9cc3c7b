"""Photons: what becomes of them, and images that do not depend on them."""

import itertools
import re
from pathlib import Path

import numpy as np
import planes
import pytest
from scene_builder import build, camera, floor, glowing, inside_out, lambertian, render, z_scores
from scene_builder import renderer as open_renderer
from scipy import stats
from test_light_tree import check_against_table, many_kinds

from psf_cl.device import layout
from psf_cl.errors import InputError
from psf_cl.features import MANY_LIGHTS
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Light, Mesh
from psf_cl.settings import AOVS, Settings
from psf_cl.stages.photons import FEWEST, FEWEST_MORE, MOST, VIEWS, photons_for

SCENES = Path(__file__).resolve().parents[1] / "scenes"
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


@pytest.mark.parametrize(
    ("settings", "paths", "rays", "photons"),
    [
        ({"photons": 7}, 10**6, {"camera": 100, "bounce": 300}, 7),
        # Two rays to expect of each path, 2.3 in truth; before the first are known, ten.
        ({"photon_share": 0.5}, 10**6, {"camera": 100, "bounce": 30, "shadow": 100}, 10**6),
        ({}, 10**6, {"camera": 0, "bounce": 0, "shadow": 0}, 250_000),
        ({}, 100, {"camera": 100, "bounce": 100}, FEWEST),
        ({"photon_share": 1.0}, 1 << 24, {"camera": 100, "bounce": 100}, MOST),
    ],
)
def test_photons_are_as_many_as_was_said_or_a_share_of_the_rays(settings, paths, rays, photons):
    assert photons_for(Settings(**settings), paths, rays) == photons


@pytest.mark.parametrize("name", ["many_lights", "moving/light_off"])
def test_photons_stay_from_frame_to_frame_where_nothing_moves_but_the_camera(device, name):
    scene = load_scene(SCENES / f"{name}.toml", moving=True, size=(12, 9))
    opened = Renderer(scene, Settings(light_sampling="photon"), device)
    drawn = []
    for frame in range(3):
        if frame:
            opened.set_frame(frame / 24)
        opened.render(spp=1)
        drawn.append(opened.photon_map.drawn())
    opened.close()
    if name == "many_lights":
        assert drawn == [FEWEST, FEWEST + FEWEST_MORE, FEWEST + 2 * FEWEST_MORE]
    else:
        assert drawn == [FEWEST] * 3


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


def lamps_over_a_floor():
    """Return a floor under three lamps without extent, of powers 1, 2 and 5."""
    lights = [
        Light("point", (power,) * 3, position=(x, 1.0, 0.0))
        for x, power in ((-0.5, 1.0), (0.0, 2.0), (0.5, 5.0))
    ]
    view = camera((0, 3, 0.01), (0, 0, 0), 12)
    return build([floor(0.2, lambertian(0.5))], view, (8, 8), lights=lights)


def test_images_of_the_choice_show_what_a_cell_knows(device):
    """All of the floor is one cell: every photon that hit it came there, from three groups."""
    common = {"light_sampling": "photon", "photons": 4096, "photon_cell": 1.0, "max_depth": 1}
    asked = ["photons", "lights", "light_pmf", "samples", "depth"]
    opened = open_renderer(device, lamps_over_a_floor(), outputs=asked, **common)
    opened.render(spp=1)
    image = opened.image()
    stored = opened.photon_map.counts()["stored"]
    opened.close()
    hit = image.aovs["depth"] > 0.0
    asked_it = image.aovs["photons"] > 0.0
    # Points are moved before they ask, some of them out of the cell.
    assert 0.5 * hit.sum() < asked_it.sum() <= hit.sum() < hit.size and 0 < stored < 4096
    np.testing.assert_array_equal(image.aovs["photons"], np.where(asked_it, stored, 0.0))
    np.testing.assert_array_equal(image.aovs["lights"], np.where(asked_it, 3.0, 0.0))
    assert not asked_it[~hit].any() and set(image.aovs) == {"rgb", *asked}


def test_image_of_chances_is_their_mean_over_what_was_drawn(device):
    """A table draws a light with chance p as often as p says: the mean is the sum of squares."""
    asked = ["light_pmf", "depth"]
    common = {"sampler": "random", "max_depth": 1, "outputs": asked}
    image = render(device, lamps_over_a_floor(), 256, light_sampling="power", **common)
    hit = image.aovs["depth"] > 0.0
    chances = np.array([1.0, 2.0, 5.0]) / 8.0
    error = np.sqrt((chances**3).sum() - (chances**2).sum() ** 2)
    seen = image.aovs["light_pmf"][hit]
    error *= 4 / np.sqrt(256 * len(seen))
    assert seen.mean() == pytest.approx((chances**2).sum(), abs=error)
    assert np.all(image.aovs["light_pmf"][~hit] == 0.0)


@pytest.mark.parametrize(
    ("names", "settings", "error"),
    [
        ("lights", {}, "--aov: lights needs light_sampling=photon; light_sampling is auto"),
        ("photons", {"light_sampling": "hierarchy"}, "--aov: photons needs light_sampling=photon;"),
        ("light_pmf", {"max_depth": 0}, "--aov: light_pmf needs a light to choose; max_depth"),
    ],
)
def test_images_of_choices_that_are_not_made_are_refused(names, settings, error):
    with pytest.raises(InputError, match=re.escape(error)):
        make_plan(lamps_over_a_floor(), Settings(**settings), [names])


def test_images_of_choices_cost_nothing_where_nobody_asks():
    def kept(outputs, **values):
        plan = make_plan(lamps_over_a_floor(), Settings(**values), outputs)
        buffers = {buffer.name for buffer in plan.buffers} & {"choices", "film_choices"}
        return plan.features["AOV_LIGHTS"].value, buffers, plan.outputs & set(VIEWS)

    both = {"choices", "film_choices"}
    assert kept(["albedo"], light_sampling="photon") == (0, set(), set())
    assert kept(["light_pmf"]) == (1, both, set())
    assert kept(["lights"], light_sampling="photon") == (2, both, {"lights"})
    # Of all that there are, those are made that this render has.
    assert kept(AOVS) == (1, both, set())
    assert kept(AOVS, max_depth=0) == (0, set(), set())


@pytest.mark.parametrize(
    ("sampling", "rays", "direct"),
    [
        ("photon", "auto", "mis"),
        pytest.param("photon", "1", "mis", marks=pytest.mark.slow),
        pytest.param("photon", "1", "light", marks=pytest.mark.slow),
        pytest.param("photon", "3", "mis", marks=pytest.mark.slow),
        pytest.param("hierarchy", "3", "mis", marks=pytest.mark.slow),
        pytest.param("power", "8", "light", marks=pytest.mark.slow),
    ],
)
def test_image_is_the_same_as_with_one_ray_and_a_table(device, sampling, rays, direct):
    guided, _ = check_against_table(device, sampling, direct, shadow_rays=rays)
    if sampling == "photon":
        counts = guided.stats["photons"]
        assert counts["emitted"] == counts["stored"] + counts["escaped"] > 0
        assert counts["escaped"] > 0  # The sky's photons go past the floor, too.


def test_rays_are_as_many_as_were_asked_for(device):
    """Three lamps and four rays: each cell knows three groups of lights."""
    common = {"max_depth": 1, "photon_cell": 1.0}

    def shadow_rays(**values):
        return render(device, lamps_over_a_floor(), 4, **common, **values).stats["rays"]["shadow"]

    one = shadow_rays(light_sampling="power", shadow_rays="1")
    assert 0 < one <= 4 * 64
    assert shadow_rays(light_sampling="power", shadow_rays="5") == 5 * one
    assert shadow_rays(light_sampling="power", shadow_rays="auto") == one
    assert shadow_rays(light_sampling="photon", shadow_rays="auto") == 3 * one


def shadow_of_a_square(device, way, spp, size=1.0, **settings):
    """Return a floor under two square lamps, half hidden from it, by direct light alone."""
    down = inside_out(primitives.quad())

    def at(x, y, z, half):
        return transform.translation((x, y, z)) @ transform.scaling(half)

    parts = [
        floor(1.0, lambertian(0.5)),
        (down, at(0.4, 1.5, 0.0, 0.25 * size), glowing(4.0 / size**2)),
        (down, at(-0.6, 1.0, 0.3, 0.2 * size), glowing(2.0 / size**2)),
        (primitives.box(), at(0.0, 0.5, 0.0, 0.1), lambertian(0.5)),
    ]
    scene = build(parts, camera((0, 4, 0.01), (0, 0, 0), 26), (16, 16))
    values = {"sampler": "random", "max_depth": 1, "outputs": ["variance"]} | settings
    return render(device, scene, spp, light_sampling=way, **values)


def test_rays_to_where_photons_started_are_wrong_in_soft_shadows_alone(device):
    """To lamps as small as points there is one place to go to; large ones are seen in part."""
    exact = {"direct_sampling": "light"}
    for size, agree in ((0.002, True), (1.0, False)):
        truth = shadow_of_a_square(device, "power", 256, size, direct_sampling="light")
        image = shadow_of_a_square(device, "photon_origin", 256, size, seed=1, **exact)
        z = z_scores(image, truth, 4)
        assert (np.abs(z).max() < 4.5) == agree
        # Its bias: points that photons came from are those that are seen.
        assert image.rgb.mean() == pytest.approx(truth.rgb.mean(), rel=0.01 if agree else 0.1)


def test_rays_to_where_photons_started_share_their_light_with_rays_that_find_it(device):
    """Weights of both ways sum to 1: without a photon the picture is that of fresh points."""
    image = shadow_of_a_square(device, "photon_origin", 256, photons=1, photon_floor=1.0)
    truth = shadow_of_a_square(device, "power", 256, seed=1)
    assert np.abs(z_scores(image, truth, 4)).max() < 4.0


def test_what_rays_to_where_photons_started_do_not_go_with_is_refused():
    both = Settings(light_sampling="photon_origin", area_sampling="solid_angle")
    with pytest.raises(InputError, match="goes with any area_sampling but solid_angle"):
        make_plan(many_kinds(), both)
    chains = Settings(light_sampling="photon_origin", integrator="metropolis")
    with pytest.raises(InputError, match="any light_sampling but photon_origin"):
        make_plan(many_kinds(), chains)


def test_chains_have_one_ray_at_a_vertex():
    with pytest.raises(InputError, match="integrator=metropolis needs shadow_rays=1; got 2"):
        make_plan(many_kinds(), Settings(integrator="metropolis", shadow_rays="2"))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "spp"), [("many_lights", 512), ("cornell_box", 256)])
def test_all_choices_of_lights_agree_on_the_projects_scenes(device, name, spp):
    scene = load_scene(SCENES / f"{name}.toml", size=(32, 32))
    settings = dict(scene.render) | {"sampler": "random", "outputs": ["variance"]}
    settings.pop("preset", None)
    images = [
        render(device, scene, spp, light_sampling=way, seed=seed, **settings)
        for seed, way in enumerate(("uniform", "power", "hierarchy", "photon"))
    ]
    for one, other in itertools.combinations(images, 2):
        z = z_scores(one, other, 4)
        # 16 blocks of six pairs: the largest of 96 standard normals is beyond 4.5 once in 1,500.
        assert np.abs(z).max() < 4.5
        assert stats.chi2.sf((z**2).sum(), z.size) > 1e-4


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
    tree = ("light_pairs", "light_places", "light_clusters", "light_groups")
    names = ("params", "lights", *tree, "particle_table")
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


def test_what_a_lane_draws_does_not_hang_on_its_neighbours(device):
    """Of 8,192 lights, for a quarter of a million numbers: some draws are close calls."""
    axis = np.linspace(-1.0, 1.0, 65, dtype=np.float32)
    corners = np.stack(np.meshgrid(axis, [2.0], axis, indexing="ij"), axis=-1).reshape(-1, 3)
    at = (np.arange(64)[:, None] * 65 + np.arange(64)).reshape(-1, 1) + np.array([0, 1, 65, 66])
    triangles = np.concatenate([at[:, [0, 2, 1]], at[:, [1, 2, 3]]]).astype(np.uint32)
    lamps = Mesh("lamps", corners.astype(np.float32), triangles)
    parts = [(floor(3.0, lambertian(0.5))), (lamps, np.eye(4), glowing(1.0, double_sided=True))]
    lit = build(parts, camera((0, 1, 3), (0, 0, 0)), (4, 4))
    opened = open_renderer(device, lit, light_sampling="photon", photons=20000)
    opened.render(spp=1)
    tree = ("light_pairs", "light_places", "light_clusters", "light_groups")
    names = ("params", "lights", *tree, "particle_table")
    given = {name: opened.buffers[name] for name in names}
    defines = {name: feature.value for name, feature in opened.plan.features.items()}
    rng = np.random.default_rng(12)
    points = np.zeros((6, 1 << 18), np.float32)
    points[[0, 2]] = rng.uniform(-1.0, 1.0, (2, 1 << 18))
    points[[1, 4]] = [[1e-4], [1.0]]
    bits = rng.integers(0, 1 << 32, 1 << 18, dtype=np.uint32)

    def drawn(order):
        inputs = {"points": points[:, order], "bits": bits[order]}
        outputs = {"drawn": (np.uint32, 1), "chances": (np.float32, 1)}
        file = "light_choice_test.cl"
        return planes.run(device, file, "draw_lights", inputs, outputs, defines, **given)[0]

    # The smallest numbers ask for any light: in their order they are among themselves.
    order = np.argsort(bits)
    np.testing.assert_array_equal(drawn(order), drawn(slice(None))[order])
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


def test_one_lamp_of_many_triangles_is_no_reason_for_photons():
    ball = primitives.sphere(80, 40)
    assert len(ball.triangles) >= MANY_LIGHTS

    def sampling(*places):
        lamps = [
            (ball, transform.translation(place) @ transform.scaling(0.05), glowing(5.0))
            for place in places
        ]
        scene = build([floor(1.0, lambertian(0.5)), *lamps], camera((0, 1, 3), (0, 0, 0)))
        return make_plan(scene, Settings()).features["LIGHT_SAMPLING"].value

    assert sampling((0.0, 1.0, 0.0)) == 0
    # Two of them, one at each end of the floor, are near and far.
    assert sampling((-0.9, 1.0, 0.0), (0.9, 1.0, 0.0)) == 2


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
