"""Samples per second beside Mitsuba 3: ``python tools/compare_speed.py SCENE...``.

The Python that runs this needs both renderers: ``.venv/bin/pip install mitsuba``.  Mitsuba's fast
``llvm_ad_rgb`` variant needs LLVM (Debian: ``libllvm19``) and ``DRJIT_LIBLLVM_PATH`` set to its
library; without that ``scalar_rgb`` is used, which is no fair rival.

Both trace the same scene to the same depth with the same roulette, over a box filter, each with its
own sampler.  Mitsuba renders as many samples a pixel at a time as it is fastest with.  Times are
wall clock, after a warm-up, in interleaved rounds; the table has medians and the range of rounds.
psf_cl's rate is that of a pool that stays full; "passes apart" ends every pass before the next
begins, as a filter between passes needs.

The images of the timed rounds are compared as tools/compare_mitsuba.py does it: "blocks out" are
those beyond 3 sigma, and how many may be.  "cores" is the least that each renderer had of the
machine in a round: where it is low, something else was running.

Where materials are more than Lambertian, Mitsuba runs psf_cl's BSDF (tools/mitsuba_bsdf.py), so
that both do the same work.  ``--own-materials`` takes Mitsuba's own plugins that come closest; the
images differ then.  Shading normals near the horizon and cut-outs before a light mean different
things: ``--flat`` leaves them away in both, ``--lambertian`` also makes all materials so.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from compare_mitsuba import Agreement, Estimate, agreement
from measuring import interleaved, ratio, samples_per_second, spread
from mitsuba_scene import differences, flat, lambertian, mitsuba_scene, opaque, set_variant
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl.cli.common import positive_integer, positive_number, size_argument
from psf_cl.errors import DeviceError, InputError
from psf_cl.measure.errors import LUMINANCE
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings, resolve

# Mitsuba's own default is the fifth vertex; psf_cl counts the bounces before it.
SETTINGS = {"max_depth": "16", "roulette_depth": "4"}

# Samples a pixel and call of Mitsuba that are tried, and samples that a call may have at most.
MITSUBA_SPP = (4, 16, 64)
MITSUBA_SAMPLES = 1 << 22
TRIAL_SECONDS = 1.0
WARM_UP_SECONDS = 0.5

# Calls of Mitsuba between which its noise is measured.
NOISE_CALLS = 16


class Mitsuba:
    """A scene in Mitsuba, and the sum of the samples that it rendered.

    Attributes:
        spp: samples a pixel of one call, those of the highest rate.
    """

    def __init__(self, scene: Scene, settings: Settings, own_materials: bool) -> None:
        depths = settings.max_depth, settings.roulette_depth
        self.scene = mitsuba_scene(scene, *depths, own_materials)
        self.pixels = scene.width * scene.height
        self.calls = 0
        self.count = 0
        self.sum = np.zeros((scene.height, scene.width, 3))
        most = max(MITSUBA_SAMPLES // self.pixels, 1)
        rates = {}
        for spp in sorted({min(spp, most) for spp in MITSUBA_SPP}):
            self.spp = spp
            self._render(spp)  # Compiles.
            rates[spp] = self.rate(TRIAL_SECONDS)
        self.spp = max(rates, key=lambda spp: rates[spp])

    def _render(self, spp: int) -> np.ndarray:
        self.calls += 1
        integrator = self.scene.integrator()
        image = np.array(integrator.render(self.scene, seed=self.calls, spp=spp), np.float64)
        self.sum += spp * image
        self.count += spp
        return image

    def rate(self, seconds: float) -> float:
        """Render for at least ``seconds``; return samples per second."""
        start = time.perf_counter()
        before = self.count
        while time.perf_counter() - start < seconds:
            self._render(self.spp)
        return (self.count - before) * self.pixels / (time.perf_counter() - start)

    def estimate(self) -> Estimate:
        """Return the mean image and its noise, which some more calls tell."""
        spp = MITSUBA_SPP[0]
        luminance = np.stack([self._render(spp) @ LUMINANCE for _ in range(NOISE_CALLS)])
        return Estimate(self.sum / self.count, luminance.var(axis=0, ddof=1) * spp / self.count)


class Ours:
    """A scene in psf_cl."""

    def __init__(self, scene: Scene, settings: Settings) -> None:
        self.renderer = psf_cl.Renderer(scene, settings)
        self.pixels = scene.width * scene.height

    def rate(self, seconds: float) -> float:
        """Render for at least ``seconds``; return samples per second."""
        return samples_per_second(self.renderer, seconds)

    def passes_apart(self, seconds: float) -> float:
        """The same, but one pass ends before the next begins."""
        self.renderer.step()  # Ends what is in flight.
        first = self.renderer.scheduler.passes
        start = time.perf_counter()
        while time.perf_counter() - start < seconds:
            self.renderer.step()
        elapsed = time.perf_counter() - start
        return (self.renderer.scheduler.passes - first) * self.pixels / elapsed

    def estimate(self) -> Estimate:
        image = self.renderer.snapshot(("rgb", "variance"))
        variance = image.aovs["variance"][..., 0].astype(np.float64)
        return Estimate(image.rgb.astype(np.float64), variance)


@dataclass(frozen=True)
class Comparison:
    """Samples per second of each round, and how the images agree.

    Attributes:
        spp: of a call of Mitsuba.
        means: luminance of the images, ours and Mitsuba's.
        cores: the least that either renderer had in a round.
    """

    ours: list[float]
    apart: list[float]
    theirs: list[float]
    spp: int
    means: tuple[float, float]
    images: Agreement
    cores: tuple[float, float]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", metavar="SCENE", nargs="+")
    parser.add_argument("--size", metavar="WxH", type=size_argument, default=(256, 256))
    parser.add_argument("--rounds", type=positive_integer, default=3)
    parser.add_argument("--seconds", type=positive_number, default=4.0, help="of a round (4)")
    parser.add_argument("--flat", action="store_true", help="no shading normals, no cut-outs")
    parser.add_argument("--lambertian", action="store_true", help="that, and all Lambertian")
    parser.add_argument("--own-materials", action="store_true", help="let Mitsuba use its own")
    parser.add_argument("--passes-apart", action="store_true", help="measure that too")
    parser.add_argument("--variant", help="of Mitsuba")
    args = parser.parse_args(arguments)
    variant = set_variant(args.variant)
    table = _table(args.passes_apart, variant)
    notes = []
    for path in args.scenes:
        scene = psf_cl.load_scene(path, size=args.size)
        if args.lambertian:
            scene = lambertian(scene)
        elif args.flat:
            scene = flat(opaque(scene))
        result = compare(scene, args.rounds, args.seconds, args.passes_apart, args.own_materials)
        name = Path(path).stem
        table.add_row(name, *_row(result))
        other = differences(scene, args.own_materials)
        if other:
            notes.append(f"{name} differs from Mitsuba's by: {'; '.join(other)}")
    console = Console(width=max(170, Console().width))
    console.print(table)
    for note in notes:
        console.print(note)
    return 0


def compare(
    scene: Scene, rounds: int, seconds: float, apart: bool, own_materials: bool
) -> Comparison:
    """Measure one scene in both renderers."""
    settings = resolve(scene.render, scene.path, preset="pt", overrides=SETTINGS)
    theirs = Mitsuba(scene, settings, own_materials)
    ours = Ours(scene, settings)
    ours.rate(WARM_UP_SECONDS)
    subjects = {
        "ours": lambda: ours.rate(seconds),
        "theirs": lambda: theirs.rate(seconds),
    }
    if apart:
        ours.passes_apart(WARM_UP_SECONDS)
        subjects["apart"] = lambda: ours.passes_apart(seconds)
    measured = interleaved(subjects, rounds)
    rates = measured.values
    pair = ours.estimate(), theirs.estimate()
    ours.renderer.close()
    return Comparison(
        rates["ours"],
        rates.get("apart", []),
        rates["theirs"],
        theirs.spp,
        tuple(float((image.mean @ LUMINANCE).mean()) for image in pair),
        agreement(*pair),
        (measured.cores["ours"], measured.cores["theirs"]),
    )


def _table(apart: bool, variant: str) -> Table:
    table = Table(
        title=f"M samples/s beside Mitsuba {variant}: median (least-greatest of the rounds)",
        title_justify="left",
    )
    table.add_column("scene")
    for head in ("psf_cl", "Mitsuba", "spp a call", "ratio"):
        table.add_column(head, justify="right")
    if apart:
        table.add_column("passes apart", justify="right")
        table.add_column("share", justify="right")
    for head in ("means", "difference", "blocks out", "cores"):
        table.add_column(head, justify="right")
    return table


def _row(result: Comparison) -> list[str]:
    def million(rates: list[float]) -> str:
        return spread([rate / 1e6 for rate in rates]).text()

    apart = [million(result.apart), ratio(result.apart, result.ours).text()] if result.apart else []
    ours, theirs = result.means
    images = result.images
    return [
        million(result.ours),
        million(result.theirs),
        str(result.spp),
        ratio(result.ours, result.theirs).text(),
        *apart,
        f"{ours:.5f} {theirs:.5f}",
        f"{100.0 * (ours / theirs - 1.0):+.3f} +- {100.0 * images.ratio_sigma:.3f} %",
        f"{images.outside} of {images.z.size}, {images.allowed} may",
        " ".join(f"{cores:.2f}" for cores in result.cores),
    ]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"compare_speed: {error}")
