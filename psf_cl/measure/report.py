"""The report of a study: a page that needs nothing else, plots, and tables for other programs."""

from __future__ import annotations

import base64
import csv
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np
import PIL.Image

from psf_cl.files import write_whole
from psf_cl.image import json_text
from psf_cl.measure import plot
from psf_cl.measure.curves import (
    METRICS,
    Point,
    Reference,
    Run,
    measure_runs,
    slope,
    speed_ratio,
)
from psf_cl.measure.errors import mean_luminance
from psf_cl.measure.statistics import Interval

#: Pictures of one contestant in the page: its first, its last, and between them.
_PICTURES = 3


@dataclass
class Entry:
    """What is known of one contestant.

    Attributes:
        settings: name to value, or what it is called with.
        failures: one line for each run that failed: which, ": ", why.
    """

    name: str
    settings: dict[str, str]
    runs: list[Run]
    failures: list[str] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)


@dataclass
class Study:
    """Runs of contestants on one scene.

    Attributes:
        marks: what each point is called.
        provenance: what the page says of where it comes from, name to value.
    """

    title: str
    lead: str
    marks: Sequence[str]
    entries: list[Entry]
    reference: Reference
    provenance: dict[str, str]
    notes: list[str] = field(default_factory=list)

    def measure(self) -> None:
        """Measure every run against the reference."""
        for entry in self.entries:
            entry.points = measure_runs(entry.runs, self.reference)


def write_report(study: Study, folder: Path) -> list[Path]:
    """Write ``report.html``, ``error.png``, ``error.svg``, ``points.csv`` and ``summary.csv``.

    Raises:
        InputError: a file cannot be written.
    """
    figure = error_figure(study)
    files = {
        "report.html": page(study, figure).encode(),
        "error.png": figure.png(),
        "error.svg": (figure.svg() + "\n").encode(),
        "points.csv": points_csv(study).encode(),
        "summary.csv": summary_csv(study).encode(),
    }
    for name, data in files.items():
        write_whole(folder / name, data)
    return [folder / name for name in files]


# The plots.


def error_figure(study: Study) -> plot.Drawing:
    """Draw all curves: relMSE, trimmed relMSE, bias and variance, and over process time."""
    styles = [_style(index) for index in range(len(study.entries))]

    def curves(metric: str, time: str) -> list[plot.Series]:
        return [
            plot.Series(
                entry.name,
                colour,
                shape,
                [
                    (getattr(point, time), *_bounds(point.metrics[metric]))
                    for point in _valid(entry.points)
                ],
                [point.below_noise for point in _valid(entry.points)],
                [_point_title(study, entry, point) for point in _valid(entry.points)],
            )
            for entry, (colour, shape) in zip(study.entries, styles, strict=True)
        ]

    splits = []
    for entry, (colour, shape) in zip(study.entries, styles, strict=True):
        points = [point for point in entry.points if point.split is not None]
        grey = [point.below_noise for point in points]
        for bias in (True, False):
            values = [
                (point.seconds, *_shown_bounds(point.split.bias2 if bias else point.split.variance))
                for point in points
                if point.split is not None
            ]
            splits.append(
                plot.Series(entry.name, colour, shape, values, grey, dashed=bias, band=not bias)
            )
    panels = [
        plot.panel("relMSE", "seconds of rendering", curves("relmse", "seconds")),
        plot.panel(
            "variance (line) and squared bias (dashed, bars)", "seconds of rendering", splits
        ),
        plot.panel(
            "relMSE without the worst 0.1 %",
            "seconds of rendering",
            curves("relmse_trimmed", "seconds"),
        ),
        plot.panel("relMSE", "seconds of the whole process", curves("relmse", "process_seconds")),
    ]
    return plot.figure(
        panels, [(e.name, *style) for e, style in zip(study.entries, styles, strict=True)]
    )


def _style(index: int) -> tuple[str, str]:
    return plot.COLOURS[index % len(plot.COLOURS)], plot.SHAPES[index % len(plot.SHAPES)]


def _valid(points: Iterable[Point]) -> list[Point]:
    return [point for point in points if point.nonfinite == 0]


def _bounds(interval: Interval) -> tuple[float, float, float]:
    return interval.value, interval.low, interval.high


