"""Directions drawn for materials of all lobes together, against the density that is told."""

import numpy as np
import pytest
from scipy import stats
from test_bsdf import direction
from test_bsdf_layers import evaluate, record, sample

P_MIN = 1e-5
COUNT = 8192

#: Materials of a seed, and seeds: 200 materials together.
MATERIALS, SEEDS = 5, 40

#: Points of Gauss's quadrature along each side of a cell.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)


def random_record(rng):
    def often(*values):
        return values[k] if (k := rng.integers(len(values) + 2)) < len(values) else rng.random()

    return record(
        color=tuple(rng.random(3)),
        metallic=often(0.0, 1.0),
        roughness=often(0.0, 0.05),
        specular=often(0.0, 1.0),
        ior=float(rng.choice([1.3, 1.5, 2.4])),
        transmission=often(0.0, 1.0),
        entering=bool(rng.random() < 0.5),
        thin=bool(rng.random() < 0.4),
        tint=tuple(rng.random(3)),
        coat=often(0.0, 1.0),
        coat_roughness=often(0.0),
        sheen=tuple(often(0.0) * rng.random(3)),
        sheen_roughness=rng.random(),
        anisotropy=often(0.0),
    )


def place(w):
    """Return (side, 1 - |z|, turn) of directions ``(n, 3)``: steps of these are steps of area.

    From x and y, because 1 - z has cancelled away near the normal.
    """
    w = w.astype(np.float64)
    low = (w[:, 0] ** 2 + w[:, 1] ** 2) / (1 + abs(w[:, 2]))
    turn = np.arctan2(w[:, 1], w[:, 0]) % (2 * np.pi)
    return np.column_stack([w[:, 2] < 0, low, turn])


def split(cells):
    """Return the four quarters of cells ``(n, 5)``: side, low and high 1 - |z|, turns."""
    side, a, b, c, d = cells.T
    m, n = (a + b) / 2, (c + d) / 2
    quarters = [(a, m, c, n), (a, m, n, d), (m, b, c, n), (m, b, n, d)]
    return np.stack([np.stack([side, *q], axis=1) for q in quarters], axis=1)


def cells_around(places):
    """Return cells that tile the sphere, ``(n, 5)``, small where many of ``places`` are."""
    turns = np.arange(8) * np.pi / 4
    heights = np.arange(4) / 4
    active = np.array(
        [(s, v, v + 0.25, t, t + np.pi / 4) for s in (0, 1) for v in heights for t in turns]
    )
    done = []
    for _ in range(22):
        inside = (
            (places[:, None, 0] == active[:, 0])
            & (places[:, None, 1] >= active[:, 1])
            & (places[:, None, 1] < active[:, 2])
            & (places[:, None, 2] >= active[:, 3])
            & (places[:, None, 2] < active[:, 4])
        )
        crowded = inside.sum(axis=0) > len(places) / 200
        done.append(active[~crowded])
        active = split(active[crowded]).reshape(-1, 5)
    return np.concatenate([*done, active])


def shares(device, row, wo, cells):
    """Return the integral of the density of a material over each cell.

    Sixteenths whose quarters say otherwise are divided again.
    """
    total = np.zeros(len(cells))
    index = np.repeat(np.arange(len(cells)), 16)
    cells = split(split(cells).reshape(-1, 5)).reshape(-1, 5)
    estimate = integrals(device, row, wo, cells)
    for _ in range(12):
        quarters = split(cells).reshape(-1, 5)
        finer = integrals(device, row, wo, quarters)
        sums = finer.reshape(-1, 4).sum(axis=1)
        rough = abs(sums - estimate) > 2e-3 * sums + 2e-6
        np.add.at(total, index[~rough], sums[~rough])
        if not rough.any():
            return total
        keep = np.repeat(rough, 4)
        cells, estimate = quarters[keep], finer[keep]
        index = np.repeat(index[rough], 4)
    np.add.at(total, index, estimate)
    return total


def integrals(device, row, wo, cells):
    """Return the integral over each cell by one rule, without a look at how good it is."""
    side, a, b, c, d = (v[:, None, None] for v in cells.T)
    low = (a + b) / 2 + (b - a) / 2 * NODES[:, None]
    turn = (c + d) / 2 + (d - c) / 2 * NODES
    low, turn, side = np.broadcast_arrays(low, turn, side)
    sine = np.sqrt(low * (2 - low))
    z = np.where(side > 0, low - 1, 1 - low)
    wi = np.stack([sine * np.cos(turn), sine * np.sin(turn), z], axis=-1).reshape(-1, 3)
    _, pdf = evaluate(
        device, np.repeat(row[None], len(wi), axis=0), np.repeat(wo[None], len(wi), axis=0), wi
    )
    values = pdf.astype(np.float64).reshape(len(cells), -1)
    weight = np.outer(WEIGHTS, WEIGHTS).ravel()
    return values @ weight * (cells[:, 2] - cells[:, 1]) * (cells[:, 4] - cells[:, 3]) / 4


def draw(device, rows, wo, rng):
    """Return places ``(materials, COUNT, 3)`` of drawn directions, and which are none."""
    wi, _, pdf = sample(
        device,
        np.repeat(rows, COUNT, axis=0),
        np.repeat(wo, COUNT, axis=0),
        rng.random((len(rows) * COUNT, 3)),
    )
    return place(wi).reshape(len(rows), COUNT, 3), (pdf > 0).reshape(len(rows), COUNT)


def found_in(cells, places):
    """Return how many of ``places`` each cell has."""
    counts = np.zeros(len(cells), int)
    for k, (side, a, b, c, d) in enumerate(cells):
        s, v, t = places.T
        counts[k] = ((s == side) & (v >= a) & (v < b) & (t >= c) & (t < d)).sum()
    return counts


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, SEEDS))]
)
def test_samples_of_random_materials_follow_their_density(device, seed):
    """Chi-square; a quarter of the directions are within 6 degrees of the surface.

    Bins are as small as some first samples ask for; their share is found by quadrature of the
    density that the device tells.
    """
    rng = np.random.default_rng([4, seed])
    count = MATERIALS
    rows = np.array([random_record(rng) for _ in range(count)])
    grazing = (np.arange(count) + seed) % 4 == 0
    cosines = rng.uniform(0.01, np.where(grazing, 0.1, 1.0))
    turns = rng.uniform(0, 6.28, count)
    wo = np.array([direction(c, phi) for c, phi in zip(cosines, turns, strict=True)])
    first, valid = draw(device, rows, wo, rng)
    cells = [cells_around(p[ok]) for p, ok in zip(first, valid, strict=True)]
    places, valid = draw(device, rows, wo, rng)
    for k in range(count):
        expected = shares(device, rows[k], wo[k], cells[k]) * COUNT
        found = found_in(cells[k], places[k][valid[k]])
        label = f"material {k}: {rows[k].tolist()}, cosine {cosines[k]}"
        assert abs(expected.sum() - found.sum()) < 5 * COUNT**0.5 / 2 + 0.005 * COUNT, label
        assert expected.sum() < 1.005 * COUNT, label
        rare = expected < 8
        expected = np.append(expected[~rare], expected[rare].sum())
        found = np.append(found[~rare], found[rare].sum())
        # Quadrature of float densities knows a share to half a per cent; so much is no deviation.
        excess = np.maximum(abs(found - expected) - 0.005 * expected - 0.5, 0)
        chi2 = (excess**2 / np.maximum(expected, 1)).sum()
        assert stats.chi2.sf(chi2, len(expected)) > P_MIN, label
