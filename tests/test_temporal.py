"""Frames that share light: closed forms, images of as many samples, what must not be shared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, lambertian, render, renderer

from psf_cl.device.device import open_device
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.curve import Curve
from psf_cl.scene.load import load_scene
from psf_cl.settings import Settings

OUTPUTS = ("history", "alpha", "motion", "gradient")
SIZE = (40, 30)


LAMP = np.array((8.0, 6.0, 4.0))


def room(size=SIZE, view=None, sky=0.2, factor=1.0, change=None):
    """Return a lamp over a floor with a ball on it, under a sky.

    Args:
        factor: of the lamp's radiance.
        change: (frame, factor from it on), or None if the lamp stays as it is.
    """
    curve = None
    if change is not None:
        times = np.array((0.0, change[0] / 24))
        curve = Curve(times, np.array((LAMP, LAMP * change[1])), "step")
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    ball = transform.translation((-0.3, 0.5, 0.5)) @ transform.scaling(0.5)
    shade = glowing(LAMP * factor, emission_curve=curve)
    return build(
        [
            floor(3.0, lambertian((0.7, 0.5, 0.3))),
            (primitives.sphere(8, 6), ball, lambertian((0.3, 0.6, 0.8))),
            (
                primitives.quad(),
                over @ transform.scaling(0.3),
                shade,
            ),
        ],
        view or camera((0, 1.5, 3), (0, 0.5, 0), 45),
        size,
        environment=sky,
    )


def sequence(device, scene, frames, spp=1, views=(), outputs=OUTPUTS, **settings):
    """Return the images of so many frames; ``views`` are their cameras, if it moves."""
    opened = renderer(device, scene, outputs, **settings)
    images = []
    for frame in range(frames):
        if frame:
            if views:
                opened.moving = replace(opened.moving, cameras=(views[frame],))
            opened.set_frame(frame / 24)
        opened.render(spp=spp)
        images.append(opened.image())
    opened.close()
    return images


def error_of(rgb, truth):
    return float(np.mean((rgb - truth) ** 2 / (truth**2 + 0.01)))


def test_frames_that_share_nothing_leave_nothing_behind():
    plan = make_plan(room(), Settings())
    assert plan.features["TEMPORAL"].value == plan.features["SEEN"].value == 0
    assert not {"seen", "temporal"} & {stage.name for stage in plan.stages}
    assert dict(plan.left_out)["temporal"] == "temporal is off"
    on = make_plan(room(), Settings(temporal="adaptive"))
    assert {"seen", "temporal"} <= {stage.name for stage in on.stages}
    assert on.features["BASE"].value == 0


def test_frames_of_a_still_scene_become_the_image_of_all_their_samples(device):
    """Passes go on from frame to frame, so that 16 frames have the samples of 16 passes."""
    images = sequence(device, room(), 16, temporal="cumulative")
    np.testing.assert_allclose(images[-1].rgb, render(device, room(), 16).rgb, atol=1e-5)
    for number, image in enumerate(images, start=1):
        # Nothing is rejected, at no edge either.
        np.testing.assert_array_equal(image.aovs["history"], number)
        np.testing.assert_allclose(image.aovs["alpha"], 1 / number, rtol=1e-6)
        np.testing.assert_array_equal(image.aovs["motion"], 0.0)


def test_a_frame_of_more_samples_weighs_more(device):
    opened = renderer(device, room(), OUTPUTS, temporal="cumulative")
    opened.render(spp=1)
    opened.set_frame(0.1)
    opened.render(spp=3)
    image = opened.image()
    opened.close()
    np.testing.assert_array_equal(image.aovs["alpha"], 0.75)
    np.testing.assert_allclose(image.rgb, render(device, room(), 4).rgb, atol=1e-5)


def test_adaptive_has_the_bits_of_cumulative_while_nothing_changes(device):
    # The lamp has a curve, so that probes look at it.
    scene = room(change=(3, 1.0))
    assert make_plan(scene, Settings(temporal="adaptive")).features["TEMPORAL"].value == 2
    truth = sequence(device, scene, 6, temporal="cumulative")
    images = sequence(device, scene, 6, temporal="adaptive")
    for image, expected in zip(images, truth, strict=True):
        assert image.rgb.tobytes() == expected.rgb.tobytes()


def test_exponential_follows_its_recurrence_and_reaches_its_variance(device):
    """Independent samples of variance v: (1 - a) and a of it leave a / (2 - a) v in the end."""
    alpha, frames = 0.25, 24
    settings = {"sampler": "random", "seed": 5}
    alone = sequence(device, room(), frames, **settings)
    images = sequence(
        device, room(), frames, temporal="exponential", temporal_alpha=alpha, **settings
    )
    expected = alone[0].rgb.astype(np.float64)
    for image, own in zip(images[1:], alone[1:], strict=True):
        expected = (1 - alpha) * expected + alpha * own.rgb
        np.testing.assert_allclose(image.rgb, expected, rtol=1e-4, atol=1e-6)
    truth = render(device, room(), 256, sampler="random", seed=9).rgb
    single = np.mean([(image.rgb - truth) ** 2 for image in alone])
    left = np.mean([(image.rgb - truth) ** 2 for image in images[12:]])
    assert left / single == pytest.approx(alpha / (2 - alpha), rel=0.2)


def test_a_camera_that_moves_by_pixels_takes_its_history_along(device):
    """A wall across the view: history moves with it, whole pixels, and is new where it comes in."""
    wall = transform.rotation_xyz_degrees((90, 0, 0))
    size, distance = (32, 24), 2.0
    footprint = distance * 2 * np.tan(np.radians(20)) / size[1]
    views = [
        camera((step * footprint, 0, distance), (step * footprint, 0, 0), 40) for step in (0, 3, 6)
    ]
    parts = [(primitives.quad(), wall @ transform.scaling(50.0), lambertian(0.5))]
    scene = build(parts, views[0], size, environment=1.0)
    images = sequence(device, scene, 3, views=views, temporal="cumulative")
    np.testing.assert_allclose(images[1].aovs["motion"][..., 0], -3.0, atol=1e-3)
    np.testing.assert_allclose(images[1].aovs["motion"][..., 1], 0.0, atol=1e-3)
    history = np.broadcast_to(np.minimum((31 - np.arange(32)) // 3 + 1, 3), (24, 32))
    np.testing.assert_allclose(images[2].aovs["history"][..., 0], history, atol=1e-3)
    # What was seen before is the mean of what the frames saw there.
    alone = sequence(device, scene, 3, views=views)
    mean = (alone[0].rgb[:, 6:] + alone[1].rgb[:, 3:-3] + alone[2].rgb[:, :-6]) / 3
    np.testing.assert_allclose(images[2].rgb[:, :-6], mean, atol=2e-3)


def test_what_a_moving_camera_newly_sees_has_no_history(device):
    views = [camera((0.1 * k, 1.5, 3), (0.1 * k, 0.5, 0), 45) for k in range(4)]
    images = sequence(device, room(), 4, views=views, temporal="cumulative")
    alone = sequence(device, room(), 4, views=views)
    fresh = images[-1].aovs["alpha"][..., 0] == 1.0
    # Behind the ball, at the border, at edges; most of the picture is known.
    assert 0.02 < fresh.mean() < 0.4
    np.testing.assert_array_equal(images[-1].rgb[fresh], alone[-1].rgb[fresh])
    truth = render(device, replace(room(), cameras=(views[-1],)), 256).rgb
    error = [np.mean((s[-1].rgb - truth) ** 2 / (truth**2 + 0.01)) for s in (images, alone)]
    assert error[0] < 0.5 * error[1]


def test_a_cut_to_another_camera_starts_anew(device):
    views = [camera((0, 1.5, 3), (0, 0.5, 0), 45), camera((3, 1.0, 0), (0, 0.5, 0), 30)]
    images = sequence(device, room(), 2, views=views, temporal="cumulative")
    alone = sequence(device, room(), 2, views=views)
    fresh = images[1].aovs["alpha"][..., 0] == 1.0
    np.testing.assert_array_equal(images[1].rgb[fresh], alone[1].rgb[fresh])
    # The floor may show the same place to both: what is kept is right, not only plausible.
    truth = render(device, replace(room(), cameras=(views[1],)), 256).rgb
    error = [np.mean((s[1].rgb - truth) ** 2) for s in (images, alone)]
    assert fresh.mean() > 0.5 and error[0] < 1.2 * error[1]


def test_sequences_have_the_same_bits_for_any_pool_and_any_number_of_looks(device):
    views = [camera((0.05 * k, 1.5, 3), (0, 0.5, 0), 45) for k in range(4)]
    settings = {"temporal": "adaptive", "screen_filter": "path_space"}
    truth = sequence(device, room(), 4, spp=2, views=views, **settings)
    small = open_device(traits=replace(device.traits, slots=128))
    opened = renderer(small, room(), **settings)
    for view, image in zip(views, truth, strict=True):
        if view is not views[0]:
            opened.moving = replace(opened.moving, cameras=(view,))
            opened.set_frame(0.0)
        for _ in range(2):
            opened.step()
            opened.snapshot()
        np.testing.assert_array_equal(opened.snapshot().rgb, image.rgb)
    opened.close()


def test_probes_find_nothing_while_only_the_camera_moves(device):
    views = [camera((0.05 * k, 1.5, 3), (0, 0.5, 0), 45) for k in range(4)]
    scene = room(change=(2, 1.0))
    truth = sequence(device, scene, 4, views=views, temporal="cumulative")
    images = sequence(device, scene, 4, views=views, temporal="adaptive")
    for image, expected in zip(images, truth, strict=True):
        np.testing.assert_array_equal(image.aovs["gradient"], 0.0)
        assert image.rgb.tobytes() == expected.rgb.tobytes()


def test_nothing_is_kept_of_a_light_that_is_switched_off(device):
    """The lamp is all the light there is: what it lit begins anew, in the same frame."""
    scene = room(sky=0.0, change=(6, 0.0))
    images = sequence(device, scene, 8, temporal="adaptive")
    lit = images[5].rgb.max(axis=-1) > 0.0
    assert lit.mean() > 0.4
    np.testing.assert_array_equal(images[5].aovs["gradient"], 0.0)
    assert (images[6].aovs["gradient"][lit] > 0.5).mean() > 0.98
    assert (images[6].rgb[lit] == 0.0).mean() > 0.98
    np.testing.assert_array_equal(images[7].aovs["gradient"], 0.0)


def test_probes_find_how_much_of_the_light_has_changed(device):
    size = (120, 90)
    images = sequence(device, room(size, change=(1, 0.0)), 2, temporal="adaptive")
    on, off = (
        render(device, room(size, factor=factor), 128).rgb.mean(axis=-1) for factor in (1.0, 0.0)
    )
    found, truth = images[1].aovs["gradient"][..., 0], 1 - off / on
    # Means over a few probes, and over their surroundings; above a half all counts as changed,
    # which is up to 0.15 more in the last range.
    for low, high, most in ((0.1, 0.2, 0.1), (0.2, 0.4, 0.1), (0.4, 0.7, 0.15)):
        some = (truth > low) & (truth < high)
        assert some.sum() > 100
        assert found[some].mean() == pytest.approx(truth[some].mean(), abs=most)
    assert np.median(found[np.abs(truth) < 0.01]) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 0.5, 3.0])
def test_adaptive_is_ahead_of_both_other_rules_when_a_light_changes(device, factor):
    """As good as a fresh start after 4 frames, though it need not forget what has not changed."""
    size, at, frames = (120, 90), 12, 24
    scene, later = room(size, change=(at, factor)), room(size, factor=factor)
    before, after = render(device, room(size), 1024, seed=1).rgb, render(device, later, 1024).rgb

    # A start with the samples of the same frames.
    images = [image.rgb for image in sequence(device, later, frames, outputs=())[at:]]
    sums = np.cumsum(images, axis=0)
    fresh = [error_of(mean / (k + 1), after) for k, mean in enumerate(sums)]
    errors = {
        rule: [
            error_of(image.rgb, before if frame < at else after)
            for frame, image in enumerate(sequence(device, scene, frames, temporal=rule))
        ]
        for rule in ("adaptive", "cumulative", "exponential")
    }
    assert errors["adaptive"][at + 3] < 1.1 * fresh[3]
    assert errors["adaptive"][at + 7] < 1.1 * fresh[7]
    assert sum(errors["adaptive"]) < min(sum(errors["cumulative"]), sum(errors["exponential"]))


SCENE = """
[film]
width = {size[0]}
height = {size[1]}
[camera]
position = {eye}
target = {target}
fov_y = 40
[environment]
radiance = [0.2, 0.2, 0.2]
[materials.floor]
base_color = [0.7, 0.5, 0.3]
specular = 0
[materials.thing]
base_color = [0.3, 0.6, 0.8]
specular = 0
[materials.lamp]
specular = 0
emission = [8, 6, 4]
[[shapes]]
primitive = "quad"
material = "floor"
transform = [{{ scale = 3 }}]
[[shapes]]
name = "thing"
primitive = "{thing}"
material = "thing"
transform = [{{ scale = {scale} }}, {turned}{{ translate = {start} }}]
[[shapes]]
name = "lamp"
primitive = "quad"
material = "lamp"
transform = [{{ scale = 0.3 }}, {{ rotate = [180, 0, 0] }}, {{ translate = [0.3, 2, 0] }}]
[[animation]]
target = "{target_name}"
property = "translation"
times = [0.0, 1.0]
values = [[0, 0, 0], {way}]
"""


def moving(tmp_path, target_name, way, **values):
    """Return a thing on a floor and a lamp above, one of which moves ``way`` in 24 frames."""
    values = {
        "size": (120, 90),
        "eye": [0, 1.2, 3],
        "target": [0, 0.5, 0],
        "thing": "sphere",
        "scale": 0.4,
        "turned": "",
        "start": [-0.8, 0.4, 0.3],
    } | values
    path = tmp_path / "moving.toml"
    path.write_text(
        SCENE.format(target_name=target_name, way=[float(part) for part in way], **values)
    )
    return load_scene(path, moving=True)


def test_history_goes_along_with_what_moves(device, tmp_path):
    """A board that hides all else moves by two pixels a frame: its whole history moves with it."""
    size, distance = (32, 24), 2.0
    footprint = distance * 2 * np.tan(np.radians(20)) / size[1]
    scene = moving(
        tmp_path,
        "thing",
        (24 * 2 * footprint, 0, 0),
        size=size,
        eye=[0, 5, distance],
        target=[0, 5, 0],
        thing="quad",
        scale=50,
        turned="{ rotate = [90, 0, 0] }, ",
        start=[0, 5, 0],
    )
    images = sequence(device, scene, 4, temporal="cumulative")
    np.testing.assert_allclose(images[3].aovs["motion"][..., 0], 2.0, atol=1e-3)
    np.testing.assert_allclose(images[3].aovs["motion"][..., 1], 0.0, atol=1e-3)
    history = np.broadcast_to(np.minimum(np.arange(32) // 2 + 1, 4), (24, 32))
    np.testing.assert_allclose(images[3].aovs["history"][..., 0], history, atol=1e-3)


def test_a_lamp_in_view_is_not_smeared_over_what_is_around_it(device):
    """Edges of its pixels are those of a floor, with its light in them: none of it goes on."""
    above = transform.translation((0.013, 0.001, 0.0)) @ transform.scaling(0.1)
    parts = [
        floor(3.0, lambertian(0.5)),
        (primitives.quad(), above, glowing(50.0)),
    ]
    views = [camera((0.021 * k, 2.0, 0.0), (0.021 * k, 0, 0), 40, up=(0, 0, -1)) for k in range(8)]
    scene = build(parts, views[0], (32, 24))
    ways = {"max_depth": 0, "views": views, "outputs": ()}
    seen = sequence(device, scene, 8, spp=64, **ways)[-1].rgb[..., 0]
    image = sequence(device, scene, 8, spp=4, **ways, temporal="cumulative")[-1].rgb[..., 0]
    assert seen.max() == pytest.approx(50.0, rel=1e-4)
    np.testing.assert_array_equal(image[seen == 0.0], 0.0)
    assert image.mean() == pytest.approx(seen.mean(), rel=0.1)


MOVING = Path(__file__).parents[1] / "scenes" / "moving"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "end", "frames"),
    [
        ("light_off", 8, 18),
        ("light_moved", 8, 18),
        ("camera_cut", 8, 18),
        ("door_opens", 13, 24),
        ("passing", 21, 29),
    ],
)
def test_adaptive_leads_on_the_moving_scenes(device, name, end, frames):
    """``end`` is the first frame that has nothing new; a cut forgets by itself, with any rule."""
    scene = load_scene(MOVING / f"{name}.toml", moving=True, size=(80, 60))

    def errors(rule, first=0, seed=0):
        opened = Renderer(scene, Settings(temporal=rule, seed=seed), device, time=first / 24)
        found = []
        for frame in range(first, frames):
            if frame > first:
                opened.set_frame(frame / 24)
            opened.render(spp=1)
            found.append(error_of(opened.snapshot().rgb, truth[frame]))
        opened.close()
        return np.array(found)

    opened = Renderer(scene, Settings(seed=777), device)
    truth = []
    for frame in range(frames):
        opened.set_frame(frame / 24)
        opened.render(spp=96)
        truth.append(opened.snapshot().rgb)
    opened.close()
    rules = ("adaptive", "cumulative", "exponential")
    found = {rule: np.mean([errors(rule, 0, s) for s in range(3)], axis=0) for rule in rules}
    fresh = np.mean([errors("cumulative", end, seed) for seed in range(50, 53)], axis=0)
    for since in (4, 8):
        assert found["adaptive"][end + since - 1] < 1.1 * fresh[since - 1]
    sums = {rule: one.sum() for rule, one in found.items()}
    if name == "camera_cut":
        assert sums["adaptive"] == sums["cumulative"] < sums["exponential"]
    else:
        assert sums["adaptive"] < min(sums["cumulative"], sums["exponential"])


@pytest.mark.slow
def test_adaptive_is_ahead_of_both_other_rules_while_something_moves(device, tmp_path):
    """A ball and its shadow go across the floor."""
    scene = moving(tmp_path, "thing", (1.6, 0.0, 0.0))
    frames = 20
    truth = [image.rgb for image in sequence(device, scene, frames, spp=128, outputs=())]
    errors = {}
    for rule in ("off", "adaptive", "cumulative", "exponential"):
        images = sequence(device, scene, frames, outputs=(), temporal=rule)
        errors[rule] = sum(
            np.mean((image.rgb - expected) ** 2 / (expected**2 + 0.01))
            for image, expected in zip(images, truth, strict=True)
        )
    assert errors["adaptive"] < 0.5 * errors["off"]
    assert errors["adaptive"] < min(errors["cumulative"], errors["exponential"])


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 8])
def test_lane_widths_agree_on_sequences(device, lanes):
    views = [camera((0.05 * k, 1.5, 3), (0, 0.5, 0), 45) for k in range(4)]
    traits = replace(device.traits, lanes=lanes, block=max(lanes, 8), slots=512)
    image = sequence(open_device(traits=traits), room(), 4, views=views, temporal="adaptive")[-1]
    truth = sequence(device, room(), 4, views=views, temporal="adaptive")[-1]
    close = np.isclose(image.rgb, truth.rgb, rtol=1e-3, atol=1e-4).all(axis=-1)
    assert close.mean() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["cumulative", "adaptive"])
def test_64_frames_have_the_error_of_64_samples(device, rule):
    truth = render(device, room(), 2048, seed=3).rgb
    image = sequence(device, room(), 64, temporal=rule)[-1]

    def error(rgb):
        return np.mean((rgb - truth) ** 2 / (truth**2 + 0.01))

    assert error(image.rgb) == pytest.approx(error(render(device, room(), 64).rgb), rel=0.1)


@pytest.mark.slow
def test_100_frames_take_no_more_memory_than_two_and_repeat_their_bits(device):
    views = [camera((0.02 * k, 1.5, 3), (0, 0.5, 0), 45) for k in range(100)]
    bits, peaks = [], []
    for frames in (2, 100, 100):
        fresh = open_device()
        image = sequence(fresh, room(), frames, views=views, temporal="adaptive")[-1]
        bits.append(image.rgb.tobytes())
        peaks.append(image.stats["peak_device_bytes"])
    assert bits[1] == bits[2]
    assert peaks[0] == peaks[1] == peaks[2]
