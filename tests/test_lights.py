"""Lights: the table, what is drawn from it, densities in both measures, and the sky."""

import math
from functools import cache

import numpy as np
import planes
import pytest
from scipy import stats

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.device.layout import CONSTANT
from psf_cl.scene.model import Environment, Light, Material, Mesh, Scene, Shape, Texture
from psf_cl.scene.transform import rotation_xyz_degrees

P_MIN = 1e-4
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class Lit:
    """A scene's light tables on a device."""

    def __init__(self, device, scene, sampling="power", scene_radius=10.0):
        self.device, self.scene = device, scene
        self.geometry = tables.flatten(scene)
        self.lights = tables.light_table(scene, self.geometry, sampling)
        sky = self.lights["kind"] == CONSTANT["LIGHT_ENVIRONMENT"]
        self.sky_pmf = self.lights["pmf"][sky].sum()
        image = scene.environment.image
        self.defines = {
            "AREA_LIGHTS": 1,
            "PUNCTUAL_LIGHTS": 1,
            "ENVIRONMENT": 1 if image is None else 2,
            "TEXTURES": int(bool(scene.textures)),
        }
        params = np.zeros(1, layout.PARAMS.dtype)
        row = params[0]
        row["seed"], row["sampler"] = 3, CONSTANT["SAMPLER_RANDOM"]
        row["light_count"] = len(self.lights)
        row["environment_light"] = tables.environment_light(self.lights)
        row["environment_radiance"] = scene.environment.radiance
        row["environment_rotation"] = np.asarray(scene.environment.rotation).T.ravel()
        row["scene_radius"] = scene_radius
        if image is not None:
            row["environment_height"], row["environment_width"] = image.shape[:2]
        surfaces = self.geometry.surfaces
        self.sky = {"params": device.upload("params", params)}
        if image is not None:
            self.sky["cells"] = device.upload("cells", tables.environment_cells(scene.environment))
        self.buffers = self.sky | {
            "lights": device.upload("lights", self.lights),
            "surfaces": device.upload(
                "surfaces", surfaces if len(surfaces) else np.zeros(1, layout.SURFACE.dtype)
            ),
            "materials": device.upload("materials", tables.material_table(scene.materials)),
        }
        if scene.textures:
            records, texels = tables.texture_tables(scene.textures)
            self.buffers |= {
                "uvs": device.upload("uvs", self.geometry.uvs),
                "textures": device.upload("textures", records),
                "texels": device.upload("texels", texels.reshape(-1)),
                "srgb_to_linear": device.upload("srgb_to_linear", tables.srgb_to_linear()),
            }

    def run(self, kernel, inputs, outputs, **buffers):
        return planes.run(
            self.device, "light_test.cl", kernel, inputs, outputs, self.defines, **buffers
        )

    def sample(self, origin, active=None):
        """Return toward, wi, radiance ``(n, 3)``, pdf and extended ``(n,)``."""
        count = len(origin)
        inputs = {
            "origin": np.ascontiguousarray(origin.T, np.float32),
            "active": np.ones(count, np.uint32) if active is None else active.astype(np.uint32),
            "pixel": np.arange(count, dtype=np.uint32) % 4096,
            "sample": np.arange(count, dtype=np.uint32) // 4096,
        }
        outputs = {name: (np.float32, 3) for name in ("toward", "wi", "radiance")}
        outputs |= {"pdfs": (np.float32, 1), "extended": (np.uint32, 1)}
        toward, wi, radiance, pdf, extended = self.run(
            "sample_lights", inputs, outputs, **self.buffers
        )
        return toward.T, wi.T, radiance.T, pdf, extended

    def density(self, light, distance, cosine):
        hits = np.stack([distance, cosine]).astype(np.float32)
        inputs = {"light": np.asarray(light, np.uint32), "hits": hits}
        outputs = {"pdfs": (np.float32, 1)}
        return self.run("list_densities", inputs, outputs, lights=self.buffers["lights"])[0]

    def look_up(self, directions):
        """Return radiance ``(n, 3)`` and density ``(n,)`` of directions ``(n, 3)``."""
        inputs = {"directions": np.ascontiguousarray(directions.T, np.float32)}
        outputs = {"radiance": (np.float32, 3), "pdfs": (np.float32, 1)}
        lights = self.buffers["lights"]
        radiance, pdf = self.run("look_up_sky", inputs, outputs, lights=lights, **self.sky)
        return radiance.T, pdf

    def release(self):
        self.device.release(*self.buffers.values())


