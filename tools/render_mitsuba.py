"""Render with Mitsuba 3 for some seconds: a contestant of ``psf-cl converge``.

    psf-cl converge SCENE --reference REF.exr --presets pt --command "mitsuba: python \
        tools/render_mitsuba.py {scene} {out} --seconds {seconds} --seed {seed} \
        --size {width}x{height} --stats {stats}"

What it needs and which materials it knows: see ``tools/compare_mitsuba.py``.  Passes of 1, 1, 2,
4, ... samples a pixel are averaged until the next one would go beyond the time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np
from compare_mitsuba import MITSUBA_SAMPLES
from mitsuba_scene import mitsuba_scene, set_variant

import psf_cl
from psf_cl.cli.common import positive_integer, positive_number, size_argument
from psf_cl.errors import InputError
from psf_cl.files import write_whole
from psf_cl.image import Image, json_text, write_exr
from psf_cl.settings import resolve


def main(arguments: Sequence[str] | None = None) -> int:
    """Render, and write the EXR and what ``{stats}`` asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("output", metavar="OUT.exr")
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--seconds", type=positive_number)
    budget.add_argument("--spp", type=positive_integer)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", metavar="WxH", type=size_argument)
    parser.add_argument("--stats", metavar="FILE.json")
    args = parser.parse_args(arguments)

    scene = psf_cl.load_scene(args.scene, size=args.size)
    set_variant()
    settings = resolve(scene.render, scene.path)
    built = mitsuba_scene(scene, settings.max_depth, settings.roulette_depth)
    largest = max(1, MITSUBA_SAMPLES // (scene.width * scene.height))
    # Compiles; a pass of its own, so that render time has no compiling in it.
    np.array(mi.render(built, spp=1, seed=0))

    begin = time.perf_counter()
    total, spp, part, passes = 0.0, 0, 1, 0
    while True:
        if args.spp:
            part = min(part, args.spp - spp)
        number = (args.seed * 0x10001 + passes + 1) & 0xFFFFFFFF
        started = time.perf_counter()
        total = total + part * np.array(mi.render(built, spp=part, seed=number), np.float64)
        now = time.perf_counter()
        spp, passes = spp + part, passes + 1
        if args.spp:
            if spp >= args.spp:
                break
            part = min(spp, largest)
            continue
        left = args.seconds - (now - begin)
        affordable = int(left / ((now - started) / part))
        part = min(spp, largest, affordable)
        if part < 1:
            break
    seconds = time.perf_counter() - begin
    write_exr(Path(args.output), Image({"rgb": (total / spp).astype(np.float32)}))
    if args.stats:
        content = {"render_seconds": seconds, "spp": spp}
        write_whole(args.stats, json_text(content).encode())
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"render_mitsuba: {error}")
