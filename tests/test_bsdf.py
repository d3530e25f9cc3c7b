"""The BSDF: formulas against doubles, sampling against its density, energy, reciprocity."""

from functools import cache
from itertools import pairwise

import bsdf_truth as truth
import numpy as np
import planes
import pytest
from bsdf_truth import Bsdf, Lobe
from scipy import stats

P_MIN = 1e-4
BY_CHANCE = (-1.0, -1.0, -1.0, -1.0)
ONLY = {
    "reflect": (1.0, 0.0, 0.0, 0.0),
    "refract": (0.0, 1.0, 0.0, 0.0),
    "diffuse": (0.0, 0.0, 1.0, 0.0),
}

MATERIALS = {
    "lambert": Bsdf(specular=0.0, roughness=1.0),
    "plastic": Bsdf(roughness=0.3),
    "rough plastic": Bsdf(roughness=1.0, ior=2.4),
    "half coat": Bsdf(roughness=0.4, specular=0.5),
    "metal": Bsdf(roughness=0.5, metallic=1.0),
    "polished metal": Bsdf(roughness=0.05, metallic=1.0),
    "half metal": Bsdf(roughness=0.7, metallic=0.5),
    "glass": Bsdf(roughness=0.3, transmission=1.0),
    "glass from inside": Bsdf(roughness=0.3, transmission=1.0, entering=False),
    "rough water": Bsdf(roughness=0.8, transmission=1.0, ior=1.3),
    "diamond from inside": Bsdf(roughness=0.5, transmission=1.0, ior=2.4, entering=False),
    "fogged": Bsdf(roughness=0.6, transmission=0.5),
    "everything": Bsdf(roughness=0.5, metallic=0.4, transmission=0.3, specular=0.6),
}


def direction(cosine, phi=0.4):
    sine = np.sqrt(1 - cosine**2)
    return np.array([sine * np.cos(phi), sine * np.sin(phi), cosine])


def run(device, kernel, inputs, outputs, transmission=1, glossy=1):
    inputs = {name: np.ascontiguousarray(v, np.float32) for name, v in inputs.items()}
    defines = {"GLOSSY": glossy, "TRANSMISSION": transmission, "LAYERS": transmission}
    return planes.run(device, "bsdf_test.cl", kernel, inputs, outputs, defines)


def sample(device, records, given, wo, numbers, *build):
    """Return directions and values ``(n, 3)`` and densities ``(n,)``; all arguments ``(n, k)``."""
    wi, values, pdfs = run(
        device,
        "sample_directions",
        {"materials": records.T, "given": given.T, "wo": wo.T, "numbers": numbers.T},
        {"wi": (np.float32, 3), "values": (np.float32, 3), "pdfs": (np.float32, 1)},
        *build,
    )
    return wi.T, values.T, pdfs


def evaluate(device, records, given, wo, wi, side=None, build=()):
    """Return values ``(n, 3)`` and densities ``(n,)``."""
    side = wi[:, 2] if side is None else side
    values, pdfs = run(
        device,
        "eval_pairs",
        {"materials": records.T, "given": given.T, "wo": wo.T, "wi": wi.T, "side": side},
        {"values": (np.float32, 3), "pdfs": (np.float32, 1)},
        *build,
    )
    return values.T, pdfs


def chances(device, records, wo, *build):
    """Return the chances to reflect, refract and scatter, ``(n, 3)``."""
    inputs = {"materials": records.T, "wo": wo.T}
    return run(device, "list_chances", inputs, {"chances": (np.float32, 4)}, *build)[0].T[:, :3]


def left_of_choice(device, records, wo, numbers, *build):
    """Return what is left of the numbers ``(n,)`` that choose a lobe."""
    inputs = {"materials": records.T, "wo": wo.T, "numbers": numbers}
    return run(device, "list_left_of_choice", inputs, {"left": (np.float32, 1)}, *build)[0]


