"""Write cl/common/albedo_tables.h: what lobes leave of white light from one direction.

Light that meets a second facet is lost to a model of single facets, and what lies under a layer
gets what the layer leaves.  So ``cl/common/albedo.h`` must know albedos: of GGX reflection and of
sheen by polynomials, of stretched highlights by tables.  All are found by quadrature, fitted so
that the largest error is least, and raised until they nowhere promise less than there is, but for
``SLACK``: for then light would be gained.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

HEADER = Path(__file__).resolve().parent.parent / "cl" / "common" / "albedo_tables.h"

#: Gain of light that is allowed.
SLACK = 0.0003

ALPHA_MIN = 1e-3
SHEEN_ROUGHNESS_MIN = 0.3

#: The edge's fit is in 1 / (1 + EDGE_SCALE alpha), that of sheen in cos / (cos + SHEEN_SCALE).
EDGE_SCALE = 12.0
SHEEN_SCALE = 0.2

#: Quadrature points along each axis, of tables and of polynomials, and what is done at once.
POINTS = 36
FINE = 72
CHUNK = 300

Array = np.ndarray


# --- Truth


def visible_normals(wo: Array, alpha: Array, points: int) -> tuple[Array, Array]:
    """Return GGX normals that are visible from ``wo``, and the share of the view that each has.

    Dupuy, Benyoub, Sampling Visible GGX Normals with Spherical Caps, 2023; the cap by Gauss's
    quadrature, denser at both of its ends, where the integrands have their edges.

    Args:
        wo: unit directions, ``(n, 3)``.
        alpha: widths along x and y, ``(n, 2)``.

    Returns:
        Normals ``(points^2, n, 3)`` and weights ``(points^2, 1)`` with a sum of 1.
    """
    node, weight = np.polynomial.legendre.leggauss(points)
    t = 0.5 * node + 0.5
    weight = weight * t * (1.0 - t)
    u1 = np.repeat(t * t * (3.0 - 2.0 * t), points)[:, None]
    # Rings are turned against each other, or a horizon that follows a row would be off by it.
    row, place = np.divmod(np.arange(points**2), points)
    turn = (2.0 * np.pi * (place + row * 0.618034 % 1.0) / points)[:, None]
    view = np.column_stack([alpha * wo[:, :2], wo[:, 2]])
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    z = (1.0 - u1) * (1.0 + view[:, 2]) - view[:, 2]
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    x = alpha[:, 0] * (radius * np.cos(turn) + view[:, 0])
    y = alpha[:, 1] * (radius * np.sin(turn) + view[:, 1])
    h = np.stack([x, y, np.maximum(z + view[:, 2], 1e-12)], axis=-1)
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    return h, np.repeat(weight / weight.sum() / points, points)[:, None]


def seen_too(wo: Array, wi: Array, alpha: Array) -> Array:
    """Return the share of the facets seen from wo that wi sees; Heitz 2014, height-correlated."""

    def hidden(w: Array) -> Array:
        slope2 = ((alpha * w[..., :2]) ** 2).sum(axis=-1) / np.maximum(w[..., 2] ** 2, 1e-30)
        return 0.5 * (np.sqrt(1.0 + slope2) - 1.0)

    once = 1.0 + hidden(wo)
    return once / (once + hidden(wi))


def in_parts(function: Callable[..., Array]) -> Callable[..., Array]:
    """Return ``function`` applied to parts of its arguments that fit into memory."""

    def parts(*given: Array, **options: int) -> Array:
        cuts = range(0, len(given[0]), CHUNK)
        done = [function(*(v[k : k + CHUNK] for v in given), **options) for k in cuts]
        return np.concatenate(done)

    return parts


def direction(cosine: Array, turn: Array) -> Array:
    """Return unit directions ``(n, 3)``."""
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return np.column_stack([sine * np.cos(turn), sine * np.sin(turn), cosine])


@in_parts
def reflected(
    cosine: Array, turn: Array, alpha_x: Array, alpha_y: Array, points: int = POINTS
) -> Array:
    """Return what GGX reflects if white, and with a reflectance of (1 - cos)^5, ``(n, 2)``."""
    alpha = np.column_stack([alpha_x, alpha_y])
    wo = direction(cosine, turn)
    h, weight = visible_normals(wo, alpha, points)
    along = (h * wo).sum(axis=-1)
    wi = 2.0 * along[..., None] * h - wo
    share = np.where(wi[..., 2] > 0.0, weight * seen_too(wo, wi, alpha), 0.0)
    edge = np.clip(1.0 - along, 0.0, 1.0) ** 5
    return np.column_stack([share.sum(axis=0), (share * edge).sum(axis=0)])


@in_parts
def reflected_by_sheen(cosine: Array, roughness: Array) -> Array:
    """Return what white sheen reflects: Estevez, Kulla 2017, and Neubelt, Pettineo's visibility."""
    node, weight = np.polynomial.legendre.leggauss(4 * POINTS)
    t = 0.5 * node + 0.5
    cos_i, weight = (t * t)[:, None, None], (weight * t)[:, None, None]
    turn = (np.pi * (np.arange(3 * POINTS) + 0.5) / (3 * POINTS))[:, None]
    between = np.sqrt((1.0 - cos_i**2) * (1.0 - cosine**2)) * np.cos(turn) + cos_i * cosine
    cos_h = (cos_i + cosine) / np.sqrt(np.maximum(2.0 + 2.0 * between, 1e-12))
    inverse = 1.0 / roughness**2
    fibres = (2.0 + inverse) * np.maximum(1.0 - cos_h**2, 1e-12) ** (0.5 * inverse) / (2.0 * np.pi)
    value = fibres * cos_i / (4.0 * (cos_i + cosine - cos_i * cosine))
    return (2.0 * np.pi * weight * value.mean(axis=1, keepdims=True)).sum(axis=(0, 1))


