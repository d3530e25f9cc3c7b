"""Render a reference: ``python tools/make_references.py SCENE -o REF.exr --spp N --seeds K``.

Plain path tracing at many samples, as K independent renders of N samples a pixel each.  REF.exr
holds their mean and, as the AOV ``variance``, the variance of the mean's luminance as it shows
between them: no assumption about samples within a render, which Sobol' points make dependent.
REF.json beside it says where the picture comes from.  ``psf-cl render --reference`` and
``psf-cl compare`` read REF.exr.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import psf_cl
from psf_cl.cli.common import add_scene_arguments, load_with_settings, positive_integer
from psf_cl.device.device import open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import check_writable, write_whole
from psf_cl.image import Image, json_text, output_paths, write_exr, write_png
from psf_cl.measure.errors import LUMINANCE
from psf_cl.scene.model import Scene


def main(arguments: Sequence[str] | None = None) -> int:
    """Render all seeds, and write the EXR, its PNG and the record."""
    parser = argparse.ArgumentParser()
    add_scene_arguments(parser)
    # After that call, which makes the settings the epilog.
    parser.description = __doc__
    parser.add_argument("-o", "--output", metavar="REF.exr", required=True)
    parser.add_argument("--spp", type=positive_integer, default=1024, help="for each seed (1024)")
    parser.add_argument("--seeds", type=positive_integer, default=8, help="at least 2 (8)")
    parser.add_argument("--device", metavar="TEXT", help="part of its name")
    args = parser.parse_args(arguments)
    if args.seeds < 2:
        parser.error("--seeds: expected at least 2: the variance shows between them")
    if args.crop or args.aov:
        parser.error("--crop, --aov: a reference is the whole picture and nothing else")

    exr, png = output_paths(args.output)
    record = exr.with_suffix(".json")
    for path in (exr, png, record):
        check_writable(path)
    scene, settings = load_with_settings(args)
    device = open_device(args.device)
    seeds = [(settings.seed + index) & 0xFFFFFFFF for index in range(args.seeds)]
    first, total, squares = None, 0.0, 0.0
    for number, seed in enumerate(seeds):
        renderer = psf_cl.Renderer(scene, replace(settings, seed=seed), device)
        renderer.render(spp=args.spp)
        rgb = renderer.snapshot().rgb.astype(np.float64)
        stats = renderer.stats()
        renderer.close()
        if first is None:
            first = rgb
        # From the first render's values on, so that squares of bright pixels do not cancel.
        total = total + (rgb - first)
        squares = squares + ((rgb - first) @ LUMINANCE) ** 2
        print(f"{exr}: {number + 1} of {len(seeds)} renders", flush=True)

    count = len(seeds)
    rgb = first + total / count
    spread = np.maximum(squares - (total @ LUMINANCE) ** 2 / count, 0.0)
    variance = (spread / (count - 1) / count)[..., None]
    aovs = {"rgb": rgb.astype(np.float32), "variance": variance.astype(np.float32)}
    stats = {key: stats[key] for key in ("scene", "device", "driver", "settings")}
    stats["settings"].pop("seed")
    image = Image(aovs, {**stats, "spp": args.spp * count, "seed": seeds})
    write_exr(exr, image)
    write_png(png, image)
    noise = float(np.sqrt(variance.mean()) / (rgb @ LUMINANCE).mean())
    write_whole(record, (json_text(_record(args, scene, image, noise), indent=2) + "\n").encode())
    print(f"{exr}: {args.spp * count} samples a pixel, noise {100.0 * noise:.3f} % of the mean")
    return 0


def scene_hash(scene: Scene) -> str:
    """Return the SHA-256 of what the picture is of: also of meshes and textures in other files."""
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
        elif is_dataclass(value):
            for item in fields(value):
                if item.name not in ("path", "notes"):
                    add(getattr(value, item.name))
        elif isinstance(value, tuple):
            for item in value:
                add(item)
        else:
            digest.update(repr(value).encode() + b";")

    add(scene)
    return digest.hexdigest()


def _record(args: argparse.Namespace, scene: Scene, image: Image, noise: float) -> dict[str, Any]:
    """Return what is needed to tell whether the picture still is of this scene."""
    files = [path for path in (args.scene, args.environment) if path]
    hashes = {path: hashlib.sha256(Path(path).read_bytes()).hexdigest() for path in files}
    return {
        "version": psf_cl.__version__,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "sha256": hashes | {"all that was loaded": scene_hash(scene)},
        "camera": args.camera,
        "width": image.width,
        "height": image.height,
        "spp_per_seed": args.spp,
        "noise": noise,
        **image.stats,
    }


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"make_references: {error}")
