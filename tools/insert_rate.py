"""Rate of the table of cells: ``python tools/insert_rate.py``.

Processor time (of all threads) of a sample: inserting it, as many atomic adds to a random
cell of a table of the same bytes without any search, and looking it up.  The number of distinct
keys stays the same while the table grows: it is searched less, but fits into fewer caches.

``--plot FILE`` draws the curves, as SVG or PNG.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from psf_cl.cli.common import positive_integer
from psf_cl.device import layout
from psf_cl.device.device import Device, open_device
from psf_cl.device.hash_map import buckets_of, slots_for
from psf_cl.device.program import load_program
from psf_cl.errors import DeviceError, InputError
from psf_cl.measure import plot

FOLDER = Path(__file__).parent
# Samples of a work item and lane, as in the kernels.
SAMPLES = 64
ITEMS = 1 << 11
# Tables up to so many times the slots that the keys need.
LARGEST = 64
NAMES = ("insert", "bare adds", "look-up")


@dataclass(frozen=True)
class Rates:
    """A table of some size: its load, mean probes, failed inserts, ns a sample by NAMES."""

    slots: int
    load: float
    probes: float
    failed: int
    nanoseconds: dict[str, float]

    @property
    def mib(self) -> float:
        """Return the bytes of cells and keys, MiB."""
        return self.slots * (layout.CELL.dtype.itemsize + 4) / 2**20


def measure(device: Device, slots: int, distinct: int, rounds: int) -> Rates:
    """Measure a table of ``slots``; the keys are in it when it is measured."""
    program = load_program(device, "insert_rate.cl", folder=FOLDER)
    keys, full, failed, counts, found = (
        device.allocate(name, np.uint32, count)
        for name, count in (
            ("keys", slots),
            ("full", buckets_of(slots)),
            ("failed", 1),
            ("counts", 2),
            ("found", ITEMS),
        )
    )
    cells, bare = (device.allocate(name, layout.CELL.dtype, slots) for name in ("cells", "bare"))
    size = {"slots": slots, "distinct": distinct}
    launches = {
        "insert": program.bind("insert_samples", keys=keys, cells=cells, failed=failed, **size),
        "bare adds": program.bind("add_bare", cells=bare, **size),
        "look-up": program.bind(
            "look_up_samples", keys=keys, cells=cells, full=full, found=found, **size
        ),
    }
    spent: dict[str, list[float]] = {name: [] for name in NAMES}
    for index in range(rounds + 1):
        for name in NAMES if index % 2 == 0 else reversed(NAMES):
            seconds = _seconds(device, lambda launch=launches[name]: launch(ITEMS))
            # The first round fills the table.
            if index > 0:
                spent[name].append(seconds)
    program.bind("count_probes", keys=keys, counts=counts, slots=slots)(slots)
    used, probes = map(int, device.read(counts))
    lost = int(device.read(failed)[0])
    device.release(keys, full, failed, counts, found, cells, bare)
    samples = ITEMS * SAMPLES * device.traits.lanes
    nanoseconds = {name: 1e9 * statistics.median(spent[name]) / samples for name in NAMES}
    return Rates(slots, used / slots, probes / used, lost, nanoseconds)


def _seconds(device: Device, work: Callable[[], None]) -> float:
    device.wait()
    start = time.process_time()
    work()
    device.wait()
    return time.process_time() - start


def table_of(rates: Sequence[Rates]) -> Table:
    """Return the rates, and that of inserting relative to bare adds."""
    table = Table(title="processor ns a sample", title_justify="left")
    heads = ("slots", "MiB", "load", "probes", "failed", *NAMES, "bare / insert")
    for head in heads:
        table.add_column(head, justify="right")
    for one in rates:
        ns = one.nanoseconds
        table.add_row(
            str(one.slots),
            f"{one.mib:.1f}",
            f"{one.load:.3f}",
            f"{one.probes:.2f}",
            str(one.failed),
            *(f"{ns[name]:.1f}" for name in NAMES),
            f"{ns['bare adds'] / ns['insert']:.2f}",
        )
    return table


def figure_of(rates: Sequence[Rates]) -> plot.Drawing:
    """Draw nanoseconds a sample against the size of the table."""
    looks = dict(zip(NAMES, zip(plot.COLOURS, plot.SHAPES, strict=False), strict=False))
    series = [
        plot.Series(
            name, *looks[name], [(r.mib, r.nanoseconds[name], math.nan, math.nan) for r in rates]
        )
        for name in NAMES
    ]
    panel = plot.panel("processor nanoseconds a sample", "table, MiB", series)
    return plot.figure([panel], [(name, *looks[name]) for name in NAMES])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keys", type=positive_integer, default=50000, help="distinct (50000)")
    parser.add_argument("--rounds", type=positive_integer, default=7)
    parser.add_argument("--plot", type=Path, metavar="FILE.svg")
    args = parser.parse_args(arguments)
    device = open_device()
    least = slots_for(args.keys)
    sizes = [least << power for power in range(int(math.log2(LARGEST)) + 1)]
    rates = [measure(device, slots, args.keys, args.rounds) for slots in sizes]
    Console(width=100).print(table_of(rates))
    if args.plot is not None:
        figure_of(rates).write(args.plot)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"insert_rate: {error}")
