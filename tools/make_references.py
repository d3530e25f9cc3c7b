"""Render a reference: ``python tools/make_references.py SCENE -o REF.exr --noise 1e-5``.

Plain path tracing at many samples, as independent renders of N samples a pixel each, until there
are K of them and, with ``--noise``, until the relMSE of their mean against the truth is estimated
below E.  REF.exr holds the mean, the variance of the mean as it shows between the renders
(``variance``), and the mean of every other render (``half``), all as floats; its header says
samples, seeds, settings and version.  REF.json beside it says where the picture comes from.

The file is written after every render, from the second on: an interrupted command, started again,
goes on; so does a finished one with more ``--seeds`` or less ``--noise``.  At the end the halves
are compared with what the stated variance allows.

With ``--frames A:B`` there is one of each frame; #### in REF.exr is its number.

``psf-cl converge``, ``psf-cl render --reference`` and ``psf-cl compare`` read REF.exr.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psf_cl
from psf_cl.cli.common import (
    add_frame_arguments,
    add_scene_arguments,
    load_with_settings,
    numbered,
    positive_integer,
    positive_number,
    tell_notes,
)
from psf_cl.device.device import Device, open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import check_writable, write_whole
from psf_cl.image import Image, json_text, output_paths, read_exr, write_exr, write_png
from psf_cl.measure.curves import Reference
from psf_cl.measure.references import RunningReference
from psf_cl.scene.digest import scene_digest
from psf_cl.scene.load import NO_ENVIRONMENT, load_scene
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings

# Fewer renders say too little of their own variance to stop by it.
LEAST_SEEDS = 8

# Of each render; fewer where the noise decides when to stop.
SPP = 1024
SPP_TOWARDS_NOISE = 256

# Halves that differ more than this, in sigmas of the stated variance, contradict it.
LARGEST_RMS = 1.25


def main(arguments: Sequence[str] | None = None) -> int:
    """Render, and write the EXR, its PNG and the record; return 1 if the halves disagree."""
    parser = argparse.ArgumentParser()
    add_scene_arguments(parser)
    # After that call, which makes the settings the epilog.
    parser.description = __doc__
    add_frame_arguments(parser)
    parser.add_argument("-o", "--output", metavar="REF.exr", required=True)
    parser.add_argument(
        "--spp",
        type=positive_integer,
        help=f"of each render ({SPP}; with --noise {SPP_TOWARDS_NOISE}, to stop soon after it)",
    )
    parser.add_argument(
        "--seeds", type=positive_integer, default=LEAST_SEEDS, help="renders, at least 2 (8)"
    )
    parser.add_argument(
        "--noise",
        metavar="E",
        type=positive_number,
        help="go on until the relMSE of the reference itself is below E",
    )
    parser.add_argument("--device", metavar="TEXT", help="part of its name")
    args = parser.parse_args(arguments)
    if args.seeds < 2:
        parser.error("--seeds: expected at least 2: the variance shows between them")
    if args.crop or args.aov:
        parser.error("--crop, --aov: a reference is the whole picture and nothing else")

    if not args.frames:
        scene, settings = load_with_settings(args)
        return make(args, scene, settings, open_device(args.device), args.output)
    _, settings = load_with_settings(args)
    device = open_device(args.device)
    failed = 0
    for frame in args.frames:
        scene = load_scene(
            args.scene,
            environment=args.environment,
            camera=args.camera,
            size=args.size,
            clip=args.clip,
            time=frame / args.fps,
        )
        failed |= make(args, scene, settings, device, numbered(args.output, frame, "-o"))
    return failed


def make(
    args: argparse.Namespace, scene: Scene, settings: Settings, device: Device, output: str
) -> int:
    """Render one reference, and write it; return 1 if its halves disagree."""
    spp = args.spp or (SPP_TOWARDS_NOISE if args.noise else SPP)
    exr, png = output_paths(output)
    record = exr.with_suffix(".json")
    for path in (exr, png, record):
        check_writable(path)
    tell_notes(scene.notes)
    made = {
        "scene": scene.path,
        "scene_digest": scene_digest(scene),
        "settings": {k: v for k, v in asdict(settings).items() if k != "seed"},
        "spp_per_seed": spp,
        "device": device.name,
    }
    running = resumed(exr, made, settings.seed, (scene.height, scene.width))
    if running.count:
        print(f"{exr}: goes on after {running.count} renders")
    noise = noise_of(running)
    while running.count < args.seeds or (args.noise and noise > args.noise):
        seed = (settings.seed + running.count) & 0xFFFFFFFF
        renderer = psf_cl.Renderer(scene, replace(settings, seed=seed), device)
        try:
            renderer.render(spp=spp)
            running.add(renderer.snapshot().rgb)
        finally:
            renderer.close()
        if running.count < 2:
            continue
        noise = noise_of(running)
        image = image_of(running, made, settings.seed, noise)
        write_exr(exr, image)
        print(f"{exr}: {running.count} renders, relMSE {noise:.3g}", flush=True)

    image = image_of(running, made, settings.seed, noise)
    write_png(png, image)
    halves = running.halves_agreement()
    content = {**_record(args, image), "halves": asdict(halves)}
    write_whole(record, (json_text(content, indent=2) + "\n").encode())
    print(
        f"{exr}: {image.stats['spp']} samples a pixel, relMSE {noise:.3g}; its halves differ by "
        f"{halves.rms:.2f} sigma (expected about 1), {100.0 * halves.beyond_three:.2f} % of the "
        "blocks by more than 3"
    )
    if halves.rms > LARGEST_RMS:
        print("FAILED: the renders differ more than the variance says: more --spp may help")
        return 1
    return 0


def noise_of(running: RunningReference) -> float:
    """Return the relMSE that the mean has by its own variance; infinite before the second render.

    Raises:
        InputError: the picture is black or not finite.
    """
    if running.count < 2:
        return float("inf")
    return Reference(running.mean, running.variance, running.count).noise


def image_of(
    running: RunningReference, made: dict[str, Any], first_seed: int, noise: float
) -> Image:
    """Return what is written."""
    seeds = [(first_seed + k) & 0xFFFFFFFF for k in range(running.count)]
    spp = made["spp_per_seed"] * running.count
    return Image(running.aovs(), {**made, "spp": spp, "seed": seeds, "noise": noise})


def resumed(
    path: Path, made: dict[str, Any], first_seed: int, shape: tuple[int, int]
) -> RunningReference:
    """Return what ``path`` holds if it was begun in the same way, else a new start."""
    fresh = RunningReference(*shape)
    if not path.is_file():
        return fresh
    try:
        image = read_exr(path)
        seeds = image.stats["seed"]
        same = all(image.stats.get(key) == value for key, value in made.items())
        same = same and image.stats.get("version") == psf_cl.__version__
        same = same and seeds == [(first_seed + k) & 0xFFFFFFFF for k in range(len(seeds))]
        return RunningReference.from_image(image, len(seeds)) if same else fresh
    except (InputError, KeyError, TypeError, ValueError):
        return fresh


def _record(args: argparse.Namespace, image: Image) -> dict[str, Any]:
    """Return what is needed to tell whether the picture still is of this scene."""
    files = [path for path in (args.scene, args.environment) if path not in (None, NO_ENVIRONMENT)]
    return {
        "version": psf_cl.__version__,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "sha256": {path: hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files},
        "camera": args.camera,
        "width": image.width,
        "height": image.height,
        **image.stats,
    }


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"make_references: {error}")
