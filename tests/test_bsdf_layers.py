"""The whole BSDF, layers and sheets too: energy, sampling against density, over all parameters."""

import itertools

import numpy as np
import planes
import pytest
from scipy import stats
from test_bsdf import direction

P_MIN = 1e-5
BY_CHANCE = -np.ones(4)
COSINES = (1.0, 0.7, 0.3, 0.1, 0.02)


def record(
    color=(1.0, 1.0, 1.0),
    metallic=0.0,
    roughness=0.5,
    specular=1.0,
    ior=1.5,
    transmission=0.0,
    entering=True,
    thin=False,
    tint=(1.0, 1.0, 1.0),
    coat=0.0,
    coat_roughness=0.0,
    sheen=(0.0, 0.0, 0.0),
    sheen_roughness=0.5,
    anisotropy=0.0,
):
    """Return the row that the test kernel reads, as material.h would make it."""
    alpha = max(roughness**2, 1e-3)
    f0 = ((ior - 1) / (ior + 1)) ** 2 * specular
    along = alpha + (1 - alpha) * anisotropy**2
    eta = ior if entering or thin else 1 / ior
    surface = [*color, metallic, along, f0, specular, transmission, eta, float(thin)]
    layers = [*tint, coat, max(coat_roughness**2, 1e-3), *sheen, max(sheen_roughness, 0.3), alpha]
    return surface + layers


def run(device, kernel, inputs, outputs):
    inputs = {name: np.ascontiguousarray(v, np.float32) for name, v in inputs.items()}
    defines = {"GLOSSY": 1, "TRANSMISSION": 1, "LAYERS": 1}
    return planes.run(device, "bsdf_test.cl", kernel, inputs, outputs, defines)


def sample(device, records, wo, numbers):
    """Return directions and values ``(n, 3)`` and densities ``(n,)``."""
    given = np.tile(BY_CHANCE, (len(records), 1))
    wi, values, pdfs = run(
        device,
        "sample_directions",
        {"materials": records.T, "given": given.T, "wo": wo.T, "numbers": numbers.T},
        {"wi": (np.float32, 3), "values": (np.float32, 3), "pdfs": (np.float32, 1)},
    )
    return wi.T, values.T, pdfs


def evaluate(device, records, wo, wi):
    """Return values ``(n, 3)`` and densities ``(n,)``."""
    given = np.tile(BY_CHANCE, (len(records), 1))
    values, pdfs = run(
        device,
        "eval_pairs",
        {"materials": records.T, "given": given.T, "wo": wo.T, "wi": wi.T, "side": wi[:, 2]},
        {"values": (np.float32, 3), "pdfs": (np.float32, 1)},
    )
    return values.T, pdfs


def furnace(device, records, cosines, count=2304):
    """Return what comes back of white light, ``(materials, cosines)``, and its deviation.

    Power, not radiance: what passes into glass is multiplied with the square of the index.
    """
    pairs = list(itertools.product(range(len(records)), cosines))
    side = round(count**0.5)
    u = (np.mgrid[:side, :side].reshape(2, -1).T + 0.5) / side
    rng = np.random.default_rng(1)
    numbers = np.column_stack([rng.permutation((np.arange(len(u)) + 0.5) / len(u)), u])
    rows = np.repeat([records[k] for k, _ in pairs], len(u), axis=0)
    wo = np.repeat([direction(cosine) for _, cosine in pairs], len(u), axis=0)
    wi, values, pdfs = sample(device, rows, wo, np.tile(numbers, (len(pairs), 1)))
    power = np.where((wi[:, 2] < 0) & (rows[:, 9] == 0), rows[:, 8] ** 2, 1.0)
    weight = np.where(pdfs > 0, values[:, 0] / np.where(pdfs > 0, pdfs, 1), 0) * power
    weight = weight.astype(np.float64).reshape(len(records), len(cosines), -1)
    return weight.mean(axis=2), weight.std(axis=2) / np.sqrt(len(u))


ROUGHNESSES = (0.05, 0.2, 0.4, 0.6, 0.8, 1.0)


