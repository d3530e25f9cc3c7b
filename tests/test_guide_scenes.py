"""Learned directions on the project's scenes: the light of plain paths, and no brighter dots."""

from __future__ import annotations

import itertools
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


def chance_of_more(one, other):
    """Return how often seeds dealt out anew leave ``one`` as far above ``other`` on average.

    Where both are alike any deal is as likely: the exact test of Fisher and Pitman, one-sided.
    """
    both = np.concatenate([one, other])
    deals = np.array(list(itertools.combinations(range(len(both)), len(one))))
    means = both[deals].mean(axis=1)
    return np.mean(means >= one.mean() * (1 - 1e-12))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ajar_door", "cornell_box"])
def test_learned_directions_leave_no_brighter_dots(device, name):
    """The largest errors of the pixels of a picture at equal samples, over 8 seeds of either."""
    reference = read_exr(ROOT / "tests" / "references" / f"{name}.exr").rgb @ LUMINANCE
    side = reference.shape[0]
    plain, learned = (
        np.abs(pictures(device, name, side, 64, guiding=guiding) - reference).reshape(SEEDS, -1)
        for guiding in ("off", "learned")
    )
    for worst in (lambda errors: np.percentile(errors, 99.9, axis=1), lambda e: e.max(axis=1)):
        # Of the 12,870 deals of the seeds more than one in a hundred: no sign of larger errors.
        assert chance_of_more(worst(learned), worst(plain)) > 0.01


def test_larger_errors_would_be_noticed():
    rng = np.random.default_rng(5)
    plain, learned = rng.gamma(4.0, size=(2, SEEDS))
    assert chance_of_more(learned, plain) > 0.01
    assert chance_of_more(1.0 + 2.0 * learned, plain) < 0.01
    assert chance_of_more(plain, plain) >= 0.5
