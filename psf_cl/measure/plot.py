"""Log-log plots, drawn once and written as SVG or as PNG."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont

from psf_cl.files import write_whole

#: Colours that the colour-blind tell apart.
#: Source: Okabe, Ito, "Color Universal Design", 2008; without its yellow, which is faint on white.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
SHAPES = ("circle", "square", "triangle", "diamond")
GREY = "#9a9a9a"

_INK, _GRID, _FAINT_GRID = "#333333", "#cccccc", "#ececec"
# The PNG is drawn this much larger than wanted and made smaller, for smooth edges.
_SMOOTHING = 2

Position = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One curve of a panel.

    Attributes:
        points: x, y, low, high; low and high NaN for no interval; y that is not above 0 has an
            interval only.
        grey: which points are for no claim, drawn grey.
        titles: what a pointer shows over each point.
    """

    name: str
    colour: str
    shape: str
    points: Sequence[tuple[float, float, float, float]]
    grey: Sequence[bool] = ()
    titles: Sequence[str] = ()
    dashed: bool = False
    band: bool = True


@dataclass
class Drawing:
    """Lines, areas, markers and text on a white sheet; units are CSS pixels from the top left."""

    width: float
    height: float
    items: list[tuple[str, tuple[Position, ...], dict[str, object]]] = field(default_factory=list)

    def line(
        self, points: Iterable[Position], colour: str, width: float = 1.0, dash: bool = False
    ) -> None:
        self.items.append(("line", tuple(points), {"colour": colour, "width": width, "dash": dash}))

    def area(
        self, points: Iterable[Position], colour: str, opacity: float = 1.0, title: str = ""
    ) -> None:
        values = {"colour": colour, "opacity": opacity, "title": title}
        self.items.append(("area", tuple(points), values))

    def text(
        self, at: Position, text: str, anchor: str = "start", bold: bool = False, size: float = 12.0
    ) -> None:
        values = {"text": text, "anchor": anchor, "bold": bold, "size": size}
        self.items.append(("text", (at,), values))

    def marker(self, at: Position, shape: str, colour: str, title: str = "") -> None:
        x, y = at
        corners = {
            "circle": [(k / 8.0, 4.2) for k in range(16)],
            "square": [(0.25 + k / 2.0, 5.0) for k in range(4)],
            "triangle": [(1.5 + k / 1.5, 5.2) for k in range(3)],
            "diamond": [(k / 2.0, 5.2) for k in range(4)],
        }[shape]
        points = [
            (x + r * math.cos(math.pi * angle), y + r * math.sin(math.pi * angle))
            for angle, r in corners
        ]
        self.area(points, colour, title=title)

    def write(self, path: Path) -> None:
        """Write an SVG or a PNG, as the name says.

        Raises:
            InputError: it cannot be written.
        """
        write_whole(path, self.svg().encode() if path.suffix == ".svg" else self.png(1.0))

    def place(self, other: Drawing, left: float, top: float) -> None:
        """Add all of another drawing, moved."""
        for kind, points, values in other.items:
            self.items.append((kind, tuple((x + left, y + top) for x, y in points), values))

    def svg(self) -> str:
        """Return the drawing as one SVG element."""
        parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" font-family="sans-serif">',
            f'<rect width="{self.width:g}" height="{self.height:g}" fill="#ffffff"/>',
        ]
        for kind, points, v in self.items:
            path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
            if kind == "line":
                dash = ' stroke-dasharray="5 4"' if v["dash"] else ""
                parts.append(
                    f'<polyline points="{path}" fill="none" stroke="{v["colour"]}" '
                    f'stroke-width="{v["width"]:g}" stroke-linejoin="round"{dash}/>'
                )
            elif kind == "area":
                title = f"<title>{escape(str(v['title']))}</title>" if v["title"] else ""
                opacity = f' fill-opacity="{v["opacity"]:g}"' if v["opacity"] != 1.0 else ""
                parts.append(
                    f'<polygon points="{path}" fill="{v["colour"]}"{opacity}>{title}</polygon>'
                )
            else:
                bold = ' font-weight="bold"' if v["bold"] else ""
                (x, y), text = points[0], escape(str(v["text"]))
                parts.append(
                    f'<text x="{x:.1f}" y="{y:.1f}" font-size="{v["size"]:g}" fill="{_INK}" '
                    f'text-anchor="{v["anchor"]}"{bold}>{text}</text>'
                )
        return "\n".join([*parts, "</svg>"])

    def png(self, scale: float = 2.0) -> bytes:
        """Return the drawing as a PNG file of ``scale`` image pixels a unit."""
        zoom = scale * _SMOOTHING
        size = round(self.width * zoom), round(self.height * zoom)
        image = PIL.Image.new("RGB", size, "white")
        for kind, points, v in self.items:
            pixels = [(x * zoom, y * zoom) for x, y in points]
            if kind == "line":
                draw = PIL.ImageDraw.Draw(image)
                pieces = _dashes(pixels, 5.0 * zoom, 4.0 * zoom) if v["dash"] else [pixels]
                for piece in pieces:
                    draw.line(piece, v["colour"], max(round(v["width"] * zoom), 1), joint="curve")
            elif kind == "area":
                draw = PIL.ImageDraw.Draw(image, "RGBA")
                red, green, blue = PIL.ImageColor.getrgb(str(v["colour"]))[:3]
                draw.polygon(pixels, (red, green, blue, round(255 * float(v["opacity"]))))
            else:
                draw = PIL.ImageDraw.Draw(image)
                font = PIL.ImageFont.load_default(float(v["size"]) * zoom)
                anchor = {"start": "ls", "middle": "ms", "end": "rs"}[str(v["anchor"])]
                stroke = round(0.25 * zoom) if v["bold"] else 0
                text = str(v["text"]).encode("ascii", "replace").decode()
                draw.text(pixels[0], text, _INK, font, anchor, stroke_width=stroke)
        small = round(self.width * scale), round(self.height * scale)
        buffer = io.BytesIO()
        image.resize(small, PIL.Image.Resampling.BOX).quantize(128).save(
            buffer, format="png", optimize=True
        )
        return buffer.getvalue()


