"""The film: sums of whole passes, in their order, whatever the order in which samples come."""

import numpy as np
import pytest
from scene_builder import build, camera

from psf_cl.device import layout
from psf_cl.device.program import load_program
from psf_cl.plan import make_plan
from psf_cl.settings import Settings

AT = layout.COUNTER_INDEX


class Film:
    """add_samples and advance_film on buffers of their own."""

    def __init__(self, device, pixel_count, ring, planes=1):
        self.device, self.pixel_count, self.ring, self.planes = device, pixel_count, ring, planes
        params = np.zeros(1, layout.PARAMS.dtype)
        params["pixel_count"], params["ring"] = pixel_count, ring
        film = np.zeros(planes * pixel_count, layout.FILM_SUM.dtype)
        self.buffers = {
            "params": device.upload("params", params),
            "samples": device.allocate("samples", np.float32, planes * ring * pixel_count * 4),
            "counters": device.allocate("counters", np.uint32, AT["finished"] + ring),
            "film": device.upload("film", film),
        }
        program = load_program(device, "film.cl")
        self.add, self.add_partial = (
            program.bind("add_samples", planes=planes, partial=partial, **self.buffers)
            for partial in (0, 1)
        )
        self.advance = program.bind(
            "advance_film", params=self.buffers["params"], counters=self.buffers["counters"]
        )
        self.limit(2**31)

    def count(self, name, index=0):
        return int(self.device.read(self.buffers["counters"], 1, AT[name] + index)[0])

    def set(self, name, value, index=0):
        values = np.array([value], np.uint32)
        self.device.write(self.buffers["counters"], values, AT[name] + index)

    def limit(self, passes):
        self.set("pass_limit", passes)

    def put(self, pass_index, samples, done=True):
        """Write the samples of a pass, ``(planes, pixels, 4)``, into its place of the ring."""
        slot = pass_index % self.ring
        samples = np.broadcast_to(samples, (self.planes, self.pixel_count, 4)).astype(np.float32)
        for plane in range(self.planes):
            at = (plane * self.ring + slot) * self.pixel_count * 4
            self.device.write(self.buffers["samples"], samples[plane].ravel(), at)
        if done:
            self.set("finished", self.pixel_count, slot)

    def launch(self):
        self.add(self.planes * self.pixel_count, 8)
        self.advance(1)

    def read(self):
        return self.device.read(self.buffers["film"]).reshape(self.planes, -1)

    def release(self):
        self.device.release(*self.buffers.values())


@pytest.fixture
def film(device):
    made = []

    def build(*arguments, **options):
        made.append(Film(device, *arguments, **options))
        return made[-1]

    yield build
    for item in made:
        item.release()


def passes_of(count, pixels, seed=0):
    """Return positive samples of weight 1 that span six decades, ``(count, pixels, 4)``."""
    rng = np.random.default_rng(seed)
    samples = (10.0 ** rng.uniform(-3, 3, (count, pixels, 4))).astype(np.float32)
    samples[..., 3] = 1
    return samples


def sums_of(film):
    return film["sum"].astype(np.float64) - film["lost"]


def test_sums_means_and_variances_equal_double_precision(film):
    passes = passes_of(100, 37)
    f = film(37, ring=4)
    for k, samples in enumerate(passes):
        f.put(k, samples)
        f.launch()
    (found,) = f.read()
    exact = passes.astype(np.float64)
    np.testing.assert_array_equal(found["count"], 100)
    np.testing.assert_allclose(sums_of(found), exact[..., :3].sum(axis=0), rtol=2e-7)
    level = exact[..., :3] @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(found["mean"], level.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found["squares"] / 99, level.var(axis=0, ddof=1), rtol=1e-4)


def test_sums_go_on_growing_when_a_sample_is_far_below_their_last_digit(film):
    f = film(8, ring=8)
    f.put(0, [1e6, 1e6, 1e6, 1])
    f.launch()
    # A plain sum of floats would stay at 1e6: the step there is 0.0625.
    for start in range(1, 2001, 8):
        for k in range(start, start + 8):
            f.put(k, [0.01, 0.02, 0.03, 1])
        f.launch()
    (found,) = f.read()
    assert f.count("film_pass") == 2001
    expected = 1e6 + 2000 * np.array([0.01, 0.02, 0.03])
    np.testing.assert_allclose(sums_of(found), np.tile(expected, (8, 1)), rtol=0, atol=2e-3)