@pytest.fixture
def lit(lane_device):
    made = []

    def build(scene, **options):
        made.append(Lit(lane_device, scene, **options))
        return made[-1]

    yield build
    for item in made:
        item.release()


def triangles_scene(corners, materials, of, **more):
    """Return a scene with one shape a triangle; ``of`` are their materials."""
    shapes = tuple(
        Shape(
            f"t{k}",
            Mesh("t", np.asarray(c, np.float32), np.array([[0, 1, 2]], np.uint32)),
            np.eye(4),
            material,
        )
        for k, (c, material) in enumerate(zip(corners, of, strict=True))
    )
    return Scene("test", materials=tuple(materials), shapes=shapes, **more)


CORNERS = np.array(
    [
        [[-1, 2, -1], [1, 2, -1], [0, 2, 1]],  # overhead, seen from its front below
        [[2, -1, -1], [2, -1, 1], [2.5, 1, 0]],
        [[-2, -1, -1], [-2, 1, 0.5], [-2.2, -1, 1]],
        [[-1, -1, -3], [1, -1, -3], [0, 1.5, -2.5]],
    ]
)
GLOW = [
    Material("weak", emission=(1.0, 2.0, 3.0)),
    Material("strong", emission=(50.0, 40.0, 30.0), double_sided=True),
    Material("both", emission=(4.0, 4.0, 4.0), double_sided=True),
]


def areas_and_normals(corners):
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(cross, axis=1)
    return length / 2, cross / length[:, None]