def cases_in_turn(cases, count, seed):
    """Return arrays in which the lanes of a work item belong to different cases.

    Args:
        cases: tuples of a Bsdf, chances and wo.

    Returns:
        Materials, chances, wo and random numbers, each ``(count * len(cases), k)``.
    """
    records = np.tile([b.record() for b, _, _ in cases], (count, 1))
    given = np.tile([c for _, c, _ in cases], (count, 1))
    wo = np.tile([o for _, _, o in cases], (count, 1))
    numbers = np.random.default_rng(seed).integers(0, 1 << 24, (len(records), 3)) / 2.0**24
    return records, given, wo, numbers


def random_pairs(count, seed):
    """Return Bsdfs that differ from each other, wo and wi, ``(count, 3)``, also grazing ones."""
    rng = np.random.default_rng(seed)

    def often(*values):
        return values[k] if (k := rng.integers(len(values) + 2)) < len(values) else rng.random()

    bsdfs = [
        Bsdf(
            base_color=tuple(rng.random(3)),
            roughness=often(0.05, 0.2, 1.0),
            metallic=often(0.0, 1.0),
            specular=often(0.0, 1.0),
            transmission=often(0.0, 1.0),
            ior=float(rng.choice([1.3, 1.5, 2.4])),
            entering=bool(rng.random() < 0.5),
        )
        for _ in range(count)
    ]
    wo, wi = rng.normal(size=(2, count, 3))
    wo[:, 2] = abs(wo[:, 2])
    wo[::7, 2] *= 0.01
    wi[::5, 2] *= 0.01
    as_device = np.float32
    return bsdfs, truth.unit(wo).astype(as_device), truth.unit(wi).astype(as_device)


@pytest.mark.parametrize("opaque", [False, True], ids=["transmission", "opaque build"])
def test_values_and_densities_equal_the_papers(lane_device, opaque):
    count = 1200
    bsdfs, wo, wi = random_pairs(count, 1)
    if opaque:
        bsdfs = [truth.replace(b, transmission=0.0) for b in bsdfs]
    records = np.array([b.record() for b in bsdfs])
    by_chance = np.full((count, 4), -1.0)
    build = 0 if opaque else 1
    # Half of the pairs at random, half where the BSDF has its peaks.
    numbers = np.random.default_rng(2).random((count, 3))
    drawn, _, _ = sample(lane_device, records, by_chance, wo, numbers, build)
    use = (np.arange(count) % 2 == 0) & (drawn[:, 2] != 0)
    wi[use] = drawn[use]
    values, pdfs = evaluate(lane_device, records, by_chance, wo, wi, build=(build,))
    chance = chances(lane_device, records, wo, build)

    o, i = wo.astype(np.float64), wi.astype(np.float64)
    exact = np.array([truth.evaluate(*pair) for pair in zip(bsdfs, o, i, strict=True)])
    pdf = np.array(
        [
            sum(c * truth.PDFS[kind](b, x, y) for kind, c in zip(ONLY, cs, strict=True))
            for b, x, y, cs in zip(bsdfs, o, i, chance.astype(np.float64), strict=True)
        ]
    )
    # A rounding of a direction is 1e-7, and a lobe as sharp as alpha turns it into 1e-7 / alpha;
    # refraction at an index near 1 multiplies that by up to 1 / (eta - 1).
    alpha, eta = records[:, 4], records[:, 8]
    tolerance = 3e-5 + 4e-6 / alpha
    error = abs(values - exact).max(axis=1) / (exact.max(axis=1) + 1e-5)
    # The transmittance falls to 0 like a square root before the critical angle.
    near_critical = np.where(eta < 1, 2e-3, 0)
    assert (error < tolerance + near_critical).all(), (error / tolerance).max()
    assert (error < tolerance).mean() > 0.998
    error = abs(pdfs - pdf) / (pdf + 1e-5)
    assert (error < tolerance).all(), (error / tolerance).max()
    assert (exact.max(axis=1) > 0).mean() > 0.5