@pytest.mark.parametrize(
    "kind", ["metal", "dielectric", "glass", "sheet", "coated", "coated metal"]
)
def test_white_conserves(device, kind):
    """All that arrives comes back, to the accuracy of the fits, and never more."""
    values = {
        "metal": {"metallic": 1.0},
        "dielectric": {},
        "glass": {"transmission": 1.0},
        "sheet": {"transmission": 1.0, "thin": True},
        "coated": {"coat": 1.0, "coat_roughness": 0.4},
        "coated metal": {"coat": 0.5, "coat_roughness": 0.7, "metallic": 1.0},
    }[kind]
    records = np.array(
        [
            record(roughness=roughness, ior=ior, **values)
            for roughness in ROUGHNESSES
            for ior in (1.3, 1.5, 2.4)
        ]
    )
    returned, deviation = furnace(device, records, COSINES)
    # The deviation of a stratified mean is smaller still.
    assert (returned < 1.001 + 2 * deviation).all(), (returned - deviation).max()
    # Each layer's fit and the table of glass err on the safe side.
    lost = 0.025 if kind.startswith("coated") else 0.011
    steep = np.array(COSINES) >= 0.1
    assert (returned > 1 - lost - 2 * deviation)[:, steep].all(), returned[:, steep].min()
    assert (returned > 0.965 - 2 * deviation).all(), returned.min()


def test_no_combination_gains_energy(device):
    """A grid over all parameters, each white."""
    white, black = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    grid = {
        "roughness": (0.05, 0.4, 1.0),
        "metallic": (0.0, 0.5, 1.0),
        "transmission": (0.0, 0.5, 1.0),
        "shape": ((True, False), (False, False), (True, True)),
        "specular": (0.0, 1.0),
        "ior": (1.3, 2.4),
        "coat": (0.0, 1.0),
        "sheen": (black, white),
        "anisotropy": (0.0, 0.6, 1.0),
    }
    records = []
    for values in itertools.product(*grid.values()):
        row = dict(zip(grid, values, strict=True))
        entering, thin = row.pop("shape")
        row |= {"entering": entering, "thin": thin, "coat_roughness": 0.3}
        row["sheen_roughness"] = 0.3 + 0.7 * row["roughness"]
        records.append(record(**row))
    returned, deviation = furnace(device, np.array(records), (0.9, 0.3, 0.03), 144)
    over = returned - 1.001 - 4 * deviation
    assert over.max() < 0, records[int(over.max(axis=1).argmax())]
    assert (returned >= 0).all()


def random_record(rng):
    def often(*values):
        return values[k] if (k := rng.integers(len(values) + 2)) < len(values) else rng.random()

    return record(
        color=tuple(rng.random(3)),
        metallic=often(0.0, 1.0),
        roughness=0.4 + 0.6 * rng.random(),
        specular=often(0.0, 1.0),
        ior=float(rng.choice([1.3, 1.5, 2.4])),
        transmission=often(0.0, 1.0),
        entering=bool(rng.random() < 0.5),
        thin=bool(rng.random() < 0.4),
        tint=tuple(rng.random(3)),
        coat=often(0.0, 1.0),
        coat_roughness=0.5 + 0.5 * rng.random(),
        sheen=tuple(often(0.0) * rng.random(3)),
        sheen_roughness=rng.random(),
        anisotropy=often(0.0),
    )


