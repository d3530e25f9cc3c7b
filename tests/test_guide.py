"""Directions drawn by what was learned, against closed forms, quadrature and a model in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import planes
import pytest
from scene_builder import (
    build,
    camera,
    floor,
    glowing,
    lambertian,
    luminance_blocks,
    render,
    renderer,
    z_scores,
)

from psf_cl.device import layout
from psf_cl.device.device import Device
from psf_cl.device.program import load_program
from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Material
from psf_cl.scheduler import MAX_PASSES
from psf_cl.settings import Settings
from psf_cl.stages import guide

FILE = "guide_test.cl"
SIDE = layout.CONSTANT["GUIDE_SIDE"]
PARTS = SIDE**2
LEARN = {"guiding": "learned"}


def random_sums(count, seed=3):
    """Return sums of cells: some of nothing, some of few visits, some of one bright part."""
    rng = np.random.default_rng(seed)
    sums = np.zeros(count, layout.GUIDE_SUM.dtype)
    visits = rng.poisson(10.0 ** rng.uniform(-2, 3, (count, 1)), (count, PARTS))
    value = visits * 10.0 ** rng.uniform(-3, 5, (count, PARTS)) * rng.random((count, 1))
    value[rng.random((count, PARTS)) < 0.3] = 0
    whole = value.astype(np.uint64)
    sums["count"] = visits
    sums["low"] = whole & np.uint64(0xFFFFFFFF)
    sums["high"] = whole >> np.uint64(32)
    return sums


def frozen(device, sums, share=0.75, steps=64.0, full=(), fades=0):
    """Return the cells that the device makes of ``sums``, and the sums afterwards."""
    count = len(sums)
    params = np.zeros(1, layout.PARAMS.dtype)
    params[0]["guide_slots"] = count
    params[0]["guide_share"] = share
    params[0]["guide_steps"] = steps
    marks = np.zeros(max(count // layout.CONSTANT["BUCKET_SLOTS"], 1), np.uint32)
    marks[list(full)] = 1
    buffers = {
        "params": device.upload("params", params),
        "guide_keys": device.upload("guide_keys", np.ones(count, np.uint32)),
        "guide_full": device.upload("guide_full", marks),
        "guide_sums": device.upload("guide_sums", sums),
        "guide_cells": device.allocate("guide_cells", layout.GUIDE_CELL.dtype, count),
    }
    features = dict.fromkeys(make_plan(room(), Settings()).features, 0) | {"GUIDE": 1}
    program = load_program(device, "guide.cl", features)
    program.bind("freeze_guide", **buffers, fades=fades)(count)
    found = device.read(buffers["guide_cells"]), device.read(buffers["guide_sums"])
    device.release(*buffers.values())
    return found


def model(sums, share, steps, trust=8.0):
    """Return densities and means of cells, in double precision: a pyramid from coarse to fine."""
    value = (sums["low"] + sums["high"] * 2.0**32).reshape(-1, SIDE, SIDE) / steps
    visits = sums["count"].astype(np.float64).reshape(-1, SIDE, SIDE)
    total = visits.sum(axis=(1, 2))
    known = value.sum(axis=(1, 2), keepdims=True) / np.maximum(total, 1)[:, None, None]
    side = 2
    while side <= SIDE:
        shape = (-1, side, SIDE // side, side, SIDE // side)
        around = known.repeat(2, axis=1).repeat(2, axis=2)
        seen = value.reshape(shape).sum(axis=(2, 4))
        n = visits.reshape(shape).sum(axis=(2, 4))
        known = (seen + trust * around) / (n + trust)
        side *= 2
    mean = known.mean(axis=(1, 2))
    taught = (total >= PARTS) & (mean > 0)
    part = np.where(taught, share, 0.0)[:, None, None]
    density = 1 - part + part * known / np.where(taught, mean, 1)[:, None, None]
    return density.reshape(-1, PARTS), mean


def room(size=(24, 16), **values):
    """Return a lamp behind a wall that lights a floor around the corner."""
    wall = transform.translation((0, 0.6, 0)) @ transform.rotation_xyz_degrees((90, 0, 0))
    lamp = transform.translation((0, 1.4, -1.5)) @ transform.rotation_xyz_degrees((180, 0, 0))
    back = transform.translation((0, 1.5, -2.5)) @ transform.rotation_xyz_degrees((90, 0, 0))
    return build(
        [
            floor(3.0, lambertian((0.7, 0.5, 0.3))),
            (primitives.quad(), wall @ transform.scaling(1.2), lambertian((0.3, 0.6, 0.8))),
            (primitives.quad(), back @ transform.scaling(3.0), lambertian((0.8, 0.8, 0.8))),
            (primitives.quad(), lamp @ transform.scaling(0.2), glowing((40.0, 30.0, 20.0))),
        ],
        camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        **values,
    )


def test_guiding_that_is_off_leaves_nothing_behind():
    plan = make_plan(room(), Settings())
    assert plan.features["GUIDE"].value == 0
    assert "guide" not in [stage.name for stage in plan.stages]
    assert dict(plan.left_out)["guide"] == "guiding is off"
    assert not plan.in_epochs
    assert make_plan(room(), Settings(**LEARN)).in_epochs


def test_metropolis_refuses_it():
    with pytest.raises(InputError, match="integrator=metropolis needs guiding=off"):
        make_plan(room(), Settings(integrator="metropolis", **LEARN))


def test_frozen_cells_are_those_of_the_model_and_integrate_to_1(device):
    sums = random_sums(1 << 14)
    cells, _ = frozen(device, sums, share=0.75, steps=64.0)
    density, mean = model(sums, 0.75, 64.0)
    np.testing.assert_allclose(cells["density"], density, rtol=2e-4)
    np.testing.assert_allclose(cells["mean"], mean, rtol=2e-5)
    # Each part has an equal share of the cosine: the integral is the mean.
    np.testing.assert_allclose(cells["density"].mean(axis=1), 1.0, rtol=2e-6)
    np.testing.assert_allclose(cells["rows"][:, -1], 1.0, rtol=1e-6)
    assert (cells["density"] >= 0.2499).all()


def test_sums_fade_by_half_and_full_buckets_are_given_up(device):
    sums = random_sums(256)
    cells, after = frozen(device, sums, full=(1,), fades=1)
    value = (sums["low"] + (sums["high"].astype(np.uint64) << np.uint64(32))) >> np.uint64(1)
    np.testing.assert_array_equal(after["low"], value & np.uint64(0xFFFFFFFF))
    np.testing.assert_array_equal(after["high"], value >> np.uint64(32))
    np.testing.assert_array_equal(after["count"], sums["count"] >> 1)
    bucket = layout.CONSTANT["BUCKET_SLOTS"]
    lost = slice(bucket, 2 * bucket)
    assert (cells["density"][lost] == 1).all() and not cells["visits"][lost].any()
    assert cells["visits"][:bucket].any() and not cells["mean"][lost].any()


def test_draws_are_dense_as_the_guide_says(lane_device):
    cells, _ = frozen(lane_device, random_sums(64))
    chosen = int(np.argmax(cells["density"].max(axis=1)))
    count = 1 << 18
    rng = np.random.default_rng(5)
    buffer = lane_device.upload("cells", cells)
    direction, part, density = planes.run(
        lane_device,
        FILE,
        "draw",
        {
            "u1": rng.random(count, np.float32) * np.float32(0.9999999),
            "u2": rng.random(count, np.float32) * np.float32(0.9999999),
            "slot": np.full(count, chosen, np.uint32),
        },
        {"direction": (np.float32, 3), "part": (np.uint32, 2), "density": (np.float32, 1)},
        cells=buffer,
    )
    np.testing.assert_allclose((direction.astype(np.float64) ** 2).sum(axis=0), 1.0, rtol=1e-5)
    # Rounding may move a direction over an edge.
    assert (part[0] == part[1]).mean() > 0.9999
    np.testing.assert_array_equal(density, cells["density"][chosen][part[1]])
    # Chi-square in rings of equal cosine, not in the parts: expected counts by quadrature.
    rings, sectors, fine = 4, 12, 64
    r2 = (np.arange(rings * fine) + 0.5) / (rings * fine)
    turn = (np.arange(sectors * fine) + 0.5) / (sectors * fine) * 2 * np.pi
    radius = np.sqrt(r2)[:, None]
    grid = np.stack([(radius * np.cos(turn)).ravel(), (radius * np.sin(turn)).ravel()])
    (at,) = planes.run(
        lane_device,
        FILE,
        "density_of",
        {
            "direction": grid.astype(np.float32),
            "slot": np.full(grid.shape[1], chosen, np.uint32),
        },
        {"density": (np.float32, 1)},
        cells=buffer,
    )
    lane_device.release(buffer)
    cell = at.reshape(rings, fine, sectors, fine).mean(axis=(1, 3), dtype=np.float64)
    np.testing.assert_allclose(cell.mean(), 1.0, atol=2e-3)
    ring = np.minimum((direction[0] ** 2 + direction[1] ** 2) * rings, rings - 1).astype(int)
    angle = np.arctan2(direction[1], direction[0]) / (2 * np.pi) % 1.0
    sector = np.minimum(angle * sectors, sectors - 1).astype(int)
    observed = np.bincount(ring * sectors + sector, minlength=rings * sectors)
    expected = cell.ravel() / cell.sum() * count
    # Of 47 degrees of freedom the mean is 47, the spread 10; quadrature errs by a percent of it.
    assert ((observed - expected) ** 2 / expected).sum() < 120


def test_points_without_a_cell_are_drawn_by_the_cosine(lane_device):
    count = 1 << 16
    rng = np.random.default_rng(6)
    cells = lane_device.allocate("cells", layout.GUIDE_CELL.dtype, 1)
    direction, _, density = planes.run(
        lane_device,
        FILE,
        "draw",
        {
            "u1": rng.random(count, np.float32) * np.float32(0.9999999),
            "u2": rng.random(count, np.float32) * np.float32(0.9999999),
            "slot": np.full(count, 0xFFFFFFFF, np.uint32),
        },
        {"direction": (np.float32, 3), "part": (np.uint32, 2), "density": (np.float32, 1)},
        cells=cells,
    )
    lane_device.release(cells)
    assert (density == 1).all()
    # Mean cosine 2/3 with a variance of 1/18; the square of the radius is uniform.
    assert abs(direction[2].mean() - 2 / 3) < 4 * np.sqrt(1 / 18 / count)
    assert abs((direction[0] ** 2 + direction[1] ** 2).mean() - 0.5) < 4 * np.sqrt(1 / 12 / count)
    assert np.abs(direction[:2].mean(axis=1)).max() < 4 * np.sqrt(0.25 / count)


def test_frames_are_right_handed_and_turn_little_on_a_side_of_the_cube(lane_device):
    rng = np.random.default_rng(7)
    normal = rng.standard_normal((3, 4096))
    normal[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    normal = (normal / np.linalg.norm(normal, axis=0)).astype(np.float32)
    moved = normal + np.float32(1e-4) * rng.standard_normal(normal.shape).astype(np.float32)
    moved /= np.linalg.norm(moved, axis=0)
    frames = []
    for n in (normal, moved):
        (frame,) = planes.run(
            lane_device, FILE, "frame_of", {"normal": n}, {"frame": (np.float32, 6)}
        )
        s, t = frame[:3], frame[3:]
        np.testing.assert_allclose(np.cross(s.T, t.T), n.T, atol=3e-6)
        np.testing.assert_allclose((s * n).sum(axis=0), 0, atol=1e-6)
        frames.append(frame)
    axes = [np.argmax(np.abs(n), axis=0) for n in (normal, moved)]
    same = axes[0] == axes[1]
    assert same.mean() > 0.99
    assert np.abs(frames[0] - frames[1])[:, same].max() < 3e-3


@pytest.fixture(scope="module")
def small(device):
    """Return the device with a small pool, so that epochs are short."""
    traits = replace(device.traits, slots=1024)
    return Device(device.context, traits)


def noisy(device, spp, **settings):
    """Return an image of independent samples with their variance."""
    return render(device, room(), spp, outputs=("variance",), sampler="random", **settings)


@pytest.fixture(scope="module")
def plain(small):
    return noisy(small, 256)


@pytest.fixture(scope="module")
def learned(small):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guide, "MOST_NOISE_LEFT", 1.0)
        return noisy(small, 256, **LEARN)


def test_guided_paths_agree_with_plain_ones(plain, learned):
    # 16 blocks: the largest of so many standard normals is below 4 with a chance of 0.999.
    assert np.abs(z_scores(learned, plain, 4)).max() < 4


def test_fewer_paths_bring_nothing_and_variance_falls(plain, learned):
    dark = [image.stats["paths"]["zero_contribution"] for image in (learned, plain)]
    assert dark[0] < 0.95 * dark[1]
    variance = [luminance_blocks(image, 1)[1].item() for image in (learned, plain)]
    assert variance[0] < 0.85 * variance[1]


def test_bits_do_not_depend_on_the_pool(device, small):
    image = noisy(small, 20, **LEARN)
    assert noisy(small, 20, **LEARN).rgb.tobytes() == image.rgb.tobytes()
    larger = Device(device.context, replace(device.traits, slots=4096))
    assert noisy(larger, 20, **LEARN).rgb.tobytes() == image.rgb.tobytes()


def shown(device, density):
    """Return what is shown of a guide whose cells all have this density, of a floor from above."""
    scene = build(
        [floor(3.0, lambertian(0.5))], camera((0, 3, 0.1), (0, 0, 0), 30), (8, 8), environment=1.0
    )
    opened = renderer(device, scene, tuple(guide.VIEWS), **LEARN)
    opened.render(spp=1)
    cells = opened.device.read(opened.buffers["guide_cells"])
    cells["density"], cells["visits"] = density, 7.0
    opened.device.write(opened.buffers["guide_cells"], cells)
    aovs = opened.image().aovs
    opened.close()
    return aovs


@pytest.mark.parametrize(("row", "column"), [(0, 3), (4, 4), (6, 1)])
def test_images_of_the_guide_show_the_part_that_it_draws(small, row, column):
    density = np.zeros((SIDE, SIDE))
    density[row, column] = PARTS
    aovs = shown(small, density.ravel())
    np.testing.assert_allclose(aovs["guide_entropy"], 0.0, atol=1e-5)
    np.testing.assert_allclose(aovs["visits"], 7.0, rtol=1e-6)
    # The concentric map of the middle of the part, on a floor whose tangents are z and x.
    a, b = (2 * (np.array([row, column]) + 0.5) / SIDE - 1).tolist()
    radius, angle = (
        (a, np.pi / 4 * b / a) if abs(a) > abs(b) else (b, np.pi / 2 - np.pi / 4 * a / b)
    )
    z, x = radius * np.cos(angle), radius * np.sin(angle)
    expected = np.broadcast_to([x, np.sqrt(1 - x * x - z * z), z], (8, 8, 3))
    np.testing.assert_allclose(aovs["guide"], expected, atol=1e-5)


def test_images_of_a_guide_that_knows_nothing_are_those_of_the_cosine(small):
    aovs = shown(small, 1.0)
    np.testing.assert_allclose(aovs["guide_entropy"], 6.0, atol=1e-4)
    # Of the middles of the parts: squares around the middle become circles.
    middles = 2 * (np.arange(SIDE) + 0.5) / SIDE - 1
    radius = np.maximum(np.abs(middles)[:, None], np.abs(middles))
    up = np.broadcast_to([0, np.sqrt(1 - radius**2).mean(), 0], (8, 8, 3))
    np.testing.assert_allclose(aovs["guide"], up, atol=1e-5)


def test_images_of_a_guide_are_refused_where_there_is_none():
    with pytest.raises(InputError, match="--aov: guide, visits needs guiding=learned"):
        make_plan(room(), Settings(), ["guide", "visits"])


def patched(opened, **values):
    """Change parameters that no setting has."""
    params = opened.device.read(opened.buffers["params"])
    for name, value in values.items():
        params[name] = value
    opened.device.write(opened.buffers["params"], params)
    return opened


def test_full_tables_cost_the_guide_and_nothing_else(small, plain):
    opened = patched(renderer(small, room(), ("variance",), sampler="random", **LEARN))
    patched(opened, guide_slots=16, guide_least=2.0**-6, guide_most=2.0**-6)
    opened.render(spp=128)
    image = opened.image()
    assert opened.device.read(opened.buffers["guide_full"])[0] == 1
    assert not opened.device.read(opened.buffers["guide_cells"])["visits"].any()
    opened.close()
    assert image.stats["guide"]["failed_inserts"] > 0
    assert np.abs(z_scores(image, plain, 2)).max() < 4


def test_noise_that_is_left_is_what_the_model_says():
    cells = np.zeros(3, layout.GUIDE_CELL.dtype)
    cells["visits"] = 100.0
    cells["density"] = 1.0
    # Light from everywhere alike: nothing to gain.  From half of the parts, q = 2 there: guided by
    # three quarters 4 / (0.25 + 0.75 * 2) against 4.  Nothing is known of the third cell.
    assert guide.noise_left(cells, 0.75) == 1.0
    cells["density"][1] = np.where(np.arange(PARTS) % 2, 1.75, 0.25)
    cells["visits"][2] = 1.0
    cells["density"][2] = 7.0
    assert guide.noise_left(cells, 0.75) == pytest.approx((1 + 2 / 1.75) / (1 + 2))
    assert guide.noise_left(cells[:0], 0.75) == 1.0


def test_guide_that_does_not_pay_is_left_out(small, monkeypatch):
    """In a furnace all light is alike."""
    monkeypatch.setattr(guide, "ENOUGH_VISITS", 1.0)
    white = lambertian((0.5, 0.5, 0.5))
    ball = (primitives.sphere(12, 8), np.eye(4), white)
    scene = build([ball], camera((0, 0, 3), (0, 0, 0), 45), (24, 16), environment=1.0)
    opened = renderer(small, scene, ("samples",), **LEARN)
    opened.render(spp=24)
    image = opened.image()
    assert image.stats["guide"]["left_out"]
    assert image.stats["guide"]["noise_left"] > 0.9
    # From then on its programs are those of a render that has none, and the pool never drains.
    assert all(program.defines.get("GUIDE", 0) == 0 for program in opened.programs.values())
    assert opened.scheduler.epoch.stop == MAX_PASSES
    opened.close()
    np.testing.assert_array_equal(image.aovs["samples"], 24)


@pytest.mark.parametrize(("halvings", "weight"), [(0, 1), (1, 0.5), (2, 0.25), (3, 0.125)])
def test_faded_film_keeps_its_means_and_counts_for_less(lane_device, halvings, weight):
    rng = np.random.default_rng(5)
    planes, pixels = 3, 37
    sums = np.zeros(planes * pixels, layout.FILM_SUM.dtype)
    sums["count"] = 8
    sums["sum"] = rng.exponential(1e3, (len(sums), 3))
    sums["lost"] = rng.normal(0, 1e-4, (len(sums), 3))
    sums["mean"] = sums["sum"].mean(axis=1) / 8
    sums["squares"] = rng.exponential(1e6, len(sums))
    sums["lost_squares"] = rng.normal(0, 1e-2, len(sums))
    sums["count"][:2] = 0, 1
    sums["count"][-1] = 0
    params = np.zeros(1, layout.PARAMS.dtype)
    params[0]["pixel_count"] = pixels
    film = lane_device.upload("film", sums)
    features = dict.fromkeys(make_plan(room(), Settings()).features, 0) | {"GUIDE": 1}
    program = load_program(lane_device, "guide.cl", features)
    params_buffer = lane_device.upload("params", params)
    launch = program.bind(
        "fade_film", params=params_buffer, film=film, planes=planes, halvings=halvings
    )
    launch(-(-len(sums) // lane_device.traits.lanes))
    found = lane_device.read(film)
    lane_device.release(film, params_buffer)
    # Nothing was added, or only one sample: no part of that can be taken.
    weights = np.full(len(sums), weight)
    weights[[0, 1, -1]] = 1
    np.testing.assert_array_equal(found["count"], sums["count"] * weights)
    for name, power in (("sum", 1), ("lost", 1), ("mean", 0), ("squares", 2), ("lost_squares", 2)):
        factor = (weights**power).reshape(-1, *[1] * (sums[name].ndim - 1))
        np.testing.assert_allclose(found[name], sums[name] * factor, rtol=1e-6, err_msg=name)


def test_first_passes_count_for_less_where_the_guide_stays(small, monkeypatch):
    """From what is there after 8 and 24 passes of equal weight follows what has other weights."""
    monkeypatch.setattr(guide, "MOST_NOISE_LEFT", 1.0)

    def images(halvings):
        monkeypatch.setattr(guide, "EARLY_HALVINGS", ((1.0, halvings),))
        opened = renderer(small, room(), ("samples", "direct"), sampler="random", **LEARN)
        found = []
        for spp in (8, 24):
            opened.render(spp=spp)
            found.append(opened.image().aovs)
        opened.close()
        return found

    early, even = images(0)
    again, faded = images(2)
    np.testing.assert_array_equal(again["rgb"], early["rgb"])
    np.testing.assert_array_equal(faded["samples"], 8 / 4 + 16)
    for name in ("rgb", "direct"):
        late = (24 * even[name].astype(np.float64) - 8 * early[name]) / 16
        expected = (2 * early[name] + 16 * late) / 18
        np.testing.assert_allclose(faded[name], expected, rtol=1e-4, atol=1e-5)
    assert np.abs(faded["rgb"] - even["rgb"]).max() > 1e-2


@pytest.mark.parametrize("frames", [False, True])
def test_what_is_known_from_the_start_is_not_faded(small, monkeypatch, tmp_path, frames):
    """Neither frames after the first nor renders that begin with a cache fade what they have."""
    monkeypatch.setattr(guide, "MOST_NOISE_LEFT", 1.0)
    monkeypatch.setattr(guide, "EARLY_HALVINGS", ((1.0, 2),))
    opened = renderer(small, room(), ("samples",), **LEARN)
    opened.render(spp=4)
    if frames:
        opened.set_frame(0.0)
    else:
        opened.save_cache(tmp_path / "a.cache")
        opened.close()
        opened = renderer(small, room(), ("samples",), **LEARN)
        opened.load_cache(tmp_path / "a.cache")
    opened.render(spp=16)
    samples = opened.image().aovs["samples"]
    opened.close()
    np.testing.assert_array_equal(samples, 16)


def test_guide_comes_back_to_a_sequence_that_changes(small, monkeypatch):
    """Left out on a still scene it stays so; after a change and enough passes it is tried again."""
    monkeypatch.setattr(guide, "PASSES_WITHOUT", 8)
    opened = renderer(small, room(), **LEARN)
    opened.render(spp=2)
    opened._guide(False, 2)
    opened.set_frame(0.0)
    opened.render(spp=12)
    assert opened.guide_out == 2
    opened.set_frame(0.0)
    opened.changed = True
    opened.render(spp=2)
    stats = opened.stats()
    samples = opened.image().aovs
    opened.close()
    assert opened.guide_out is None and not stats["guide"]["left_out"]
    assert samples["rgb"].mean() > 0


def test_light_too_bright_for_the_sums_is_counted_and_left_out(small):
    opened = patched(renderer(small, room(), **LEARN), guide_limit=1e-9)
    opened.render(spp=4)
    stats = opened.image().stats
    sums = opened.device.read(opened.buffers["guide_sums"])
    opened.close()
    assert stats["guide"]["rejected"] > 0
    assert not sums["low"].any() and not sums["high"].any()


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.4, 1.0])
def test_guided_paths_agree_with_plain_ones_on_glossy_things(small, roughness):
    shiny = Material(base_color=(0.6, 0.5, 0.4), roughness=roughness)
    shapes = [replace(shape, material=0) for shape in room().shapes[:3]] + [room().shapes[3]]
    scene = room((32, 32))
    scene = replace(scene, materials=(shiny, *scene.materials[1:]), shapes=tuple(shapes))
    scene = replace(scene, environment=Environment(radiance=(0.05, 0.06, 0.08)))
    images = [
        render(small, scene, 512, outputs=("variance",), sampler="random", **more)
        for more in ({}, LEARN)
    ]
    assert np.abs(z_scores(*images, 4)).max() < 4
