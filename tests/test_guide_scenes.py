"""Learned directions on the project's scenes: the light of plain paths, and no brighter dots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scene_builder import LUMINANCE, block_means
from scene_builder import render as render_path

from psf_cl.image import read_exr
from psf_cl.scene.load import load_scene

ROOT = Path(__file__).resolve().parents[1]
SCENES = sorted(path.stem for path in (ROOT / "scenes").glob("*.toml"))
SEEDS, SPP = 8, 128


def pictures(device, name, side, spp, **settings):
    """Return the luminance of pictures of all seeds, ``(seeds, side, side)``."""
    scene = load_scene(ROOT / "scenes" / f"{name}.toml", size=(side, side))
    settings = dict(scene.render) | settings
    settings.pop("preset", None)
    return np.array(
        [
            render_path(device, scene, spp, seed=seed, **settings).rgb @ LUMINANCE
            for seed in range(SEEDS)
        ]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_learned_directions_bring_the_light_of_plain_paths(device, name):
    """Of the picture and of 16 blocks of it, over 8 seeds of either, by Welch's statistic."""
    plain, learned = (
        pictures(device, name, 32, SPP, guiding=guiding).astype(np.float64)
        for guiding in ("off", "learned")
    )

    def statistic(reduce):
        one, other = (np.array([reduce(image) for image in part]) for part in (plain, learned))
        spread = (one.var(axis=0, ddof=1) + other.var(axis=0, ddof=1)) / SEEDS
        return (other.mean(axis=0) - one.mean(axis=0)) / np.sqrt(np.maximum(spread, 1e-12))

    # With 14 degrees of freedom or fewer: beyond 4.5 once in 2,000; of 16 beyond 6 once in 1,000.
    assert abs(statistic(np.mean)) < 4.5
    blocks = statistic(lambda image: block_means(image[..., None], 4)[..., 0])
    assert blocks.size == 16 and np.abs(blocks).max() < 6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ajar_door", "cornell_box"])
def test_learned_directions_leave_no_brighter_dots(device, name):
    """The largest errors of all pixels and seeds at equal samples.

    Where the guide is left out the two are as good as each other: a quarter is chance.
    """
    reference = read_exr(ROOT / "tests" / "references" / f"{name}.exr").rgb @ LUMINANCE
    side = reference.shape[0]
    worst = []
    for guiding in ("off", "learned"):
        errors = np.abs(pictures(device, name, side, 64, guiding=guiding) - reference)
        worst.append((np.percentile(errors, 99.9), errors.max()))
    assert worst[1][0] <= 1.25 * worst[0][0]
    assert worst[1][1] <= 1.25 * worst[0][1]
