"""Write cl/common/glass_table.h: how much of the light one bounce on rough glass leaves.

Light that meets a second facet is lost to a model of single facets.  The table holds what is left,
reflected and refracted, of light from one direction, by direction, roughness and index, so that
``cl/common/bsdf.h`` can divide by it.  It is found by quadrature over the visible normals; entries
are raised until interpolation between them nowhere promises less than there is, for then light
would be gained.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

HEADER = Path(__file__).resolve().parent.parent / "cl" / "common" / "glass_table.h"

#: Entries along each axis; the middle one of the last is an index of 1.
SHAPE = (16, 12, 19)

#: (eta - 1) / (eta + 1) at the ends, that is, indices from 1/5 to 5.
LARGEST = 2.0 / 3.0

#: Samples of the quadrature along each axis, and places at which the table is tried.
POINTS = 40
TRIALS = 60_000
CHUNK = 1000


def albedo(cosine: np.ndarray, alpha: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Return what a rough dielectric boundary reflects and refracts of white light.

    Walter et al., Microfacet Models for Refraction through Rough Surfaces, 2007, with
    height-correlated masking; normals as in Dupuy, Benyoub, Sampling Visible GGX Normals with
    Spherical Caps, 2023.

    Args:
        cosine: of the direction to the normal, ``(n,)``.
        alpha: width of the lobe, ``(n,)``.
        eta: index beyond the boundary over the index on the side of the direction, ``(n,)``.

    Returns:
        Shares of the power, ``(n,)``.
    """
    u = (np.arange(POINTS) + 0.5) / POINTS
    u1, u2 = (v.ravel()[:, None] for v in np.meshgrid(u, u, indexing="ij"))
    sine = np.sqrt(1.0 - cosine**2)
    length = np.hypot(alpha * sine, cosine)
    tilt, up = alpha * sine / length, cosine / length
    z = (1.0 - u1) * (1.0 + up) - up
    radius, turn = np.sqrt(np.maximum(1.0 - z * z, 0.0)), 2.0 * np.pi * u2
    x, y = alpha * (radius * np.cos(turn) + tilt), alpha * radius * np.sin(turn)
    z = np.maximum(z + up, 1e-9)
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    x, z = x * scale, z * scale
    along = x * sine + z * cosine
    sine2 = (1.0 - along**2) / eta**2
    bent = np.sqrt(np.maximum(1.0 - sine2, 0.0))
    parallel = (eta * along - bent) / (eta * along + bent)
    vertical = (along - eta * bent) / (along + eta * bent)
    fresnel = np.where(sine2 >= 1.0, 1.0, 0.5 * (parallel**2 + vertical**2))

    def hidden(c: np.ndarray) -> np.ndarray:
        return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 - c**2) / np.maximum(c**2, 1e-20)) - 1.0)

    def seen(c: np.ndarray) -> np.ndarray:
        return (1.0 + hidden(cosine)) / (1.0 + hidden(cosine) + hidden(np.minimum(np.abs(c), 1.0)))

    up = 2.0 * along * z - cosine
    down = -cosine / eta + z * (along / eta - bent)
    reflected = np.where(up > 0.0, fresnel * seen(up), 0.0)
    refracted = np.where((down < 0.0) & (sine2 < 1.0), (1.0 - fresnel) * seen(down), 0.0)
    return (reflected + refracted).mean(axis=0)


def albedos(cosine: np.ndarray, alpha: np.ndarray, eta: np.ndarray) -> np.ndarray:
    """Do what ``albedo`` does, in parts that fit into memory."""
    parts = [slice(k, k + CHUNK) for k in range(0, len(cosine), CHUNK)]
    return np.concatenate([albedo(cosine[part], alpha[part], eta[part]) for part in parts])


def places(cosine: np.ndarray, alpha: np.ndarray, eta: np.ndarray) -> list[np.ndarray]:
    """Return where in the table something is, in entries, an ``(n,)`` for each axis.

    Lobes near the horizon look alike for one ratio of cosine and alpha; near an index of 1 all
    changes fast.
    """
    x = (eta - 1.0) / (eta + 1.0)
    t = np.copysign(np.sqrt(np.minimum(np.abs(x) / LARGEST, 1.0)), x)
    along = (cosine * (1.0 + alpha) / (cosine + alpha), alpha, 0.5 * t + 0.5)
    return [np.clip(v, 0.0, 1.0) * (n - 1) for v, n in zip(along, SHAPE, strict=True)]


def table() -> np.ndarray:
    """Return the table, uint8 of ``SHAPE``: 255 is all of the light."""
    q, alpha, t = (
        v.ravel() for v in np.meshgrid(*(np.linspace(0, 1, n) for n in SHAPE), indexing="ij")
    )
    alpha = np.maximum(alpha, 1e-3)
    s = q / (1.0 + alpha)
    cosine = np.clip(s * alpha / (1.0 - s), 1e-4, 1.0)
    t = 2.0 * t - 1.0
    x = np.sign(t) * t * t * LARGEST
    entries = albedos(cosine, alpha, (1.0 + x) / (1.0 - x))

    rng = np.random.default_rng(0)
    cosine, alpha = np.maximum(rng.random(TRIALS) ** 2, 1e-3), np.maximum(rng.random(TRIALS), 1e-3)
    t = rng.uniform(-1.0, 1.0, TRIALS)
    x = np.sign(t) * t * t * LARGEST
    eta = (1.0 + x) / (1.0 - x)
    truth = albedos(cosine, alpha, eta)
    corners, weights = [], []
    place = places(cosine, alpha, eta)
    first = [np.minimum(p.astype(int), n - 2) for p, n in zip(place, SHAPE, strict=True)]
    for corner in np.ndindex(2, 2, 2):
        index = [i + c for i, c in zip(first, corner, strict=True)]
        part = [p - i for p, i in zip(place, first, strict=True)]
        corners.append(np.ravel_multi_index(index, SHAPE))
        weights.append(
            np.prod([p if c else 1 - p for p, c in zip(part, corner, strict=True)], axis=0)
        )
    corner, weight = np.array(corners), np.array(weights)
    for _ in range(60):
        lacking = truth - (entries[corner] * weight).sum(axis=0)
        wanted = np.where(lacking > 0.0, lacking / (weight**2).sum(axis=0), 0.0) * weight
        raised = np.zeros_like(entries)
        np.maximum.at(raised, corner, wanted)
        entries = np.minimum(entries + 0.7 * raised, 1.0)
    return np.ceil(entries * 255.0).astype(np.uint8).reshape(SHAPE)


def header() -> str:
    """Return the text of the header."""
    lines = [
        "// Light that one bounce on rough glass leaves, 255 for all: by cosine, roughness, index.",
        "// Written by tools/make_glass_table.py, which says how it is found and where what is.",
        "#pragma once",
        "",
        "#if TRANSMISSION",
        *(
            f"#define GLASS_{name} {n}"
            for name, n in zip(("COSINES", "ALPHAS", "INDICES"), SHAPE, strict=True)
        ),
        f"#define GLASS_LARGEST {LARGEST:.9g}f",
        "",
        "__constant uchar GLASS_TABLE[GLASS_COSINES * GLASS_ALPHAS * GLASS_INDICES] = {",
        *("    " + ", ".join(map(str, row)) + "," for row in table().reshape(-1, SHAPE[2])),
        "};",
        "#endif",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    HEADER.write_text(header(), encoding="utf-8")
    print(HEADER)