# --- Polynomials


def polynomial(terms: Array, values: Array, weights: Array, shape: tuple[int, int]) -> Array:
    """Return coefficients, of ``shape``, whose largest weighted error is the least; by Lawson.

    Args:
        terms: what each coefficient is multiplied with, ``(n, coefficients)``.
    """
    size = np.abs(terms).max(axis=0)
    importance = np.ones_like(values)
    best, least = np.zeros(terms.shape[1]), math.inf
    for _ in range(200):
        root = np.sqrt(importance) * weights
        found = np.linalg.lstsq(terms / size * root[:, None], values * root, rcond=None)[0]
        error = np.abs(terms / size @ found - values) * weights
        if error.max() < least:
            best, least = found / size, error.max()
        importance *= error
        importance /= importance.mean()
    return best.reshape(shape)


def powers(x: Array, y: Array, shape: tuple[int, int]) -> Array:
    """Return x^i y^j for all i and j below ``shape``, ``(n, coefficients)``."""
    both = x[:, None, None] ** np.arange(shape[0])[:, None] * y[:, None, None] ** np.arange(
        shape[1]
    )
    return both.reshape(len(x), -1)


def evaluated(fit: Array, x: Array, y: Array) -> Array:
    """Return the sum of fit[i, j] x^i y^j."""
    return powers(x, y, fit.shape) @ fit.ravel()


@dataclass(frozen=True)
class Fit:
    """A polynomial of two variables in [-1, 1], or of one, and by how much it is raised."""

    name: str
    what: str
    coefficients: Array
    raised: float = 0.0


def places(cosine: Array, alpha: Array) -> tuple[Array, Array, Array]:
    """Return where the fits of GGX have a direction and a width, in [-1, 1].

    Lobes near the horizon look alike for one ratio of cosine and alpha.

    Returns:
        x of the direction; of the width for the mirror, and for its edge.
    """
    x = cosine * (1.0 + alpha) / (cosine + alpha)
    q = 1.0 / (1.0 + EDGE_SCALE * alpha)
    least = 1.0 / (1.0 + EDGE_SCALE)
    return 2.0 * x - 1.0, 2.0 * alpha - 1.0, 2.0 * (q - least) / (1.0 - least) - 1.0


