"""What sharing light costs, and what it takes the place of: ``python tools/filter_scaling.py``.

Two series on the Cornell box, in processor time (of all threads), which other programs hardly
change:

- vertices: filtering one pass of 2^16 to 2^22 pixels by cells and by range search, with cells and
  balls of the same size in the scene, so that ever more vertices are in one of them: cells should
  take time in proportion, range search by the square; it is stopped at ``--stop`` seconds;
- splitting: relMSE against the cost of a picture by plain paths, by splitting one path of each
  pixel at the first surface, and by sharing (preset psf).  Splitting is charged for the beginning
  of a path once, although here it is traced for each sample.

``--plot FILE`` draws them, as SVG or PNG.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl.cli.common import positive_integer, positive_number
from psf_cl.device import layout
from psf_cl.errors import DeviceError, InputError
from psf_cl.measure import plot
from psf_cl.measure.errors import compare
from psf_cl.renderer import Renderer
from psf_cl.settings import resolve
from psf_cl.stages.range_search import BATCH

CORNELL_BOX = Path(__file__).parents[1] / "scenes" / "cornell_box.toml"
VERTICES = tuple(1 << power for power in range(16, 23))
# Edge of a cell where there are 2^16 pixels, pixels.
CELL_SIZE = 16.0
# Batches of range search between two looks at the clock.
BATCHES = 4

SPLITS = (1, 2, 4, 8, 16, 32, 64)
SHARED_SAMPLES = (1, 2, 4, 8, 16)
# Seeds of the errors; the reference has another one.
SEEDS = 4
TIMED_SAMPLES = 32

# Of each series, what is on its axes.
AXES = {
    "vertices": ("vertices of the pass", "processor seconds to filter it"),
    "splitting": ("processor nanoseconds a pixel", "relMSE"),
}

# (x, y) of each point of a named curve; what a curve has not come to is None.
Curves = dict[str, list[tuple[float, float | None]]]


def opened(side: int, preset: str = "pt", **values: Any) -> Renderer:
    """Return a renderer of the Cornell box of ``side`` pixels."""
    scene = psf_cl.load_scene(CORNELL_BOX, size=(side, side))
    return Renderer(scene, resolve(scene.render, scene.path, preset, values))


def seconds_of(renderer: Renderer, work: Callable[[], object]) -> float:
    """Return the processor time of ``work`` and of what it enqueued."""
    renderer.device.wait()
    start = time.process_time()
    work()
    renderer.device.wait()
    return time.process_time() - start


def with_a_pass(side: int, path_filter: str) -> Renderer:
    """Return a renderer whose kernels take its first pass for one that is still to be filtered."""
    size = CELL_SIZE * side / VERTICES[0] ** 0.5
    values = {"path_filter": path_filter, "filter_vertex": "1", "cell_size": size}
    renderer = opened(side, **values)
    renderer.render(spp=1)
    counters, index = renderer.buffers["counters"], layout.COUNTER_INDEX
    for name, value in (("film_pass", 0), ("finished", renderer.plan.pixel_count)):
        renderer.device.write(counters, np.array([value], np.uint32), index[name])
    return renderer


def filter_by_cells(side: int, rounds: int) -> float:
    """Return the median seconds that cells take for a pass."""
    renderer = with_a_pass(side, "hash_grid")

    def work() -> None:
        for launch, items in renderer.cells.share:
            launch(items)
        renderer.cells.clear(renderer.plan.pixel_count)

    seconds = [seconds_of(renderer, work) for _ in range(rounds)]
    renderer.close()
    return statistics.median(seconds)


def filter_by_search(side: int, stop: float) -> float | None:
    """Return the seconds that range search takes for a pass; None if more than ``stop``."""
    renderer = with_a_pass(side, "range_search")
    search = renderer.range_search

    def sort() -> None:
        nonlocal count, inverse
        count, inverse = search.prepare(0)

    def search_on() -> None:
        nonlocal first
        end = min(first + BATCHES * BATCH, count)
        for start in range(first, end, BATCH):
            search.average(0, count, inverse, start)
        first = end

    first, count, inverse = 0, 0, 1.0
    seconds = seconds_of(renderer, sort)
    while first < count and seconds <= stop:
        seconds += seconds_of(renderer, search_on)
    renderer.close()
    return seconds if first >= count and seconds <= stop else None


def measure_vertices(most: int, rounds: int, stop: float) -> Curves:
    """Measure both filters at each of VERTICES up to ``most``."""
    curves: Curves = {"cells": [], "range search": []}
    searched: float | None = 0.0
    for vertices in (count for count in VERTICES if count <= most):
        side = round(vertices**0.5)
        curves["cells"].append((side * side, filter_by_cells(side, rounds)))
        # What takes too long takes longer with more vertices.
        searched = filter_by_search(side, stop) if searched is not None else None
        curves["range search"].append((side * side, searched))
    return curves


def nanoseconds(side: int, rounds: int, runs: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return the median processor time of a sample by each of ``runs``, taken in turns."""
    renderers = {name: opened(side, **values) for name, values in runs.items()}
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for done in range(rounds + 1):
        for name, renderer in renderers.items():
            more = functools.partial(renderer.render, spp=TIMED_SAMPLES * (done + 1))
            seconds = seconds_of(renderer, more)
            samples = TIMED_SAMPLES * renderer.plan.pixel_count
            spent[name].append(1e9 * seconds / samples)
    for renderer in renderers.values():
        renderer.close()
    # The first round warms up.
    return {name: statistics.median(values[1:]) for name, values in spent.items()}


