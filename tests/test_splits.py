"""Splitting: what samples have in common, and that their mean is that of plain path tracing."""

from __future__ import annotations

import numpy as np
import pytest
from scene_builder import block_means, build, camera, floor, glowing, lambertian, render

from psf_cl.errors import InputError
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings, check_together


def room():
    """Return a lamp over a floor with a box on it, seen through a lens."""
    over = transform.translation((0.5, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    box = transform.translation((0, 0.4, 0)) @ transform.scaling(0.4)
    view = camera((0, 1.5, 3), (0, 0.5, 0), 45)
    return build(
        [
            floor(3.0, lambertian((0.7, 0.5, 0.3))),
            (primitives.box(), box, lambertian((0.3, 0.6, 0.8))),
            (primitives.quad(), over @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        view,
        (16, 16),
        environment=0.2,
    )


@pytest.mark.parametrize("sampler", ["sobol", "random"])
def test_paths_part_at_the_first_surface(device, sampler):
    names = ["depth", "normal", "direct"]
    one = render(device, room(), 3, names, sampler=sampler)
    many = render(device, room(), 12, names, sampler=sampler, splits=4)
    for name in ("depth", "normal"):
        np.testing.assert_allclose(many.aovs[name], one.aovs[name], rtol=1e-6, atol=1e-6)
    assert np.abs(many.aovs["direct"] - one.aovs["direct"]).mean() > 0.01 * one.rgb.mean()
    plain = render(device, room(), 12, names, sampler=sampler)
    assert np.abs(plain.aovs["depth"] - one.aovs["depth"]).mean() > 1e-3


def test_paths_part_at_the_second_surface(device):
    """Light that was reflected once is settled by then, light that was reflected twice is not."""
    one = render(device, room(), 3, ["direct", "indirect"])
    many = render(device, room(), 12, ["direct", "indirect"], splits=4, split_vertex=2)
    np.testing.assert_allclose(many.aovs["direct"], one.aovs["direct"], rtol=1e-5, atol=1e-6)
    assert np.abs(many.aovs["indirect"] - one.aovs["indirect"]).max() > 0.01 * one.rgb.mean()


@pytest.mark.parametrize(("splits", "vertex"), [(3, 1), (16, 2)])
def test_splitting_is_unbiased(device, splits, vertex):
    truth = block_means(render(device, room(), 4096, seed=99).rgb, 4)
    settings = {"splits": splits, "split_vertex": vertex}
    blocks = np.array(
        [block_means(render(device, room(), 96, seed=k, **settings).rgb, 4) for k in range(12)]
    )
    # Errors of 12 renders each: Student's t of 11 degrees, 1e-5 for 48 numbers in two cases.
    error = blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))
    assert (np.abs(blocks.mean(axis=0) - truth) < 8.0 * error + 0.002 * truth).all()


def test_splits_exclude_what_takes_samples_for_independent():
    with pytest.raises(InputError, match="metropolis needs splits=1; got 2"):
        check_together(Settings(integrator="metropolis", splits=2))
    with pytest.raises(InputError, match="--noise: samples of splits=2"):
        make_plan(room(), Settings(splits=2), halves=True)