def test_chances_are_a_distribution_over_the_lobes_that_exist(lane_device):
    bsdfs, wo, _ = random_pairs(2000, 3)
    bsdfs[:10] = [Bsdf(base_color=(0, 0, 0), specular=0.0)] * 10
    records = np.array([b.record() for b in bsdfs])
    chance = chances(lane_device, records, wo)
    np.testing.assert_allclose(chance.sum(axis=1), 1, atol=1e-6)
    dielectric = np.array([b.metallic < 1 for b in bsdfs])
    coated = np.array([b.specular > 0 or (b.metallic > 0 and max(b.base_color) > 0) for b in bsdfs])
    clear = np.array([b.transmission > 0 for b in bsdfs])
    opaque = np.array([b.transmission < 1 and max(b.base_color) > 0 for b in bsdfs])
    # Under total reflection nothing reaches the base, but tilted facets still refract a little.
    total = np.array([truth.dielectric(b, o[2]) > 1 - 1e-5 for b, o in zip(bsdfs, wo, strict=True)])
    cannot_pass = (
        np.array([truth.fresnel(o[2], b.eta) for b, o in zip(bsdfs, wo, strict=True)]) == 1
    )
    coated |= dielectric & clear & cannot_pass
    exists = np.stack([coated, dielectric & clear, dielectric & opaque & ~total], axis=1)
    exists[:10] = False, False, True
    np.testing.assert_array_equal(chance > 0, exists)
    assert (chance[exists & ~total[:, None]] > 0.08).all()
    assert (chance[exists] > 0.008).all()


def lobe_cases():
    cases = []
    for roughness in (0.0, 0.05, 0.3, 0.6, 1.0):
        for cosine in (1.0, 0.7, 0.15, 0.02):
            cases.append(("reflect", Bsdf(roughness=roughness, metallic=1.0), direction(cosine)))
    for ior in (1.3, 1.5, 2.4):
        for entering in (True, False):
            for roughness in (0.05, 0.4, 1.0):
                b = Bsdf(roughness=roughness, transmission=1.0, ior=ior, entering=entering)
                cases += [("refract", b, direction(cosine, 2.0)) for cosine in (0.95, 0.5, 0.05)]
    cases.append(("diffuse", Bsdf(specular=0.0), direction(0.5)))
    return cases


@cache
def expected_shares():
    """Return the cases' lobes and the share of samples that each bin should have."""
    made = []
    for kind, b, wo in lobe_cases():
        # What is thrown down ends abruptly, within bins: they have to be large and known well.
        abrupt = kind == "refract" and not b.entering and truth.is_rough_glass(b)
        lobe = Lobe(kind, b, wo, **({"cells": 6, "fine": 48} if abrupt else {}))
        made.append((lobe, lobe.integrate(truth.PDFS[kind])))
    return made


def test_samples_of_every_lobe_follow_its_density(lane_device):
    """Chi-square over bins in the lobe's own coordinates; failed draws are a bin of their own."""
    count = 20000
    cases = [(b, ONLY[kind], wo) for kind, b, wo in lobe_cases()]
    drawn = sample(lane_device, *cases_in_turn(cases, count, seed=5))
    wi, _, pdfs = (values.reshape(count, len(cases), -1) for values in drawn)
    for k, (lobe, share) in enumerate(expected_shares()):
        label = f"{lobe.kind} {lobe.b} cosine {lobe.wo[2]}"
        assert share.sum() < 1.002, label
        share = np.append(share, max(1 - share.sum(), 0))
        index = np.where(pdfs[:, k, 0] > 0, lobe.bin_of(wi[:, k]), lobe.cells**2)
        found = np.bincount(index, minlength=len(share))
        # The last bin takes what is too rare for the test.
        rare = share * count < 10
        rare[-1] = True
        expected = np.append(share[~rare], share[rare].sum())
        found = np.append(found[~rare], found[rare].sum())
        if expected[-1] * count < 10:
            # Quadrature knows the sum to 0.2 %.
            assert found[-1] < 10 + 0.002 * count, label
            expected, found = expected[:-1], found[:-1]
        if len(expected) < 2:
            # Beyond the critical angle of a sharp boundary there is nothing.
            continue
        p = stats.chisquare(found, expected / expected.sum() * found.sum()).pvalue
        assert p > P_MIN, f"{label}: p = {p}"


