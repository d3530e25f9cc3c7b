"""Cost of a sample against image size and triangles: ``python tools/scaling.py``.

Three series, each a table of nanoseconds a sample (wall clock, steady state, interleaved rounds):

- size: the Cornell box from 256x256 to 2048x2048 pixels: should be flat;
- terrain: one hilly landscape under a sky in ever finer triangles, 10^3 to 10^6: like a logarithm;
- soup: that many triangles in a cube, all of one total area, so that light meets as many surfaces
  however many there are: the hardest for a tree.

``--plot FILE.png`` draws them; needs matplotlib (the extra ``report``).
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from measuring import Spread, interleaved, samples_per_second, spread
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl.cli.common import positive_integer, positive_number
from psf_cl.errors import DeviceError, InputError
from psf_cl.scene.model import Camera, Environment, Material, Mesh, Scene, Shape
from psf_cl.scene.transform import look_at
from psf_cl.settings import resolve

CORNELL_BOX = Path(__file__).parents[1] / "scenes" / "cornell_box.toml"
SIZES = (256, 512, 1024, 2048)
TRIANGLES = (10**3, 10**4, 10**5, 10**6)
WARM_UP_SECONDS = 0.5

# Of all triangles of the soup together, in faces of its cube: a ray through it meets about one.
SOUP_AREA = 4.0


@dataclass(frozen=True)
class Series:
    """Nanoseconds a sample at each of ``places``."""

    name: str
    axis: str
    places: tuple[int, ...]
    costs: tuple[Spread, ...]


def terrain(triangles: int) -> Mesh:
    """Return hills over [-1, 1]^2, about ``triangles`` of them, the same hills for any number."""
    cells = max(round((triangles / 2) ** 0.5), 1)
    axis = np.linspace(-1.0, 1.0, cells + 1)
    x, z = np.meshgrid(axis, axis)
    y = sum(
        0.2 / octave * np.sin(3.1 * octave * x + octave**2) * np.cos(2.7 * octave * z - octave)
        for octave in (1, 2, 4)
    )
    row, column = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    first = (row * (cells + 1) + column).ravel()
    right, below = first + 1, first + cells + 1
    faces = np.concatenate(
        [np.stack([first, below, right], -1), np.stack([right, below, below + 1], -1)]
    )
    return _mesh("terrain", np.stack([x, y, z], -1).reshape(-1, 3), faces)


def soup(triangles: int) -> Mesh:
    """Return equilateral triangles anywhere in [-1, 1]^3, SOUP_AREA faces of it in all."""
    random = np.random.default_rng(1)
    normal, first = random.standard_normal((2, triangles, 3))
    first = np.cross(normal, first)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), first)
    # The area of an equilateral triangle with circumradius r is 3 sqrt(3) / 4 r^2.
    radius = (SOUP_AREA * 4.0 / triangles * 4.0 / (3.0 * 3.0**0.5)) ** 0.5
    turns = 2.0 * np.pi / 3.0 * np.arange(3)
    corners = random.uniform(-1.0, 1.0, (triangles, 1, 3)) + radius * (
        np.cos(turns)[:, None] * first[:, None] + np.sin(turns)[:, None] * second[:, None]
    )
    return _mesh("soup", corners.reshape(-1, 3), np.arange(3 * triangles).reshape(-1, 3))


def _mesh(name: str, positions: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(name, positions.astype(np.float32), faces.astype(np.uint32))


def under_sky(mesh: Mesh) -> Scene:
    """Return ``mesh`` in grey under a constant sky, 256x256 pixels."""
    view = look_at([1.4, 1.3, 2.2], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    return Scene(
        path=mesh.name,
        width=256,
        height=256,
        cameras=(Camera(view, np.radians(50.0)),),
        materials=(Material(specular=0.0),),
        shapes=(Shape(mesh.name, mesh, np.eye(4), 0),),
        environment=Environment(radiance=(1.0, 1.0, 1.0)),
    )


SERIES: dict[str, tuple[str, tuple[int, ...], Callable[[int], Scene]]] = {
    "size": ("pixels along a side", SIZES, lambda n: psf_cl.load_scene(CORNELL_BOX, size=(n, n))),
    "terrain": ("triangles", TRIANGLES, lambda n: under_sky(terrain(n))),
    "soup": ("triangles", TRIANGLES, lambda n: under_sky(soup(n))),
}


def measure(name: str, rounds: int, seconds: float) -> Series:
    """Measure one of SERIES."""
    axis, places, scene_of = SERIES[name]
    renderers = {}
    for place in places:
        scene = scene_of(place)
        settings = resolve(scene.render, scene.path, preset="pt")
        renderers[str(place)] = psf_cl.Renderer(scene, settings)

    def cost(renderer: psf_cl.Renderer) -> Callable[[], float]:
        return lambda: 1e9 / samples_per_second(renderer, seconds)

    for renderer in renderers.values():
        samples_per_second(renderer, WARM_UP_SECONDS)
    subjects = {place: cost(renderer) for place, renderer in renderers.items()}
    values = interleaved(subjects, rounds).values
    for renderer in renderers.values():
        renderer.close()
    return Series(name, axis, places, tuple(spread(values[str(place)]) for place in places))


def table_of(series: Series) -> Table:
    """Return the costs, and how much they grew."""
    table = Table(title=f"{series.name}: ns a sample", title_justify="left")
    for head in (series.axis, "median (least-greatest)", "of the first", "of the one before"):
        table.add_column(head, justify="right")
    first = before = series.costs[0].median
    for place, cost in zip(series.places, series.costs, strict=True):
        relative = [f"{cost.median / other:.2f}" for other in (first, before)]
        table.add_row(str(place), cost.text(0), *relative)
        before = cost.median
    return table


def plot(all_series: Sequence[Series], file: Path) -> None:
    """Draw the series side by side.

    Raises:
        InputError: matplotlib is not there.
    """
    try:
        matplotlib = importlib.import_module("matplotlib")
    except ImportError:
        raise InputError("--plot: needs matplotlib (the extra report)") from None
    matplotlib.use("Agg")
    pyplot = importlib.import_module("matplotlib.pyplot")
    figure, axes = pyplot.subplots(1, len(all_series), squeeze=False, layout="constrained")
    figure.set_size_inches(4 * len(all_series), 3.5)
    for area, series in zip(axes[0], all_series, strict=True):
        medians = np.array([cost.median for cost in series.costs])
        below = medians - [cost.low for cost in series.costs]
        above = [cost.high for cost in series.costs] - medians
        area.errorbar(series.places, medians, (below, above), marker="o", capsize=3)
        area.set_xscale("log")
        area.set_ylim(bottom=0.0)
        area.set_title(series.name)
        area.set_xlabel(series.axis)
        area.set_ylabel("ns a sample")
    figure.savefig(file, dpi=120)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("series", nargs="*", metavar="SERIES", help="size, terrain, soup (all)")
    parser.add_argument("--rounds", type=positive_integer, default=3)
    parser.add_argument("--seconds", type=positive_number, default=1.5, help="of a round (1.5)")
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    args = parser.parse_args(arguments)
    for name in args.series:
        if name not in SERIES:
            parser.error(f"{name}: expected {', '.join(SERIES)}")
    console = Console()
    measured = [measure(name, args.rounds, args.seconds) for name in args.series or SERIES]
    for series in measured:
        console.print(table_of(series))
    if args.plot is not None:
        plot(measured, args.plot)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"scaling: {error}")