def sphere_directions(count):
    """Return directions that share the sphere evenly (a Fibonacci lattice), ``(count, 3)``."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    phi = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def intersect(corners, origin, direction):
    """Return distance and barycentrics of every ray with one triangle; inf for a miss."""
    e1, e2 = corners[1] - corners[0], corners[2] - corners[0]
    p = np.cross(direction, e2)
    det = p @ e1
    with np.errstate(all="ignore"):
        s = origin - corners[0]
        u = (p * s).sum(axis=-1) / det
        q = np.cross(s, e1)
        v = (direction * q).sum(axis=-1) / det
        t = (q @ e2) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.inf), u, v


def test_density_seen_by_rays_integrates_to_the_chance_of_the_light(lit):
    scene = triangles_scene(CORNERS, GLOW, [2, 1, 1, 2])
    table = lit(scene)
    _, normal = areas_and_normals(CORNERS)
    directions = sphere_directions(200_000)
    origin = np.array([0.1, 0.2, -0.3])
    for k in range(len(CORNERS)):
        t, _, _ = intersect(CORNERS[k], origin, directions)
        hit = np.isfinite(t)
        cosine = abs(directions[hit] @ normal[k])
        light = np.full(hit.sum(), scene_light(table, k))
        pdf = table.density(light, t[hit], cosine)
        integral = pdf.astype(np.float64).sum() * 4 * np.pi / len(directions)
        # Some ten thousand directions: their edge is what the sum does not know.
        np.testing.assert_allclose(integral, table.lights["pmf"][light[0]], rtol=5e-3)


def scene_light(table, triangle):
    return int(table.geometry.surfaces["light"][triangle])


def which_triangle(points):
    """Return the triangle nearest to each point, and its barycentrics."""
    _, normal = areas_and_normals(CORNERS)
    distance = abs(((points[:, None] - CORNERS[None, :, 0]) * normal).sum(axis=-1))
    u, v = np.empty((2, len(points), len(CORNERS)))
    for k, c in enumerate(CORNERS):
        e = np.stack([c[1] - c[0], c[2] - c[0]], axis=1)
        u[:, k], v[:, k] = np.linalg.pinv(e) @ (points - c[0]).T
    outside = np.maximum.reduce([-u, -v, u + v - 1])
    best = np.where(outside < 1e-4, distance, np.inf).argmin(axis=1)
    rows = np.arange(len(points))
    return best, u[rows, best], v[rows, best], distance[rows, best]


def test_area_lights_are_drawn_by_power_uniformly_with_the_density_that_rays_see(lit):
    of = [0, 1, 2, 2]
    scene = triangles_scene(CORNERS, GLOW, of)
    table = lit(scene)
    count = 1 << 16
    origin = np.tile([0.1, 0.2, -0.3], (count, 1)).astype(np.float32)
    toward, wi, radiance, pdf, extended = table.sample(origin)
    assert extended.all()
    np.testing.assert_allclose(
        wi, toward / np.linalg.norm(toward, axis=1, keepdims=True), atol=1e-6
    )
    area, normal = areas_and_normals(CORNERS)

    # Triangle 0 emits away from the origin or towards it: its front decides, by its winding.
    faces = (normal[0] @ (origin[0] - CORNERS[0, 0])) > 0
    on = pdf > 0
    chosen, u, v, distance = which_triangle((origin + toward)[on].astype(np.float64))
    assert distance.max() < 1e-5
    assert faces == (0 in chosen)
    pmf = table.lights["pmf"][table.geometry.surfaces["light"][: len(CORNERS)]].astype(np.float64)
    if not faces:
        np.testing.assert_allclose(1 - on.mean(), pmf[0], atol=5 / np.sqrt(count))
    lights = np.flatnonzero(np.bincount(chosen, minlength=len(CORNERS)))
    found = np.bincount(chosen, minlength=len(CORNERS))[lights]
    expected = pmf[lights] / pmf[lights].sum() * found.sum()
    assert stats.chisquare(found, expected).pvalue > P_MIN

    np.testing.assert_allclose(
        radiance[on], np.array([m.emission for m in GLOW])[np.array(of)[chosen]], rtol=1e-6
    )
    cosine = abs((wi[on].astype(np.float64) * normal[chosen]).sum(axis=1))
    t = np.linalg.norm(toward[on].astype(np.float64), axis=1)
    expected = pmf[chosen] * t**2 / (cosine * area[chosen])
    np.testing.assert_allclose(pdf[on], expected, rtol=2e-5)
    seen = table.density(table.geometry.surfaces["light"][chosen], t, cosine)
    np.testing.assert_allclose(pdf[on], seen, rtol=2e-5)

    for k in lights:
        # b2 / (b1 + b2) and (b1 + b2)^2 are uniform if the point is uniform on the triangle.
        s = (u + v)[chosen == k].clip(1e-9, 1)
        x, y = (v[chosen == k] / s).clip(0, 1 - 1e-9), (s**2).clip(0, 1 - 1e-9)
        cells = (x * 8).astype(int) * 8 + (y * 8).astype(int)
        if len(cells) > 2000:
            assert stats.chisquare(np.bincount(cells, minlength=64)).pvalue > P_MIN


def test_light_from_an_area_light_adds_up_to_its_irradiance(lit):
    """E[L cos / pdf] = sum over triangles of L times Lambert's polygon formula."""
    scene = triangles_scene(CORNERS, GLOW, [2, 1, 2, 1])
    table = lit(scene)
    count = 1 << 16
    point = np.array([0.1, 0.2, -0.3])
    _, wi, radiance, pdf, _ = table.sample(np.tile(point, (count, 1)))
    up = np.array([0.0, 0.0, -1.0])
    cosine = np.maximum(wi.astype(np.float64) @ up, 0)
    weight = np.where(pdf > 0, radiance[:, 0] * cosine / np.where(pdf > 0, pdf, 1), 0)
    directions = sphere_directions(400_000)
    expected = 0.0
    for k, material in enumerate([2, 1, 2, 1]):
        hit = np.isfinite(intersect(CORNERS[k], point, directions)[0])
        share = np.maximum(directions[hit] @ up, 0).sum() * 4 * np.pi / len(directions)
        expected += GLOW[material].emission[0] * share
    error = abs(weight.mean() - expected)
    assert error < 4.5 * weight.std() / np.sqrt(count) + 3e-3 * expected