def test_failed_draws_are_as_many_as_the_density_lacks(lane_device):
    count = 20000
    cases = [(b, ONLY[kind], wo) for kind, b, wo in lobe_cases()]
    _, _, pdfs = sample(lane_device, *cases_in_turn(cases, count, seed=6))
    drawn = (pdfs.reshape(count, len(cases)) > 0).mean(axis=0)
    total = []
    for (lobe, share), (kind, b, wo) in zip(expected_shares(), lobe_cases(), strict=True):
        if kind == "refract" and not b.entering:
            found = lobe.integrate(truth.pdf_bent).sum()
            upper = Lobe("reflect", b, wo, fine=16)
            found += upper.integrate(truth.pdf_total_reflection).sum()
            for again in ("returned", "thrown"):
                found += Lobe(again, b, wo, fine=16).integrate(truth.pdf_thrown).sum()
            total.append(found)
        else:
            total.append(share.sum())
    total = np.array(total)
    deviation = np.sqrt(np.clip(total * (1 - total), 0, 1) / count)
    assert (abs(drawn - total) < 5 * deviation + 0.002).all(), abs(drawn - total).max()


def test_smooth_glass_loses_nothing_where_it_reflects_all(lane_device):
    """Losing 1 in 100 there, a path of a thousand bounces would be worth 10^4 times the others."""
    glass = truth.white(Bsdf(roughness=0.0, transmission=1.0, ior=1.5, entering=False))
    cases = [(glass, BY_CHANCE, direction(cosine)) for cosine in (0.6, 0.3, 0.05)]
    _, values, pdfs = sample(lane_device, *cases_in_turn(cases, 2000, seed=14))
    assert (pdfs > 0).all()
    np.testing.assert_allclose(values / pdfs.reshape(-1, 1), 1.0, rtol=2e-3)


@cache
def expected_albedo(name, cosine):
    return truth.albedo(MATERIALS[name], direction(cosine))


@pytest.mark.parametrize("cosine", [0.98, 0.4, 0.08])
def test_mean_weight_of_samples_is_the_integral(lane_device, cosine):
    """E[f cos / pdf] with lobes drawn by their chances, against quadrature of f cos."""
    count = 30000
    cases = [(b, BY_CHANCE, direction(cosine)) for b in MATERIALS.values()]
    drawn = sample(lane_device, *cases_in_turn(cases, count, seed=7))
    _, values, pdfs = (v.astype(np.float64).reshape(count, len(cases), -1) for v in drawn)
    weight = np.where(pdfs > 0, values / np.where(pdfs > 0, pdfs, 1), 0)
    for k, name in enumerate(MATERIALS):
        expected = expected_albedo(name, cosine)
        deviation = weight[:, k].std(axis=0) / np.sqrt(count)
        error = abs(weight[:, k].mean(axis=0) - expected)
        assert (error < 4.5 * deviation + 1e-3 * expected).all(), f"{name}: {error} {expected}"


def test_share_of_refracted_samples_is_the_chance_to_refract(lane_device):
    """With the chances that lobe_chances gives, up to what is lost to total reflection."""
    count = 20000
    b = Bsdf(roughness=0.1, transmission=0.5, metallic=0.2)
    cases = [(b, BY_CHANCE, direction(0.9)), (b, BY_CHANCE, direction(0.3))]
    records, given, wo, numbers = cases_in_turn(cases, count, seed=8)
    wi, _, _ = sample(lane_device, records, given, wo, numbers)
    below = (wi[:, 2] < 0).reshape(count, 2).mean(axis=0)
    chance = chances(lane_device, records[:2], wo[:2])[:, 1]
    np.testing.assert_allclose(below, chance, rtol=0, atol=5 * 0.5 / np.sqrt(count))


def test_reflection_of_dielectrics_is_reciprocal(lane_device):
    """Of metals and glass it is not: what scatters between facets is reckoned from one side."""
    bsdfs, wo, wi = random_pairs(3000, 9)
    bsdfs = [truth.replace(b, metallic=0.0, transmission=0.0) for b in bsdfs]
    wi[:, 2] = abs(wi[:, 2])
    records = np.array([b.record() for b in bsdfs])
    given = np.full((len(bsdfs), 4), -1.0)
    there, _ = evaluate(lane_device, records, given, wo, wi)
    back, _ = evaluate(lane_device, records, given, wi, wo)
    f, g = there / wi[:, 2:], back / wo[:, 2:]
    tolerance = 1e-4 + 4e-6 / records[:, 4:5]
    assert (abs(f - g) <= tolerance * (f + g) + 1e-6).all()


