"""All techniques at once: the preset ``game``."""

from __future__ import annotations

import numpy as np
import pytest
from scene_builder import (
    block_means,
    build,
    camera,
    floor,
    glowing,
    inside_out,
    lambertian,
    render,
)

from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings, preset_values


@pytest.fixture(scope="module")
def scene():
    """A floor with a box on it, under two lamps that look down."""
    lamp = inside_out(primitives.quad())
    return build(
        [
            floor(2.0, lambertian((0.6, 0.5, 0.4))),
            (primitives.box(), transform.scaling(0.3), lambertian(0.7)),
            (lamp, transform.translation((1, 1.5, 0)) @ transform.scaling(0.3), glowing(8.0)),
            (lamp, transform.translation((-1, 1, 0)) @ transform.scaling(0.1), glowing(30.0)),
        ],
        camera((0, 1.5, 3), (0, 0.3, 0), 40),
        (32, 32),
    )


def test_game_has_a_stage_for_each_technique(scene):
    stages = {stage.name for stage in make_plan(scene, Settings(**preset_values("game"))).stages}
    assert stages >= {"photons", "guide", "cells", "temporal", "screen"}


@pytest.mark.slow
def test_together_they_are_as_bright_as_plain_path_tracing(device, scene):
    """Cells blur, but neither darken nor brighten; the screen filter blurs shadows in addition."""
    truth = render(device, scene, 1024).rgb
    game = preset_values("game")
    image = render(device, scene, 64, **game | {"screen_filter": "off"}).rgb
    assert image.mean() == pytest.approx(truth.mean(), rel=0.005)
    blocks = block_means(truth, 4)
    np.testing.assert_allclose(block_means(image, 4), blocks, rtol=0.05, atol=0.01 * truth.mean())
    filtered = render(device, scene, 64, **game).rgb
    assert np.isfinite(filtered).all()
    assert filtered.mean() == pytest.approx(truth.mean(), rel=0.04)