@pytest.mark.parametrize("size", [1e-5, 1.0, 1e5])
def test_shadow_rays_end_before_the_boxes_of_a_flat_light(lit, size):
    """Else each goes down through the tree to one of 2^17 lights, which takes most of the time.

    Boxes are as geometry.h says, with u = 2^-24: 10 u of the coordinates of both larger, and met up
    to 8 u beyond a ray's end.
    """
    chance = np.random.default_rng(4)
    corners = size * (chance.uniform(-1, 1, (64, 1, 3)) + chance.normal(0, 1e-3, (64, 3, 3)))
    corners[..., 1] = size
    scene = triangles_scene(
        corners, [Material("m", emission=(1, 1, 1), double_sided=True)], [0] * 64
    )
    origin = np.float32(size * chance.uniform(-1, 1, (4096, 3)))
    origin[:, 1] *= chance.uniform(-1, 1, 4096).astype(np.float32)
    toward = lit(scene).sample(origin)[0].astype(np.float64)
    u = 2.0**-24
    slack = 10 * u * (np.abs(corners).max() + np.abs(origin).max(axis=1).astype(np.float64))
    assert np.all(toward[:, 1] > 0)
    assert np.all(origin[:, 1] + toward[:, 1] * (1 + 8 * u) < size - slack)
    # But no farther before it than rounding asks for.
    assert np.all(origin[:, 1] + toward[:, 1] > size * (1 - 1e-5))


def test_emission_textures_glow_where_they_are_bright(lit):
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[0, 0, :3], pixels[1, 1, :3] = (255, 0, 0), (0, 255, 255)
    texture = Texture("t", pixels, srgb=True, filter="nearest")
    mesh = Mesh(
        "quad",
        np.array([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        uvs=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32),
    )
    glow = Material(emission=(2.0, 3.0, 4.0), emission_texture=0, double_sided=True)
    plain = Material(emission=(1.0, 1.0, 1.0), double_sided=True)
    shapes = (
        Shape("textured", mesh, np.eye(4), 0),
        Shape("plain", mesh, np.diag([1, -1, 1, 1.0]), 1),
    )
    table = lit(Scene("test", textures=(texture,), materials=(glow, plain), shapes=shapes))
    toward, _, radiance, _, _ = table.sample(np.zeros((4096, 3)))
    above = toward[:, 1] > 0
    column, row = (toward[:, 0] > 0).astype(int), (toward[:, 2] > 0).astype(int)
    colors = pixels[row, column, :3] / 255.0 * glow.emission
    np.testing.assert_allclose(radiance, np.where(above[:, None], colors, 1.0), rtol=1e-6)
    # 3/4 of the textured quad's luminance is gone; the plain one has (2, 3, 4) / 4 against 1.
    mean = np.array([0.25 * 2, 0.25 * 3, 0.25 * 4]) @ LUMINANCE
    np.testing.assert_allclose(above.mean(), mean / (mean + 1), atol=0.03)


def test_punctual_lights_follow_the_formulas_of_khr_lights_punctual(lit):
    inner, outer = math.radians(20), math.radians(35)
    lights = (
        Light("point", (1.0, 2.0, 3.0), position=(1.0, 2.0, 0.5)),
        Light("point", (5.0, 5.0, 5.0), position=(-2.0, 0.0, 0.0), range=3.0),
        Light(
            "spot",
            (7.0, 8.0, 9.0),
            position=(0.0, 3.0, 0.0),
            direction=(0.0, -1.0, 0.0),
            inner_angle=inner,
            outer_angle=outer,
        ),
        Light("directional", (0.5, 0.25, 1.0), direction=(0.6, -0.8, 0.0)),
    )
    table = lit(Scene("test", lights=lights), sampling="uniform", scene_radius=6.0)
    count = 8192
    origin = np.random.default_rng(0).uniform(-2, 2, (count, 3)).astype(np.float32)
    toward, wi, radiance, pdf, extended = table.sample(origin)
    assert not extended.any()
    np.testing.assert_array_equal(pdf, np.float32(0.25))
    o = origin.astype(np.float64)
    known = np.zeros(count, bool)
    for light in lights:
        if light.kind == "directional":
            axis = np.asarray(light.direction)
            mine = np.allclose(wi, -axis, atol=1e-6) | (abs(wi + axis).max(axis=1) < 1e-6)
            expected = np.tile(light.intensity, (count, 1))
            assert (np.linalg.norm(toward[mine], axis=1) > 2 * 6.0).all()
        else:
            to = np.asarray(light.position) - o
            d2 = (to**2).sum(axis=1)
            mine = abs(toward - to).max(axis=1) < 1e-5
            window = np.clip(1 - (np.sqrt(d2) / light.range) ** 4, 0, 1)
            cone = 1.0
            if light.kind == "spot":
                cosine = (to / np.sqrt(d2)[:, None]) @ -np.asarray(light.direction)
                ramp = (cosine - math.cos(outer)) / (math.cos(inner) - math.cos(outer))
                cone = np.clip(ramp, 0, 1) ** 2
            expected = np.asarray(light.intensity) * (window * cone / d2)[:, None]
        assert 0.2 < mine.mean() < 0.3
        np.testing.assert_allclose(radiance[mine], expected[mine], rtol=1e-4, atol=1e-5)
        known |= mine
    assert known.all()


def test_dead_lanes_and_lights_of_every_kind_stay_apart(lit):
    """One table with all kinds: each lane gets its own kind, a dead lane gets nothing."""
    environment = Environment(radiance=(0.5, 0.5, 0.5))
    lights = (
        Light("point", (1.0, 1.0, 1.0), position=(0.0, 5.0, 0.0)),
        Light("directional", (1.0, 1.0, 1.0), direction=(0.0, 0.0, 1.0)),
    )
    scene = triangles_scene(CORNERS, GLOW, [2, 1, 1, 2], lights=lights, environment=environment)
    table = lit(scene, sampling="uniform")
    count = 1 << 14
    active = np.random.default_rng(1).random(count) < 0.7
    toward, _, radiance, pdf, extended = table.sample(np.zeros((count, 3)), active)
    assert not pdf[~active].any() and not radiance[~active].any()
    assert (pdf[active] > 0).all()
    # Seven entries: four triangles, the sky, two lights without extent.
    length = np.linalg.norm(toward, axis=1)
    sky = active & (abs(length - 40) < 1e-3) & (extended == 1)
    share = [sky[active].mean(), (extended[active] == 0).mean()]
    np.testing.assert_allclose(share, [1 / 7, 2 / 7], atol=0.02)
    np.testing.assert_allclose(pdf[sky], 1 / 7 / (4 * np.pi), rtol=1e-5)
    np.testing.assert_allclose(radiance[sky], 0.5, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 3, 7, 64, 1000, 1_000_003])