def error_of(side: int, reference: np.ndarray, spp: int, **values: Any) -> float:
    """Return the mean relMSE over seeds."""
    errors = []
    for seed in range(SEEDS):
        renderer = opened(side, seed=seed, **values)
        renderer.render(spp=spp)
        errors.append(compare(renderer.image().rgb, reference).relmse)
        renderer.close()
    return statistics.mean(errors)


def measure_splitting(side: int, rounds: int, reference_spp: int) -> Curves:
    """Measure relMSE and nanoseconds a pixel of plain paths, splitting and sharing."""
    renderer = opened(side, seed=1000)
    renderer.render(spp=reference_spp)
    reference = renderer.image().rgb
    renderer.close()
    # max_depth=0 is the beginning that the samples of a split path have in common.
    runs = {"pt": {}, "split": {"splits": 64}, "begin": {"max_depth": 0}, "psf": {"preset": "psf"}}
    cost = nanoseconds(side, rounds, runs)
    return {
        "plain paths": [(n * cost["pt"], error_of(side, reference, n)) for n in SPLITS],
        "splitting": [
            (n * cost["split"] - (n - 1) * cost["begin"], error_of(side, reference, n, splits=n))
            for n in SPLITS
        ],
        "sharing": [
            (n * cost["psf"], error_of(side, reference, n, preset="psf")) for n in SHARED_SAMPLES
        ],
    }


def print_curves(console: Console, key: str, curves: Curves) -> None:
    """Print a table of each curve of a series."""
    for name, points in curves.items():
        table = Table(title=f"{key}: {name}", title_justify="left")
        for column in AXES[key]:
            table.add_column(column, justify="right")
        for x, y in points:
            table.add_row(f"{x:.0f}", "stopped" if y is None else f"{y:.4g}")
        console.print(table)


def figure_of(measured: dict[str, Curves], stop: float) -> plot.Drawing:
    """Draw the series side by side; where range search was stopped its mark is grey."""
    names = [name for curves in measured.values() for name in curves]
    looks = dict(zip(names, zip(plot.COLOURS, itertools.cycle(plot.SHAPES)), strict=False))
    panels = []
    for key, curves in measured.items():
        x_label, title = AXES[key]
        series = []
        for name, points in curves.items():
            # What comes after the first point that was stopped was not tried.
            known = [(x, y) for x, y in points if y is not None]
            shown = [*known, *[(x, stop) for x, y in points if y is None][:1]]
            values = [(float(x), y, math.nan, math.nan) for x, y in shown]
            grey = [False] * len(known) + [True] * (len(shown) - len(known))
            series.append(plot.Series(name, *looks[name], values, grey))
        panels.append(plot.panel(title, x_label, series))
    return plot.figure(panels, [(name, *looks[name]) for name in names])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("series", nargs="*", metavar="SERIES", help=", ".join(AXES))
    parser.add_argument("--rounds", type=positive_integer, default=5)
    parser.add_argument("--stop", type=positive_number, default=120.0, help="range search at (120)")
    parser.add_argument("--most", type=positive_integer, default=VERTICES[-1], help="vertices")
    parser.add_argument("--side", type=positive_integer, default=128, help="of the picture (128)")
    parser.add_argument("--reference-spp", type=positive_integer, default=2048, metavar="SPP")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg")
    args = parser.parse_args(arguments)
    for name in args.series:
        if name not in AXES:
            parser.error(f"{name}: expected {', '.join(AXES)}")
    measures = {
        "vertices": lambda: measure_vertices(args.most, args.rounds, args.stop),
        "splitting": lambda: measure_splitting(args.side, args.rounds, args.reference_spp),
    }
    measured = {key: measures[key]() for key in args.series or AXES}
    for key, curves in measured.items():
        print_curves(Console(), key, curves)
    if args.plot is not None:
        figure_of(measured, args.stop).write(args.plot)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"filter_scaling: {error}")
