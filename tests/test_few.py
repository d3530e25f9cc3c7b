"""Small scenes without a tree: hits against brute force, and closed meshes against leaks."""

import numpy as np
import planes
import pytest
from rays import NO_HIT, all_hits, rays_at_edges
from scene_builder import IDENTITY, SMALL, build, camera, floor, glowing, lambertian, render
from trimesh.creation import icosphere

from psf_cl import few, tables
from psf_cl.device import layout
from psf_cl.device.device import Device
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light, Material, Mesh, Texture
from psf_cl.settings import Settings
from psf_cl.traits import DeviceTraits

#: Room for corners: the most that a scene without a tree may have.
ROOM = 128

CHECKS = np.random.default_rng(11).integers(0, 2, (8, 8)) == 1


class Listed:
    """Triangles, ``(n, 3, 3)``, as a list on the device.

    With ``cut_out``, ``(n,)`` bool, those triangles show CHECKS of their barycentrics (u, v).
    """

    def __init__(self, device, triangles, cut_out=None, flat=True):
        self.device = device
        self.triangles = np.ascontiguousarray(triangles, np.float32).reshape(-1, 3, 3)
        self.few = few.few_triangles(self.triangles.reshape(-1, 9), cut_out)
        assert len(self.few.corners) <= ROOM
        params = np.zeros(1, layout.PARAMS.dtype)
        params["corner_count"], params["face_count"] = len(self.few.corners), len(self.few.faces)
        plates = few.NO_PLATES
        if flat:
            apart = np.zeros(len(self.triangles), bool) if cut_out is None else cut_out
            plates = few.flat_pieces(self.few, apart)
        params["plate_count"], params["pair_count"] = len(plates.records), plates.pairs
        self.plates = plates
        contents = {
            "params": params,
            "plates": plates.padded(len(plates.records) + 1),
            "corners": np.append(self.few.corners, np.float32(0)),
            "faces": np.append(self.few.faces, np.uint32(0)),
        }
        if cut_out is not None:
            contents |= self.cut_out_tables()
        self.defines = {"FEW": ROOM, "ALPHA": int(cut_out is not None)}
        self.buffers = {name: device.upload(name, values) for name, values in contents.items()}

    def cut_out_tables(self):
        count = len(self.triangles)
        uvs = np.zeros(count, layout.UVS.dtype)
        uvs["uv1"], uvs["uv2"] = (1, 0), (0, 1)
        pixels = np.zeros((8, 8, 4), np.uint8)
        pixels[..., 3] = 255 * CHECKS
        texture = Texture("checks", pixels, wrap=("clamp", "clamp"), filter="nearest")
        records, texels = tables.texture_tables((texture,))
        material = Material(base_color_texture=0, alpha_mode="mask", alpha_cutoff=0.5)
        return {
            "surfaces": np.zeros(count, layout.SURFACE.dtype),
            "materials": tables.material_table((material,)),
            "uvs": uvs,
            "textures": records,
            "texels": texels.reshape(-1),
            "srgb_to_linear": tables.srgb_to_linear(),
        }

    def run(self, kernel, rays, active, outputs):
        active = np.ones(len(rays), np.uint32) if active is None else active.astype(np.uint32)
        inputs = {"rays": np.ascontiguousarray(rays[:, :6].T, np.float32), "active": active}
        return planes.run(
            self.device, "few_test.cl", kernel, inputs, outputs, self.defines, **self.buffers
        )

    def closest(self, rays, active=None):
        """Return triangles ``(n,)`` and t, u, v ``(n, 3)`` of rays ``(n, 6)`` without an end."""
        outputs = {"triangles": (np.uint32, 1), "hits": (np.float32, 3)}
        triangles, hits = self.run("trace_closest_listed", rays, active, outputs)
        return triangles, hits.T

    def any(self, rays, active=None):
        """Return whether anything lies before the rays' t = 1."""
        outputs = {"blocked": (np.uint32, 1)}
        return self.run("trace_any_listed", rays, active, outputs)[0] != 0

    def release(self):
        self.device.release(*self.buffers.values())


