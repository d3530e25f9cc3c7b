"""One BSDF beside kernels of their own for each kind of material.

    python tools/material_kernels.py SCENE ... [--size 128x128] [--rounds 9]

A render is stopped where a full pool of paths waits to be shaded, and that pool is shaded again and
again: by the scene's own build; by one with every lobe there is; by the own build with the paths in
the order of their material's kind; and by a kernel of its own for each kind (matt, glossy, glass,
layered; with and without textures), each on a pool that has no others.  What sorting and moving the
paths takes, before each time that they are shaded, is measured too.  Processor nanoseconds of all
threads for a path that is alive: medians of interleaved rounds.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measuring import ENDLESS, interleaved
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl.cli.common import positive_integer, size_argument
from psf_cl.device import layout
from psf_cl.device.device import Buffer, open_device
from psf_cl.device.primitives import Primitives
from psf_cl.device.program import Launch, load_program
from psf_cl.errors import DeviceError, InputError
from psf_cl.renderer import Renderer
from psf_cl.scene.model import TEXTURE_FIELDS, Material, has_layers, lets_through
from psf_cl.settings import resolve

FOLDER = Path(__file__).parent
LOBES = ("GLOSSY", "TRANSMISSION", "LAYERS")
BIT = {"GLOSSY": 1, "TRANSMISSION": 2, "LAYERS": 4, "TEXTURES": 8}
WARM_UP = 0.5


@dataclass(frozen=True)
class Waiting:
    """Paths that wait to be shaded: ``(fields, slots)`` float32, and the kind of each."""

    fields: np.ndarray
    kinds: np.ndarray

    @property
    def alive(self) -> np.ndarray:
        status = self.fields[_field("STATUS")].view(np.uint32)
        return (status & layout.CONSTANT["STATUS_MASK"]) == layout.CONSTANT["STATUS_ALIVE"]


def _field(name: str) -> int:
    return layout.all_path_fields().index(name.lower())


def kind_of(material: Material, textures_matter: bool) -> int:
    """Return what a kernel for ``material`` has to know, as bits of BIT."""
    found = 0
    if material.specular > 0.0 or material.metallic > 0.0:
        found |= BIT["GLOSSY"]
    if lets_through(material):
        found |= BIT["GLOSSY"] | BIT["TRANSMISSION"]
    if has_layers(material):
        found |= BIT["GLOSSY"] | BIT["LAYERS"]
    if textures_matter or any(getattr(material, name) >= 0 for name in TEXTURE_FIELDS):
        found |= BIT["TEXTURES"]
    return found


class Experiment:
    """The subjects of one scene."""

    def __init__(self, path: str, size: tuple[int, int]) -> None:
        scene = psf_cl.load_scene(path, size=size)
        settings = resolve(scene.render, scene.path, "pt")
        self.renderer = renderer = Renderer(scene, settings, open_device())
        self.device, self.buffers = renderer.device, renderer.buffers
        self.features = renderer.plan.features
        if self.features["INSTANCES"].value:
            raise InputError(f"{path}: expected a scene whose meshes are not placed several times")
        self.stage = next(stage for stage in renderer.plan.stages if stage.name == "shade")
        glowing_textures = any(m.emission_texture >= 0 for m in scene.materials)
        textures_matter = bool(self.features["ALPHA"].value) or glowing_textures
        self.kind = np.array([kind_of(m, textures_matter) for m in scene.materials], np.uint32)
        self.group = self.device.traits.group * self.device.traits.lanes
        self.waiting = self._wait()
        self.subjects: dict[str, Callable[[], float]] = {}
        self.results: dict[str, Callable[[], np.ndarray]] = {}
        own = self.renderer.plan.defines(self.stage)
        order = np.argsort(self.waiting.kinds, kind="stable")
        as_it_is = np.arange(len(order))
        self._add("scene's own build", [(own, as_it_is)])
        self._add("every lobe", [(own | dict.fromkeys(LOBES, 1), as_it_is)])
        self._add("own build, paths sorted", [(own, order)])
        parts = []
        self.parts: dict[str, int] = {}
        for kind in np.unique(self.waiting.kinds):
            # What the scene has not stays out.
            has = {name: own[name] * int(bool(kind & bit)) for name, bit in BIT.items()}
            chosen = np.flatnonzero(self.waiting.kinds == kind)
            parts.append((own | has, chosen))
            name = " ".join(n.lower() for n, value in has.items() if value) or "matt or none"
            self.parts[name] = len(chosen)
        self._add("a kernel a kind, sorted", parts)
        self._add_sorting()

    def _wait(self) -> Waiting:
        """Render on for a while, and stop before the pool is shaded."""
        renderer = self.renderer
        start = time.process_time()
        renderer.render(
            spp=ENDLESS, progress=lambda progress: time.process_time() - start < WARM_UP
        )
        for launch, items in renderer.bounce_launches:
            if launch.name == "shade_paths":
                break
            launch(items)
        block = self.device.traits.block
        pool = self.device.read(self.buffers["pool"])
        fields = layout.path_field_count(self._values())
        paths = pool.reshape(-1, fields, block).transpose(1, 0, 2).reshape(fields, -1)
        hit = paths[_field("HIT_TRIANGLE")].view(np.uint32)
        status = paths[_field("STATUS")].view(np.uint32)
        hits = (status & layout.CONSTANT["STATUS_MASK"]) == layout.CONSTANT["STATUS_ALIVE"]
        hits &= hit != layout.CONSTANT["NO_HIT"]
        material = self.device.read(self.buffers["surfaces"])["material"]
        kinds = np.where(hits, self.kind[material[np.where(hits, hit, 0)]], 0)
        return Waiting(paths, kinds)

    def _values(self) -> dict[str, int]:
        return {name: feature.value for name, feature in self.features.items()}

    def _pool(self, name: str, defines: dict[str, int], chosen: np.ndarray) -> np.ndarray:
        """Return a pool of the chosen paths, as a build with ``defines`` has it."""
        count = layout.path_field_count(defines)
        slots = -(-len(chosen) // self.group) * self.group
        paths = np.zeros((count, slots), np.float32)
        # The only field that a lobe brings is the last one: see layout.OPTIONAL_PATH_FIELDS.
        paths[-1] = 1.0
        kept = min(count, len(self.waiting.fields))
        paths[:kept, : len(chosen)] = self.waiting.fields[:kept, chosen]
        block = self.device.traits.block
        return np.ascontiguousarray(paths.reshape(count, -1, block).transpose(1, 0, 2))

    def _add(self, name: str, parts: list[tuple[dict[str, int], np.ndarray]]) -> None:
        """Add a subject: each part a build and the paths that it shades."""
        jobs: list[tuple[Launch, Buffer, np.ndarray, int, int, np.ndarray]] = []
        for defines, chosen in parts:
            program = load_program(self.device, self.stage.source, defines)
            pool = self._pool(name, defines, chosen)
            buffer = self.device.upload(f"{name} {len(jobs)}", pool.ravel())
            launch = program.bind_planned("shade_paths", self.buffers | {"pool": buffer})
            fields = layout.path_field_count(defines)
            items = pool.shape[0] * pool.shape[2] // self.device.traits.lanes
            jobs.append((launch, buffer, pool, items, fields, chosen))

        def shade() -> float:
            for _, buffer, pool, *_ in jobs:
                self.device.write(buffer, pool.ravel())
            return self._seconds(lambda: [job[0](job[3]) for job in jobs])

        def result() -> np.ndarray:
            fields = _field("STATUS") + 1
            found = np.zeros((fields, len(self.waiting.kinds)), np.float32)
            for _, buffer, _, _, count, chosen in jobs:
                pool = self.device.read(buffer).reshape(-1, count, self.device.traits.block)
                paths = pool.transpose(1, 0, 2).reshape(count, -1)
                found[:, chosen] = paths[:fields, : len(chosen)]
            return found

        self.subjects[name], self.results[name] = shade, result

    def _add_sorting(self) -> None:
        device, slots = self.device, len(self.waiting.kinds)
        primitives = Primitives(device)
        program = load_program(device, "material_kernels.cl", self._values(), FOLDER)
        keys, values, spare_keys, spare_values = (
            device.allocate(name, np.uint32, slots)
            for name in ("keys", "values", "spare keys", "spare values")
        )
        kinds = device.upload("kinds", self.kind)
        moved = device.allocate("moved", np.float32, self.waiting.fields.size)
        pool = device.upload(
            "unsorted", self._pool("unsorted", self._values(), np.arange(slots)).ravel()
        )
        make = program.bind(
            "make_keys",
            pool=pool,
            surfaces=self.buffers["surfaces"],
            kinds=kinds,
            keys=keys,
            values=values,
            slots=slots,
        )
        move = program.bind("move_paths", pool=pool, values=values, moved=moved, slots=slots)

        def sort() -> Buffer:
            make(slots)
            return primitives.sort(keys, values, spare_keys, spare_values, slots, 8)[1]

        ordered = move.set(values=sort())
        self.subjects["sorting"] = lambda: self._seconds(sort)
        self.subjects["moving"] = lambda: self._seconds(
            lambda: ordered(slots // device.traits.block)
        )

    def _seconds(self, work: Callable[[], object]) -> float:
        self.device.wait()
        start = time.process_time()
        work()
        self.device.wait()
        return time.process_time() - start

    def agreement(self) -> float:
        """Return the share of paths that all subjects shade alike, to 1e-3."""
        alive = self.waiting.alive
        names = list(self.results)
        first = self.results[names[0]]()
        same = np.ones(len(alive), bool)
        beta, radiance, status = _field("BETA_R"), _field("RADIANCE_R"), _field("STATUS")
        # What has ended keeps whatever throughput.
        ended = ~Waiting(first, self.waiting.kinds).alive
        for name in names[1:]:
            other = self.results[name]()
            close = np.isclose(first, other, rtol=1e-3, atol=1e-6)
            same &= close[radiance : radiance + 3].all(axis=0)
            same &= ended | close[beta : beta + 3].all(axis=0)
            same &= first[status].view(np.uint32) == other[status].view(np.uint32)
        return float(same[alive].mean())

    def close(self) -> None:
        self.renderer.close()


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", metavar="SCENE", nargs="+")
    parser.add_argument("--size", metavar="WxH", type=size_argument, default=(128, 128))
    parser.add_argument("--rounds", type=positive_integer, default=9)
    args = parser.parse_args(arguments)
    console = Console(width=110)
    for path in args.scenes:
        experiment = Experiment(path, args.size)
        for subject in experiment.subjects.values():
            subject()
        rounds = interleaved(experiment.subjects, args.rounds)
        alive = int(experiment.waiting.alive.sum())
        table = Table("", title=f"{Path(path).name}, {alive} paths", title_justify="left")
        for head in ("ns a path", "least", "over own"):
            table.add_column(head, justify="right")
        own = rounds.values["scene's own build"]
        for name, values in rounds.values.items():
            ratios = [value / base for value, base in zip(values, own, strict=True)]
            table.add_row(
                name,
                f"{1e9 * statistics.median(values) / alive:.1f}",
                f"{1e9 * min(values) / alive:.1f}",
                f"{statistics.median(ratios):.2f}",
            )
        console.print(table)
        kinds = ", ".join(f"{name} {count}" for name, count in experiment.parts.items())
        share = 100.0 * experiment.agreement()
        console.print(f"paths: {kinds}; {share:.1f} % are shaded alike by all\n")
        experiment.close()
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"material_kernels: {error}")