def test_samples_follow_their_density_for_200_random_materials(device):
    """Chi-square over bins of the sphere of what is drawn, against the density that is told."""
    rng = np.random.default_rng(4)
    rows = np.array([random_record(rng) for _ in range(200)])
    cosines = np.concatenate([rng.random(150), rng.uniform(0.01, 0.1, 50)])
    wo = np.array(
        [direction(c, phi) for c, phi in zip(cosines, rng.uniform(0, 6.28, 200), strict=True)]
    )
    count, heights, turns, fine = 4096, 10, 8, 30
    # Midpoints of cells of equal solid angle; each bin has fine^2 of them.
    z = (np.arange(heights * fine) + 0.5) / (heights * fine) * 2 - 1
    phi = (np.arange(turns * fine) + 0.5) / (turns * fine) * 2 * np.pi
    zz, pp = (m.ravel() for m in np.meshgrid(z, phi, indexing="ij"))
    sine = np.sqrt(1 - zz**2)
    grid = np.stack([sine * np.cos(pp), sine * np.sin(pp), zz], axis=-1)
    bin_of_cell = (np.arange(len(z)) // fine)[:, None] * turns + np.arange(len(phi)) // fine
    worst = []
    for first in range(0, 200, 10):
        part = slice(first, first + 10)
        repeated = np.repeat(rows[part], len(grid), axis=0)
        _, pdfs = evaluate(
            device, repeated, np.repeat(wo[part], len(grid), axis=0), np.tile(grid, (10, 1))
        )
        cells = pdfs.reshape(10, -1).astype(np.float64) * (4 * np.pi / len(grid))
        numbers = rng.random((10 * count, 3))
        wi, _, drawn = sample(
            device,
            np.repeat(rows[part], count, axis=0),
            np.repeat(wo[part], count, axis=0),
            numbers,
        )
        for k in range(10):
            share = np.bincount(bin_of_cell.ravel(), cells[k], heights * turns)
            assert share.sum() < 1.02, rows[first + k]
            w = wi[k * count : (k + 1) * count]
            ok = drawn[k * count : (k + 1) * count] > 0
            row = np.clip((w[:, 2] + 1) / 2 * heights, 0, heights - 1).astype(int)
            turn = np.arctan2(w[:, 1], w[:, 0]) % (2 * np.pi) / (2 * np.pi) * turns
            index = row * turns + np.minimum(turn.astype(int), turns - 1)
            found = np.bincount(index[ok], minlength=heights * turns)
            # The midpoint rule knows a bin to a per cent of it; so much is no deviation.
            enough = share * count > 8
            excess = np.maximum(abs(found - share * count) - 0.015 * share * count, 0)
            chi2 = (excess[enough] ** 2 / (share[enough] * count)).sum()
            worst.append(stats.chi2.sf(chi2, max(enough.sum(), 1)))
            missing = abs(ok.mean() - share.sum())
            assert missing < 5 * np.sqrt(0.25 / count) + 0.01, rows[first + k]
    worst = np.array(worst)
    assert worst.min() > P_MIN, rows[worst.argmin()]


def test_a_sheet_lets_light_through_as_a_mirror_image(device):
    """Behind over in front is (1 - F) / F, with the F of two faces."""
    rng = np.random.default_rng(5)
    rows = np.array([record(roughness=r, transmission=1.0, thin=True) for r in rng.random(500)])
    wo = np.array([direction(c) for c in rng.uniform(0.05, 1, 500)])
    wi, _, _ = sample(device, rows, wo, rng.random((500, 3)))
    wi = wi * np.where(wi[:, 2:] < 0, (1, 1, -1), 1)
    front, _ = evaluate(device, rows, wo, wi)
    back, _ = evaluate(device, rows, wo, wi * (1, 1, -1))
    h = wo + wi
    cosine = (wo * h).sum(axis=1) / np.linalg.norm(h, axis=1)
    inside = np.sqrt(1 - (1 - cosine**2) / 2.25)
    s = (cosine - 1.5 * inside) / (cosine + 1.5 * inside)
    p = (1.5 * cosine - inside) / (1.5 * cosine + inside)
    once = (s**2 + p**2) / 2
    both = 2 * once / (1 + once)
    ok = (wi[:, 2] > 1e-3) & (front[:, 0] > 1e-6)
    assert ok.sum() > 400
    np.testing.assert_allclose((back[:, 0] / front[:, 0])[ok], (1 / both - 1)[ok], rtol=2e-3)


def test_sheen_is_reciprocal(device):
    """On a black base, and where the base takes what it leaves."""
    rng = np.random.default_rng(6)
    rows = np.array(
        [
            record(color=(0, 0, 0), specular=0.0, sheen=(1.0, 0.5, 0.2), sheen_roughness=r)
            for r in rng.uniform(0.3, 1, 300)
        ]
    )
    wo, wi = rng.normal(size=(2, 300, 3))
    for w in (wo, wi):
        w[:, 2] = abs(w[:, 2]) + 1e-2
        w /= np.linalg.norm(w, axis=1, keepdims=True)
    there, _ = evaluate(device, rows, wo, wi)
    back, _ = evaluate(device, rows, wi, wo)
    np.testing.assert_allclose(there / wi[:, 2:], back / wo[:, 2:], rtol=2e-3)
    assert (there > 0).all()


def test_anisotropy_stretches_the_highlight_along_x(device):
    """The spread of reflected directions at normal incidence, of an alpha of 0.01 against 0.5."""
    row = record(metallic=1.0, roughness=0.1, anisotropy=0.7)
    numbers = np.random.default_rng(7).random((4096, 3))
    wi, _, pdf = sample(
        device, np.tile(row, (4096, 1)), np.tile(direction(1.0), (4096, 1)), numbers
    )
    wi = wi[pdf > 0]
    assert np.median(abs(wi[:, 0])) > 10 * np.median(abs(wi[:, 1]))
