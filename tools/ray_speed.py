"""Rays per second beside Mitsuba 3 and Embree: ``python tools/ray_speed.py SCENE...``.

The rays are those of real paths: a pool of a million slots is filled from the camera and traced
and shaded; what its slots hold after a kernel is kept and given to all tracers.  The rows:

- camera: from the camera, neighbours after one another;
- bounce 1, 2: from the first and second surface, in the order of their pixels;
- shadow 1, 2: from there to the sampled lights;
- mixed, mixed shadow: of all depths side by side, as the pool holds them during a render.

psf_cl's own kernels run on a pool of these rays and the tree that its device built; a launch and
its end are timed.  Mitsuba runs ``ray_intersect_preliminary`` (told that camera rays are coherent)
and ``ray_test``, Embree single rays, all over the same triangles, on all cores, wall clock, in
interleaved rounds.  Materials count as opaque: cut-outs would be tested differently.

Needs Mitsuba (see tools/compare_speed.py); Embree's column also a C compiler and Embree's headers
(Debian: ``libembree-dev``).
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from measuring import Rounds, interleaved, ratio, spread
from mitsuba_scene import opaque, set_variant
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl import tables
from psf_cl.cli.common import positive_integer, size_argument
from psf_cl.device.device import open_device
from psf_cl.device.layout import CONSTANT, PATH_FIELDS, path_field_count
from psf_cl.errors import DeviceError, InputError
from psf_cl.scene.model import Scene
from psf_cl.settings import resolve

SLOTS = 1 << 20

# After so many bounces the pool holds paths of all depths, in the shares of a long render.
STEADY_BOUNCES = 40

# Relative difference of two distances to what counts as one hit.
SAME_DISTANCE = 1e-4

FIELD = {name: index for index, (name, _) in enumerate(PATH_FIELDS)}


@dataclass(frozen=True)
class Rays:
    """Rays to be traced.

    Attributes:
        origins, directions: ``(n, 3)`` float32; of shadow rays the light is at t = 1.
        shadow: whether the question is only if something is hit before t = 1.
    """

    name: str
    origins: np.ndarray
    directions: np.ndarray
    shadow: bool = False
    coherent: bool = False

    @property
    def count(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class Hits:
    """What a tracer found: the triangle and distance of each ray, or whether it is blocked."""

    triangle: np.ndarray | None = None
    t: np.ndarray | None = None
    blocked: np.ndarray | None = None


def agreement(ours: Hits, theirs: Hits) -> float:
    """Return the share of rays with the same answer: the same triangle, or the same distance."""
    if ours.blocked is not None:
        return float(np.mean(ours.blocked == theirs.blocked))
    no_hit = CONSTANT["NO_HIT"]
    missed = (ours.triangle == no_hit) & (theirs.triangle == no_hit)
    both = (ours.triangle != no_hit) & (theirs.triangle != no_hit)
    near = np.zeros(len(both), bool)
    near[both] = np.abs(ours.t[both] - theirs.t[both]) <= SAME_DISTANCE * ours.t[both]
    return float(np.mean(missed | (both & ((ours.triangle == theirs.triangle) | near))))


class Ours:
    """psf_cl with a pool of ``slots``, its kernels one by one."""

    def __init__(self, scene: Scene, slots: int) -> None:
        settings = resolve(scene.render, scene.path, preset="pt", overrides={"max_depth": "16"})
        device = open_device()
        device = open_device(traits=replace(device.traits, slots=slots))
        self.renderer = psf_cl.Renderer(scene, settings, device)
        self.device = device
        self.pool = self.renderer.buffers["pool"]
        self.launches = {
            launch.name: (launch, items) for launch, items in self.renderer.bounce_launches
        }
        self.block = device.traits.block
        features = self.renderer.plan.features
        self.words = path_field_count({name: item.value for name, item in features.items()})

    def run(self, *kernels: str) -> None:
        for name in kernels:
            # A scene without lights has no shadow rays.
            if name in self.launches:
                launch, items = self.launches[name]
                launch(items)

    def fields(self) -> np.ndarray:
        """Return the pool, ``(slots, fields)`` float32."""
        blocks = self.device.read(self.pool).reshape(-1, self.words, self.block)
        return blocks.transpose(0, 2, 1).reshape(-1, self.words)

    def capture(self) -> list[Rays]:
        """Run the path tracer and keep the rays that its kernels meet."""
        self.renderer.scheduler.hooks.limit(0xFFFFFFFF)
        rays = []
        self.run("regenerate_paths")
        rays.append(_path_rays("camera", self.fields(), coherent=True))
        for bounce in (1, 2):
            self.run("intersect_closest", "shade_paths")
            state = self.fields()
            rays.append(_path_rays(f"bounce {bounce}", state))
            rays.append(_shadow_rays(f"shadow {bounce}", state))
            self.run("connect_lights")
        for _ in range(STEADY_BOUNCES):
            self.renderer.scheduler.hooks.bounce()
            self.renderer.scheduler.hooks.film()
        self.run("regenerate_paths")
        rays.append(_path_rays("mixed", self.fields()))
        self.run("intersect_closest", "shade_paths")
        rays.append(_shadow_rays("mixed shadow", self.fields()))
        return [part for part in rays if part.count]

    def tracer(self, rays: Rays) -> Callable[[], float]:
        """Return a call that traces ``rays`` and returns the rays per second."""
        name = "connect_lights" if rays.shadow else "intersect_closest"
        launch, all_items = self.launches[name]
        state = _pool_of(rays, self.block, self.words)
        paths = len(state) // self.words
        items = -(-paths * all_items // self.device.traits.slots)

        def trace() -> float:
            self.device.write(self.pool, state)
            self.device.wait()
            start = time.perf_counter()
            launch(items)
            self.device.wait()
            return rays.count / (time.perf_counter() - start)

        # The slots beyond are of no path.
        self.device.fill(self.pool)
        return trace

    def hits(self, rays: Rays) -> Hits:
        """Return what the last trace of ``rays`` found."""
        state = self.fields()[: rays.count]
        if rays.shadow:
            return Hits(blocked=state[:, FIELD["radiance_r"]] == 0.0)
        triangle = np.ascontiguousarray(state[:, FIELD["hit_triangle"]]).view(np.uint32)
        return Hits(triangle, state[:, FIELD["hit_t"]])


def _vectors(state: np.ndarray, first: str, chosen: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(state[chosen, FIELD[first] : FIELD[first] + 3])


def _path_rays(name: str, state: np.ndarray, coherent: bool = False) -> Rays:
    status = np.ascontiguousarray(state[:, FIELD["status"]]).view(np.uint32)
    alive = (status & CONSTANT["STATUS_MASK"]) == CONSTANT["STATUS_ALIVE"]
    return Rays(
        name,
        _vectors(state, "origin_x", alive),
        _vectors(state, "direction_x", alive),
        coherent=coherent,
    )


def _shadow_rays(name: str, state: np.ndarray) -> Rays:
    wanted = state[:, FIELD["light_r"] : FIELD["light_r"] + 3].sum(axis=1) > 0.0
    origins = _vectors(state, "shadow_x", wanted)
    return Rays(name, origins, _vectors(state, "toward_x", wanted), shadow=True)


def _pool_of(rays: Rays, block: int, words: int) -> np.ndarray:
    """Return whole blocks of the pool that hold ``rays`` in paths of ``words``, flat float32."""
    state = np.zeros((-(-rays.count // block) * block, words), np.float32)
    used = state[: rays.count]
    origin, direction = ("shadow_x", "toward_x") if rays.shadow else ("origin_x", "direction_x")
    used[:, FIELD[origin] : FIELD[origin] + 3] = rays.origins
    used[:, FIELD[direction] : FIELD[direction] + 3] = rays.directions
    if rays.shadow:
        used[:, FIELD["light_r"]] = 1.0
    else:
        used[:, FIELD["status"]] = np.uint32(CONSTANT["STATUS_ALIVE"]).view(np.float32)
    return np.ascontiguousarray(state.reshape(-1, block, words).transpose(0, 2, 1)).reshape(-1)


class Mitsuba:
    """The triangles in Mitsuba."""

    def __init__(self, corners: np.ndarray) -> None:
        mesh = mi.Mesh("all", 3 * len(corners), len(corners))
        values = mi.traverse(mesh)
        values["vertex_positions"] = corners.ravel()
        values["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        values.update()
        self.scene = mi.load_dict({"type": "scene", "all": mesh})
        self.found: Any = None

    def tracer(self, rays: Rays) -> Callable[[], float]:
        origins = mi.Point3f(np.ascontiguousarray(rays.origins.T))
        directions = mi.Vector3f(np.ascontiguousarray(rays.directions.T))
        ray = mi.Ray3f(origins, directions)
        if rays.shadow:
            ray.maxt = mi.Float(1.0)
        dr.eval(ray)

        def trace() -> float:
            dr.sync_thread()
            start = time.perf_counter()
            if rays.shadow:
                self.found = self.scene.ray_test(ray)
                dr.eval(self.found)
            else:
                self.found = self.scene.ray_intersect_preliminary(ray, coherent=rays.coherent)
                dr.eval(self.found.t, self.found.prim_index)
            dr.sync_thread()
            return rays.count / (time.perf_counter() - start)

        return trace

    def hits(self, rays: Rays) -> Hits:
        if rays.shadow:
            return Hits(blocked=np.array(self.found))
        t = np.array(self.found.t)
        triangle = np.array(self.found.prim_index)
        return Hits(np.where(np.isfinite(t), triangle, CONSTANT["NO_HIT"]), t)


class Embree:
    """The triangles in Embree, through a C library that is compiled on the spot."""

    def __init__(self, library: ctypes.CDLL, corners: np.ndarray) -> None:
        self.library = library
        corners = np.ascontiguousarray(corners, np.float32)
        library.embree_scene.restype = ctypes.c_void_p
        self.scene = ctypes.c_void_p(
            library.embree_scene(_address(corners), ctypes.c_size_t(len(corners)))
        )
        self.triangle = self.t = np.zeros(0)

    def tracer(self, rays: Rays) -> Callable[[], float]:
        self.triangle = np.zeros(rays.count, np.uint32)
        self.t = np.zeros(rays.count, np.float32)
        triangle, t = self.triangle, self.t

        def trace() -> float:
            start = time.perf_counter()
            self.library.embree_trace(
                self.scene,
                _address(rays.origins),
                _address(rays.directions),
                ctypes.c_float(1.0 if rays.shadow else np.inf),
                ctypes.c_size_t(rays.count),
                None if rays.shadow else _address(triangle),
                _address(t),
                ctypes.c_uint(os.cpu_count() or 1),
            )
            return rays.count / (time.perf_counter() - start)

        return trace

    def hits(self, rays: Rays) -> Hits:
        if rays.shadow:
            return Hits(blocked=self.t == -np.inf)
        return Hits(self.triangle, self.t)


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def embree_library(folder: Path) -> ctypes.CDLL | None:
    """Compile tools/embree_rays.c into ``folder``; None without a compiler or Embree's headers."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    source, library = Path(__file__).with_name("embree_rays.c"), folder / "embree_rays.so"
    for flags in (["-DEMBREE_4", "-lembree4"], ["-lembree3"]):
        command = [compiler, "-O3", "-shared", "-fPIC", str(source), "-o", str(library), "-pthread"]
        if subprocess.run([*command, *flags], capture_output=True, check=False).returncode == 0:
            return ctypes.CDLL(str(library))
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", metavar="SCENE", nargs="+")
    parser.add_argument("--size", metavar="WxH", type=size_argument, default=(1024, 1024))
    parser.add_argument("--rounds", type=positive_integer, default=7)
    parser.add_argument("--variant", help="of Mitsuba")
    args = parser.parse_args(arguments)
    set_variant(args.variant)
    console = Console(width=max(150, Console().width))
    with tempfile.TemporaryDirectory() as folder:
        library = embree_library(Path(folder))
        if library is None:
            console.print("no column for Embree: no C compiler, or no headers of Embree 3 or 4")
        for path in args.scenes:
            scene = opaque(psf_cl.load_scene(path, size=args.size))
            console.print(compare(scene, library, args.rounds))
    return 0