def test_nothing_stalls_beyond_two_to_the_24_samples(film):
    """A float has steps of 4 there, and these samples are 0 and 2."""
    f, before = film(8, ring=8), 1 << 25
    state = np.zeros(8, layout.FILM_SUM.dtype)
    state["sum"], state["count"], state["mean"], state["squares"] = before, before, 1.0, before
    f.device.write(f.buffers["film"], state)
    for start in range(0, 800, 8):
        for k in range(start, start + 8):
            f.put(k, [2.0 * (k % 2)] * 3 + [1])
        f.launch()
    (found,) = f.read()
    np.testing.assert_array_equal(found["count"], before + 800)
    np.testing.assert_array_equal(sums_of(found), before + 800)
    squares = found["squares"].astype(np.float64) - found["lost_squares"]
    np.testing.assert_allclose(squares, before + 800, rtol=0, atol=1)


def hand_in(device, radiance, direct):
    """Let regenerate_paths hand in finished paths; return both rings and the rejected samples."""
    traits, count = device.traits, len(radiance)
    pool = np.zeros((traits.slots // traits.block, len(layout.PATH_FIELDS), traits.block), "f4")
    places = {name: index for index, (name, _) in enumerate(layout.PATH_FIELDS)}
    slot = np.arange(count)
    at = slot // traits.block, slot % traits.block
    for field, values in (("radiance_r", radiance), ("direct_r", direct)):
        for channel in range(3):
            pool[at[0], places[field] + channel, at[1]] = values[:, channel]
    words = pool.view(np.uint32)
    words[at[0], places["status"], at[1]] = layout.CONSTANT["STATUS_DONE"]
    words[at[0], places["pixel"], at[1]] = slot
    params = np.zeros(1, layout.PARAMS.dtype)
    params["pixel_count"], params["ring"], params["slots"] = count, 1, traits.slots
    params["crop_width"], params["crop_height"] = count, 1
    buffers = {
        "params": device.upload("params", params),
        "pool": device.upload("pool", pool.ravel()),
        "counters": device.allocate("counters", np.uint32, AT["finished"] + 1),
        "samples": device.allocate("samples", np.float32, count * 4),
        "direct": device.allocate("direct", np.float32, count * 4),
    }
    features = make_plan(build([], camera((0, 0, 1), (0, 0, 0), 40)), Settings()).features
    flags = dict.fromkeys(features, 0) | {"AOV_DIRECT": 1}
    program = load_program(device, "camera.cl", flags)
    program.bind("regenerate_paths", **buffers)(traits.slots // traits.lanes)
    rings = [device.read(buffers[name]).reshape(count, 4) for name in ("samples", "direct")]
    counters = device.read(buffers["counters"])
    device.release(*buffers.values())
    assert counters[AT["finished"]] == count
    return *rings, counters[AT["rejected_samples"]]


def test_samples_that_cannot_be_summed_are_handed_in_as_black_and_counted(lane_device):
    largest = float(np.nextafter(np.float32(2.0**96), np.float32(0)))
    radiance = np.ones((40, 3), np.float32)
    direct = np.full((40, 3), 0.5, np.float32)
    for k, value in enumerate([np.nan, np.inf, -np.inf, -np.nan, 2.0**96, -(2.0**96)]):
        for channel in range(3):
            radiance[3 * k + channel, channel] = value
    radiance[20] = [-1.0, 0.0, largest]
    direct[25, 1] = np.nan
    samples, parts, rejected = hand_in(lane_device, radiance, direct)
    bad = np.arange(40) < 18
    bad[25] = True
    assert rejected == 19
    np.testing.assert_array_equal(samples[:, :3], np.where(bad[:, None], 0, radiance))
    # The direct part goes with the whole, or the indirect part would be negative.
    np.testing.assert_array_equal(parts[:, :3], np.where(bad[:, None], 0, direct))
    # A rejected sample counts as black: the mean must not depend on how many there were.
    assert (samples[:, 3] == 1).all() and (parts[:, 3] == 1).all()


def test_samples_without_weight_are_no_samples(film):
    samples = np.ones((10, 4))
    samples[::2, 3] = 0
    samples[::2, 0] = np.nan
    f = film(10, ring=1)
    f.put(0, samples)
    f.launch()
    (found,) = f.read()
    np.testing.assert_array_equal(found["count"], [0, 1] * 5)
    np.testing.assert_array_equal(found["sum"][:, 0], [0, 1] * 5)


def test_passes_are_added_whole_and_in_order(film):
    """Pass 1 is ready before pass 0: nothing may be added, then both."""
    passes = passes_of(2, 11, seed=1)
    f = film(11, ring=4)
    f.put(1, passes[1])
    f.launch()
    assert f.count("film_pass") == 0 and not f.read()["count"].any()
    f.put(0, passes[0], done=False)
    f.set("finished", 10, 0)
    f.launch()
    assert f.count("film_pass") == 0 and not f.read()["count"].any()
    f.set("finished", 11, 0)
    f.launch()
    assert f.count("film_pass") == 2
    np.testing.assert_array_equal(f.read()["count"], 2)
    # Their counts are cleared for the passes that come round next.
    assert [f.count("finished", k) for k in range(4)] == [0, 0, 0, 0]


@pytest.mark.parametrize("ring", [1, 2, 8])
def test_bits_do_not_depend_on_ring_or_order_of_completion(film, ring):
    passes = passes_of(24, 19, seed=2)
    one = film(19, ring=1)
    for k, samples in enumerate(passes):
        one.put(k, samples)
        one.launch()
    other = film(19, ring=ring)
    rng = np.random.default_rng(ring)
    for start in range(0, 24, ring):
        # Every order within what the ring may hold; the film is asked after each pass.
        for k in rng.permutation(np.arange(start, start + ring)):
            other.put(int(k), passes[k])
            other.launch()
    assert other.count("film_pass") == 24
    assert one.read().tobytes() == other.read().tobytes()


def test_passes_beyond_the_limit_wait(film):
    passes = passes_of(3, 5)
    f = film(5, ring=4)
    f.limit(2)
    for k in range(3):
        f.put(k, passes[k])
    f.launch()
    assert f.count("film_pass") == 2
    np.testing.assert_array_equal(f.read()["count"], 2)
    f.limit(3)
    f.launch()
    assert f.count("film_pass") == 3
    exact = passes[..., :3].astype(np.float64).sum(axis=0)
    np.testing.assert_allclose(sums_of(f.read()[0]), exact, rtol=2e-7)


def test_partial_passes_add_the_samples_that_are_there(film):
    samples = passes_of(1, 12)[0]
    samples[5:, 3] = 0
    f = film(12, ring=4)
    f.put(0, samples, done=False)
    f.put(1, np.ones(4), done=False)
    f.set("finished", 5, 0)
    f.add_partial(12, 8)
    (found,) = f.read()
    np.testing.assert_array_equal(found["count"], [1] * 5 + [0] * 7)
    np.testing.assert_array_equal(found["sum"][:5], samples[:5, :3])
    assert not found["sum"][5:].any()
    assert f.count("film_pass") == 0


def test_planes_keep_apart(film):
    samples = np.stack([passes_of(1, 9, seed)[0] for seed in range(3)])
    f = film(9, ring=2, planes=3)
    for k in range(3):
        f.put(k, samples * (k + 1) * [1, 1, 1, 1 / (k + 1)])
        f.launch()
    found = f.read()
    np.testing.assert_allclose(sums_of(found), samples[..., :3] * 6.0, rtol=1e-6)
    np.testing.assert_array_equal(found["count"], 3)


def test_counters_of_rays_carry_into_their_high_words_and_the_queue_stays_small(film):
    f = film(10, ring=2)
    f.set("camera_rays", 2**32 - 5)
    f.set("pending_camera", 7)
    f.set("bounce_rays", 100)
    f.set("pending_bounce", 11)
    f.set("next_pixel", 37)
    f.set("next_pass", 4)
    f.launch()
    assert (f.count("camera_rays"), f.count("camera_rays_high")) == (2, 1)
    assert (f.count("bounce_rays"), f.count("bounce_rays_high")) == (111, 0)
    assert f.count("pending_camera") == f.count("pending_bounce") == 0
    assert (f.count("next_pass"), f.count("next_pixel")) == (7, 7)