@pytest.fixture
def listed(lane_device):
    made = []

    def build(triangles, cut_out=None, flat=True):
        made.append(Listed(lane_device, triangles, cut_out, flat))
        return made[-1]

    yield build
    for item in made:
        item.release()


def sharing_soup(count, seed=0):
    """Return triangles of all sizes that share their corners, ``(count, 3, 3)``."""
    rng = np.random.default_rng([seed, count])
    points = rng.uniform(-1, 1, (min(count + 2, 100), 3))
    faces = np.argsort(rng.random((count, len(points))), axis=1)[:, :3]
    return points[faces].astype(np.float32)


def rays_around(count, seed=1, scale=1.0):
    """Return rays ``(n, 6)`` from inside and around the scene, of all lengths about its size."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-2, 2, (count, 3))
    targets = rng.uniform(-1, 1, (count, 3))
    return (scale * np.concatenate([origins, targets - origins], axis=1)).astype(np.float32)


def endless(rays):
    return np.concatenate([rays, np.full((len(rays), 1), np.inf, np.float32)], axis=1)


def check_against_brute_force(listed, rays, there=None, margin=1e-4):
    """Compare every ray that passes no edge within ``margin``; return what is hit.

    Args:
        there: from u and v of all hits, ``(rays, triangles)``, which hits count and which are sure.
    """
    found, hits = listed.closest(rays)
    blocked = listed.any(rays)
    t, u, v, edge = all_hits(listed.triangles, endless(rays))
    clear = np.nan_to_num(edge, nan=np.inf).min(axis=1) > margin
    if there is not None:
        counts, sure = there(u, v)
        clear &= (sure | ~np.isfinite(t)).all(axis=1)
        t = np.where(counts, t, np.inf)
    nearest = t.min(axis=1)
    expected = np.where(np.isfinite(nearest), t.argmin(axis=1), NO_HIT)
    # Equal but for rounding: either may be first.
    second = np.partition(t, 1, axis=1)[:, 1] if t.shape[1] > 1 else np.full(len(t), np.inf)
    first = clear & ~(second - nearest < 1e-5 * nearest)
    assert first.mean() > 0.4
    np.testing.assert_array_equal(found[first], expected[first])
    hit = first & (expected != NO_HIT)
    exact = np.stack([a[hit, expected[hit]] for a in (t, u, v)], axis=1)
    np.testing.assert_allclose(hits[hit], exact, rtol=1e-4, atol=1e-4)
    assert np.isposinf(hits[found == NO_HIT, 0]).all()
    sure_end = clear & ~(abs(nearest - 1) < 1e-4)
    np.testing.assert_array_equal(blocked[sure_end], nearest[sure_end] < 1)
    return found


@pytest.mark.parametrize("count", [1, 2, 5, 31, 32, 33, 64, 97, 160])
def test_hits_equal_brute_force(listed, count):
    found = check_against_brute_force(listed(sharing_soup(count)), rays_around(2000))
    assert (found != NO_HIT).sum() > 20


def test_no_triangles_are_never_hit(listed):
    empty = listed(np.zeros((0, 3, 3)))
    found, hits = empty.closest(rays_around(100))
    assert (found == NO_HIT).all() and np.isposinf(hits[:, 0]).all()
    assert not empty.any(rays_around(100)).any()


def test_any_hit_is_what_the_closest_hit_says(listed):
    triangles = listed(sharing_soup(60))
    rays = rays_around(20_000)
    rays[:, 3:] *= np.float32(0.5)
    _, hits = triangles.closest(rays)
    blocked = triangles.any(rays)
    same = abs(hits[:, 0] - 1) > 1e-5
    assert same.mean() > 0.99 and 0.2 < blocked.mean() < 0.8
    np.testing.assert_array_equal(blocked[same], (hits[:, 0] < 1)[same])


def test_dead_lanes_hit_nothing_and_change_nothing(listed):
    triangles = listed(sharing_soup(40))
    rays = rays_around(4096)
    active = np.random.default_rng(2).random(4096) < 0.3
    active[:64] = False
    # What dead lanes hold is never looked at.
    spoiled = np.where(active[:, None], rays, np.float32(np.nan))
    found, hits = triangles.closest(rays)
    found_some, hits_some = triangles.closest(spoiled, active)
    assert (found_some[~active] == NO_HIT).all()
    np.testing.assert_array_equal(found_some[active], found[active])
    np.testing.assert_array_equal(hits_some[active], hits[active])
    blocked = triangles.any(spoiled, active)
    np.testing.assert_array_equal(blocked, triangles.any(rays) & active)


@pytest.mark.parametrize("copies", [2, 4])
def test_the_lowest_index_wins_among_equal_triangles(listed, copies):
    distinct = sharing_soup(40)
    order = np.random.default_rng(6).permutation(np.repeat(np.arange(40), copies))
    found, _ = listed(distinct[order]).closest(rays_around(2000))
    hit = found[found != NO_HIT]
    first_of = np.array([np.flatnonzero(order == k)[0] for k in range(40)])
    np.testing.assert_array_equal(hit, first_of[order[hit]])
    assert len(np.unique(hit)) > 20


def test_triangles_that_are_not_finite_are_left_out_and_counted(listed):
    triangles = sharing_soup(50)
    bad = {3: np.nan, 17: np.inf, 18: -np.inf, 49: np.nan}
    for number, (index, value) in enumerate(bad.items()):
        triangles[index, number % 3, (number + 1) % 3] = value
    spoiled = listed(triangles)
    assert spoiled.few.dropped == len(bad)
    kept = np.setdiff1d(np.arange(50), list(bad))
    np.testing.assert_array_equal(spoiled.few.faces[:, 3], kept)
    found, hits = spoiled.closest(rays_around(2000))
    found_kept, hits_kept = listed(triangles[kept]).closest(rays_around(2000))
    hit = found != NO_HIT
    np.testing.assert_array_equal(found[hit], kept[found_kept[hit]])
    np.testing.assert_array_equal(hits, hits_kept)


def test_triangles_without_area_are_never_hit(listed):
    triangles = sharing_soup(90)
    triangles[::3, 2] = triangles[::3, 1]
    triangles[1::30] = triangles[1::30, :1]
    flat = listed(triangles)
    rays = rays_around(3000)
    # Aimed exactly at their corners, along their edges, and from corners of them.
    rays[:300, 3:] = np.tile(triangles[::3, 2], (10, 1)) - rays[:300, :3]
    rays[300:330, :3] = triangles[::3, 0] - (triangles[::3, 1] - triangles[::3, 0])
    rays[300:330, 3:] = triangles[::3, 1] - triangles[::3, 0]
    rays[330:360, :3] = triangles[::3, 0]
    found, hits = flat.closest(rays)
    hit = found[found != NO_HIT]
    assert len(hit) > 500 and not (hit % 3 == 0).any() and not (hit % 30 == 1).any()
    assert np.isfinite(hits[found != NO_HIT]).all()
    alone = listed(triangles[::3])
    assert (alone.closest(rays)[0] == NO_HIT).all() and not alone.any(rays).any()


def test_both_sides_count_and_hits_lie_strictly_between_0_and_the_end(listed):
    triangle = listed([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]])
    rays = np.array(
        [
            [0, 0, 0, 0, 0, 4],
            [0, 0, 4, 0, 0, -4],
            [0, 0, 3, 0, 0, 1],
            [0, 0, 0, 0, 0, 2],
            [0, 0, 0, 0, 0, np.nextafter(np.float32(2), np.float32(3))],
            [0, 0, 2, 0, 0, 1],
        ],
        np.float32,
    )
    found, hits = triangle.closest(rays)
    np.testing.assert_array_equal(found == 0, [True, True, False, True, True, False])
    np.testing.assert_allclose(hits[[0, 1, 3, 4], 0], [0.5, 0.5, 1, 1], rtol=2e-7)
    np.testing.assert_array_equal(triangle.any(rays), [True, True, False, False, True, False])


@pytest.mark.parametrize(
    "ray",
    [
        [np.nan, 0, 0, 0, 0, 1],
        [0, 0, 0, 0, np.nan, 1],
        [np.inf, 0, 0, 0, 0, 1],
        [0, 0, 0, np.inf, 0, 1],
        [0, 0, 0, 0, 0, 0],
    ],
)
def test_rays_that_are_none_hit_nothing(listed, ray):
    triangles = listed(sharing_soup(60))
    rays = rays_around(64)
    rays[5] = ray
    found, _ = triangles.closest(rays)
    assert found[5] == NO_HIT and not triangles.any(rays)[5]
    # The lanes beside it do not mind.
    others = np.arange(64) != 5
    np.testing.assert_array_equal(found[others], triangles.closest(rays_around(64))[0][others])


def test_cut_out_triangles_count_only_where_they_are_there(listed):
    cut_out = np.arange(100) % 2 == 1

    def there(u, v):
        texel = (
            np.clip(np.floor(8 * x), 0, 7).astype(int) for x in (np.nan_to_num(u), np.nan_to_num(v))
        )
        column, row = texel
        shows = CHECKS[row, column]
        border = np.minimum(*(abs(8 * x - np.round(8 * x)) for x in (u, v)))
        return ~cut_out | shows, ~cut_out | (border > 1e-2)

    triangles = listed(sharing_soup(100), cut_out)
    rays = rays_around(4000)
    found = check_against_brute_force(triangles, rays, there)
    # Some go through a hole, some are held by a cut-out triangle.
    assert (found != listed(sharing_soup(100)).closest(rays)[0]).sum() > 100
    assert (found[found != NO_HIT] % 2 == 1).sum() > 100


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e-6, 1e6, 1e12, 1e30])
def test_any_scale_gives_the_same_hits(listed, scale):
    triangles = sharing_soup(60)
    plain, _ = listed(triangles).closest(rays_around(2000))
    scaled = listed(triangles * np.float32(scale))
    rays = rays_around(2000, scale=scale)
    found, hits = scaled.closest(rays)
    # Scales are no powers of two: hits near an edge may move.
    assert (plain == found).mean() > 0.995
    assert (hits[found != NO_HIT, 0] > 0).all()
    blocked = scaled.any(rays)
    assert (blocked == (hits[:, 0] < 1)).mean() > 0.999
    # Directions of length 1, as those of paths.
    length = np.linalg.norm(rays[:, 3:].astype(np.float64), axis=1, keepdims=True)
    rays[:, 3:] = rays[:, 3:] / length
    unit, unit_hits = scaled.closest(rays)
    assert (unit == found).mean() > 0.995
    same = (unit == found) & (unit != NO_HIT)
    np.testing.assert_allclose(unit_hits[same, 0], hits[same, 0] * length[same, 0], rtol=1e-3)


BALL = icosphere(subdivisions=1)
CLOSED = {
    "box": (primitives.box().positions, primitives.box().triangles),
    "icosphere": (np.asarray(BALL.vertices), np.asarray(BALL.faces)),
}


@pytest.mark.parametrize("offset", [0.0, 100.0])
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("mesh", CLOSED)
def test_no_ray_leaves_a_closed_mesh(listed, mesh, scale, offset):
    points, faces = CLOSED[mesh]
    center = scale * offset * np.array([1.0, -0.3, 0.7])
    points = (center + scale * points).astype(np.float32)
    closed = listed(points[faces])
    origins = center + scale * np.random.default_rng(3).uniform(-0.3, 0.3, (100_000, 3))
    rays = rays_at_edges(points, faces, origins.astype(np.float32), 4)[:, :6]
    assert (closed.closest(rays)[0] != NO_HIT).all()
    # The same as shadow rays to points outside.
    rays[:, 3:] *= np.float32(1.5)
    assert closed.any(rays).all()


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-5])
def test_no_ray_from_close_to_an_edge_leaves_a_box(listed, gap):
    points, faces = CLOSED["box"]
    low = points.min(axis=0)
    box = listed((points - low)[faces])
    rng = np.random.default_rng(8)
    count = 100_000
    along = rng.integers(0, 3, count)
    targets = np.zeros((count, 3))
    targets[np.arange(count), along] = rng.uniform(0.1, 0.9, count)
    origins = gap * rng.uniform(0.5, 2.0, (count, 3))
    origins[np.arange(count), along] = targets[np.arange(count), along]
    origins[np.arange(count), along] += gap * rng.uniform(-10, 10, count)
    targets += 1e-8 * rng.normal(size=(count, 3))
    rays = np.concatenate([origins, targets - origins], axis=1).astype(np.float32)
    assert (box.closest(rays)[0] != NO_HIT).all()
    rays[:, 3:] *= np.float32(1.5)
    assert box.any(rays).all()


def test_rays_along_the_axes_do_not_slip_between_faces(listed):
    # A grid of quads in the plane z = 1: rays straight at its corners and edges.
    x, y = np.meshgrid(np.arange(-4, 4), np.arange(-4, 4), indexing="ij")
    a = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) / np.array([4.0, 4.0, 1.0])
    step_x, step_y = np.array([0.25, 0, 0]), np.array([0, 0.25, 0])
    triangles = np.concatenate(
        [
            np.stack([a, a + step_x, a + step_y], axis=1),
            np.stack([a + step_x, a + step_x + step_y, a + step_y], axis=1),
        ]
    )
    grid = listed(triangles)
    middles = (triangles + np.roll(triangles, 1, axis=1)).reshape(-1, 3) / 2
    targets = np.concatenate([triangles.reshape(-1, 3), middles])
    targets = targets[(np.abs(targets[:, :2]) < 1).all(axis=1)]
    for sign in (1.0, -1.0):
        # -0.0 on the way back: a zero of either sign.
        directions = np.broadcast_to(np.array([0.0, 0.0, 1.0]) * sign, targets.shape)
        rays = np.concatenate([targets - 3 * directions, directions], axis=1)
        found, hits = grid.closest(rays)
        assert (found != NO_HIT).all()
        np.testing.assert_allclose(hits[:, 0], 3.0, rtol=1e-6)
        assert grid.any(rays * np.array([1, 1, 1, 4, 4, 4])).all()


@pytest.mark.parametrize("offset", [0.0, 100.0])
@pytest.mark.parametrize("mesh", CLOSED)
def test_plates_find_what_going_by_corners_finds(listed, mesh, offset):
    points, faces = CLOSED[mesh]
    center = offset * np.array([1.0, -0.3, 0.7])
    points = (center + points).astype(np.float32)
    origins = (center + np.random.default_rng(5).uniform(-2, 2, (20_000, 3))).astype(np.float32)
    rays = np.concatenate(
        [rays_at_edges(points, faces, origins, 6)[:, :6], rays_around(20_000)]
    ).astype(np.float32)
    rays[20_000:, :3] += center.astype(np.float32)
    flat, exact = listed(points[faces]), listed(points[faces], flat=False)
    assert len(flat.plates.records) and not len(exact.plates.records)
    (found, hits), (expected, known) = flat.closest(rays), exact.closest(rays)
    # On a diagonal either half of a side is right.
    side = found // 2 if mesh == "box" else found
    np.testing.assert_array_equal(side, expected // 2 if mesh == "box" else expected)
    same = (found == expected) & (found != NO_HIT)
    assert same.mean() > 0.2
    tolerance = 1e-4 if offset == 0.0 else 1e-2
    # Rays within a hair of a plane round more.
    assert (np.abs(hits[same] - known[same]).max(axis=1) > tolerance).mean() < 1e-3
    # Rays to the mesh end right on it.
    rays[:, 3:] *= np.float32(1.5)
    np.testing.assert_array_equal(flat.any(rays), exact.any(rays))


def test_sides_of_a_box_are_plates_and_other_triangles_stay_alone(listed):
    points, faces = CLOSED["box"]
    box = points[faces].astype(np.float32)
    sides = listed(box).plates
    assert (len(sides.records), sides.pairs) == (6, 6)
    corner = (1 << layout.CONSTANT["PLATE_TURN"]) - 1
    pairs = np.sort(np.stack([sides.records["first"], sides.records["second"]]) & corner, axis=0)
    normals = np.cross(box[:, 1] - box[:, 0], box[:, 2] - box[:, 0])
    np.testing.assert_allclose(normals[pairs[0]], normals[pairs[1]], atol=1e-6)
    assert sorted(pairs.ravel()) == list(range(12))
    # From the neighbourhood of the box rounding decides next to nothing.
    assert (3.0 * sides.records["slack"] + sides.records["slack_here"] < 1e-4).all()
    ball = listed(BALL.vertices[BALL.faces]).plates
    assert (len(ball.records), ball.pairs) == (len(BALL.faces), 0)
    # Nothing says which of two that lie in one place is hit, but their order.
    assert listed(np.concatenate([box, box])).plates.pairs == 0
    assert listed(box, np.arange(12) < 2).plates.pairs == 5


def test_what_moves_or_has_no_plane_is_looked_at_corner_by_corner():
    triangles = sharing_soup(8).reshape(-1, 9)
    alone = np.zeros(9, bool)
    still = few.few_triangles(triangles)
    assert len(few.flat_pieces(still, alone).records) == 8
    labels = np.full((8, 3), -1)
    labels[0, 0] = 0
    assert not len(few.flat_pieces(few.few_triangles(triangles, labels=labels), alone).records)
    sliver = np.array([[0, 0, 0, 1, 0, 0, 0.5, 1e-30, 0]], np.float32)
    thin = few.few_triangles(np.concatenate([triangles, sliver]))
    assert not len(few.flat_pieces(thin, alone).records)
    line = np.array([[0, 0, 0, 1, 0, 0, 2, 0, 0]], np.float32)
    pieces = few.flat_pieces(few.few_triangles(np.concatenate([triangles, line])), alone)
    assert len(pieces.records) == 9 and not pieces.records["n"][8].any()


# Whole renders, with a list and with a tree.


def shards(count):
    """Return ``count`` triangles that share corners, in the half space above the floor."""
    points = np.random.default_rng(7).uniform((-0.8, 0.1, -0.8), (0.8, 1.2, 0.8), (60, 3))
    faces = np.argsort(np.random.default_rng(8).random((count, 60)), axis=1)[:, :3]
    return Mesh("shards", points.astype(np.float32), faces.astype(np.uint32))


def scene_of(count):
    """Return a scene of ``count`` triangles, lit as far as they go."""
    light = transform.translation((0, 2, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    lamp = Mesh("lamp", primitives.quad().positions, primitives.quad().triangles[:1])
    parts = []
    if count > 0:
        parts.append((lamp, light @ transform.scaling(0.5), glowing(8.0)))
    if count > 2:
        parts.append(floor(2.0, lambertian(0.5)))
    if count > 3:
        parts.append((shards(count - 3), IDENTITY, Material(roughness=0.5)))
    elif count == 2:
        parts.append((lamp, transform.scaling(2.0), lambertian(0.5)))
    view = camera((0, 1.2, 3), (0, 0.6, 0), 50)
    return build(
        parts,
        view,
        (24, 16),
        lights=[Light("point", (2, 2, 2), position=(1, 2, 1))],
        environment=0.2,
    )


def on_both(device, scene, spp, outputs):
    """Return the images with the list of triangles and with a tree, and the list's plan."""
    traits = DeviceTraits("cpu", 16, 16, 1024, 8, **SMALL)
    plan = make_plan(scene, Settings(), outputs, traits)
    few = render(Device(device.context, traits), scene, spp, outputs)
    without = DeviceTraits("cpu", 16, 16, 1024, 8)
    return few, render(Device(device.context, without), scene, spp, outputs), plan


