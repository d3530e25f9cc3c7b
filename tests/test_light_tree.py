"""The tree of lights: chances, whom it can find, and the same images as other choices."""

import numpy as np
import planes
import pytest
from scene_builder import (
    LUMINANCE,
    build,
    camera,
    floor,
    glowing,
    inside_out,
    lambertian,
    render,
    z_scores,
)
from scipy import stats

from psf_cl.device import layout, light_tree
from psf_cl.device.layout import CONSTANT
from psf_cl.device.light_tree import LightTree
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light
from psf_cl.settings import Settings

FILE = "light_tree_test.cl"
KINDS = ("TRIANGLE", "POINT", "SPOT", "DIRECTIONAL", "ENVIRONMENT")
NEAR_SHARE = 0.6


def random_table(count, seed=1, kinds=KINDS):
    """Return a light table of all ``kinds``, powers over four decades, some facing two ways."""
    rng = np.random.default_rng(seed)
    table = np.zeros(count, layout.LIGHT.dtype)
    names = rng.choice(kinds, count)
    table["kind"] = [CONSTANT[f"LIGHT_{name}"] for name in names]
    table["position"] = rng.uniform(-3, 3, (count, 3))
    table["e1"], table["e2"] = rng.normal(0, 0.2, (2, count, 3))
    normal = np.cross(table["e1"], table["e2"])
    table["direction"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    two_sided = CONSTANT["MATERIAL_TWO_SIDED_EMISSION"]
    table["flags"] = np.where(rng.random(count) < 0.3, two_sided, 0)
    table["cos_outer"] = np.cos(rng.uniform(0.1, 1.2, count))
    table["power"] = 10.0 ** rng.uniform(-2, 2, count)
    return table


class Planted:
    """A tree of lights on a device."""

    def __init__(self, device, table, radius=5.0):
        self.device, self.count = device, len(table)
        self.lights = device.upload("lights", table)
        self.tree = LightTree(device, table, self.lights, NEAR_SHARE, radius)
        names = ("light_pairs", "light_places", "light_clusters")
        self.given = {name: self.tree.buffers[name] for name in names}

    def draw(self, points, bits):
        inputs = {"points": points, "bits": bits}
        outputs = {"drawn": (np.uint32, 1), "pmfs": (np.float32, 1), "chances": (np.float32, 1)}
        return self.run("draw_lights", inputs, outputs)

    def chances(self, points):
        """Return the chance of every light at points ``(6, n)``: ``(n, lights)`` float64."""
        n = points.shape[1]
        inputs = {
            "points": np.repeat(points, self.count, axis=1),
            "light": np.tile(np.arange(self.count, dtype=np.uint32), n),
        }
        (found,) = self.run("list_chances", inputs, {"chances": (np.float32, 1)})
        return found.reshape(n, self.count).astype(np.float64)

    def run(self, kernel, inputs, outputs):
        given = self.given | {"light_count": self.count}
        defines = {"LIGHT_SAMPLING": 1, "TRANSMISSION": 0}
        return planes.run(self.device, FILE, kernel, inputs, outputs, defines, **given)

    def release(self):
        self.device.release(self.lights, *self.tree.buffers.values())


@pytest.fixture
def plant(lane_device):
    made = []

    def build_tree(table, **options):
        made.append(Planted(lane_device, table, **options))
        return made[-1]

    yield build_tree
    for item in made:
        item.release()


def random_points(count, seed=2):
    """Return positions and unit normals, ``(6, count)`` float32; some on the lights' planes."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(3, count))
    normal /= np.linalg.norm(normal, axis=0)
    return np.concatenate([rng.uniform(-4, 4, (3, count)), normal]).astype(np.float32)


def reaches(table, points):
    """Return which lights can bring light to the points, ``(n, lights)`` bool: by their corners."""
    p, n = points[:3].T[:, None].astype(np.float64), points[3:].T[:, None].astype(np.float64)
    far = np.isin(table["kind"], [CONSTANT["LIGHT_ENVIRONMENT"], CONSTANT["LIGHT_DIRECTIONAL"]])
    triangle = table["kind"] == CONSTANT["LIGHT_TRIANGLE"]
    spot = table["kind"] == CONSTANT["LIGHT_SPOT"]
    both = (table["flags"] & CONSTANT["MATERIAL_TWO_SIDED_EMISSION"]) != 0
    found = np.zeros((points.shape[1], len(table)), bool)
    for corner in (0.0, table["e1"], table["e2"]):
        toward = table["position"] + np.where(triangle[:, None], corner, 0.0) - p
        toward /= np.linalg.norm(toward, axis=2, keepdims=True)
        leaves = -(toward * table["direction"]).sum(axis=2)
        shines = ~triangle & ~spot | triangle & (both | (leaves > 0))
        shines |= spot & (leaves > table["cos_outer"])
        found |= shines & ((toward * n).sum(axis=2) > 0)
    return found | far


@pytest.mark.parametrize("count", [1, 2, 3, 200])
def test_chances_of_all_lights_sum_to_one(plant, count):
    table = random_table(count)
    planted = plant(table)
    points = random_points(1000 if count < 200 else 100)
    chances = planted.chances(points)
    np.testing.assert_allclose(chances.sum(axis=1), 1.0, atol=2e-5)


def test_lights_are_drawn_as_often_as_their_chances_say(plant):
    table = random_table(40)
    planted = plant(table)
    rng = np.random.default_rng(5)
    for column in range(3):
        point = random_points(3)[:, column : column + 1]
        truth = planted.chances(point)[0]
        draws = 1 << 18
        bits = rng.integers(0, 1 << 32, draws, dtype=np.uint32)
        drawn, pmf, chance = planted.draw(np.repeat(point, draws, axis=1), bits)
        np.testing.assert_allclose(pmf, truth[drawn], rtol=2e-5)
        np.testing.assert_allclose(chance, pmf, rtol=2e-5)
        count = np.bincount(drawn, minlength=len(table))
        often = truth * draws > 20
        rest = draws * (1 - truth[often].sum())
        expected = np.append(truth[often] * draws, max(rest, 1e-9))
        seen = np.append(count[often], count[~often].sum())
        if rest < 5:
            expected, seen = expected[:-1] / expected[:-1].sum() * seen[:-1].sum(), seen[:-1]
        assert stats.chisquare(seen, expected * (seen.sum() / expected.sum())).pvalue > 1e-4


def test_no_light_that_reaches_a_point_is_left_out(plant):
    table = random_table(200, seed=3)
    # One is a million times as bright as all others together, and one hides among equals.
    table["power"][17] = 1e10
    planted = plant(table)
    points = random_points(300, seed=4)
    chances = planted.chances(points)
    found = reaches(table, points)
    assert 0.2 < found.mean() < 0.9
    assert chances[found].min() > 1e-30
    assert np.median(chances[~found]) < 1e-4


def test_near_bright_and_facing_lights_are_preferred(plant):
    table = random_table(3, kinds=("POINT",))
    table["position"] = [[0, 1, 0], [0, 2, 0], [0, -1, 0]]
    table["power"] = 1.0
    planted = plant(table)
    chances = planted.chances(np.array([[0, 0, 0, 0, 1, 0]], np.float32).T)[0]
    # One over the square of the distance; the third is below the horizon.
    np.testing.assert_allclose(chances[:2], [0.8, 0.2], atol=0.15)
    assert chances[2] < 0.01


def test_lights_infinitely_far_have_the_share_of_the_table(plant):
    table = random_table(50, seed=6)
    far = np.isin(table["kind"], [CONSTANT["LIGHT_ENVIRONMENT"], CONSTANT["LIGHT_DIRECTIONAL"]])
    assert 3 < far.sum() < 47
    chances = plant(table).chances(random_points(20))
    np.testing.assert_allclose(chances[:, far].sum(axis=1), 1 - NEAR_SHARE, atol=1e-5)
    only_far = table[far]
    chances = plant(only_far).chances(random_points(20))
    power = only_far["power"] / only_far["power"].sum()
    # Each node keeps a thousandth for its darker half.
    np.testing.assert_allclose(chances, np.broadcast_to(power, chances.shape), atol=5e-3)


def test_refitted_tree_finds_lights_where_they_have_moved_to(plant):
    table = random_table(100, seed=7)
    planted = plant(table)
    moved = random_table(100, seed=8)
    moved["kind"] = table["kind"]
    planted.device.write(planted.lights, moved)
    planted.tree.fit(moved)
    points = random_points(200, seed=9)
    chances = planted.chances(points)
    assert chances[reaches(moved, points)].min() > 1e-30
    old = plant(table).chances(points)
    assert (old[reaches(moved, points)] == 0.0).any()  # A tree that was not would miss some.


def test_light_that_is_not_finite_is_never_drawn(plant):
    table = random_table(10, kinds=("POINT",))
    table["position"][4] = np.nan
    chances = plant(table).chances(random_points(50))
    assert np.all(chances[:, 4] == 0.0)
    np.testing.assert_allclose(chances.sum(axis=1), 1.0, atol=2e-5)


@pytest.fixture
def bunches(plant, monkeypatch):
    """Return a tree of eight bunches of tiny lights that are clusters, their table and bunches."""
    monkeypatch.setattr(light_tree, "MOST_IN_CLUSTER", 12)
    monkeypatch.setattr(light_tree, "FEWEST_CLUSTERED", 2)
    table = random_table(80, seed=11, kinds=("TRIANGLE",))
    bunch = np.arange(80) % 8
    table["flags"] = 0
    table["e1"], table["e2"] = [0.01, 0, 0], [0, 0, 0.01]
    table["direction"] = [0, -1, 0]
    table["position"] *= 0.01
    table["position"] += 3.0 * np.array([[1, 1, 1], [-1, 1, 1], [1, 1, -1], [-1, 1, -1]])[bunch % 4]
    table["position"][bunch >= 4, 1] += 9.0
    table["power"][3] = 0.0
    table["power"][11] = 1e9
    return plant(table), table, bunch


def test_clusters_that_are_far_away_draw_by_power(bunches):
    planted, table, bunch = bunches
    chances = planted.chances(np.array([[0.3, -1.0, 0.2, 0, 1, 0]], np.float32).T)[0]
    for k in range(8):
        power = np.where(bunch == k, table["power"], 0.0).astype(np.float64)
        # All that shine have a 64th of the cluster alike.
        shines = power > 0
        truth = 63 / 64 * power / power.sum() + shines / shines.sum() / 64
        own = chances[bunch == k]
        np.testing.assert_allclose(own / own.sum(), truth[bunch == k], rtol=1e-4, atol=1e-7)
    assert chances.sum() == pytest.approx(1.0, abs=2e-5)


def test_clusters_draw_lights_as_often_as_their_chances_say_near_and_far(bunches):
    planted, _, _ = bunches
    rng = np.random.default_rng(5)
    draws = 1 << 18
    bits = rng.integers(0, 1 << 32, draws, dtype=np.uint32)
    for place in ([0.3, -1.0, 0.2], [3.0, 2.95, 3.0]):
        point = np.array([[*place, 0, 1, 0]], np.float32).T
        truth = planted.chances(point)[0]
        drawn, pmf, chance = planted.draw(np.repeat(point, draws, axis=1), bits)
        np.testing.assert_allclose(pmf, truth[drawn], rtol=2e-5)
        np.testing.assert_allclose(chance, pmf, rtol=2e-5)
        often = truth * draws > 20
        seen = np.bincount(drawn, minlength=80)[often]
        expected = truth[often] * (seen.sum() / truth[often].sum())
        assert often.sum() >= 8
        assert stats.chisquare(seen, expected).pvalue > 1e-4


def many_kinds():
    """Return a scene with quads of both kinds, a sphere, a point light, a spot, a sun and a sky."""
    down = inside_out(primitives.quad())

    def at(x, y, z, size):
        return transform.translation((x, y, z)) @ transform.scaling(size)

    parts = [
        floor(30.0, lambertian(0.6)),
        (primitives.box(), at(0.0, 0.4, 0.3, 0.4), lambertian(0.5)),
        (down, at(-1.0, 1.5, 0.0, 0.3), glowing(20.0)),
        (down, at(1.2, 0.8, 0.5, 0.1), glowing((90.0, 60.0, 30.0))),
        (primitives.quad(), at(0.4, 1.1, -0.5, 0.2), glowing(5.0, double_sided=True)),
        (primitives.sphere(8, 6), at(1.5, 0.3, -1.0, 0.2), glowing(8.0)),
    ]
    lights = [
        Light("point", (2.0, 2.0, 2.0), position=(-1.5, 1.0, 1.0)),
        Light("spot", (9.0, 5.0, 5.0), position=(0.0, 2.0, 1.5), direction=(0.0, -1.0, 0.0)),
        Light("directional", (1.0, 1.0, 0.5), direction=(0.6, -0.8, 0.0)),
    ]
    view = camera((0, 4, 4), (0, 0.3, 0), 40)
    return build(parts, view, (16, 16), lights=lights, environment=0.3)


def check_against_table(device, way, sampling, **settings):
    """Compare a choice of lights with that by power; return both images of ``many_kinds``.

    Args:
        settings: of the first image alone.
    """
    common = {"sampler": "random", "max_depth": 3, "direct_sampling": sampling}
    common["outputs"] = ["variance"]
    image = render(device, many_kinds(), 256, light_sampling=way, **common, **settings)
    table = render(device, many_kinds(), 1024, light_sampling="power", seed=1, **common)
    z = z_scores(image, table, 4)
    assert np.abs(z).max() < 4.0
    assert stats.chi2.sf((z**2).sum(), z.size) > 1e-4
    return image, table


@pytest.mark.parametrize("sampling", ["mis", pytest.param("light", marks=pytest.mark.slow)])
def test_image_is_the_same_as_with_a_table(device, sampling):
    tree, table = check_against_table(device, "hierarchy", sampling)
    noise = [np.mean(image.aovs["variance"]) * image.stats["spp"] for image in (tree, table)]
    assert noise[0] < noise[1]
    assert (tree.rgb @ LUMINANCE).mean() > 0.1


def test_one_light_needs_no_tree():
    scene = build(
        [floor(1.0, lambertian(0.5))],
        camera((0, 1, 3), (0, 0, 0)),
        lights=[Light("point", (1.0, 1.0, 1.0), position=(0, 1, 0))],
    )
    plan = make_plan(scene, Settings(light_sampling="hierarchy"))
    assert plan.features["LIGHT_SAMPLING"].value == 0
    assert ("light_sampling", "there is one light: nothing to choose") in plan.left_out
    both = make_plan(many_kinds(), Settings(light_sampling="hierarchy"))
    names = {buffer.name for buffer in both.scene_buffers}
    assert both.features["LIGHT_SAMPLING"].value == 1 and "light_pairs" in names
    assert "light_pairs" not in {b.name for b in make_plan(many_kinds(), Settings()).buffers}