def test_refraction_is_reciprocal_up_to_the_squared_index(lane_device):
    """f(wo, wi) / n_o^2 = f(wi, wo) / n_i^2; Veach 1997, equation 5.12.

    But for the shares of each facet, and what is thrown down, in place of scattering between them.
    """
    bsdfs, wo, _ = random_pairs(3000, 10)
    bsdfs = [truth.replace(b, transmission=1.0, roughness=max(b.roughness, 0.2)) for b in bsdfs]
    records = np.array([b.record() for b in bsdfs])
    numbers = np.random.default_rng(11).random((len(bsdfs), 3))
    only = np.tile(ONLY["refract"], (len(bsdfs), 1))
    wi, _, pdf = sample(lane_device, records, only, wo, numbers)
    there, _ = evaluate(lane_device, records, only, wo, wi)
    turned = [truth.replace(b, entering=not b.entering) for b in bsdfs]
    swapped = np.array([b.record() for b in turned])
    back, _ = evaluate(lane_device, swapped, only, -wi, -wo)
    ok = (pdf > 0) & (wi[:, 2] < -1e-3) & (wo[:, 2] > 1e-3)
    assert ok.sum() > 1000

    def once(b, wo, wi, value):
        wo, wi = wo.astype(np.float64), wi.astype(np.float64)
        share = truth.shares_of_facet(b, wo, truth.refraction_normal(b, wo, wi))[1]
        return (value - truth.eval_thrown(b, wo, wi)) / abs(wi[2]) / np.maximum(share, 1e-6)

    for k in np.nonzero(ok)[0]:
        f = once(bsdfs[k], wo[k], wi[k], there[k]) * records[k, 8] ** 2
        g = once(turned[k], -wi[k], -wo[k], back[k])
        assert (abs(f - g) <= 2e-3 * (f + g) + 1e-6).all(), bsdfs[k]


def test_nothing_reflects_more_than_it_receives(lane_device):
    """A white one in a white furnace: the mean weight is an estimate of what comes back."""
    count = 4000
    bsdfs = [Bsdf(specular=0.0)]
    for roughness in (0.05, 0.3, 0.6, 1.0):
        bsdfs.append(Bsdf(roughness=roughness, metallic=1.0))
        for ior in (1.3, 1.5, 2.4):
            bsdfs.append(Bsdf(roughness=roughness, ior=ior))
            for entering in (True, False):
                glass = Bsdf(roughness=roughness, transmission=1.0, ior=ior, entering=entering)
                bsdfs.append(glass)
    cosines = (1.0, 0.5, 0.15, 0.02)
    cases = [(truth.white(b), BY_CHANCE, direction(c)) for b in bsdfs for c in cosines]
    records, given, wo, numbers = cases_in_turn(cases, count, seed=12)
    wi, values, pdfs = sample(lane_device, records, given, wo, numbers)
    weight = np.where(pdfs > 0, values[:, 0] / np.where(pdfs > 0, pdfs, 1), 0)
    # Radiance is compressed by 1 / eta^2 on its way into glass; power is not.
    weight = np.where(wi[:, 2] < 0, weight * records[:, 8] ** 2, weight)
    weight = weight.astype(np.float64).reshape(count, len(cases))
    deviation = weight.std(axis=0) / np.sqrt(count)
    over = weight.mean(axis=0) - 1 - 4 * deviation
    # What enters under a coat is reckoned with fits.
    assert over.max() < 0.001, cases[int(over.argmax())]


