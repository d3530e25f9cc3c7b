"""Renders against stored references of other settings, by the variance that these state."""

from pathlib import Path

import numpy as np
import pytest

import psf_cl
from psf_cl.image import read_exr
from psf_cl.measure.references import RunningReference
from psf_cl.scene.digest import scene_digest
from psf_cl.settings import resolve

ROOT = Path(__file__).resolve().parents[1]
REFERENCES = sorted((ROOT / "tests" / "references").glob("*.exr"))
SEEDS = 8


def scene_of(path):
    image = read_exr(path)
    scene = psf_cl.load_scene(
        ROOT / "scenes" / f"{path.stem}.toml", size=(image.width, image.height)
    )
    return scene, image


def by_name(path):
    return path.stem


def test_there_are_references_and_they_are_small():
    assert len(REFERENCES) >= 4
    assert sum(path.stat().st_size for path in REFERENCES) < 1_500_000


@pytest.mark.parametrize("path", REFERENCES, ids=by_name)
def test_references_are_of_the_scenes_as_they_are_and_of_other_settings(path):
    scene, image = scene_of(path)
    assert image.stats["scene_digest"] == scene_digest(scene), "render the reference anew"
    settings, ours = image.stats["settings"], resolve(scene.render, scene.path)
    # What estimates light here must not be what estimated it there.
    assert settings["sampler"] == "random" != ours.sampler
    other = {"light_sampling", "direct_sampling"}
    assert any(settings[name] != getattr(ours, name) for name in other)
    assert settings["max_depth"] == ours.max_depth


@pytest.mark.parametrize("path", REFERENCES, ids=by_name)
def test_the_halves_of_a_reference_agree_with_its_variance(path):
    _, image = scene_of(path)
    running = RunningReference.from_image(image, len(image.stats["seed"]))
    halves = running.halves_agreement()
    # 64 blocks in 3 channels that hardly differ: 1 +- 0.09.
    assert 0.7 < halves.rms < 1.3 and halves.beyond_three < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("path", REFERENCES, ids=by_name)
def test_renders_as_shipped_agree_with_the_reference(path, device):
    scene, image = scene_of(path)
    running = RunningReference(scene.height, scene.width)
    for seed in range(SEEDS):
        running.add(psf_cl.render(scene, spp=128, device=device, seed=seed).rgb)
    difference = running.mean - image.rgb
    variance = running.variance + image.aovs["variance"]

    def blocks(values):
        return values.reshape(8, 8, 8, 8, 3).sum(axis=(1, 3))

    sigma = np.sqrt(blocks(variance))
    # Where there is no noise, the lamp seen directly, rounding is left.
    sigma = np.hypot(sigma, 1e-5 * blocks(image.rgb.astype(np.float64)))
    z = blocks(difference)[sigma > 0.0] / sigma[sigma > 0.0]
    # As Student's t of 7 degrees of freedom: rms 1.18, beyond 5 in 1 of 600 at worst.
    assert np.sqrt((z**2).mean()) < 1.5
    assert (np.abs(z) > 5.0).mean() < 0.02
    total = difference.sum() / np.sqrt(variance.sum(axis=-1).sum() * 3.0)
    assert abs(total) < 4.0
