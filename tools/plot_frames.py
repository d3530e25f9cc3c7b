"""One figure of several sequences: ``python tools/plot_frames.py "TITLE=DIR" ... -o FILE.svg``.

Each DIR is a report of ``psf-cl converge --frames``; its panel has the error of every frame.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Sequence
from pathlib import Path

from psf_cl.errors import InputError
from psf_cl.measure import plot

Curves = dict[str, list[tuple[float, float]]]


def read_frames(folder: Path) -> Curves:
    """Return the relMSE of the frames, counted from 1, by contestant.

    Raises:
        InputError: the folder is no such report.
    """
    path, curves = folder / "frames.csv", {}
    try:
        with path.open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                points = curves.setdefault(row["contestant"], [])
                points.append((len(points) + 1.0, float(row["relmse"])))
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: expected frames.csv of converge --frames; {error}") from error
    return curves


def figure_of(sequences: dict[str, Curves]) -> plot.Drawing:
    """Return a panel a sequence; a contestant looks the same in all of them."""
    names = list(dict.fromkeys(name for curves in sequences.values() for name in curves))
    looks = {
        name: (plot.COLOURS[k % len(plot.COLOURS)], plot.SHAPES[k % len(plot.SHAPES)])
        for k, name in enumerate(names)
    }
    nan = float("nan")
    panels = [
        plot.panel(
            f"relMSE, {title}",
            "frames rendered",
            [
                plot.Series(name, *looks[name], [(x, y, nan, nan) for x, y in points])
                for name, points in curves.items()
            ],
        )
        for title, curves in sequences.items()
    ]
    return plot.figure(panels, [(name, *looks[name]) for name in names])


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw, and write the SVG."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("reports", nargs="+", metavar="TITLE=DIR")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.svg")
    args = parser.parse_args(arguments)
    sequences = {}
    for text in args.reports:
        title, equals, folder = text.partition("=")
        if not (title and equals and folder):
            parser.error(f"{text}: expected TITLE=DIR")
        sequences[title] = read_frames(Path(folder))
    figure_of(sequences).write(args.output)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(f"plot_frames: {error}")
