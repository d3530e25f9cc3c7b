"""References: their mean, variance and halves against NumPy; stopping, resuming, disagreement."""

from pathlib import Path

import make_references as tool
import numpy as np
import pytest

from psf_cl.image import Image, read_exr
from psf_cl.measure.references import RunningReference

ROOT = Path(__file__).resolve().parents[1]
SHAPE = (24, 32, 3)


def renders(count, seed=0):
    rng = np.random.default_rng(seed)
    return (1000.0 + rng.gamma(2.0, 1.0, (count, *SHAPE))).astype(np.float32)


def running_of(images):
    running = RunningReference(*SHAPE[:2])
    for image in images:
        running.add(image)
    return running


def test_mean_variance_and_half_are_those_of_numpy():
    images = renders(7)
    running = running_of(images)
    exact = images.astype(np.float64)
    np.testing.assert_allclose(running.mean, exact.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(running.half, exact[::2].mean(axis=0), rtol=1e-12)
    # Digits are lost neither to the large mean nor on the way.
    np.testing.assert_allclose(running.variance, exact.var(axis=0, ddof=1) / 7, rtol=1e-9)


def test_going_on_from_the_file_gives_the_same():
    images = renders(9) - 1000.0
    begun = running_of(images[:5])
    resumed = RunningReference.from_image(Image(begun.aovs()), 5)
    for image in images[5:]:
        resumed.add(image)
    whole = running_of(images)
    # The file holds 32-bit floats.
    np.testing.assert_allclose(resumed.mean, whole.mean, rtol=1e-6)
    np.testing.assert_allclose(resumed.half, whole.half, rtol=1e-6)
    np.testing.assert_allclose(resumed.variance, whole.variance, rtol=1e-5)
    with pytest.raises(ValueError, match="not an image"):
        RunningReference.from_image(Image({"rgb": images[0]}), 5)


def test_halves_agree_when_renders_are_independent_and_only_then():
    # rms over 36 numbers, hardly dependent: 1 +- 0.12; averaged over 20 references, 0.03.
    values = [running_of(renders(8, seed)).halves_agreement() for seed in range(20)]
    assert np.mean([value.rms for value in values]) == pytest.approx(1.0, abs=0.1)
    assert np.mean([value.beyond_three for value in values]) < 0.02

    # Pixels of a render that err together, which no pixel alone can tell.
    together = renders(8) - 1000.0
    together += np.random.default_rng(3).normal(0.0, 1.0, (8, 1, 1, 1))
    assert running_of(together).halves_agreement().rms > 2.0


def test_the_tool_stops_goes_on_and_tells_the_truth(device, tmp_path, capsys):
    out = tmp_path / "ref.exr"
    scene = str(ROOT / "scenes" / "cornell_box.toml")
    base = [scene, "--size", "24x16", "--spp", "16", "-o", str(out)]
    assert tool.main([*base, "--seeds", "2"]) in (0, 1)  # Two are too few for halves to agree.
    assert tool.main([*base, "--seeds", "8"]) == 0
    assert "goes on after 2 renders" in capsys.readouterr().out
    image = read_exr(out)
    assert image.stats["spp"] == 128 and image.stats["seed"] == list(range(8))
    assert image.stats["version"] and image.stats["settings"]["sampler"] == "sobol"
    assert image.aovs["variance"].shape == image.aovs["half"].shape == (16, 24, 3)

    # The same in one go, but for the rounding of the file.
    whole = tmp_path / "whole.exr"
    assert tool.main([*base[:-1], str(whole), "--seeds", "8"]) == 0
    np.testing.assert_allclose(read_exr(whole).rgb, image.rgb, rtol=1e-5)

    # It goes on to half the noise, which takes about twice as many renders.
    target = image.stats["noise"] / 2.0
    assert tool.main([*base, "--noise", str(target)]) == 0
    more = read_exr(out)
    assert more.stats["noise"] <= target
    assert 11 <= len(more.stats["seed"]) <= 32

    # Another way to begin is a new start.
    capsys.readouterr()
    assert tool.main([*base, "--seeds", "2", "--set", "max_depth=2"]) in (0, 1)
    assert "goes on" not in capsys.readouterr().out
    assert len(read_exr(out).stats["seed"]) == 2