@pytest.mark.parametrize("ior", [1.3, 1.5, 2.4])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.6, 1.0])
def test_albedo_of_a_coat_is_what_it_reflects(roughness, ior):
    """So a white base under it gives back nearly all: 1 + reflected - fit."""
    coat = Bsdf(base_color=(0.0, 0.0, 0.0), roughness=roughness, ior=ior)
    for cosine in (1.0, 0.5, 0.15, 0.05, 0.02):
        reflected = truth.albedo(coat, direction(cosine))[0]
        over = truth.coat_albedo(coat, cosine) - reflected
        assert -0.001 < over < 0.0125, cosine
    cosines = np.sqrt((np.arange(20000) + 0.5) / 20000)
    average = truth.coat_albedo(coat, cosines).mean()
    assert abs(truth.average_coat_albedo(coat) - average) < 5e-4


def test_what_is_left_of_the_choice_of_a_lobe_is_uniform(lane_device):
    """In each lobe apart: roulette must not know which lobe was chosen."""
    count = 40_000
    fogged = Bsdf(roughness=0.6, transmission=0.5, metallic=0.2)
    for bsdf in (*(MATERIALS[name] for name in ("lambert", "plastic", "metal", "glass")), fogged):
        records = np.tile(bsdf.record(), (count, 1))
        wo = np.tile(direction(0.6), (count, 1))
        numbers = np.arange(count) / count
        left = left_of_choice(lane_device, records, wo, numbers).astype(np.float64)
        assert left.min() >= 0 and left.max() < 1
        reflect, refract, diffuse = chances(lane_device, records[:1], wo[:1])[0].astype(np.float64)
        # sample_bsdf takes the diffuse lobe first, then reflection.
        ends = np.cumsum([0, diffuse, reflect, refract])
        for low, high in pairwise(ends):
            inside = (numbers > low + 1e-6) & (numbers < high - 1e-6)
            if high - low > 1e-3:
                expected = (numbers[inside] - low) / (high - low)
                # A rounding of the number, stretched by the inverse of the chance.
                np.testing.assert_allclose(left[inside], expected, atol=3e-7 / (high - low))


def test_a_build_without_gloss_is_the_full_one_for_matt_materials(lane_device):
    count = 4000
    rng = np.random.default_rng(14)
    colors = rng.random((count, 3))
    bsdfs = [Bsdf(base_color=tuple(c), specular=0.0, roughness=rng.random()) for c in colors]
    records = np.array([b.record() for b in bsdfs])
    given = np.full((count, 3), -1.0)
    _, wo, wi = random_pairs(count, 15)
    matt, full = (0, 0), (1, 1)
    assert (chances(lane_device, records, wo, *matt) == [0, 0, 1]).all()
    for side in (None, -wi[:, 2]):
        values, pdfs = evaluate(lane_device, records, given, wo, wi, side, matt)
        expected, expected_pdfs = evaluate(lane_device, records, given, wo, wi, side, full)
        np.testing.assert_allclose(values, expected, rtol=2e-6)
        np.testing.assert_allclose(pdfs, expected_pdfs, rtol=1e-6)
    above = np.clip(wi[:, 2:], 0, None).astype(np.float64)
    values, pdfs = evaluate(lane_device, records, given, wo, wi, build=matt)
    np.testing.assert_allclose(values, records[:, :3] * above / np.pi, rtol=1e-6)
    np.testing.assert_allclose(pdfs[:, None], above / np.pi, rtol=1e-6)
    numbers = rng.integers(0, 1 << 24, (count, 3)) / 2.0**24
    one, other = (sample(lane_device, records, given, wo, numbers, *b) for b in (matt, full))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6)
    one, other = (left_of_choice(lane_device, records, wo, numbers[:, 0], *b) for b in (matt, full))
    np.testing.assert_array_equal(one, other)