def test_slots_are_uniform_and_so_is_what_is_left_in_each(lane_device, count):
    bits = np.random.default_rng(count).integers(0, 2**32, 200_000, np.uint32)
    bits[:2] = 0, 2**32 - 1
    slots, left = planes.run(
        lane_device,
        "light_test.cl",
        "list_slots",
        {"bits": bits},
        {"slots": (np.uint32, 1), "left": (np.float32, 1)},
        {"AREA_LIGHTS": 0, "PUNCTUAL_LIGHTS": 0, "ENVIRONMENT": 0, "TEXTURES": 0},
        count=count,
    )
    product = bits.astype(np.uint64) * count
    np.testing.assert_array_equal(slots, product >> np.uint64(32))
    expected = (product & np.uint64(2**32 - 1)) / 2.0**32
    assert left.min() >= 0 and left.max() < 1
    np.testing.assert_allclose(left, expected, rtol=0, atol=2.0**-24)
    # Bins of slots by bins of what is left.
    at = (slots.astype(np.int64) * min(count, 16) // count) * 16 + (left * 16).astype(int)
    share = np.bincount(np.arange(count) * min(count, 16) // count) / count / 16
    expected = np.repeat(share, 16) * len(bits)
    assert stats.chisquare(np.bincount(at, minlength=len(expected)), expected).pvalue > P_MIN


def test_weights_of_two_samplers_are_the_power_heuristic(lane_device):
    a = np.array([1, 0, 3, 1e-20, 1e25, 1e30, 5, 0.1, 1e38], np.float32)
    b = np.array([1, 2, 0, 1e-20, 1e-5, 1e30, 1, 0.3, 1e-38], np.float32)
    inputs, outputs = {"a": a, "b": b}, {"weights": (np.float32, 1)}
    defines = {"AREA_LIGHTS": 1, "PUNCTUAL_LIGHTS": 1, "ENVIRONMENT": 1, "TEXTURES": 0}
    (weights,) = planes.run(
        lane_device, "light_test.cl", "weigh_densities", inputs, outputs, defines
    )
    a, b = a.astype(np.longdouble), b.astype(np.longdouble)
    np.testing.assert_allclose(weights, (a**2 / (a**2 + b**2)).astype(float), rtol=1e-6)


# The sky.


def sky_images():
    rng = np.random.default_rng(5)
    odd = rng.random((5, 7, 3)).astype(np.float32)
    sun = np.full((32, 64, 3), 0.02, np.float32)
    sun[9, 40] = (3e5, 2.5e5, 2e5)
    half = np.zeros((16, 32, 3), np.float32)
    half[3:9, 20:] = rng.random((6, 12, 3))
    half[0, 0] = half[15, 31] = 2.0
    single = np.array([[[1.0, 2.0, 3.0]]], np.float32)
    return {"odd": odd, "sun": sun, "half black": half, "one texel": single}


SKIES = {
    name: Environment((0.5, 1.0, 2.0), image, rotation_xyz_degrees((20, 65 + 40 * k, -40))[:3, :3])
    for k, (name, image) in enumerate(sky_images().items())
}


def local_direction(u, v):
    """Return the direction that the scene model puts at (u, v)."""
    phi, theta = 2 * np.pi * u, np.pi * v
    return np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1
    )


def place_of(sky, directions):
    """Return u and v of world directions."""
    x, y, z = (directions.astype(np.float64) @ sky.rotation).T
    u = np.arctan2(x, -z) / (2 * np.pi) % 1.0
    return u, np.arctan2(np.hypot(x, z), y) / np.pi


def bilinear(sky, u, v):
    """Return the radiance between texels: columns wrap, rows end."""
    height, width = sky.image.shape[:2]
    x, y = u * width - 0.5, v * height - 0.5
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - i)[..., None], (y - j)[..., None]
    image = sky.image.astype(np.float64)

    def texel(a, b):
        return image[np.clip(b, 0, height - 1), a % width]

    top = texel(i, j) * (1 - fx) + texel(i + 1, j) * fx
    bottom = texel(i, j + 1) * (1 - fx) + texel(i + 1, j + 1) * fx
    return (top * (1 - fy) + bottom * fy) * np.asarray(sky.radiance)


