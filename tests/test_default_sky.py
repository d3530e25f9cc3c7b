"""Which scenes get a sky of their own."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, grey, lambertian, render

from psf_cl.scene import primitives, transform
from psf_cl.scene.default_sky import LIT, SKY_TOWARD, glow_share, with_default_sky
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Light, Texture

GREY = lambertian(0.5)
FRONT = camera((0.0, 0.0, 4.0), (0.0, 0.0, 0.0))


def box(half: float, material):
    return primitives.box(), transform.scaling(half), material


def facing(height: float, material):
    """Return a square like ``floor(1.0)``'s above it, that looks down."""
    turn = transform.rotation_xyz_degrees((180.0, 0.0, 0.0))
    return primitives.quad(), transform.translation((0.0, height, 0.0)) @ turn, material


ROOM = [box(1.0, GREY), box(0.1, glowing(10.0))]


def test_all_that_a_lamp_in_a_closed_room_gives_counts():
    scene = build([box(1.0, GREY), box(0.1, glowing(3.0))], FRONT)
    assert glow_share(scene) == pytest.approx(3.0 * 0.24 / 24.24, rel=1e-6)


def test_a_lamp_that_both_sides_of_glow_gives_twice_as_much():
    one = glow_share(build([box(1.0, GREY), box(0.1, glowing(3.0))], FRONT))
    two = glow_share(build([box(1.0, GREY), box(0.1, glowing(3.0, double_sided=True))], FRONT))
    assert two == pytest.approx(2.0 * one)


def test_nothing_of_what_a_lamp_in_the_open_gives_counts():
    assert glow_share(build([box(1.0, glowing(3.0))], FRONT)) == 0.0


def test_light_that_comes_to_a_wall_counts_by_its_form_factor():
    """Equal parallel squares of x times their distance (Howell's catalogue, C-11)."""
    x = 2.0
    root = np.sqrt(1.0 + x * x)
    logarithm = np.log((1.0 + x * x) / np.sqrt(1.0 + 2.0 * x * x))
    part = logarithm + 2.0 * x * root * np.arctan(x / root) - 2.0 * x * np.arctan(x)
    exact = 2.0 / (np.pi * x * x) * part
    assert exact == pytest.approx(0.4153, abs=1e-3)
    scene = build([floor(1.0, glowing(1.0)), facing(1.0, GREY)], FRONT)
    # Of 128 rays: three standard errors.
    assert 2.0 * glow_share(scene) == pytest.approx(exact, abs=0.13)


def test_the_front_of_a_mirrored_lamp_stays_its_front():
    quad, _, lamp = floor(1.0, glowing(1.0))
    mirrored = quad, np.diag([-1.0, 1.0, 1.0, 1.0]), lamp
    assert glow_share(build([mirrored, facing(0.1, GREY)], FRONT)) > 0.4
    assert glow_share(build([mirrored, facing(-0.1, GREY)], FRONT)) == 0.0


def test_a_glass_bulb_around_a_lamp_is_not_what_it_lights():
    glass = lambertian(1.0, transmission=1.0)
    assert glow_share(build([box(1.0, glowing(1.0)), box(2.0, glass)], FRONT)) == 0.0


def test_a_lamp_counts_by_the_mean_of_its_texture():
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[0, 0, :3] = 255
    shapes = [box(1.0, GREY), box(0.5, glowing(1.0, emission_texture=0))]
    dark = dataclasses.replace(build(shapes, FRONT), textures=(Texture("t", pixels),))
    assert glow_share(dark) == pytest.approx(6.0 / 30.0 / 16.0, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-12, 1e15])
def test_the_size_of_the_scene_does_not_count(scale):
    shapes = [(m, transform.scaling(scale) @ t, x) for m, t, x in ROOM]
    assert glow_share(build(shapes, FRONT)) == pytest.approx(glow_share(build(ROOM, FRONT)))


def test_a_room_that_its_lamp_lights_stays_dark_outside():
    assert glow_share(build(ROOM, FRONT)) > LIT
    assert not with_default_sky(build(ROOM, FRONT), opened=True).notes


def test_a_model_with_a_lamp_that_lights_nothing_gets_a_sky():
    scene = with_default_sky(build([box(1.0, glowing(50.0))], FRONT), opened=True)
    assert scene.environment.image is not None
    assert any("(0 % of" in note for note in scene.notes)


def test_what_glows_in_a_toml_scene_is_its_light():
    scene = build([box(1.0, glowing(0.01))], FRONT)
    assert with_default_sky(scene, opened=False) is scene


def test_a_lamp_without_extent_is_light():
    scene = build([box(1.0, GREY)], FRONT, lights=(Light("point", grey(1e-3)),))
    assert with_default_sky(scene, opened=True) is scene


def test_no_sky_is_added_where_none_is_asked_for(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert load_scene(tmp_path / "a.obj").environment.image is not None
    dark = load_scene(tmp_path / "a.obj", environment="none").environment
    assert dark.radiance == (0, 0, 0) and dark.image is None
    text = '[environment]\nradiance = [1, 2, 3]\n[[shapes]]\nprimitive = "quad"\n'
    (tmp_path / "a.toml").write_text(text)
    assert load_scene(tmp_path / "a.toml", environment="none").environment.radiance == (0, 0, 0)


@pytest.mark.parametrize("normal", [(0, 1, 0), (0, -1, 0), (1, 0, 0), (0, 0, 1), (-0.6, 0, -0.8)])
def test_white_matt_surfaces_show_which_way_they_face(device, normal):
    normal = np.array(normal, float)
    # The quad lies in y = 0 and faces up: it is seen from above wherever it is turned to.
    turned = transform.look_at((0, 0, 0), tuple(-normal), tuple(np.roll(normal, 1)))
    turned = turned @ transform.rotation_xyz_degrees((90.0, 0.0, 0.0))
    view = camera(tuple(3 * normal), (0, 0, 0), 10.0, up=tuple(np.roll(normal, 1)))
    scene = build([(primitives.quad(), turned, lambertian(1.0))], view, (16, 16))
    image = render(device, with_default_sky(scene, opened=True), 64)
    shown = 0.6 + 0.4 * (2.0 / 3.0) * normal @ SKY_TOWARD
    assert image.rgb.mean() == pytest.approx(shown, abs=0.004)