def test_weights_stay_finite_at_the_extremes(lane_device):
    corners = [0.0, 2.0**-24, 0.5, 1 - 2.0**-24]
    numbers = np.stack(np.meshgrid(corners, corners, corners), axis=-1).reshape(-1, 3)
    bsdfs = [
        Bsdf(
            base_color=color, roughness=r, metallic=m, specular=s, transmission=t, ior=n, entering=e
        )
        for color in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        for r in (0.0, 0.05, 1.0)
        for m in (0.0, 1.0)
        for s in (0.0, 1.0)
        for t in (0.0, 0.5, 1.0)
        for n, e in ((1.001, True), (1.5, False), (2.4, True))
    ]
    cosines = (1.0, 0.3, 1e-3, 1e-6)
    cases = [(b, BY_CHANCE, direction(c)) for b in bsdfs for c in cosines]
    records = np.repeat([b.record() for b, _, _ in cases], len(numbers), axis=0)
    given = np.full((len(records), 4), -1.0)
    wo = np.repeat([o for _, _, o in cases], len(numbers), axis=0)
    u = np.tile(numbers, (len(cases), 1))
    wi, values, pdfs = sample(lane_device, records, given, wo, u)
    assert np.isfinite(wi).all()
    assert np.isfinite(values).all() and (values >= 0).all()
    assert np.isfinite(pdfs).all() and (pdfs >= 0).all()
    weight = np.where(pdfs > 0, values.max(axis=1) / np.where(pdfs > 0, pdfs, 1), 0)
    # A lobe has at least a hundredth of the samples; leaving glass multiplies by eta^2.
    assert weight.max() < 120 * 2.4**2, cases[int(weight.argmax()) // len(numbers)]


def test_nothing_crosses_the_real_surface_by_a_shading_normal(lane_device):
    bsdfs, wo, wi = random_pairs(2000, 13)
    records = np.array([b.record() for b in bsdfs])
    given = np.full((len(bsdfs), 4), -1.0)
    values, pdfs = evaluate(lane_device, records, given, wo, wi, side=-wi[:, 2])
    assert not values.any() and not pdfs.any()


def layered(bsdf, **fields):
    """Return the record of a surface with coat, sheen, tint or stretched facets."""
    places = {"tint": 10, "coat": 13, "coat_alpha": 14, "sheen": 15, "roughness": 18, "alpha_y": 19}
    record = bsdf.record()
    for name, value in fields.items():
        values = np.atleast_1d(value)
        record[places[name] : places[name] + len(values)] = values
    return record


@pytest.mark.parametrize("layers", [0, 1])
def test_reflectance_is_about_that_of_the_samples(device, layers):
    """Light is divided by it before it is shared: what differs is blurred, not lost."""
    plain = {name: b for name, b in MATERIALS.items() if b.transmission == 0.0}
    plain["copper"] = Bsdf(roughness=0.6, metallic=1.0, base_color=(0.9, 0.5, 0.0))
    surfaces = [b.record() for b in plain.values()]
    least_alphas = [0.0 if name == "lambert" else b.alpha for name, b in plain.items()]
    if layers:
        surfaces += [
            layered(Bsdf(roughness=0.6), sheen=(0.4, 0.2, 0.1), roughness=0.5),
            layered(Bsdf(roughness=0.8), coat=0.8, coat_alpha=0.36),
            layered(Bsdf(roughness=0.9), tint=(1.0, 0.5, 0.0)),
            layered(plain["copper"], alpha_y=0.1),
        ]
        least_alphas += [0.36, 0.36, 0.81, 0.1]
    cosines = (0.2, 0.6, 1.0)
    records = np.repeat(surfaces, len(cosines), axis=0)
    directions = np.tile([direction(c) for c in cosines], (len(surfaces), 1))
    count = 4096
    numbers = np.random.default_rng(11).random((count * len(records), 3))
    by_chance = np.full((len(numbers), 4), -1.0)
    rows = np.tile(records, (count, 1)), by_chance, np.tile(directions, (count, 1)), numbers
    _, values, pdfs = sample(device, *rows, layers)
    weights = np.where(pdfs[:, None] > 0.0, values / np.maximum(pdfs, 1e-30)[:, None], 0.0)
    exact = weights.reshape(count, len(records), 3).mean(axis=0)
    parts, least = run(
        device,
        "list_reflectances",
        {"materials": records.T, "wo": directions.T},
        {"parts": (np.float32, 3), "least": (np.float32, 1)},
        layers,
    )
    ratio = parts.T[exact > 0.01] / exact[exact > 0.01]
    assert 0.75 < ratio.min()
    assert ratio.max() < 1.35
    assert (parts > 0.0).all()
    np.testing.assert_allclose(least[:: len(cosines)], least_alphas, rtol=1e-4)