@pytest.mark.parametrize(
    "count",
    [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow), 160, 161],
)
def test_a_list_and_a_tree_give_the_same_image(device, count):
    outputs = ("albedo", "normal", "depth", "direct")
    few, tree, plan = on_both(device, scene_of(count), 32, outputs)
    assert bool(plan.features["FEW"].value) == (count <= 160)
    assert few.rgb.any()
    for name, pixels in tree.aovs.items():
        np.testing.assert_allclose(few.aovs[name], pixels, rtol=1e-4, atol=1e-6, err_msg=name)


def test_a_scene_of_many_corners_gets_a_tree_though_its_triangles_are_few():
    def plan(corner_count):
        rng = np.random.default_rng(9)
        points = rng.uniform(-1, 1, (corner_count, 3)).astype(np.float32)
        faces = np.arange(-(-corner_count // 3) * 3, dtype=np.uint32).reshape(-1, 3) % corner_count
        mesh = Mesh("points", points, faces)
        shapes = [(mesh, IDENTITY, lambertian(0.5))]
        return make_plan(build(shapes, camera((0, 0, 4), (0, 0, 0))), Settings())

    for corners, room in ((1, 32), (32, 32), (33, 64), (128, 128), (129, 0)):
        assert plan(corners).features["FEW"].value == room
    assert plan(129).features["FEW"].reason == "a tree: 129 corners"


def test_a_scene_of_many_plates_gets_a_tree_and_boxes_count_by_their_sides():
    def reason(count, mesh):
        step = transform.translation([2.5, 0.0, 0.0])
        places = [np.linalg.matrix_power(step, k) for k in range(count)]
        shapes = [(mesh, place, lambertian(0.5)) for place in places]
        return make_plan(build(shapes, camera((0, 0, 4), (0, 0, 0))), Settings()).features["FEW"]

    ball = Mesh("ball", np.asarray(BALL.vertices, np.float32), np.asarray(BALL.faces, np.uint32))
    assert reason(1, ball).value and reason(1, ball).reason.endswith("80 plates, 42 corners")
    assert reason(2, primitives.box()).reason == "no tree: 24 triangles, 12 plates, 16 corners"
    half = Mesh("half", ball.positions, ball.triangles[:1])
    shapes = [
        (ball, IDENTITY, lambertian(0.5)),
        (half, transform.translation([3.0, 0, 0]), lambertian(0.5)),
    ]
    plan = make_plan(build(shapes, camera((0, 0, 4), (0, 0, 0))), Settings())
    assert plan.features["FEW"].reason == "a tree: 81 triangles, 81 plates"


def test_a_scene_of_bad_triangles_only_renders_its_sky(device):
    mesh = Mesh("bad", np.full((3, 3), np.nan, np.float32), np.array([[0, 1, 2]], np.uint32))
    scene = build(
        [(mesh, IDENTITY, lambertian(0.5))], camera((0, 0, 4), (0, 0, 0)), environment=0.25
    )
    few, tree, plan = on_both(device, scene, 4, ())
    assert plan.features["FEW"].value
    np.testing.assert_array_equal(few.rgb, 0.25)
    np.testing.assert_array_equal(tree.rgb, 0.25)
