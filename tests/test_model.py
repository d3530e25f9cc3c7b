"""What counts as light, and as a surface, is said in one place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psf_cl.scene.digest import scene_digest
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import (
    MAX_RADIANCE,
    Environment,
    Light,
    Material,
    emits,
    has_environment,
    is_cut_out,
    is_invisible,
    limited,
    shines,
)


@pytest.mark.parametrize(
    ("material", "cut_out", "invisible"),
    [
        (Material(alpha=0.2), False, False),
        (Material(alpha=0.2, alpha_mode="mask"), False, True),
        (Material(alpha=0.5, alpha_mode="mask"), False, False),
        (Material(alpha=1.0, alpha_mode="mask", base_color_texture=0), True, False),
    ],
)
def test_a_mask_is_looked_up_only_where_it_matters(material, cut_out, invisible):
    assert is_cut_out(material) == cut_out
    assert is_invisible(material) == invisible


def test_one_channel_of_light_is_light():
    assert emits(Material(emission=(0.0, 0.0, 1.0))) and not emits(Material())
    assert shines(Light("point", (0.0, 1.0, 0.0))) and not shines(Light("point", (0.0, 0.0, 0.0)))


def test_a_sky_needs_a_factor_and_a_texel_that_are_not_black():
    black, one = np.zeros((2, 4, 3), np.float32), np.zeros((2, 4, 3), np.float32)
    one[1, 2, 0] = 1.0
    assert has_environment(Environment((0.0, 0.1, 0.0)))
    assert has_environment(Environment((1.0, 1.0, 1.0), one))
    assert not has_environment(Environment((0.0, 0.0, 0.0), one))
    assert not has_environment(Environment((1.0, 1.0, 1.0), black))


def test_limited_radiance_fits_float32():
    assert limited((1e308, 2.0, 0.0)) == (MAX_RADIANCE, 2.0, 0.0)


def test_a_digest_sees_what_the_picture_is_of_and_nothing_else():
    path = Path(__file__).resolve().parents[1] / "scenes" / "ajar_door.toml"
    scene = load_scene(path)
    digest = scene_digest(scene)
    assert digest == scene_digest(replace(load_scene(path), path="elsewhere", render={}, notes=()))

    def changed(shape):
        return replace(scene, shapes=(shape, *scene.shapes[1:]))

    first = scene.shapes[0]
    moved = first.transform.copy()
    moved[0, 3] += 1e-6
    positions = first.mesh.positions.copy()
    positions[0, 0] += 1e-3
    others = [
        replace(scene, width=scene.width + 1),
        changed(replace(first, transform=moved)),
        changed(replace(first, mesh=replace(first.mesh, positions=positions))),
        replace(scene, materials=scene.materials[:-1]),
        replace(scene, environment=Environment(radiance=(0.0, 0.0, 1e-9))),
        replace(scene, lights=(Light("point", (1.0, 1.0, 1.0)),)),
    ]
    assert len({digest, *map(scene_digest, others)}) == 1 + len(others)
