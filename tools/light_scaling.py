"""What choosing a light costs, from 2^4 to 2^16 lights: ``python tools/light_scaling.py``.

Lamps hang at random over a floor and light circles of it, so that a place sees some.  Points on
the floor choose lights by a table, by the tree, and by photons: processor nanoseconds a choice, of
the choice alone, medians of interleaved rounds.  ``--plot FILE`` draws them, as SVG or PNG.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from psf_cl.cli.common import positive_integer
from psf_cl.device.device import Buffer, Device, open_device
from psf_cl.device.program import Launch, load_program
from psf_cl.errors import DeviceError, InputError
from psf_cl.measure import plot
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Camera, Light, Material, Scene, Shape
from psf_cl.settings import Settings

FOLDER = Path(__file__).parent
LIGHTS = tuple(1 << power for power in range(4, 17, 2))
WAYS = ("power", "hierarchy", "photon")

# Work items of a launch; each chooses 64 times for each lane.
ITEMS = 128
# Side of the floor, m, and height of the lamps over it.
SIDE, HEIGHT = 40.0, 2.0


def hall(count: int) -> Scene:
    """Return a floor with ``count`` lamps that each light a circle below them."""
    rng = np.random.default_rng(count)
    places = rng.uniform(-SIDE / 2, SIDE / 2, (count, 2))
    powers = rng.uniform(0.2, 5.0, count)
    lights = tuple(
        Light(
            "spot",
            (float(power),) * 3,
            position=(float(x), HEIGHT, float(z)),
            direction=(0.0, -1.0, 0.0),
            inner_angle=math.radians(20.0),
            outer_angle=math.radians(35.0),
        )
        for (x, z), power in zip(places, powers, strict=True)
    )
    floor = Shape("floor", primitives.quad(), transform.scaling(SIDE), 0)
    view = Camera(transform.look_at((0.0, 30.0, 20.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), 1.0)
    return Scene(
        shapes=(floor,),
        materials=(Material(specular=0.0),),
        cameras=(view,),
        lights=lights,
        width=64,
        height=64,
        path="hall",
    )


@dataclass
class Way:
    """A way of choosing among so many lights, ready to be measured."""

    renderer: Renderer
    launch: Launch
    chosen: Buffer
    spent: list[float]

    def measure(self) -> None:
        """Choose once for every point."""
        device = self.renderer.device
        device.wait()
        start = time.process_time()
        self.launch(ITEMS)
        device.wait()
        self.spent.append(time.process_time() - start)

    def close(self) -> float:
        """Give the memory back; return nanoseconds a choice."""
        device = self.renderer.device
        device.release(self.chosen)
        self.renderer.close()
        return 1e9 * statistics.median(self.spent) / (ITEMS * 64 * device.traits.lanes)


def ready(device: Device, scene: Scene, way: str) -> Way:
    """Return a way of choosing among the lights of ``scene``, with the photons of one pass."""
    settings = Settings(light_sampling=way, photons=1 << 18)
    renderer = Renderer(scene, settings, device)
    renderer.render(spp=1)
    defines = {name: feature.value for name, feature in renderer.plan.features.items()}
    program = load_program(device, "light_choice.cl", defines, FOLDER)
    chosen = device.allocate("chosen", np.float32, ITEMS)
    given = renderer.buffers | {"chosen": chosen}
    launch = program.bind_planned("choose_lights", given, side=SIDE)
    return Way(renderer, launch, chosen, [])


def measure(most: int, rounds: int) -> dict[str, list[tuple[int, float]]]:
    """Return (lights, nanoseconds a choice) of each of WAYS."""
    device = open_device()
    curves: dict[str, list[tuple[int, float]]] = {way: [] for way in WAYS}
    for count in (count for count in LIGHTS if count <= most):
        scene = hall(count)
        ways = {name: ready(device, scene, name) for name in WAYS}
        for _ in range(rounds + 1):
            for way in ways.values():
                way.measure()
        for name, way in ways.items():
            del way.spent[0]
            curves[name].append((count, way.close()))
    return curves


def table_of(curves: dict[str, list[tuple[int, float]]]) -> Table:
    """Return the curves as a table."""
    table = Table(title="processor ns a choice", title_justify="left")
    table.add_column("lights", justify="right")
    for name in curves:
        table.add_column(name, justify="right")
    for row in zip(*curves.values(), strict=True):
        table.add_row(str(row[0][0]), *(f"{cost:.0f}" for _, cost in row))
    return table


def figure_of(curves: dict[str, list[tuple[int, float]]]) -> plot.Drawing:
    """Draw the curves."""
    looks = dict(zip(curves, zip(plot.COLOURS, itertools.cycle(plot.SHAPES)), strict=False))
    series = [
        plot.Series(name, *looks[name], [(float(x), y, math.nan, math.nan) for x, y in points])
        for name, points in curves.items()
    ]
    panel = plot.panel("processor nanoseconds a choice", "lights", series)
    return plot.figure([panel], [(name, *look) for name, look in looks.items()])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=positive_integer, default=9)
    parser.add_argument("--most", type=positive_integer, default=LIGHTS[-1], help="lights")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg")
    args = parser.parse_args(arguments)
    curves = measure(args.most, args.rounds)
    Console().print(table_of(curves))
    if args.plot is not None:
        figure_of(curves).write(args.plot)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"light_scaling: {error}")