@cache
def sky_grid(name, fine=8):
    """Return u, v and solid angle of the centres of ``fine^2`` parts of every texel."""
    height, width = SKIES[name].image.shape[:2]
    u, v = np.meshgrid(
        (np.arange(width * fine) + 0.5) / (width * fine),
        (np.arange(height * fine) + 0.5) / (height * fine),
    )
    solid = np.sin(np.pi * v) * 2 * np.pi**2 / (width * height * fine**2)
    return u.ravel(), v.ravel(), solid.ravel()


@pytest.mark.parametrize("name", SKIES)
def test_sky_look_ups_and_their_density(lit, name):
    sky = SKIES[name]
    table = lit(Scene("test", environment=sky))
    assert table.sky_pmf == 1.0
    u, v, solid = sky_grid(name)
    radiance, pdf = table.look_up(local_direction(u, v) @ sky.rotation.T)
    expected = bilinear(sky, u, v)
    # A direction is known to 1e-7, and radiance changes by a texel's difference over a texel.
    atol = 2e-6 * expected.max() * sky.image.shape[1]
    np.testing.assert_allclose(radiance, expected, rtol=1e-5, atol=atol)
    np.testing.assert_allclose((pdf * solid).sum(), 1.0, rtol=2e-5)
    # No direction with light has a density of 0.
    assert (pdf[radiance.max(axis=1) > atol] > 0).all()