def panel(
    title: str,
    x_label: str,
    series: Sequence[Series],
    width: float = 500.0,
    height: float = 330.0,
) -> Drawing:
    """Draw curves over logarithmic axes, with their intervals.

    An interval that reaches 0 or below goes on to the lower edge.
    """
    drawing = Drawing(width, height)
    left, top, right, bottom = 58.0, 34.0, width - 14.0, height - 42.0
    xs = [x for s in series for x, *_ in s.points if x > 0.0]
    # Where a curve has no value above 0 its interval alone must not stretch the axis far down.
    values = [y for s in series for _, y, _, _ in s.points if y > 0.0 and math.isfinite(y)]
    highs = [high for s in series for *_, high in s.points if high > 0.0 and math.isfinite(high)]
    drawing.text((left, 20.0), title, bold=True, size=13.0)
    drawing.text((right, height - 8.0), x_label, anchor="end")
    if not xs or not values + highs:
        drawing.text(((left + right) / 2.0, (top + bottom) / 2.0), "nothing to show", "middle")
        return drawing
    x_low, x_high = _widened(min(xs), max(xs), 1.15)
    y_low, y_high = _widened(min(values or highs), max(values + highs), 1.5)

    def at(x: float, y: float) -> Position:
        across = math.log(x / x_low) / math.log(x_high / x_low)
        up = math.log(max(y, y_low) / y_low) / math.log(y_high / y_low)
        return left + across * (right - left), bottom - min(up, 1.0) * (bottom - top)

    for value, major in ticks(x_low, x_high):
        x, _ = at(value, y_low)
        drawing.line([(x, top), (x, bottom)], _GRID if major else _FAINT_GRID)
        if major:
            drawing.text((x, bottom + 17.0), number_text(value), "middle")
    for value, major in ticks(y_low, y_high):
        _, y = at(x_low, value)
        drawing.line([(left, y), (right, y)], _GRID if major else _FAINT_GRID)
        if major:
            drawing.text((left - 7.0, y + 4.0), number_text(value), "end")
    drawing.line([(left, top), (left, bottom), (right, bottom)], _INK)
    for one in series:
        _draw_series(drawing, one, at, y_low)
    return drawing