def compare(scene: Scene, library: ctypes.CDLL | None, rounds: int) -> Table:
    """Measure all tracers on one scene."""
    ours = Ours(scene, SLOTS)
    corners = tables.flatten(scene).positions
    rivals: dict[str, Mitsuba | Embree] = {"Mitsuba": Mitsuba(corners)}
    if library is not None:
        rivals["Embree"] = Embree(library, corners)
    table = Table(
        title=f"{Path(scene.path).stem}, {len(corners)} triangles: M rays/s, median "
        "(least-greatest of the rounds)",
        title_justify="left",
    )
    table.add_column("rays")
    table.add_column("psf_cl", justify="right")
    for rival in rivals:
        for head in (rival, f"psf_cl / {rival}", "same hits"):
            table.add_column(head, justify="right")
    table.add_column("cores", justify="right")
    for rays in ours.capture():
        tracers = {"psf_cl": ours, **rivals}
        subjects = {name: tracer.tracer(rays) for name, tracer in tracers.items()}
        for trace in subjects.values():
            trace()
        found = {name: tracer.hits(rays) for name, tracer in tracers.items()}
        table.add_row(f"{rays.name} ({rays.count})", *_row(interleaved(subjects, rounds), found))
    ours.renderer.close()
    return table


def _row(measured: Rounds, found: dict[str, Hits]) -> list[str]:
    def million(name: str) -> str:
        return spread([rate / 1e6 for rate in measured.values[name]]).text()

    cells = [million("psf_cl")]
    for name in list(measured.values)[1:]:
        cells += [
            million(name),
            ratio(measured.values["psf_cl"], measured.values[name]).text(),
            f"{100.0 * agreement(found['psf_cl'], found[name]):.3f} %",
        ]
    return [*cells, " ".join(f"{cores:.1f}" for cores in measured.cores.values())]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"ray_speed: {error}")
