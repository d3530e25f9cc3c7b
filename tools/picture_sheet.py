"""A sheet of pictures at equal times: ``python tools/picture_sheet.py [SCENE] -o FILE.png``.

Each column is a way to render, ``--run "NAME: KEY=VALUE ..."`` as in ``psf-cl converge``; each row
a time, of all processors: a second of the machine is as many processor seconds as it has cores, so
that other programs hardly matter.  Compiling and loading do not count.

Without a scene and ways it is the picture of the talk (Binder, Keller 2019): many lights, chosen by
the light hierarchy and by photons, alone and with the screen filter over the picture.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageDraw

import psf_cl
from psf_cl.cli.common import positive_number, size_argument
from psf_cl.cli.converge import named_settings
from psf_cl.device.device import Device, open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.image import Image, read_exr, tone_map, write_png_pixels
from psf_cl.measure.errors import compare
from psf_cl.renderer import Renderer
from psf_cl.scene.model import Scene
from psf_cl.settings import resolve

MANY_LIGHTS = Path(__file__).parents[1] / "scenes" / "many_lights.toml"
SECONDS = (1.0, 4.0)
BAR = 14

Settings = Sequence[tuple[str, str]]

TALK: list[tuple[str, Settings]] = [
    ("light hierarchy", [("light_sampling", "hierarchy")]),
    ("photons", [("light_sampling", "photon")]),
    ("hierarchy, filtered", [("light_sampling", "hierarchy"), ("screen_filter", "path_space")]),
    ("photons, filtered", [("light_sampling", "photon"), ("screen_filter", "path_space")]),
]


def render_for(scene: Scene, device: Device, way: Settings, seconds: float) -> Image:
    """Return the picture after so many processor seconds, or after the first pass."""
    values = dict(way)
    preset = values.pop("preset", None)
    renderer = Renderer(scene, resolve(scene.render, scene.path, preset, values), device)
    end = time.process_time() + seconds
    renderer.render(spp=1 << 20, progress=lambda now: now.passes < 1 or time.process_time() < end)
    image = renderer.image()
    renderer.close()
    return image


def denoise_for(scene: Scene, device: Device, seconds: float) -> Image:
    """Return plain path tracing, denoised: both take so many processor seconds together."""
    # Tools alone have the denoiser.
    from render_denoised import denoised

    settings = resolve(scene.render, scene.path, "pt")
    renderer = Renderer(scene, settings, device, outputs=("albedo", "normal"))
    begin = time.process_time()
    renderer.render(spp=1)
    first = time.process_time() - begin
    # The first time loads the network.
    denoised(renderer)
    begin = time.process_time()
    denoised(renderer)
    end = time.process_time() + seconds - first - (time.process_time() - begin)
    renderer.render(spp=1 << 20, progress=lambda now: time.process_time() < end)
    image = Image({"rgb": denoised(renderer)}, {"spp": renderer.scheduler.passes})
    renderer.close()
    return image


def sheet(
    pictures: Sequence[Sequence[np.ndarray]], captions: Sequence[Sequence[str]]
) -> np.ndarray:
    """Return rows of pictures ``(h, w, 3)`` uint8, with a caption above each."""
    height, width = pictures[0][0].shape[:2]
    rows, columns = len(pictures), len(pictures[0])
    page = PIL.Image.new("RGB", (columns * width, rows * (height + BAR)), "white")
    draw = PIL.ImageDraw.Draw(page)
    for row in range(rows):
        for column in range(columns):
            left, top = column * width, row * (height + BAR)
            draw.text((left + 3, top + 1), captions[row][column], fill="black")
            page.paste(PIL.Image.fromarray(pictures[row][column]), (left, top + BAR))
    return np.asarray(page)


def main(arguments: Sequence[str] | None = None) -> int:
    """Render and write the sheet; print what each picture is worth."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", default=MANY_LIGHTS, metavar="SCENE")
    parser.add_argument(
        "--run", dest="runs", type=named_settings, action="append", metavar="'NAME: KEY=VALUE ...'"
    )
    parser.add_argument("--size", type=size_argument, default=(160, 100), metavar="WxH")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.png")
    parser.add_argument("--seconds", type=positive_number, nargs="+", default=SECONDS)
    parser.add_argument("--exposure", type=float, default=0.0, help="stops")
    parser.add_argument(
        "--reference", type=Path, metavar="FILE.exr", help="to show, and to say the relMSE"
    )
    parser.add_argument(
        "--denoised",
        action="store_true",
        help="show plain path tracing with Open Image Denoise too (pip install pyoidn)",
    )
    args = parser.parse_args(arguments)
    reference = read_exr(args.reference).rgb if args.reference else None
    size = args.size if reference is None else (reference.shape[1], reference.shape[0])
    scene, device = psf_cl.load_scene(args.scene, size=size), open_device()
    cores = os.cpu_count() or 1
    pictures, captions = [], []
    for seconds in args.seconds:
        row, texts = [], []
        ways: list[tuple[str, Settings | None]] = [*(args.runs or TALK)]
        if args.denoised:
            ways.append(("pt + OIDN", None))
        for name, way in ways:
            budget = seconds * cores
            image = (
                denoise_for(scene, device, budget)
                if way is None
                else render_for(scene, device, way, budget)
            )
            text = f"{name}, {seconds:g} s"
            worth = f"{text}, {image.stats['spp']} spp"
            if reference is not None:
                error = compare(image.rgb, reference).relmse
                text, worth = f"{text}: {error:.2g}", f"{worth}, relMSE {error:.3g}"
            print(worth)
            row.append(tone_map(image.rgb, args.exposure))
            texts.append(text)
        if reference is not None:
            row.append(tone_map(reference, args.exposure))
            texts.append("reference")
        pictures.append(row)
        captions.append(texts)
    write_png_pixels(args.output, sheet(pictures, captions))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"picture_sheet: {error}")