def _shown_bounds(interval: Interval) -> tuple[float, float, float]:
    """Return bounds for a plot: where 0 is possible, only the bar shows."""
    value = math.nan if interval.contains(0.0) else interval.value
    return value, interval.low, interval.high


def _point_title(study: Study, entry: Entry, point: Point) -> str:
    text = f"{entry.name}, {study.marks[point.mark]}: relMSE {point.metrics['relmse'].value:.3g}"
    return f"{text}, {point.spp:.0f} spp" if point.spp else text


# The tables for other programs.


def points_csv(study: Study) -> str:
    """Return one line for each picture: who, when, and its errors."""
    header = ["contestant", "seed", "point", "seconds", "process_seconds", "spp"]
    rows = []
    for entry in study.entries:
        for run in entry.runs:
            for snapshot in run.snapshots:
                point = next(p for p in entry.points if p.mark == snapshot.mark)
                errors = point.errors[point.seeds.index(run.seed)]
                rows.append(
                    [entry.name, run.seed, study.marks[snapshot.mark]]
                    + [snapshot.seconds, snapshot.process_seconds, snapshot.spp]
                    + [getattr(errors, name) for name in (*METRICS, "nonfinite")]
                )
    return _csv([*header, *METRICS, "nonfinite"], rows)


def summary_csv(study: Study) -> str:
    """Return one line for each point: means over the runs, intervals, bias and variance.

    ``bias2`` and ``variance`` are of the MSE, ``relative_`` of the relMSE.
    """
    header = ["contestant", "point", "runs", "seconds", "process_seconds", "spp"]
    header += ["below_noise", "nonfinite"]
    names = [*METRICS, "bias2", "variance", "relative_bias2", "relative_variance"]
    header += [f"{name}{suffix}" for name in names for suffix in ("", "_low", "_high")]
    rows = []
    for entry in study.entries:
        for point in entry.points:
            row = [entry.name, study.marks[point.mark], len(point.errors)]
            row += [point.seconds, point.process_seconds, point.spp]
            row += [int(point.below_noise), point.nonfinite]
            for interval in _all_intervals(point):
                row += list(_bounds(interval)) if interval else [math.nan] * 3
            rows.append(row)
    return _csv(header, rows)


def _all_intervals(point: Point) -> list[Interval | None]:
    intervals: list[Interval | None] = [point.metrics[name] for name in METRICS]
    for split in (point.mse_split, point.split):
        intervals += [split.bias2, split.variance] if split else [None, None]
    return intervals


def _csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow([f"{v:.8g}" if isinstance(v, float) else v for v in row])
    return text.getvalue().replace("nan", "")


# The page.


def page(study: Study, figure: plot.Drawing) -> str:
    """Return the page: one file, no network."""
    here = Path(__file__).parent
    pictures, columns = _pictures(study)
    notes = [("note", note) for note in study.notes]
    for entry in study.entries:
        notes += [("failed", text) for text in _failure_texts(entry)]
        bad = sum(point.nonfinite for point in entry.points)
        if bad:
            notes.append(("failed", f"{entry.name}: {bad} pixels are not finite"))
    parts = {
        "title": escape(study.title),
        "lead": escape(study.lead),
        "notes": "\n".join(f'<p class="{kind}">{escape(note)}</p>' for kind, note in notes),
        "figure": figure.svg(),
        "summary": _summary_table(study),
        "ratios": "\n".join(
            f'<p>{title}</p><div class="wide">{_ratio_table(study, metric)}</div>'
            for metric, title in (
                ("relmse", "By relMSE:"),
                ("relmse_trimmed", "By relMSE without the worst 0.1&nbsp;% of the pixels:"),
            )
        ),
        "settings": _settings_table(study),
        "provenance": _table(
            ["", ""],
            [
                [escape(key), _Cell(escape(value), "text")]
                for key, value in study.provenance.items()
            ],
        ),
        "columns": str(columns),
        "exposure": str(_exposure(study.reference.rgb)),
        # "</" would end the script element.
        "pictures": json_text(pictures).replace("</", "<\\/"),
        "style": (here / "report.css").read_text(encoding="utf-8"),
        "script": (here / "report.js").read_text(encoding="utf-8"),
    }
    text = (here / "report.html").read_text(encoding="utf-8")
    pieces = text.split("{{")
    return pieces[0] + "".join(
        parts[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces[1:])
    )


