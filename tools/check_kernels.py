"""Run every kernel in Oclgrind: ``python tools/check_kernels.py [--jobs a,b] [--lanes 1,16]``.

Oclgrind is a simulator of OpenCL devices (Debian's package ``oclgrind``): it reports every access
outside of a buffer, data races between work items, and barriers that not all of a group reach.  It
is also a second implementation, in which habits of PoCL show.  A job is a small picture of a small
scene, for each preset with a list of triangles and with a tree that is built, and some more for
what no preset uses: sequences, instances, trees of lights, all outputs.

Optimisations are off, for it knows no vector intrinsics, and so are builtins of compilers.  The
exit code is 1 if it reports anything, if it could not run at all, and, where all jobs were asked
for, if there is a kernel that none of them launched.

Source: Price, McIntosh-Smith: Oclgrind: An Extensible OpenCL Device Simulator, IWOCL 2015.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stability_cases import camera, grey, matt, room, room_that_moves, scene_of

import psf_cl.instancing
import psf_cl.renderer
import psf_cl.stages
from psf_cl.device.device import open_device
from psf_cl.device.program import Launch
from psf_cl.device.sources import kernel_folder
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Environment, Light, Material, Mesh, Scene, Texture
from psf_cl.settings import PRESETS, resolve
from psf_cl.traits import DeviceTraits

LIBRARIES = (
    "/usr/lib/oclgrind/liboclgrind-rt-icd.so",
    "/usr/lib/x86_64-linux-gnu/oclgrind/liboclgrind-rt-icd.so",
    "/usr/local/lib/liboclgrind-rt-icd.so",
)
#: Of a picture, pixels: more than 16 lanes, and no multiple of them.
SIZE = (5, 4)

#: Settings that make presets light enough for a simulator.
SMALL = {"max_depth": 2, "chains": 128, "photons": 64}
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


def instances(edge: int) -> Scene:
    """Return the room with four balls, which have one tree together."""
    scene = room(edge)
    ball = scene.shapes[1]
    places = ((0.0, 0.0, 0.0), (-0.6, 0.0, 0.0), (0.0, 0.9, -0.5), (-0.6, 0.8, -0.5))
    balls = [
        dataclasses.replace(ball, transform=transform.translation(place) @ ball.transform)
        for place in places
    ]
    return dataclasses.replace(scene, shapes=(scene.shapes[0], scene.shapes[2], *balls))


def lantern(edge: int) -> Scene:
    """Return a glowing ball over a floor."""
    place = transform.translation((0.0, 0.8, 0.0)) @ _half()
    parts = [
        (primitives.quad(), transform.scaling(2.0), matt(0.5)),
        (primitives.sphere(), place, matt(0.0, emission=grey(5.0))),
    ]
    return scene_of(parts, camera((0.0, 1.0, 3.0), (0.0, 0.5, 0.0)), edge)


@dataclass(frozen=True)
class Job:
    """One picture, or the pictures of a sequence.

    Attributes:
        tree: whether triangles are in a tree; else they are a list.
        times: of the frames after the first, s.
        everything: with outputs and statistics, and a look at the first pass before its end.
        outputs: more outputs.
        size: of the picture, if it is not to be the usual one.
    """

    scene: Callable[[int], Scene]
    preset: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    tree: bool = True
    times: tuple[float, ...] = ()
    everything: bool = False
    outputs: tuple[str, ...] = ()
    size: tuple[int, int] = SIZE

    def picture(self) -> Scene:
        """Return the scene with a picture of the job's size."""
        width, height = self.size
        return dataclasses.replace(self.scene(width), width=width, height=height)


OUTPUTS = ("albedo", "normal", "depth", "direct", "indirect", "variance", "samples", "motion")
OUTPUTS_OF_CELLS = ("cells", "occupancy", "cell_count", "cell_variance", "filter_weight")

#: What an estimate of the error asks for.
AS_SAMPLED = {"filter_restore": False, "filter_fireflies": False}

