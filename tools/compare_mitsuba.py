"""Compare renders with Mitsuba 3: ``python tools/compare_mitsuba.py SCENE... --spp N --seeds K``.

The Python that runs this needs both renderers: ``.venv/bin/pip install mitsuba``.  Mitsuba is no
dependency of psf_cl.  Its fast ``llvm_ad_rgb`` variant needs LLVM (Debian: ``libllvm19``) and
``DRJIT_LIBLLVM_PATH`` set to its library; without that ``scalar_rgb`` is used.

What is compared is light transport, so only what both renderers mean alike is accepted: flat
triangles, materials without cut-outs, one-sided area lights, point and directional lights, an
environment, pinhole and thin lens.  Materials that are more than Lambertian run in Mitsuba as
tools/mitsuba_bsdf.py writes them, which needs a Dr.Jit variant and gives back nothing of what rough
metal and glass lose between facets; ``--lambertian`` makes all materials Lambertian and opaque
first, ``--own-materials`` such that Mitsuba's own plugins have the same.

Both renderers average K independent seeds.  The criterion, for each comparison: the means of all
channels agree within 1 %, and the luminances of blocks of 16x16 pixels within 3 sigma, with as many
exceptions as chance allows.  sigma comes from the seeds: a pixel's variance over them, summed over
the block (pixels are independent in both renderers).  Exit code 1 if one comparison fails.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_scene import (
    differences,
    flat,
    lambertian,
    mitsuba_scene,
    plain,
    set_variant,
)
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl.cli.common import positive_integer, setting_argument, size_argument
from psf_cl.errors import DeviceError, InputError
from psf_cl.measure.errors import LUMINANCE
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings, resolve

BLOCK = 16
MEAN_TOLERANCE = 0.01

# Chance of a normal deviate beyond 3 sigma, and a distance that no block of a picture should reach.
BEYOND_THREE = math.erfc(3.0 / math.sqrt(2.0))
FAR = 6.0

# Between 4 seeds, blocks whose noise comes from a few pixels showed deviations of 4.6 sigma that
# were gone with 16.
MIN_SEEDS = 8

# Where a block has no noise (an emitter seen directly) the renderers still round differently.
ROUNDING = 1e-5

# Samples that one call of Mitsuba keeps in memory.
MITSUBA_SAMPLES = 1 << 22


@dataclass(frozen=True)
class Estimate:
    """Mean over independent seeds, ``(h, w, 3)``, and the variance of its luminance, ``(h, w)``."""

    mean: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """How two estimates differ.

    Attributes:
        ratio, ratio_sigma: ``(3,)``; mean of ours over theirs by channel, and the sigma of that of
            luminance.
        z: ``(blocks_down, blocks_across)``, difference of luminance over its sigma.
        resolution: median over blocks of sigma over luminance: what the comparison could see.
    """

    ratio: np.ndarray
    ratio_sigma: float
    z: np.ndarray
    resolution: float

    @property
    def outside(self) -> int:
        return int(np.count_nonzero(np.abs(self.z) > 3.0))

    @property
    def allowed(self) -> int:
        """Return how many blocks beyond 3 sigma chance exceeds in less than one of 1,000 runs."""
        expected = self.z.size * BEYOND_THREE
        count, term = 0, math.exp(-expected)
        above = 1.0 - term
        while above > 1e-3:
            count += 1
            term *= expected / count
            above -= term
        return count

    @property
    def passed(self) -> bool:
        close = np.abs(self.ratio - 1.0).max() <= MEAN_TOLERANCE
        return bool(close and self.outside <= self.allowed and np.abs(self.z).max() < FAR)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all comparisons; return 1 if one of them fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", metavar="SCENE", nargs="+")
    parser.add_argument("--spp", type=positive_integer, default=64, help="for each seed (64)")
    parser.add_argument("--seeds", type=positive_integer, default=8, help="at least 8, the default")
    parser.add_argument("--size", metavar="WxH", type=size_argument, help="instead of the scene's")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--lambertian", action="store_true", help="make all materials Lambertian")
    kinds.add_argument(
        "--own-materials",
        action="store_true",
        help="make all materials such as Mitsuba's own plugins are, and use these",
    )
    parser.add_argument(
        "--set",
        dest="runs",
        metavar="KEY=VALUE",
        type=setting_argument,
        nargs="+",
        action="append",
        help="settings of our renderer; given again: compare these as well",
    )
    parser.add_argument("--variant", help="of Mitsuba")
    args = parser.parse_args(arguments)
    if args.seeds < MIN_SEEDS:
        parser.error(f"--seeds: expected at least {MIN_SEEDS}: the noise is measured between seeds")
    set_variant(args.variant)
    table = Table("scene", "settings", "mean r g b", "+-", "blocks > 3 sigma", "worst", "sigma z")
    table.add_column("resolution", justify="right")
    table.add_column("")
    passed = True
    for path in args.scenes:
        scene = psf_cl.load_scene(path, size=args.size)
        scene = comparable(scene, args.lambertian, args.own_materials)
        theirs: dict[tuple[int, ...], Estimate] = {}
        for run in args.runs or [[]]:
            settings = resolve(scene.render, scene.path, overrides=dict(run))
            key = (settings.max_depth,)
            if key not in theirs:
                theirs[key] = render_mitsuba(
                    scene, settings, args.spp, args.seeds, own_materials=args.own_materials
                )
            result = agreement(render_ours(scene, settings, args.spp, args.seeds), theirs[key])
            table.add_row(Path(path).stem, *_row(run, result))
            passed &= result.passed
    Console(width=max(140, Console().width)).print(table)
    return 0 if passed else 1


def comparable(scene: Scene, matt: bool, own_materials: bool = False) -> Scene:
    """Return the scene without shading normals, with materials that can be compared.

    All are Lambertian if ``matt``, or if ``own_materials`` as ``mitsuba_scene.plain`` has them.

    Raises:
        InputError: something in it would not be the same in Mitsuba.
    """
    scene = lambertian(scene) if matt else flat(plain(scene) if own_materials else scene)
    for what in differences(scene):
        raise InputError(f"{scene.path}: expected a scene without {what}")
    return scene


def render_mitsuba(
    scene: Scene,
    settings: Settings,
    spp: int,
    seeds: int,
    bsdf: dict[str, Any] | None = None,
    own_materials: bool = False,
) -> Estimate:
    """Render with Mitsuba's path tracer, with independent samples; the rest as in mitsuba_scene."""
    depths = settings.max_depth, settings.roulette_depth
    built = mitsuba_scene(scene, *depths, own_materials, bsdf)
    part = min(spp, max(1, MITSUBA_SAMPLES // (scene.width * scene.height)))
    counts = [min(part, spp - first) for first in range(0, spp, part)]
    images = []
    for seed in range(seeds):
        total = np.zeros((scene.height, scene.width, 3))
        for index, count in enumerate(counts):
            number = seed * len(counts) + index
            total += count * np.array(mi.render(built, spp=count, seed=number), np.float64)
        images.append(total / spp)
    return estimate(images)


def render_ours(scene: Scene, settings: Settings, spp: int, seeds: int) -> Estimate:
    """Render with psf_cl."""
    images = []
    for seed in range(seeds):
        renderer = psf_cl.Renderer(scene, replace(settings, seed=seed))
        renderer.render(spp=spp)
        images.append(renderer.snapshot().rgb.astype(np.float64))
        renderer.close()
    return estimate(images)


def estimate(images: list[np.ndarray]) -> Estimate:
    """Average images of independent seeds."""
    luminance = np.stack(images) @ LUMINANCE
    return Estimate(np.mean(images, axis=0), luminance.var(axis=0, ddof=1) / len(images))


def agreement(ours: Estimate, theirs: Estimate) -> Agreement:
    """Compare two estimates of one picture."""
    difference = (ours.mean - theirs.mean) @ LUMINANCE
    level = (ours.mean + theirs.mean) @ LUMINANCE / 2.0
    variance = ours.variance + theirs.variance
    level, difference = _block_sums(level), _block_sums(difference)
    sigma = np.hypot(np.sqrt(_block_sums(variance)), ROUNDING * level)
    lit = level > 0.0
    total = float((theirs.mean @ LUMINANCE).sum())
    return Agreement(
        ours.mean.mean(axis=(0, 1)) / theirs.mean.mean(axis=(0, 1)),
        math.sqrt(variance.sum()) / total,
        np.divide(difference, sigma, out=np.zeros_like(sigma), where=sigma > 0.0),
        float(np.median(sigma[lit] / level[lit])),
    )


def _block_sums(image: np.ndarray) -> np.ndarray:
    height, width = image.shape
    rows, columns = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)


def _row(run: list[tuple[str, str]], result: Agreement) -> list[str]:
    return [
        " ".join(f"{key}={value}" for key, value in run) or "as they are",
        " ".join(f"{value:.4f}" for value in result.ratio),
        f"{result.ratio_sigma:.4f}",
        f"{result.outside} of {result.z.size} (at most {result.allowed})",
        f"{np.abs(result.z).max():.2f}",
        f"{float(np.sqrt((result.z**2).mean())):.3f}",
        f"{100.0 * result.resolution:.2f} %",
        "pass" if result.passed else "FAIL",
    ]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"compare_mitsuba: {error}")