def _failure_texts(entry: Entry) -> list[str]:
    """Return one line for each way to fail."""
    kinds = dict.fromkeys(text.partition(": ")[2] for text in entry.failures)
    counts = [sum(text.endswith(kind) for text in entry.failures) for kind in kinds]
    return [
        f"{entry.name}: {count} run{'s' * (count > 1)} failed: {kind}"
        for kind, count in zip(kinds, counts, strict=True)
    ]


@dataclass(frozen=True)
class _Cell:
    html: str
    style: str = ""


def _table(header: Sequence[str], rows: Iterable[Sequence[str | _Cell]]) -> str:
    lines = ["<table>"]
    if any(header):
        lines.append("<tr>" + "".join(f"<th>{title}</th>" for title in header) + "</tr>")
    for row in rows:
        cells = [cell if isinstance(cell, _Cell) else _Cell(cell) for cell in row]
        lines.append(
            "<tr>"
            + "".join(
                f'<td class="{cell.style}">{cell.html}</td>' if cell.style
                else f"<td>{cell.html}</td>"
                for cell in cells
            )
            + "</tr>"
        )  # fmt: skip
    return "\n".join([*lines, "</table>"])


def _summary_table(study: Study) -> str:
    header = ["", "point", "runs", "render time", "relMSE", "trimmed", "in the worst 0.1&nbsp;%"]
    header += ["variance", "bias&sup2;", "bias", "slope"]
    rows = []
    for index, entry in enumerate(study.entries):
        name = _name_cell(index, entry)
        if not entry.points:
            rows.append([name, _Cell("failed" if entry.failures else "no runs", "grey")])
            continue
        point = entry.points[-1]
        grey = "grey" if point.below_noise or point.nonfinite else ""
        fitted = slope(entry.points)
        split = point.split
        failed = len(entry.failures)
        cells = [
            escape(study.marks[point.mark])
            + (f"<small>{point.spp:.0f} spp</small>" if point.spp else ""),
            f"{len(point.errors)}" + (f"<small>{failed} failed</small>" if failed else ""),
            f"{point.seconds:.3g}&nbsp;s<small>process {point.process_seconds:.3g}&nbsp;s</small>",
            _interval_html(point.metrics["relmse"]),
            _interval_html(point.metrics["relmse_trimmed"]),
            f"{100.0 * point.worst_share:.0f}&nbsp;%",
            _interval_html(split.variance) if split else "",
            _interval_html(split.bias2) if split else "",
            _bias_words(split.bias2) if split else "",
            _interval_html(fitted, ".2f") if fitted else "",
        ]
        rows.append([name, *(_Cell(cell, grey) for cell in cells)])
    return _table(header, rows)


def _ratio_table(study: Study, metric: str) -> str:
    base = study.entries[0]
    levels = [point for point in _valid(base.points) if not point.below_noise]
    if len(study.entries) < 2 or not levels:
        return "<p class='small'>There is nothing to compare.</p>"
    header = [f"times faster than {escape(base.name)}, to its error at"]
    header += [
        f"{escape(study.marks[p.mark])}<br><small>{p.metrics[metric].value:.3g}</small>"
        for p in levels
    ]
    rows = []
    for index, entry in enumerate(study.entries):
        cells: list[str | _Cell] = [_name_cell(index, entry)]
        for point in levels:
            level = point.metrics[metric].value
            usable = [p for p in entry.points if not p.below_noise]
            ratio = None
            if entry is not base:
                ratio = speed_ratio(levels, usable, level, metric)
            if entry is base:
                cells.append("1")
            elif ratio is None:
                cells.append(_Cell("&ndash;", "grey"))
            else:
                bound = {"at least": "&ge;&nbsp;", "at most": "&le;&nbsp;", "": ""}[ratio.bound]
                cells.append(bound + _interval_html(ratio.value, ".2f"))
        rows.append(cells)
    return _table(header, rows)


def _settings_table(study: Study) -> str:
    """Return what each contestant was run with; what is the same for all stands in one row."""
    keys = list(dict.fromkeys(key for entry in study.entries for key in entry.settings))
    same = {
        key: study.entries[0].settings[key]
        for key in keys
        if len(study.entries) > 1
        and all(entry.settings.get(key, "") == study.entries[0].settings.get(key)
                for entry in study.entries)
    }  # fmt: skip
    rows: list[list[str | _Cell]] = []
    for index, entry in enumerate(study.entries):
        own = [f"{key} = {value}" for key, value in entry.settings.items() if key not in same]
        rows.append([_name_cell(index, entry), _Cell(escape(", ".join(own)) or "&ndash;", "text")])
    if same:
        text = ", ".join(f"{key} = {value}" for key, value in same.items())
        rows.append(["all", _Cell(escape(text), "text")])
    return _table(["", ""], rows)