def _draw_series(
    drawing: Drawing, one: Series, at: Callable[[float, float], Position], y_low: float
) -> None:
    points = [point for point in one.points if point[0] > 0.0]
    certain = [p for p in points if math.isfinite(p[2]) and math.isfinite(p[3]) and p[3] > 0.0]
    if one.band and len(certain) > 1:
        outline = [at(x, high) for x, _, _, high in certain]
        outline += [at(x, max(low, y_low)) for x, _, low, _ in reversed(certain)]
        drawing.area(outline, one.colour, 0.15)
    if not one.band:
        for x, _, low, high in certain:
            ends = at(x, max(low, y_low)), at(x, high)
            drawing.line(ends, one.colour, 1.5)
            for end, value in zip(ends, (low, high), strict=True):
                if value >= y_low:
                    drawing.line([(end[0] - 4.0, end[1]), (end[0] + 4.0, end[1])], one.colour, 1.5)
    shown = [at(x, y) for x, y, _, _ in points if y > 0.0]
    if len(shown) > 1:
        drawing.line(shown, one.colour, 1.8, one.dashed)
    for index, (x, y, _, _) in enumerate(points):
        if y > 0.0:
            grey = index < len(one.grey) and one.grey[index]
            title = one.titles[index] if index < len(one.titles) else ""
            drawing.marker(at(x, y), one.shape, GREY if grey else one.colour, title)


def figure(panels: Sequence[Drawing], legend: Sequence[tuple[str, str, str]]) -> Drawing:
    """Put panels two in a row, under a legend of (name, colour, shape)."""
    columns = min(len(panels), 2)
    per_row = 4 if columns == 2 else 2
    head = 14.0 + 20.0 * math.ceil(len(legend) / per_row)
    cell = columns * panels[0].width / per_row
    rows = math.ceil(len(panels) / columns)
    sheet = Drawing(columns * panels[0].width, head + rows * panels[0].height)
    for index, (name, colour, shape) in enumerate(legend):
        x, y = 30.0 + index % per_row * cell, 18.0 + 20.0 * (index // per_row)
        sheet.marker((x, y - 4.0), shape, colour)
        sheet.text((x + 10.0, y), name if len(name) <= 34 else name[:33] + "...")
    for index, one in enumerate(panels):
        sheet.place(one, index % columns * one.width, head + index // columns * one.height)
    return sheet


def ticks(low: float, high: float) -> list[tuple[float, bool]]:
    """Return (value, whether it has a label) between two positive numbers, 2 labels at least."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    span = math.log10(high / low)
    labelled = (1,) if span > 3.5 else (1, 2, 5) if span > 0.5 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
    found = [
        (digit * 10.0**decade, digit in labelled)
        for decade in decades
        for digit in sorted({*range(1, 10), *labelled})
        if low <= digit * 10.0**decade <= high
    ]
    return found if span < 7.0 else [(value, major) for value, major in found if major]


def number_text(value: float) -> str:
    """Return a short number: 0.001, 16, 2e-5."""
    text = f"{value:.3g}"
    mantissa, separator, exponent = text.partition("e")
    return f"{mantissa}e{int(exponent)}" if separator else text


def _widened(low: float, high: float, factor: float) -> tuple[float, float]:
    return low / factor, high * factor


def _dashes(points: Sequence[Position], on: float, off: float) -> list[list[Position]]:
    """Cut a polyline into dashes."""
    pieces: list[list[Position]] = []
    travelled = 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(points):
        length = math.hypot(x1 - x0, y1 - y0)
        position = 0.0
        while position < length:
            phase = math.fmod(travelled + position, on + off)
            step = min((on if phase < on else on + off) - phase + 1e-6, length - position)
            if phase < on:
                a, b = position / length, (position + step) / length
                start = x0 + a * (x1 - x0), y0 + a * (y1 - y0)
                pieces.append([start, (x0 + b * (x1 - x0), y0 + b * (y1 - y0))])
            position += step
        travelled += length
    return pieces
