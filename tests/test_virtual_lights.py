"""Photons that go on, against a tracer in NumPy; the virtual lights that they leave."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scene_builder import build, camera, glowing, inside_out, lambertian, render
from scene_builder import renderer as open_renderer

from psf_cl.device import layout
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings
from psf_cl.stages.virtual_lights import surfaces_for
from psf_cl.tables import flatten

VIRTUAL = {"indirect_light": "virtual_lights", "sampler": "random"}
WALLS = np.array([0.8, 0.5, 0.2])


def room(walls=WALLS, door=False):
    """Return a box with a lamp under its ceiling and a block on its floor; open or closed."""
    box = inside_out(primitives.box())
    if door:
        box = replace(box, triangles=box.triangles[2:])
    lamp = transform.translation((0.1, 0.45, 0.0)) @ transform.scaling(0.1)
    block = transform.translation((-0.2, -0.35, 0.1)) @ transform.scaling(0.3)
    parts = [
        (box, np.eye(4), lambertian(tuple(walls))),
        (inside_out(primitives.quad()), lamp, glowing(40.0)),
        (primitives.box(), block, lambertian((0.3, 0.3, 0.9))),
    ]
    return build(parts, camera((0, 0, 0.45), (0, -0.1, 0), 70), (16, 16))


class Flight:
    """Photons of a renderer, followed from surface to surface."""

    def __init__(self, opened):
        self.opened, self.map = opened, opened.photon_map
        self.fields = list(layout.all_path_fields())
        values = {name: item.value for name, item in opened.plan.features.items()}
        self.words = layout.path_field_count(values)
        self.traits = opened.plan.traits
        self.first = 0

    def field(self, name):
        """Return a word of every photon; only of those that all paths have."""
        pool = self.opened.device.read(self.opened.buffers["photons"])
        pool = pool.reshape(-1, self.words, self.traits.block)
        return pool[:, self.fields.index(name)].reshape(-1)

    def state(self):
        status = self.field("status").view(np.uint32) & layout.CONSTANT["STATUS_MASK"]
        power = np.stack([self.field(f"beta_{c}") for c in "rgb"], axis=-1).astype(np.float64)
        return status == layout.CONSTANT["STATUS_ALIVE"], power

    def follow(self, count):
        """Return what was emitted, and a list of (triangles hit, power before, power after)."""
        items = -(-self.traits.slots // self.traits.lanes)
        self.map.emit.set(first=self.first, count=count)(items)
        self.first += count
        alive, power = self.state()
        emitted, steps = power[alive], []
        for _ in range(self.map.virtual_lights.surfaces):
            self.map.trace(self.map.trace_items)
            triangles = self.field("hit_triangle").view(np.uint32)[alive]
            before = power[alive]
            self.map.virtual_lights.scatter_all(items)
            left, power = self.state()
            steps.append((triangles, before, np.where(left[alive, None], power[alive], 0.0)))
            alive = left
        return emitted, steps


def nearest(origins, directions, corners):
    """Return distance and triangle of the first hit of rays ``(n, 3)``; infinite and -1 if none."""
    best = np.full(len(origins), np.inf)
    which = np.full(len(origins), -1)
    for index, (a, b, c) in enumerate(corners):
        e1, e2 = b - a, c - a
        p = np.cross(directions, e2)
        scale = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("ij,ij->i", origins - a, p) / scale
            q = np.cross(origins - a, e1)
            v = np.einsum("ij,ij->i", directions, q) / scale
            t = (q @ e2) / scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6) & (t < best)
        best[hit], which[hit] = t[hit], index
    return best, which


def cosine_around(normals, rng):
    """Return directions around unit normals ``(n, 3)``, by their cosine."""
    sphere = rng.normal(size=normals.shape)
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = normals + sphere
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def traced(scene, count, surfaces, rng):
    """Return the power that comes to each triangle at each bounce, ``(surfaces, n, 3)``.

    Of a unit of power of the one lamp, without roulette, every photon with the power it has left.
    """
    corners = flatten(scene).positions.astype(np.float64).reshape(-1, 3, 3)
    owner = np.repeat(
        np.arange(len(scene.shapes)), [len(shape.mesh.triangles) for shape in scene.shapes]
    )
    materials = [scene.materials[shape.material] for shape in scene.shapes]
    colors = np.array([m.base_color for m in materials])[owner]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lamp = np.flatnonzero([any(materials[k].emission) for k in owner])
    from_ = rng.choice(lamp, count)
    a, b, c = (corners[from_, k] for k in range(3))
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    origins, directions = a + u * (b - a) + v * (c - a), cosine_around(normals[from_], rng)
    power = np.full((count, 3), 1.0 / count)
    came = np.zeros((surfaces, len(corners), 3))
    for bounce in range(surfaces):
        t, which = nearest(origins, directions, corners)
        on = which >= 0
        t, which, power = t[on], which[on], power[on]
        origins = origins[on] + t[:, None] * directions[on]
        np.add.at(came[bounce], which, power)
        facing = np.where(np.einsum("ij,ij->i", normals[which], directions[on]) < 0, 1.0, -1.0)
        directions = cosine_around(normals[which] * facing[:, None], rng)
        power = power * colors[which]
    return came


@pytest.mark.parametrize("door", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_comes_to_surfaces_is_what_a_tracer_in_numpy_finds(device, door):
    """At each bounce, by wall and colour; and every photon has one fate."""
    scene = room(door=door)
    opened = open_renderer(device, scene, max_depth=5, **VIRTUAL)
    opened.photon_map.clear()
    flight = Flight(opened)
    count = flight.traits.slots
    emitted, steps = flight.follow(count)
    counts = opened.photon_map.counts()
    assert len(steps) == surfaces_for(opened.settings) == 4
    assert counts["emitted"] == len(emitted) == count
    fates = [counts[name] for name in ("absorbed", "escaped", "cut", "rejected")]
    assert sum(fates) == count and fates[0] > 0 and (fates[1] > 0) == door and fates[2] > 0
    truth = traced(scene, 1 << 17, 4, np.random.default_rng(3))
    total = emitted.sum(axis=0)
    for bounce, (triangles, before, _) in enumerate(steps):
        came = np.zeros_like(truth[0])
        squares = np.zeros(len(came))
        hit = triangles != layout.CONSTANT["NO_HIT"]
        np.add.at(came, triangles[hit], before[hit] / total)
        np.add.at(squares, triangles[hit], ((before[hit] / total) ** 2).max(axis=1))
        # Of both: the tracer's is less than half of it.
        error = np.sqrt(1.5 * squares) + 2.0 / count
        assert (np.abs(came - truth[bounce]) / error[:, None]).max() < 4.5, bounce
    opened.close()


@pytest.mark.slow
def test_power_that_leaves_is_what_comes_times_the_reflectance(device):
    """Emitted = absorbed + escaped + cut in expectation, over 400 sets of photons, within 0.5 %."""
    scene = room(door=True)
    opened = open_renderer(device, scene, max_depth=5, **VIRTUAL)
    flight = Flight(opened)
    shapes = scene.shapes
    owner = np.repeat(np.arange(len(shapes)), [len(shape.mesh.triangles) for shape in shapes])
    colors = np.array([scene.materials[shape.material].base_color for shape in shapes])[owner]
    sums = []
    for _ in range(400):
        emitted, steps = flight.follow(2048)
        total, kept = emitted.sum(axis=0), np.zeros(3)
        for triangles, before, _ in steps:
            hit = triangles != layout.CONSTANT["NO_HIT"]
            kept += before[~hit].sum(axis=0)
            kept += (before[hit] * (1.0 - colors[triangles[hit]])).sum(axis=0)
        triangles, before, _ = steps[-1]
        hit = triangles != layout.CONSTANT["NO_HIT"]
        kept += (before[hit] * colors[triangles[hit]]).sum(axis=0)
        sums.append(kept / total)
    opened.close()
    sums = np.array(sums)
    error = sums.std(axis=0, ddof=1) / np.sqrt(len(sums))
    assert error.max() < 0.00125
    assert np.abs(sums.mean(axis=0) - 1.0).max() < 0.005


def test_slots_stand_for_all_photons_that_came_to_them(device):
    opened = open_renderer(device, room(), max_depth=3, **VIRTUAL)
    opened.render(spp=1)
    keys, counts = (opened.device.read(opened.buffers[f"virtual_{n}"]) for n in ("keys", "counts"))
    fates = opened.photon_map.counts()
    opened.close()
    np.testing.assert_array_equal(counts > 0, keys < 0xFFFFFFFF)
    # Two surfaces each: the first one of all, the next of those that were not absorbed there; but
    # the lamp reflects nothing.
    assert fates["emitted"] < counts.sum() < 2 * fates["emitted"]


def test_virtual_lights_bring_the_light_of_paths_and_are_dimmed_where_they_are_near(device):
    def mean(**settings):
        return render(device, room(), 256, max_depth=4, **settings).rgb.mean()

    paths = mean()
    clear = mean(virtual_clearance=0.0, **VIRTUAL)
    dimmed = mean(virtual_clearance=0.5, **VIRTUAL)
    direct = render(device, room(), 256, max_depth=1).rgb.mean()
    assert clear - direct == pytest.approx(paths - direct, rel=0.05)
    assert dimmed - direct < 0.92 * (paths - direct)


@pytest.mark.parametrize(
    ("settings", "error"),
    [
        ({"guiding": "learned"}, "indirect_light=virtual_lights needs guiding=off; got learned"),
        ({"path_filter": "hash_grid"}, "needs path_filter=off; got hash_grid"),
        ({"shadow_rays": "2"}, "needs shadow_rays=1; got 2"),
        ({"integrator": "metropolis"}, "integrator=metropolis needs indirect_light=paths"),
    ],
)
def test_what_does_not_go_with_virtual_lights_is_refused(settings, error):
    with pytest.raises(InputError, match=re.escape(error)):
        make_plan(room(), Settings(indirect_light="virtual_lights", **settings))


def test_virtual_lights_are_planned_where_light_is_reflected_twice():
    def stages(**values):
        plan = make_plan(room(), Settings(**values))
        return {stage.name for stage in plan.stages} & {"photons", "virtual_lights"}, plan.in_epochs

    assert stages() == (set(), False)
    both = {"photons", "virtual_lights"}
    assert stages(indirect_light="virtual_lights") == (both, True)
    assert stages(indirect_light="virtual_lights", max_depth=1) == (set(), False)
    # Direct photons alone choose lights: they end where they are stored.
    assert stages(light_sampling="photon") == ({"photons"}, True)


def test_lengths_of_paths_can_be_looked_at_too(device):
    image = render(device, room(), 1, ("bounces",), **VIRTUAL)
    assert np.isfinite(image.rgb).all() and (image.aovs["bounces"] >= 0.0).all()


def test_frames_have_photons_of_their_own(device):
    opened = open_renderer(device, room(), **VIRTUAL)
    keys = []
    for _ in range(2):
        opened.render(spp=1)
        keys.append(opened.device.read(opened.buffers["virtual_keys"]))
        opened.set_frame(0.0)
    opened.close()
    known = (keys[0] != 0xFFFFFFFF) & (keys[1] != 0xFFFFFFFF)
    assert known.sum() > 100 and not (keys[0] == keys[1])[known].any()