def _name_cell(index: int, entry: Entry) -> _Cell:
    swatch = f'<span class="swatch" style="background: {_style(index)[0]}"></span>'
    return _Cell(swatch + escape(entry.name), "name")


def _interval_html(interval: Interval, form: str = ".3g") -> str:
    text = f"{interval.value:{form}}"
    if interval.known:
        text += f"<small>{interval.low:{form}} &hellip; {interval.high:{form}}</small>"
    return text.replace("-", "&minus;")


def _bias_words(bias2: Interval) -> str:
    if not bias2.known:
        return ""
    if bias2.low > 0.0:
        return f"about {100.0 * math.sqrt(bias2.value):.2g}&nbsp;%"
    if bias2.high < 0.0:
        return "below 0<small>is the reference less noisy than it says?</small>"
    return f"none seen<small>below {100.0 * math.sqrt(bias2.high):.2g}&nbsp;%</small>"


# The pictures.


def _pictures(study: Study) -> tuple[dict[str, object], int]:
    """Return the pictures for the page's script, and the columns of small pictures."""
    height, width = study.reference.rgb.shape[:2]
    rows = [{"label": "reference", "source": _png_source(study.reference.rgb), "column": 1}]
    columns = 1
    for entry in study.entries:
        chosen = [entry.points[index] for index in _spread(len(entry.points), _PICTURES)]
        row = []
        for point in chosen:
            snapshot = next(
                snapshot
                for run in entry.runs
                for snapshot in run.snapshots
                if snapshot.mark == point.mark
            )
            row.append((f"{entry.name}, {study.marks[point.mark]}", snapshot.load()))
            if point is chosen[-1] and len(point.errors) > 1:
                mean = np.mean([s.load() for r in entry.runs for s in r.snapshots
                                if s.mark == point.mark], axis=0)  # fmt: skip
                label = f"{entry.name}, {study.marks[point.mark]}, mean of {len(point.errors)} runs"
                row.append((label, mean))
        columns = max(columns, len(row))
        rows += [
            {"label": label, "source": _png_source(rgb), "column": column + 1}
            for column, (label, rgb) in enumerate(row)
        ]
    return {"width": width, "height": height, "pictures": rows}, columns


def _spread(count: int, wanted: int) -> list[int]:
    """Return the first index, the last, and some between them."""
    if count <= wanted:
        return list(range(count))
    return [round(k * (count - 1) / (wanted - 1)) for k in range(wanted)]


def shared_exponent(rgb: np.ndarray) -> np.ndarray:
    """Return ``(2 h, w, 3)`` uint8: mantissas above, exponents below (grey).

    A value is ``mantissa / 255 * 2^(exponent - 128)``; exponent 0 is black, 255 not finite.

    Source: Ward, "Real Pixels", Graphics Gems II, 1991, with the exponent apart, because browsers
    change colours where alpha is low.
    """
    finite = np.isfinite(rgb).all(axis=-1)
    values = np.where(finite[..., None], np.maximum(rgb, 0.0), 0.0)
    _, exponents = np.frexp(values.max(axis=-1))
    exponents = np.clip(exponents, -127, 126)
    mantissas = np.rint(np.minimum(np.ldexp(values, -exponents[..., None]), 1.0) * 255.0)
    stored = np.where(values.max(axis=-1) > 0.0, exponents + 128, 0)
    stored = np.where(finite, stored, 255)
    lower = np.repeat(stored[..., None], 3, axis=-1)
    return np.concatenate([mantissas, lower]).astype(np.uint8)


def _png_source(rgb: np.ndarray) -> str:
    buffer = io.BytesIO()
    PIL.Image.fromarray(shared_exponent(rgb)).save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _exposure(reference: np.ndarray) -> float:
    """Return an exposure in quarters of an EV that brings the mean luminance to about 0.25."""
    return float(np.clip(round(4.0 * math.log2(0.25 / mean_luminance(reference))) / 4.0, -8, 8))