JOBS = {
    **{f"{preset}, tree": Job(room, preset) for preset in PRESETS},
    **{f"{preset}, list": Job(everything, preset, tree=False) for preset in PRESETS},
    "sequence, tree": Job(room_that_moves, "game", times=(0.1, 1.0)),
    "sequence, list": Job(room_that_moves, "game", tree=False, times=(1.0,)),
    "exponential": Job(room_that_moves, "pt", {"temporal": "exponential"}, False, (1.0,)),
    "instances": Job(instances, "psf"),
    "hierarchy": Job(everything, "pt", {"light_sampling": "hierarchy"}, tree=False),
    "photon origins": Job(room, "pt", {"light_sampling": "photon_origin"}),
    "cache": Job(room_that_moves, "pt", {"termination": "cache"}, times=(1.0,)),
    "material cache": Job(everything, "pt", {"material_cache": "hash_grid"}, times=(1.0,)),
    "rectangles": Job(room, "pt", {"area_sampling": "solid_angle"}, tree=False),
    "spheres": Job(lantern, "photon"),
    "range search": Job(room, "psf", {"path_filter": "range_search"} | AS_SAMPLED, everything=True),
    "outputs": Job(everything, "psf", AS_SAMPLED, tree=False, everything=True),
    "outputs of cells": Job(room, "psf", {"cell_min_count": 4}, outputs=OUTPUTS_OF_CELLS),
    # Several tiles of RESTORE_TILE and of PROBE_TILE, those at the edges no whole ones.
    "tiles": Job(room, "psf", {"cell_walls": False}, size=(37, 23)),
    "tiles of a sequence": Job(room_that_moves, "game", times=(1.0,), size=(10, 9)),
    "layers of cells": Job(everything, "psf", {"cell_directions": 4}, tree=False),
    "screen filter": Job(room, "pt", {"screen_filter": "path_space"}, tree=False),
    "splits": Job(room, "pt", {"splits": 2, "sampler": "random", "direct_sampling": "bsdf"}),
    "virtual lights": Job(
        room, "pt", {"indirect_light": "virtual_lights", "light_sampling": "photon"}
    ),
    "views": Job(
        everything,
        "pt",
        {
            "guiding": "learned",
            "light_sampling": "photon",
            "shadow_rays": "auto",
            "texture_level": "footprint",
        },
        tree=False,
        outputs=("guide", "visits", "lights", "light_pmf", "bounces"),
    ),
}

#: Tables that are large whatever the scene, and waits that are long: simulators are slow.
SMALL_TABLES = (
    (psf_cl.stages.guide, "LEAST_SLOTS", 64),
    (psf_cl.stages.guide, "FIRST_DECISION", 1),
    (psf_cl.stages.cache, "LEAST_SLOTS", 64),
    (psf_cl.stages.material_cells, "LEAST_SLOTS", 64),
    (psf_cl.stages.photons, "CELLS", 64),
    (psf_cl.stages.metropolis, "CANDIDATES", 256),
    (psf_cl.stages.metropolis, "MUTATIONS_PER_EPOCH", 4),
    (psf_cl.stages.range_search, "BATCH", 64),
    (psf_cl.instancing, "LEAST_SAVED", 1),
)


