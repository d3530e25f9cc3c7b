"""Learned directions beside plain paths and Metropolis: ``python tools/learned_figure.py SCENE``.

Renders the scene by BSDF sampling (preset pt), by learned directions (learned), by these with ends
by the radiance cache, and by Metropolis light transport (mlt): with ``--paths`` paths a pixel each,
and in the time that plain paths take for these, in processor time (of all threads), which other
programs hardly change.  Prints a table with the error against ``--reference``, and writes the
pictures, above for equal paths and below for equal time, to ``-o``.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from psf_cl.cli.common import positive_integer, size_argument
from psf_cl.device.device import Device, open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.image import Image, read_exr, tone_map, write_png_pixels
from psf_cl.measure.errors import compare
from psf_cl.renderer import Progress, Renderer
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Scene
from psf_cl.settings import resolve

RUNS = {
    "BSDF sampling": ("pt", {}),
    "learned": ("learned", {}),
    "learned, cache": ("learned", {"termination": "cache"}),
    "Metropolis": ("mlt", {}),
}

#: Pixels of a picture in the figure for each one that was rendered, and between pictures.
ENLARGED, GAP = 7, 4


class Run(NamedTuple):
    """A picture, what it took, and its relMSE as its own halves tell it, if they do."""

    image: Image
    seconds: float
    noise: float | None


def rendered(
    device: Device,
    scene: Scene,
    preset: str,
    values: dict[str, str],
    paths: int,
    budget: float | None,
) -> Run:
    """Render ``paths`` paths a pixel, or as many as fit into ``budget``, processor seconds."""
    settings = resolve(scene.render, scene.path, preset, values)
    # Neither chains nor what pixels share shows as a difference between halves.
    halves = settings.integrator == "path" and settings.termination != "cache"
    if settings.guiding != "off":
        # Where the guide does not pay, programs without it take over: they are built by now.
        unguided = dataclasses.replace(settings, guiding="off")
        with contextlib.closing(Renderer(scene, unguided, device, halves=halves)) as other:
            other.render(spp=1)
    renderer = Renderer(scene, settings, device, halves=halves)
    try:
        renderer.render(spp=1)
        start = time.process_time()

        def goes_on(now: Progress) -> bool:
            return budget is None or time.process_time() - start < budget

        renderer.render(spp=paths if budget is None else 1 << 20, progress=goes_on)
        seconds = time.process_time() - start
        return Run(renderer.image(), seconds, renderer.estimated_error() if halves else None)
    finally:
        renderer.close()


def figure(rows: list[list[Image]], exposure: float) -> np.ndarray:
    """Return the pictures side by side, ``(h, w, 3)`` uint8."""

    def framed(image: Image) -> np.ndarray:
        pixels = tone_map(image.rgb, exposure).repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
        return np.pad(pixels, ((0, GAP), (0, GAP), (0, 0)), constant_values=255)

    whole = np.concatenate([np.concatenate([framed(i) for i in row], axis=1) for row in rows])
    return whole[:-GAP, :-GAP]


def reduced(path: str, width: int, height: int) -> np.ndarray:
    """Return a reference, averaged over whole blocks of its pixels, ``(height, width, 3)``.

    Raises:
        InputError: its size is no multiple of the one that is asked for.
    """
    rgb = read_exr(path).rgb
    block = max(rgb.shape[0] // height, 1)
    if rgb.shape != (block * height, block * width, 3):
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"
        raise InputError(f"{path}: expected a multiple of {width}x{height} pixels, got {size}")
    return rgb.reshape(height, block, width, block, 3).mean(axis=(1, 3))


def run(args: argparse.Namespace) -> int:
    """Render, print the table, write the figure."""
    scene = load_scene(Path(args.scene), size=args.size)
    if args.environment:
        sky = dataclasses.replace(scene.environment, radiance=(args.environment,) * 3)
        scene = dataclasses.replace(scene, environment=sky)
    reference = reduced(args.reference, *args.size) if args.reference else None
    print("| | paths | processor seconds | rays a path | without light | relMSE | by its halves |")
    print("|---|---|---|---|---|---|---|")
    device, rows, budget = open_device(), [], None
    for title in ("equal paths", "equal time"):
        row = []
        for name, (preset, values) in RUNS.items():
            image, seconds, noise = rendered(device, scene, preset, values, args.paths, budget)
            row.append(image)
            if title == "equal paths" and name == "BSDF sampling":
                plain = seconds
            error = compare(image.rgb, reference) if reference is not None else None
            dark = image.stats["paths"]["zero_contribution"]
            print(
                f"| {name}, {title} | {image.stats['spp']} | {seconds:.0f} "
                f"| {image.stats['paths']['mean_rays']:.1f} "
                f"| {'' if dark is None else f'{dark:.0%}'} "
                f"| {'' if error is None else f'{error.relmse:.3g}'} "
                f"| {'' if noise is None else f'{noise:.3g}'} |",
                flush=True,
            )
        rows.append(row)
        budget = plain
    if args.output:
        write_png_pixels(args.output, figure(rows, args.exposure))
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--size", metavar="WxH", type=size_argument, default=(64, 64))
    parser.add_argument("--paths", metavar="N", type=positive_integer, default=2048)
    parser.add_argument("--exposure", metavar="EV", type=float, default=0.0)
    parser.add_argument("--environment", metavar="L", type=float, help="radiance of a constant sky")
    parser.add_argument("--reference", metavar="REF.exr")
    parser.add_argument("-o", "--output", metavar="OUT.png")
    try:
        return run(parser.parse_args(arguments))
    except (DeviceError, InputError) as error:
        print(f"learned_figure: {error}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1


if __name__ == "__main__":
    sys.exit(main())
