"""The whole BSDF, layers and sheets too: energy, sampling against density, over all parameters."""

import numpy as np
import planes
from test_bsdf import direction

BY_CHANCE = -np.ones(4)


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
