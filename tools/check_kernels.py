"""Run presets in Oclgrind: ``python tools/check_kernels.py [--presets a,b] [--lanes 1,16]``.

Oclgrind is a simulator of OpenCL devices (Debian's package ``oclgrind``): it reports every access
outside of a buffer, data races between work items, and barriers that not all of a group reach.  It
is also a second implementation, in which habits of PoCL show.  Small pictures of small scenes, with
a list of triangles and with a tree that is built, for each preset and width of lanes.

Optimisations are off, for it knows no vector intrinsics, and so are builtins of compilers.  The
exit code is 1 if it reports anything, and if it could not run at all.

Source: Price, McIntosh-Smith: Oclgrind: An Extensible OpenCL Device Simulator, IWOCL 2015.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
from stability_cases import camera, grey, matt, room, scene_of

import psf_cl.renderer
from psf_cl.device.device import open_device
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Light, Material, Mesh, Scene, Texture
from psf_cl.settings import PRESETS, Settings, resolve
from psf_cl.traits import DeviceTraits

LIBRARIES = (
    "/usr/lib/oclgrind/liboclgrind-rt-icd.so",
    "/usr/lib/x86_64-linux-gnu/oclgrind/liboclgrind-rt-icd.so",
    "/usr/local/lib/liboclgrind-rt-icd.so",
)
EDGE = 4

#: Settings that make presets light enough for a simulator.
SMALL = {"max_depth": 2, "chains": 128}
JOB_SECONDS = 1200.0


def everything(edge: int) -> Scene:
    """Return a scene that needs all features: textures, blending, glass, layers, lights, a sky."""
    chance = np.random.default_rng(1)
    checks = Texture("checks", chance.integers(0, 256, (4, 4, 4), np.uint8))
    flat = np.full((2, 2, 4), (128, 128, 255, 255), np.uint8)
    bumps = Texture("bumps", flat, srgb=False, wrap=("clamp", "mirror"))
    quad = primitives.quad()
    colours = chance.random((len(quad.positions), 4), np.float32)
    painted: Mesh = dataclasses.replace(quad, colors=colours)
    lamp = transform.translation((0, 2, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    coated = Material(
        base_color_texture=0,
        normal_texture=1,
        roughness=0.4,
        clearcoat=1.0,
        sheen_color=grey(0.5),
        anisotropy=0.5,
    )
    parts = [
        (quad, transform.scaling(2.0), coated),
        (primitives.sphere(6, 4), transform.translation((-0.5, 0.5, 0.0)) @ _half(), _glass()),
        (painted, transform.translation((0.5, 0.5, 0.0)) @ _half(), _veil()),
        (quad, lamp @ _half(), matt(0.0, emission=grey(5.0))),
    ]
    scene = scene_of(parts, camera((0.0, 1.0, 3.0), (0.0, 0.5, 0.0), lens_radius=0.01), edge)
    return dataclasses.replace(
        scene,
        textures=(checks, bumps),
        lights=(
            Light("point", (1.0, 1.0, 1.0), position=(1.0, 1.0, 1.0)),
            Light("spot", (1.0, 1.0, 1.0), position=(-1.0, 2.0, 1.0), direction=(0.0, -1.0, 0.0)),
            Light("directional", (1.0, 1.0, 1.0), direction=(0.0, -1.0, 0.0)),
        ),
        environment=Environment(grey(1.0), chance.random((4, 8, 3), np.float32)),
    )


def _half() -> np.ndarray:
    return transform.scaling(0.5)


def _glass() -> Material:
    return Material(base_color=grey(1.0), transmission=1.0, roughness=0.2)


def _veil() -> Material:
    return Material(alpha=0.5, alpha_mode="blend", metallic=1.0, base_color_texture=0)


SCENES = {"room": room, "everything": everything}


class InTurn(Executor):
    """Does at once what it is asked to do beside."""

    def __init__(self, count: int) -> None:
        super().__init__()

    def submit(self, call: Callable[..., Any], /, *args: Any, **values: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(call(*args, **values))
        return future


def render(name: str, preset: str, lanes: int, tree: bool) -> None:
    """Render one picture on the simulator; its reports go where its environment says."""
    # The simulator runs one kernel at a time, whatever threads ask for it.
    psf_cl.renderer.ThreadPoolExecutor = InTurn  # type: ignore[misc,assignment]
    few = 0 if tree else 400
    traits = DeviceTraits(
        "cpu", lanes, 16, slots=64, group=4, run=2, few_triangles=few, few_corners=few
    )
    device = open_device("oclgrind", traits)
    small = {key: value for key, value in SMALL.items() if hasattr(Settings(), key)}
    settings = resolve({}, name, preset, small)
    with contextlib.closing(Renderer(SCENES[name](EDGE), settings, device)) as renderer:
        renderer.render(spp=2)
        if not np.isfinite(renderer.image().rgb).all():
            raise SystemExit("a pixel is not finite")


def job(library: str, name: str, preset: str, lanes: int, tree: bool) -> tuple[str, float]:
    """Run ``render`` in a process that sees only the simulator; return its reports and seconds."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        (Path(folder) / "oclgrind.icd").write_text(library + "\n")
        environment = os.environ | {
            "OCL_ICD_VENDORS": folder,
            "OCLGRIND_DATA_RACES": "1",
            "OCLGRIND_BUILD_OPTIONS": "-cl-opt-disable -DPLAIN_C",
            "OCLGRIND_LOG": str(log),
            "OCLGRIND_MAX_ERRORS": "20",
        }
        start = time.perf_counter()
        command = [sys.executable, __file__, "--job", name, preset, str(lanes), str(int(tree))]
        try:
            done = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=JOB_SECONDS,
            )
        except subprocess.TimeoutExpired:
            return f"not done after {JOB_SECONDS:.0f} s", JOB_SECONDS
        reports = log.read_text(errors="replace").strip() if log.exists() else ""
        if done.returncode != 0:
            reports += "\n" + "\n".join(done.stderr.strip().splitlines()[-6:])
        return reports.strip(), time.perf_counter() - start


def main(argv: Sequence[str] | None = None) -> int:
    """Run the jobs that were asked for; return 0 if nothing was reported, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--presets", default=",".join(PRESETS), help="default: all")
    parser.add_argument("--lanes", default="1,16")
    parser.add_argument("--scenes", default=",".join(SCENES))
    parser.add_argument("--library", help="liboclgrind-rt-icd.so, if it is at no usual place")
    parser.add_argument("--job", nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.job:
        name, preset, lanes, tree = args.job
        render(name, preset, int(lanes), tree == "1")
        return 0
    library = args.library or next((path for path in LIBRARIES if Path(path).exists()), None)
    if library is None:
        print("Oclgrind is not there; install it: sudo apt-get install oclgrind", file=sys.stderr)
        return 1
    failed = 0
    for preset in args.presets.split(","):
        for lanes in map(int, args.lanes.split(",")):
            for name in args.scenes.split(","):
                # The room has a tree that is built, the other scene a list.
                reports, seconds = job(library, name, preset, lanes, tree=name == "room")
                verdict = "FAILED" if reports else "nothing reported"
                print(f"{preset}, {lanes} lanes, {name}: {verdict} ({seconds:.0f} s)", flush=True)
                if reports:
                    failed += 1
                    print(reports)
    print(f"{failed} jobs with reports")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