def fits_of_ggx() -> list[Fit]:
    """Return the polynomials of reflection and of their means over all directions."""
    # Directions at even steps of the fits' own measure, and of the cosine.
    step = np.linspace(0.0, 1.0, 46)
    alpha, t = (v.ravel() for v in np.meshgrid(np.linspace(ALPHA_MIN**0.5, 1.0, 26) ** 2, step))
    near = t**1.5 * alpha / (1.0 + alpha - t**1.5)
    cosine = np.clip(np.concatenate([near, t * t]), 1e-4, 1.0)
    alpha = np.concatenate([alpha, alpha])
    white, edge = reflected(cosine, np.zeros_like(cosine), alpha, alpha, points=FINE).T
    x, of_mirror, of_edge = places(cosine, alpha)

    shape = (7, 5)
    terms = powers(x, of_mirror, shape) * (alpha / (cosine + alpha))[:, None]
    lost = polynomial(terms, 1.0 - white, 1.0 / white, shape)
    raised = (white / (1.0 - terms @ lost.ravel())).max() - 1.0 - SLACK
    mirror = Fit("MIRROR", "a white mirror loses, over alpha / (cos + alpha)", lost, raised)

    shape = (6, 6)
    terms = powers(x, of_edge, shape) * ((1.0 - cosine) ** 5)[:, None]
    rim = polynomial(terms, edge, np.ones_like(x), shape)
    raised = (edge - terms @ rim.ravel()).max() - SLACK
    return means(mirror, Fit("EDGE", "its edge reflects, over (1 - cos)^5", rim, raised))


def means(mirror: Fit, edge: Fit) -> list[Fit]:
    """Return the fits and those of their cosine-weighted means."""
    node, weight = np.polynomial.legendre.leggauss(200)
    cosine, share = 0.5 * node[:, None] + 0.5, weight * (0.5 * node + 0.5)
    alpha = np.linspace(ALPHA_MIN**0.5, 1.0, 60) ** 2
    x, of_mirror, of_edge = (
        np.broadcast_to(v, (200, 60)).ravel() for v in places(cosine, alpha[None])
    )
    lost = evaluated(mirror.coefficients, x, of_mirror).reshape(200, 60)
    kept = (1.0 - lost * alpha / (cosine + alpha)) * (1.0 + mirror.raised)
    rim = (1.0 - cosine) ** 5 * evaluated(edge.coefficients, x, of_edge).reshape(200, 60)
    values = (share @ np.minimum(kept, 1.0), share @ rim + edge.raised)
    made = [mirror, edge]
    for of, mean, at in zip(made[:], values, (2.0 * alpha**0.5 - 1.0, of_edge[:60]), strict=True):
        terms = powers(at, np.ones_like(at), (7, 1))
        row = polynomial(terms, mean, np.ones_like(at), (1, 7))
        made.append(Fit(f"{of.name}_MEAN", "the mean of what is reflected so", row))
    return made


def fit_of_sheen() -> Fit:
    """Return the polynomial of what sheen reflects, in s = cos / (cos + SHEEN_SCALE)."""
    roughness, cosine = (
        v.ravel()
        for v in np.meshgrid(
            np.linspace(SHEEN_ROUGHNESS_MIN, 1.0, 22), np.linspace(0.0, 1.0, 40) ** 2, indexing="ij"
        )
    )
    cosine = np.maximum(cosine, 1e-3)
    shape = (7, 4)
    x = 2.0 * cosine / (cosine + SHEEN_SCALE) * (1.0 + SHEEN_SCALE) - 1.0
    y = 2.0 * (1.0 / roughness - 1.0) / (1.0 / SHEEN_ROUGHNESS_MIN - 1.0) - 1.0
    values = reflected_by_sheen(cosine, roughness)
    # bsdf.h scales it down by as much, so that it nowhere reflects more than all.
    scale = 1.0 / np.maximum(2.2 - 2.6 * roughness, 1.0)
    terms = powers(x, y, shape)
    fit = polynomial(terms, values, scale, shape)
    raised = (scale * (values - terms @ fit.ravel())).max() - SLACK
    return Fit("SHEEN", "white sheen reflects", fit, raised)