class InTurn(Executor):
    """Does at once what it is asked to do beside."""

    def __init__(self, count: int) -> None:
        super().__init__()

    def submit(self, call: Callable[..., Any], /, *args: Any, **values: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(call(*args, **values))
        return future


def render(job: Job, lanes: int) -> set[str]:
    """Render a job on the simulator; its reports go where its environment says.

    Returns:
        the names of the kernels that were launched.
    """
    # The simulator runs one kernel at a time, whatever threads ask for it.
    psf_cl.renderer.ThreadPoolExecutor = InTurn  # type: ignore[misc,assignment]
    for module, name, value in SMALL_TABLES:
        setattr(module, name, value)
    launched: set[str] = set()
    launch = Launch.__call__

    def noting(self: Launch, items: int, group: int | None = None) -> None:
        launched.add(self.name)
        launch(self, items, group)

    Launch.__call__ = noting  # type: ignore[method-assign]
    few = 0 if job.tree else 400
    traits = DeviceTraits(
        "cpu",
        lanes,
        16,
        slots=64,
        group=4,
        run=2,
        few_triangles=few,
        few_corners=few,
        few_plates=few,
    )
    device = open_device("oclgrind", traits)
    settings = resolve({}, "a job", job.preset, SMALL | dict(job.settings))
    scene = job.picture()
    renderer = Renderer(
        scene,
        settings,
        device,
        (OUTPUTS if job.everything else ()) + job.outputs,
        statistics=job.everything,
        halves=job.everything,
    )
    with contextlib.closing(renderer):
        if job.everything:
            renderer.render(spp=1, progress=lambda now: False)
            renderer.image()
        renderer.render(spp=2)
        for time in job.times:
            renderer.image()
            renderer.set_frame(time)
            renderer.render(spp=1)
        if not np.isfinite(renderer.image().rgb).all():
            raise SystemExit("a pixel is not finite")
    return launched


def all_kernels() -> set[str]:
    """Return the names of all kernels that there are."""
    pattern = re.compile(r"^(?:__)?kernel\s(?:[^({]|\([^)]*\)\))*?void\s+(\w+)\(", re.MULTILINE)
    texts = (path.read_text(encoding="utf-8") for path in kernel_folder().glob("*.cl"))
    return {name for text in texts for name in pattern.findall(text)}


def run(library: str, name: str, lanes: int) -> tuple[str, set[str], float]:
    """Run ``render`` in a process that sees only the simulator.

    Returns:
        its reports, the kernels that it launched, and its seconds.
    """
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
        command = [sys.executable, __file__, "--job", name, str(lanes)]
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
            return f"not done after {JOB_SECONDS:.0f} s", set(), JOB_SECONDS
        reports = log.read_text(errors="replace").strip() if log.exists() else ""
        if done.returncode != 0:
            reports += "\n" + "\n".join(done.stderr.strip().splitlines()[-6:])
        launched = set(done.stdout.splitlines()[-1].split()) if done.stdout else set()
        return reports.strip(), launched, time.perf_counter() - start


def main(argv: Sequence[str] | None = None) -> int:
    """Run the jobs that were asked for; return 0 if nothing was reported, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--jobs", metavar="A,B", default="", help="parts of names; default: all")
    parser.add_argument("--lanes", default="1,16")
    parser.add_argument("--library", help="liboclgrind-rt-icd.so, if it is at no usual place")
    parser.add_argument("--job", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.job:
        name, lanes = args.job
        print(*sorted(render(JOBS[name], int(lanes))))
        return 0
    library = args.library or next((path for path in LIBRARIES if Path(path).exists()), None)
    if library is None:
        print("Oclgrind is not there; install it: sudo apt-get install oclgrind", file=sys.stderr)
        return 1
    failed, launched = 0, set()
    names = [name for name in JOBS if any(part in name for part in args.jobs.split(","))]
    for name in names:
        for lanes in map(int, args.lanes.split(",")):
            reports, kernels, seconds = run(library, name, lanes)
            launched |= kernels
            verdict = "FAILED" if reports else "nothing reported"
            print(f"{name}, {lanes} lanes: {verdict} ({seconds:.0f} s)", flush=True)
            if reports:
                failed += 1
                print(reports)
    missing = sorted(all_kernels() - launched) if len(names) == len(JOBS) else []
    if missing:
        print(f"never launched: {', '.join(missing)}")
    print(f"{failed} jobs with reports, {len(launched)} kernels")
    return int(failed > 0 or bool(missing) or not names)


if __name__ == "__main__":
    sys.exit(main())