@pytest.mark.parametrize("name", SKIES)
def test_sky_samples_follow_the_table_and_the_density(lit, name):
    sky = SKIES[name]
    table = lit(Scene("test", environment=sky))
    height, width = sky.image.shape[:2]
    count = 1 << 17
    toward, wi, radiance, pdf, extended = table.sample(np.zeros((count, 3)))
    assert extended.all() and (pdf > 0).all()
    np.testing.assert_allclose(np.linalg.norm(wi, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(toward, wi * 40.0, rtol=1e-5)

    u, v = place_of(sky, wi)
    column = np.minimum((u * width).astype(int), width - 1)
    row = np.minimum((v * height).astype(int), height - 1)
    found = np.bincount(row * width + column, minlength=width * height)
    pmf = tables.environment_cells(sky)["pmf"].astype(np.float64)
    likely = pmf * count > 8
    expected = np.append(pmf[likely], max(1 - pmf[likely].sum(), 0)) * count
    found = np.append(found[likely], found[~likely].sum())
    if expected[-1] < 8:
        # A texel's edge is met once in a million.
        assert found[-1] < 24
        expected, found = expected[:-1], found[:-1]
    if len(found) > 1:
        p = stats.chisquare(found, expected / expected.sum() * found.sum()).pvalue
        assert p > P_MIN, p
    # Inside a texel: uniform in u and v.
    x, y = u * width % 1.0, v * height % 1.0
    cells = (x * 8).astype(int) * 8 + (y * 8).astype(int)
    assert stats.chisquare(np.bincount(cells, minlength=64)).pvalue > P_MIN

    inside = (abs(x - 0.5) < 0.499) & (abs(y - 0.5) < 0.499)
    again, density = table.look_up(wi[inside])
    # A direction is known to 1e-7, its azimuth less near the poles; density goes like 1 / sine.
    slack = 1 / np.sin(np.pi * v[inside])
    error = abs(pdf[inside] / density - 1)
    assert (error < 2e-5 + 5e-7 * slack).all(), error.max()
    error = abs(radiance[inside] - again).max(axis=1) / again.max()
    assert (error < 1e-6 * width * slack).all(), error.max()


@pytest.mark.parametrize("name", SKIES)
def test_sky_samples_add_up_to_the_light_of_the_sky(lit, name):
    sky = SKIES[name]
    table = lit(Scene("test", environment=sky))
    count = 1 << 16
    _, _, radiance, pdf, _ = table.sample(np.zeros((count, 3)))
    weight = radiance.astype(np.float64) / pdf[:, None]
    u, v, solid = sky_grid(name)
    expected = (bilinear(sky, u, v) * solid[:, None]).sum(axis=0)
    error = abs(weight.mean(axis=0) - expected)
    assert (error < 4.5 * weight.std(axis=0) / np.sqrt(count) + 3e-3 * expected).all()


# The table, on the host.


def chances_of(keep, other):
    """Return the chance of every index, for a number of 24 bits against ``keep``."""
    kept = np.ceil(keep.astype(np.float64) * 2**24) / 2**24
    chance = kept.copy()
    np.add.at(chance, other, 1 - kept)
    return chance / len(keep)


WEIGHTS = {
    "one": [3.0],
    "two": [1.0, 3.0],
    "three": [0.2, 5.0, 0.0],
    "equal": [2.0] * 7,
    "equal, each below the mean by rounding": [0.1] * 13,
    "zeros but one": [0.0, 0.0, 1e-30, 0.0],
    "thousand": np.random.default_rng(0).random(1000) ** 8,
    "thousand with zeros": np.where(np.arange(1000) % 3, 0.0, np.arange(1000.0)),
    "ratio 1e12": 10.0 ** np.linspace(-12, 0, 1000),
    "one giant": np.append(np.ones(999), 1e12),
    "random order": np.random.default_rng(1).permutation(10.0 ** np.linspace(-6, 6, 777)),
    "huge": [1e300, 3e300, 2e300],
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_alias_tables_hold_the_exact_distribution(name):
    weights = np.asarray(WEIGHTS[name], np.float64)
    keep, other = tables.alias_table(weights)
    assert keep.dtype == np.float32 and other.dtype == np.uint32
    assert (keep >= 0).all() and (keep <= 1).all() and (other < len(weights)).all()
    chance = chances_of(keep, other)
    expected = weights / weights.max()
    expected /= expected.sum()
    # A slot's share is cut to 24 bits; a heavy entry is filled from all slots.
    np.testing.assert_allclose(chance, expected, rtol=0, atol=2.0**-24)
    np.testing.assert_array_equal(chance > 0, weights > 0)


def test_chances_of_lights_are_the_chances_of_their_table():
    """Also of a light that has a millionth of a millionth of the power: no bias, however rare."""
    of = [0, 1, 0, 1]
    dim = Material(emission=(1e-9, 1e-9, 1e-9), double_sided=True)
    bright = Material(emission=(1e4, 1e4, 1e4), double_sided=True)
    scene = triangles_scene(CORNERS, [dim, bright], of)
    lights = tables.light_table(scene, tables.flatten(scene), "power")
    exact = chances_of(lights["keep"], lights["other"])
    np.testing.assert_allclose(lights["pmf"], exact, rtol=1e-6)
    cells = tables.environment_cells(SKIES["sun"])
    exact = chances_of(cells["keep"], cells["other"])
    np.testing.assert_allclose(cells["pmf"], exact, rtol=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("size", "count"), [(1e14, 4), (1e17, 0)], ids=["huge", "beyond float32"])
def test_lights_of_areas_that_float32_does_not_tell_are_no_lights(size, count):
    glow = Material(emission=(1e20, 1e20, 1e20))
    scene = triangles_scene(CORNERS * size, [glow], [0] * len(CORNERS))
    lights = tables.light_table(scene, tables.flatten(scene), "power")
    assert len(lights) == count
    assert all(np.isfinite(lights[name]).all() for name in ("area", "power", "pmf"))


def test_power_is_what_the_formulas_say():
    area, _ = areas_and_normals(CORNERS)
    lights = (
        Light("point", (1.0, 1.0, 1.0)),
        Light("spot", (3.0, 3.0, 3.0), outer_angle=0.5),
        Light("point", (0.0, 0.0, 0.0)),
    )
    scene = triangles_scene(CORNERS, [*GLOW, Material()], [0, 1, 3, 2], lights=lights)
    geometry = tables.flatten(scene)
    table = tables.light_table(scene, geometry, "power")
    level = [np.asarray(m.emission) @ LUMINANCE for m in GLOW]
    power = np.pi * np.array([area[0] * level[0], 2 * area[1] * level[1], 2 * area[3] * level[2]])
    power = [*power, 4 * np.pi, 3 * 2 * np.pi * (1 - math.cos(0.5))]
    np.testing.assert_allclose(table["pmf"], power / np.sum(power), rtol=1e-5)
    np.testing.assert_array_equal(table["triangle"][:3], [0, 1, 3])
    none = CONSTANT["NO_LIGHT"]
    np.testing.assert_array_equal(geometry.surfaces["light"], [0, 1, none, 2])

    table = tables.light_table(scene, geometry, "uniform")
    np.testing.assert_allclose(table["pmf"], 0.2, rtol=1e-6)


def test_far_light_leaves_near_lights_their_share():
    sun = Light("directional", (1e5, 1e5, 1e5))
    scene = triangles_scene(CORNERS, GLOW, [0, 1, 2, 2], lights=(sun,), environment=SKIES["odd"])
    table = tables.light_table(scene, tables.flatten(scene), "power")
    np.testing.assert_allclose(table["pmf"].sum(), 1, rtol=1e-6)
    np.testing.assert_allclose(table["pmf"][:4].sum(), tables.NEAR_SHARE, rtol=1e-5)
    # The sky's power is pi R^2 times 4 pi times its mean, the sun's pi R^2 times its lux.
    u, v, solid = sky_grid("odd", 16)
    cells = SKIES["odd"].image[
        np.minimum((v * 5).astype(int), 4), np.minimum((u * 7).astype(int), 6)
    ]
    flux = ((cells * np.asarray(SKIES["odd"].radiance)) @ LUMINANCE * solid).sum()
    np.testing.assert_allclose(table["pmf"][4] / table["pmf"][5], flux / 1e5, rtol=5e-3)
    assert tables.environment_light(table) == 4


def test_triangles_without_area_and_dark_materials_are_no_lights():
    flat = [[0, 0, 0], [1, 1, 1], [2, 2, 2]]
    broken = [[0, 0, 0], [np.nan, 0, 0], [0, 1, 0]]
    scene = triangles_scene([flat, broken, CORNERS[0]], [*GLOW, Material()], [0, 0, 3])
    table = tables.light_table(scene, tables.flatten(scene), "power")
    assert len(table) == 0