# --- Tables


def corners(place: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Return the entries that linear interpolation takes, and their weights, each ``(n, 2^axes)``.

    Args:
        place: where in the table something is, in [0, 1], ``(n, axes)``.
    """
    at = np.clip(place, 0.0, 1.0) * (np.array(shape) - 1)
    first = np.minimum(at.astype(int), np.array(shape) - 2)
    part = at - first
    picked = np.array(list(product((0, 1), repeat=len(shape))))
    index = first[:, None] + picked
    weight = np.where(picked, part[:, None], 1.0 - part[:, None]).prod(axis=2)
    return np.ravel_multi_index(np.moveaxis(index, 2, 0), shape), weight


def table(shape: tuple[int, ...], place: Array, values: Array, tolerance: Array) -> Array:
    """Return the entries, ``(entries,)``, between which interpolation meets ``values``.

    The largest error, in units of ``tolerance``, is made small, and no value is missed from below
    by more than SLACK of it.

    Args:
        place: ``(n, axes)`` in [0, 1].
        values: ``(n,)``.
        tolerance: ``(n,)``.
    """
    corner, weight = corners(place, shape)
    count = math.prod(shape)

    def spread(given: Array) -> Array:
        return np.bincount(corner.ravel(), (weight * given[:, None]).ravel(), count)

    entries = spread(values) / np.maximum(spread(np.ones_like(values)), 1e-12)
    importance = np.ones_like(values)
    for turn in range(400):
        error = (values - (entries[corner] * weight).sum(axis=1)) / tolerance
        if turn % 10 == 9:
            importance *= (np.abs(error) / np.abs(error).mean()) ** 0.5
            importance = np.clip(importance / importance.mean(), 1e-2, 1e3)
        pull = importance / tolerance
        entries += 1.5 * spread(error * pull) / np.maximum(spread(pull / tolerance), 1e-12)
        entries = np.maximum(entries, 0.0)
    for _ in range(60):
        lacking = values - SLACK * tolerance - (entries[corner] * weight).sum(axis=1)
        wanted = np.where(lacking > 0.0, lacking / (weight**2).sum(axis=1), 0.0)[:, None] * weight
        raised = np.zeros_like(entries)
        np.maximum.at(raised, corner, wanted)
        entries += 0.7 * raised
    return entries


#: Axes of what white ones reflect: how far facets turn away, along which of them, wide and narrow
#: width; and powers by which these are spread.
STRETCHED_SHAPE = (15, 7, 10, 8)
STRETCHED_POWERS = (0.75, 0.8, 1.0, 1.0)

#: The same of their edge: the direction's cosine, the width seen along it, wide and narrow width.
STRETCHED_EDGE_SHAPE = (12, 9, 9, 8)
STRETCHED_EDGE_POWERS = (0.75, 1.0, 0.5, 0.5)

#: Most that a table of white ones can tell: entries over 1 keep what is between them from lacking.
STRETCHED_MOST = 1.01

#: Largest cosine at which stretched facets seem to be met, over the direction's cosine and width.
STRETCHED_MET = 5.0

#: Places at which the tables are tried, beside their entries.
TRIALS = 150_000


def whites_at(place: Array) -> tuple[Array, Array, Array, Array]:
    """Return cosine, turn and alphas of places in the table of white stretched ones, ``(n, 4)``.

    Alphas times the direction's slopes, and the wide alpha, are all that counts where the narrow
    one is small: in their measure its zero is no edge.
    """
    t, along, high, ratio = (place ** (1.0 / np.array(STRETCHED_POWERS))).T
    high = np.maximum(high, ALPHA_MIN * (1.0 + 1e-4))
    low = np.clip(high * ratio, ALPHA_MIN, high / (1.0 + 1e-4))
    turned = 1.0 / np.maximum(t, 1e-5) - 1.0
    x, y = np.sqrt(along) / high, np.sqrt(1.0 - along) / low
    slope = np.minimum(turned * np.hypot(x, y), 1e4)
    return 1.0 / np.hypot(1.0, slope), np.arctan2(y, x), high, low


def place_of_whites(cosine: Array, turn: Array, high: Array, low: Array) -> Array:
    """Return places in the table of white stretched ones, ``(n, 4)``, the inverse of whites_at."""
    slope = np.sqrt(1.0 - cosine**2) / cosine
    x2, y2 = (high * np.cos(turn) * slope) ** 2, (low * np.sin(turn) * slope) ** 2
    along = x2 / np.maximum(x2 + y2, 1e-30)
    place = np.column_stack([1.0 / (1.0 + np.sqrt(x2 + y2)), along, high, low / high])
    return place ** np.array(STRETCHED_POWERS)


def edges_at(place: Array) -> tuple[Array, Array, Array, Array]:
    """Return cosine, turn and alphas of places in the table of stretched edges, ``(n, 4)``.

    The cosine goes by its ratio to the width that is seen along the direction, which goes by its
    fourth root between the two alphas.
    """
    t, along, high, ratio = (place ** (1.0 / np.array(STRETCHED_EDGE_POWERS))).T
    high = np.maximum(high, ALPHA_MIN * (1.0 + 1e-4))
    low = np.clip(high * ratio, ALPHA_MIN, high / (1.0 + 1e-4))
    width = (low**0.25 + along * (high**0.25 - low**0.25)) ** 4
    turn = np.arccos(np.sqrt(np.clip((width**2 - low**2) / (high**2 - low**2), 0.0, 1.0)))
    return np.clip(t * width / (1.0 + width - t), 1e-4, 1.0), turn, high, low


def place_of_edges(cosine: Array, turn: Array, high: Array, low: Array) -> Array:
    """Return places in the table of stretched edges, ``(n, 4)``, the inverse of edges_at."""
    width = np.clip(np.hypot(high * np.cos(turn), low * np.sin(turn)), low, high)
    along = (width**0.25 - low**0.25) / (high**0.25 - low**0.25)
    place = np.column_stack([cosine * (1.0 + width) / (cosine + width), along, high, low / high])
    return place ** np.array(STRETCHED_EDGE_POWERS)


def trials(shape: tuple[int, ...]) -> Array:
    """Return places in a table of ``shape``, ``(n, axes)``: of its entries, and at random.

    The latter often are on faces and edges of the table, where few others are near.
    """
    rng = np.random.default_rng(0)
    grid = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in shape), indexing="ij")
    anywhere = np.clip(1.2 * rng.random((TRIALS, len(shape))) - 0.1, 0.0, 1.0)
    return np.concatenate([anywhere, np.stack(grid, axis=-1).reshape(-1, len(shape))])


@dataclass(frozen=True)
class Table:
    """Entries between which is interpolated linearly: 65535 is all of the light."""

    name: str
    what: str
    shape: tuple[int, ...]
    entries: Array


def tables_of_stretched() -> list[Table]:
    """Return the tables of stretched highlights."""
    shape = STRETCHED_EDGE_SHAPE
    of_edges = np.array(edges_at(trials(shape)))
    # Sharp lobes have few places of their own there.
    facets = np.concatenate([of_edges, whites_at(trials(STRETCHED_SHAPE))], axis=1)
    white, edge = reflected(*facets).T
    mirror = table(STRETCHED_SHAPE, place_of_whites(*facets), white, white)

    cosine, turn, high, low = of_edges
    place = place_of_edges(cosine, turn, high, low)
    white, edge = white[: len(place)], edge[: len(place)]
    # The edge by the cosine at which all facets seem to be met: its fifth power changes too fast.
    unit = cosine + np.hypot(high * np.cos(turn), low * np.sin(turn))
    met = 1.0 - np.clip(edge / white, 0.0, 1.0) ** 0.2
    tolerance = 1.0 / (5.0 * white * (1.0 - met) ** 4 * unit * STRETCHED_MET + 0.02)
    rim = table(shape, place, 1.0 - met / unit / STRETCHED_MET, tolerance)
    what_white = "What a white stretched mirror reflects / STRETCHED_MOST"
    what = "Of its edge: 1 - cosine of facets / STRETCHED_MET"
    return [
        Table("STRETCHED", what_white, STRETCHED_SHAPE, mirror / STRETCHED_MOST),
        Table("STRETCHED_EDGE", what, shape, rim),
    ]


# --- Text


def text_of_fit(fit: Fit) -> list[str]:
    """Return the lines of a fit in OpenCL C."""
    rows, columns = fit.coefficients.shape
    lines = [
        "",
        f"// {fit.what[0].upper()}{fit.what[1:]}.",
        f"#define {fit.name}_RAISED {fit.raised:.6g}f",
        f"__constant float {fit.name}_FIT[{rows}][{columns}] = {{",
    ]
    lines += ["    {" + ", ".join(f"{c:.7g}f" for c in row) + "}," for row in fit.coefficients]
    return [*lines, "};"]


def text_of_table(made: Table) -> list[str]:
    """Return the lines of a table in OpenCL C."""
    entries = np.ceil(np.clip(made.entries, 0.0, 1.0) * 65535.0).astype(int)
    return [
        "",
        f"// {made.what}.",
        f"__constant ushort {made.name}_TABLE[{math.prod(made.shape)}] = {{",
        *("    " + ", ".join(map(str, row)) + "," for row in entries.reshape(-1, made.shape[-1])),
        "};",
    ]


def shape_of(name: str, shape: tuple[int, ...]) -> str:
    """Return the line that tells the axes of a table."""
    return f"__constant uint {name}_SHAPE[{len(shape)}] = {{{', '.join(map(str, shape))}}};"


def header() -> str:
    """Return the text of the header."""
    mirror, edge, mean, edge_mean = fits_of_ggx()
    sheen = fit_of_sheen()
    sizes = {
        "MIRROR": mirror,
        "EDGE": edge,
    }
    lines = [
        "// Parts of white light from one direction that lobes leave, as albedo.h evaluates them.",
        "// Written by tools/make_albedo_tables.py, which says how they are found and where.",
        "#pragma once",
        "",
        "#if GLOSSY",
        *(f"#define {name}_TERMS {fit.coefficients.shape[0]}" for name, fit in sizes.items()),
        *(f"#define {name}_WIDTHS {fit.coefficients.shape[1]}" for name, fit in sizes.items()),
        f"#define MEAN_TERMS {mean.coefficients.shape[1]}",
        f"#define EDGE_SCALE {EDGE_SCALE:.1f}f",
    ]
    for fit in (mirror, edge, mean, edge_mean):
        lines += text_of_fit(fit)
    lines += ["#endif", "", "#if LAYERS", f"#define SHEEN_SCALE {SHEEN_SCALE:.1f}f"]
    lines += [f"#define SHEEN_ROUGHNESS_MIN {SHEEN_ROUGHNESS_MIN:.1f}f"]
    lines += [f"#define SHEEN_TERMS {sheen.coefficients.shape[0]}"]
    lines += [f"#define SHEEN_ROUGHNESSES {sheen.coefficients.shape[1]}"]
    lines += [f"#define STRETCHED_MOST {STRETCHED_MOST:.2f}f"]
    lines += [f"#define STRETCHED_MET {STRETCHED_MET:.1f}f"]
    lines += [shape_of("STRETCHED", STRETCHED_SHAPE)]
    lines += [shape_of("STRETCHED_EDGE", STRETCHED_EDGE_SHAPE)]
    lines += text_of_fit(sheen)
    for made in tables_of_stretched():
        lines += text_of_table(made)
    return "\n".join([*lines, "#endif", ""])


if __name__ == "__main__":
    HEADER.write_text(header(), encoding="utf-8")
    print(HEADER)
