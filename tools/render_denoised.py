"""Render by plain path tracing and denoise: a contestant of ``psf-cl converge``.

    psf-cl converge SCENE --reference REF.exr --presets pt,psf --command "oidn: python \
        tools/render_denoised.py {scene} {out} --seconds {seconds} --seed {seed} \
        --size {width}x{height} --stats {stats}"

Intel's Open Image Denoise (``pip install pyoidn``) gets the picture with the albedo and the normals
of the first surfaces.  What it takes counts: it is measured on a picture of one sample before, and
rendering ends so much sooner.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyoidn

import psf_cl
from psf_cl.cli.common import positive_number, size_argument
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import write_whole
from psf_cl.image import Image, json_text, write_exr
from psf_cl.renderer import Renderer
from psf_cl.settings import resolve


def denoised(renderer: Renderer) -> np.ndarray:
    """Return the picture that ``renderer`` has so far, ``(h, w, 3)``, denoised."""
    image = renderer.image()
    albedo = np.clip(image.aovs["albedo"], 0.0, 1.0).astype(np.float32)
    normal = image.aovs["normal"].astype(np.float32)
    return pyoidn.denoise(image.rgb.astype(np.float32), albedo, normal, hdr=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Render, denoise, and write the EXR and what ``{stats}`` asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("output", metavar="OUT.exr")
    parser.add_argument("--seconds", type=positive_number, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", metavar="WxH", type=size_argument)
    parser.add_argument("--environment", metavar="FILE")
    parser.add_argument("--stats", metavar="FILE.json")
    args = parser.parse_args(arguments)

    scene = psf_cl.load_scene(args.scene, environment=args.environment, size=args.size)
    settings = resolve(scene.render, scene.path, "pt", {"seed": args.seed})
    renderer = Renderer(scene, settings, outputs=("albedo", "normal"))
    renderer.render(spp=1)
    first = renderer.scheduler.clock.now()
    # The first time loads the network.
    denoised(renderer)
    begin = time.perf_counter()
    picture = denoised(renderer)
    taken = time.perf_counter() - begin
    if args.seconds > first + taken:
        renderer.render(seconds=args.seconds - taken)
        begin = time.perf_counter()
        picture = denoised(renderer)
        taken = time.perf_counter() - begin
    seconds = renderer.scheduler.clock.now() + taken
    write_exr(Path(args.output), Image({"rgb": picture}))
    if args.stats:
        content = {"render_seconds": seconds, "spp": renderer.scheduler.passes}
        write_whole(args.stats, json_text(content).encode())
    renderer.close()
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"render_denoised: {error}")
