"""The BSDF in double precision, written for clarity from the papers, and its integrals."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Bsdf:
    """Parameters as a scene gives them.

    Attributes:
        ior: of the inside; ``entering`` says whether wo is outside.
    """

    base_color: tuple[float, float, float] = (0.8, 0.5, 0.2)
    roughness: float = 0.5
    metallic: float = 0.0
    specular: float = 1.0
    transmission: float = 0.0
    ior: float = 1.5
    entering: bool = True

    @property
    def alpha(self) -> float:
        return max(self.roughness**2, 1e-3)

    @property
    def eta(self) -> float:
        """Index on the far side over the index on wo's side."""
        return self.ior if self.entering else 1 / self.ior

    @property
    def f0(self) -> float:
        return ((self.ior - 1) / (self.ior + 1)) ** 2 * self.specular

    def record(self) -> list[float]:
        return [
            *self.base_color,
            self.metallic,
            self.alpha,
            self.f0,
            self.specular,
            self.transmission,
            self.eta,
            # Not thin, white tint, no clear coat, no sheen, isotropic.
            *(0.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, self.alpha),
        ]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Reflectance of unpolarised light by Snell's law and Fresnel's equations."""
    theta = np.arccos(np.clip(cosine, 0, 1))
    sine = np.sin(theta) / eta
    refracted = np.arcsin(np.minimum(sine, 1))
    n1, n2 = 1.0, eta
    s = (n1 * np.cos(theta) - n2 * np.cos(refracted)) / (
        n1 * np.cos(theta) + n2 * np.cos(refracted)
    )
    p = (n1 * np.cos(refracted) - n2 * np.cos(theta)) / (
        n1 * np.cos(refracted) + n2 * np.cos(theta)
    )
    return np.where(sine >= 1, 1.0, (s**2 + p**2) / 2)


def schlick(f0, f90, cosine):
    """Schlick: An Inexpensive BRDF Model for Physically-based Rendering, 1994."""
    return f0 + (f90 - f0) * (1 - np.clip(cosine, 0, 1)) ** 5


def clear(b: Bsdf, cosine: np.ndarray) -> np.ndarray:
    """Fresnel's reflectance, of which specular is a factor; all of what cannot pass."""
    f = fresnel(cosine, b.eta)
    return f * np.where(f < 1, b.specular, 1.0)


def dielectric(b: Bsdf, cosine: np.ndarray) -> np.ndarray:
    """Schlick where opaque, Fresnel where clear."""
    opaque = schlick(b.f0, b.specular, cosine)
    return (1 - b.transmission) * opaque + b.transmission * clear(b, cosine)


def ggx(h: np.ndarray, alpha: float) -> np.ndarray:
    """Density of normals; Walter et al.: Microfacet Models for Refraction, 2007, equation 33."""
    tan2 = (h[..., 0] ** 2 + h[..., 1] ** 2) / h[..., 2] ** 2
    return alpha**2 / (np.pi * h[..., 2] ** 4 * (alpha**2 + tan2) ** 2)


def smith_lambda(w: np.ndarray, alpha: float) -> np.ndarray:
    """Heitz: Understanding the Masking-Shadowing Function, 2014, equation 72."""
    tan2 = (w[..., 0] ** 2 + w[..., 1] ** 2) / w[..., 2] ** 2
    return (np.sqrt(1 + alpha**2 * tan2) - 1) / 2


def masking_shadowing(wo: np.ndarray, wi: np.ndarray, alpha: float) -> np.ndarray:
    """Height-correlated; Heitz 2014, equation 99."""
    return 1 / (1 + smith_lambda(wo, alpha) + smith_lambda(wi, alpha))


def eval_reflection(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Microfacet reflection times cosine, ``(..., 3)``; 0 below the horizon."""
    h = unit(wo + wi)
    cosine = dot(wo, h)
    base = np.array(b.base_color)
    metal = schlick(base, 1.0, cosine[..., None]) * (
        1 + base * metal_gain(b, wo[..., 2])[..., None]
    )
    reflectance = dielectric(b, cosine)
    if is_rough_glass(b):
        opaque = schlick(b.f0, b.specular, cosine)
        mirrored = shares_of_facet(b, wo, h)[0]
        reflectance = (1 - b.transmission) * opaque + b.transmission * mirrored
    f = (1 - b.metallic) * reflectance[..., None] + b.metallic * metal
    with np.errstate(all="ignore"):
        g = masking_shadowing(wo, wi, b.alpha)
        value = ggx(h, b.alpha) * g / (4 * wo[..., 2] * wi[..., 2]) * wi[..., 2]
    return np.where(wi[..., 2:] > 0, f * value[..., None], 0)


@cache
def albedo_tables() -> dict[str, np.ndarray | float]:
    """Return the renderer's fits and tables by name; tests hold them against quadrature."""
    header = Path(__file__).resolve().parent.parent / "cl" / "common" / "albedo_tables.h"
    text = header.read_text(encoding="utf-8")
    found: dict[str, np.ndarray | float] = {
        name: float(value) for name, value in re.findall(r"#define (\w+) ([-\d.e]+)f?$", text, re.M)
    }
    array = r"__constant \w+ (\w+?)((?:\[\d+\])+) = \{(.*?)\};"
    for name, sizes, values in re.findall(array, text, re.S):
        numbers = [float(v) for v in re.findall(r"-?\d[\d.]*(?:e-?\d+)?", values)]
        shape = [int(n) for n in re.findall(r"\d+", sizes)]
        found[name] = np.array(numbers).reshape(shape)
    return found


def polynomial(x, coefficients):
    return sum(c * x**k for k, c in enumerate(coefficients))


def fitted(name: str, x: np.ndarray, y: np.ndarray | float) -> np.ndarray:
    return sum(polynomial(y, row) * x**k for k, row in enumerate(albedo_tables()[f"{name}_FIT"]))


def place_of_edge(alpha: float) -> float:
    least = 1 / (1 + albedo_tables()["EDGE_SCALE"])
    q = 1 / (1 + albedo_tables()["EDGE_SCALE"] * alpha)
    return 2 * (q - least) / (1 - least) - 1


def mirror_albedo(alpha: float, cosine: np.ndarray) -> np.ndarray:
    """Albedo of a white GGX mirror, rather too large."""
    x = 2 * cosine * (1 + alpha) / (cosine + alpha) - 1
    lost = alpha / (cosine + alpha) * fitted("MIRROR", x, 2 * alpha - 1)
    return np.clip((1 - lost) * (1 + albedo_tables()["MIRROR_RAISED"]), 0.25, 1)


def edge_albedo(alpha: float, cosine: np.ndarray) -> np.ndarray:
    """Albedo of GGX with a reflectance of (1 - cos)^5, rather too large."""
    x = 2 * cosine * (1 + alpha) / (cosine + alpha) - 1
    fit = fitted("EDGE", x, place_of_edge(alpha))
    return (1 - cosine) ** 5 * fit + albedo_tables()["EDGE_RAISED"]


def coat_albedo(b: Bsdf, cosine: np.ndarray) -> np.ndarray:
    mirror, edge = mirror_albedo(b.alpha, cosine), edge_albedo(b.alpha, cosine)
    return np.minimum(b.f0 * mirror + (b.specular - b.f0) * edge, 1.0)


def metal_gain(b: Bsdf, cosine: np.ndarray) -> np.ndarray:
    """Turquin: Practical Multiple Scattering Compensation, 2019."""
    kept = mirror_albedo(b.alpha, cosine)
    return (1 - kept) / kept


def average_coat_albedo(b: Bsdf) -> float:
    """The renderer's fit; a test holds it against the mean of coat_albedo."""
    mirror = polynomial(2 * b.alpha**0.5 - 1, albedo_tables()["MIRROR_MEAN_FIT"][0])
    edge = polynomial(place_of_edge(b.alpha), albedo_tables()["EDGE_MEAN_FIT"][0])
    return b.f0 * min(mirror, 1.0) + (b.specular - b.f0) * edge


def eval_diffuse(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Kelemen, Szirmay-Kalos 2001: twice through the coat, over what it lets through at all."""
    enters = 1 - coat_albedo(b, wo[..., 2])
    leaves = 1 - coat_albedo(b, wi[..., 2])
    below = (1 - b.metallic) * (1 - b.transmission) * enters * leaves
    below = below / (1 - average_coat_albedo(b))
    value = below * np.maximum(wi[..., 2], 0) / np.pi
    return value[..., None] * np.array(b.base_color)


def refraction_normal(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Walter 2007, equation 16, turned to wo's side."""
    h = unit(-(wo + b.eta * wi))
    return h * np.sign(h[..., 2:])


def eval_refraction(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Walter 2007, equation 21, times cosine, for radiance (so 1 / eta^2), ``(..., 3)``."""
    with np.errstate(all="ignore"):
        h = refraction_normal(b, wo, wi)
        oh, ih = dot(wo, h), dot(wi, h)
        # Equation 21 with wo as its i (index 1) and wi as its o (index eta).
        value = np.abs(oh * ih) / np.abs(wo[..., 2] * wi[..., 2])
        value = value * b.eta**2 / (oh + b.eta * ih) ** 2 * ggx(h, b.alpha)
        passes = shares_of_facet(b, wo, h)[1] if is_rough_glass(b) else 1 - clear(b, oh)
        mirrored = wi * np.array([1, 1, -1])
        masking = masking_shadowing(wo, mirrored, b.alpha)
        value = value * passes * masking * np.abs(wi[..., 2]) / b.eta**2
    value = value * (1 - b.metallic) * b.transmission
    meets = (wi[..., 2] < 0) & (oh > 0) & (ih < 0)
    return np.where(meets, value, 0)[..., None] * np.array(b.base_color)


# --- Rough glass: what the head of cl/common/glass.h says


def is_rough_glass(b: Bsdf) -> bool:
    return b.transmission > 0 and b.metallic < 1 and b.alpha > 2e-3


def shares_of_facet(b: Bsdf, wo: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of Smith's masking on a facet's mirrored and on its bent way."""
    up, down = reflect(wo, h), refract(wo, h, b.eta)
    closed = down[..., 2] >= 0
    f = np.where(closed, 1.0, b.specular * fresnel(dot(wo, h), b.eta))
    seen = 1 / (1 + smith_lambda(wo, b.alpha))
    with np.errstate(all="ignore"):
        above = np.where(up[..., 2] > 0, masking_shadowing(wo, up, b.alpha) / seen, 0)
        below = np.where(closed, 0, masking_shadowing(wo, down, b.alpha) / seen)
    kept = f * above + (1 - f) * below
    return f / np.maximum(kept, 1e-9), (1 - f) / np.maximum(kept, 1e-9)


def thrown_down(b: Bsdf, wo: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Density of visible facets' mirrored directions from which no bent one leads away.

    Walter 2007, equation 14; 0 where such a direction leads up.
    """
    with np.errstate(all="ignore"):
        h = unit(wo + down)
        density = ggx(h, b.alpha) / (1 + smith_lambda(wo, b.alpha)) / wo[..., 2] / 4
        there = (down[..., 2] < 0) & (h[..., 2] > 0) & (refract(wo, h, b.eta)[..., 2] >= 0)
    return np.where(there, density if is_rough_glass(b) else 0.0, 0.0)


def through_boundary(b: Bsdf, wi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whence a smooth boundary bends light to wi below, and solid angles there over here.

    By Snell's law, of which the ratio is the derivative; 0 where it has no answer.
    """
    x, y = b.eta * wi[..., 0], b.eta * wi[..., 1]
    z2 = 1 - x**2 - y**2
    z = -np.sqrt(np.where(z2 > 0, z2, 1.0))
    return np.stack([x, y, z], axis=-1), np.where(z2 > 0, b.eta**2 * wi[..., 2] / z, 0.0)


def eval_returned(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return what is thrown down and reflected by the boundary, ``(..., 3)``."""
    down = wi * np.array([1, 1, -1])
    value = thrown_down(b, wo, down) * clear(b, wi[..., 2])
    return ((1 - b.metallic) * b.transmission * value)[..., None] * np.ones(3)


def eval_thrown(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return what is thrown down and passes the boundary, as radiance, ``(..., 3)``."""
    down, ratio = through_boundary(b, wi)
    value = thrown_down(b, wo, down) * (1 - clear(b, -down[..., 2])) * ratio / b.eta**2
    value = np.where(wi[..., 2] < 0, (1 - b.metallic) * b.transmission * value, 0)
    return value[..., None] * np.array(b.base_color)


def pdf_thrown(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Density of what the boundary lets pass, and of what it reflects in whole."""
    down, ratio = through_boundary(b, wi)
    back = thrown_down(b, wo, wi * np.array([1, 1, -1]))
    total = 1 - wi[..., 2] ** 2 >= b.eta**2
    return np.where(wi[..., 2] < 0, thrown_down(b, wo, down) * ratio, np.where(total, back, 0))


def evaluate(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return f times |cos wi|, ``(..., 3)``."""
    return sum(value(b, wo, wi) for value in VALUES.values())


def pdf_reflection(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Eto, Tokuyoshi: Bounded VNDF Sampling for Smith-GGX Reflections, 2023, listing 2."""
    h = unit(wo + wi)
    a2 = b.alpha**2
    sine2 = wo[..., 0] ** 2 + wo[..., 1] ** 2
    s = 1 + np.sqrt(sine2)
    k = (1 - a2) * s**2 / (s**2 + a2 * wo[..., 2] ** 2)
    t = np.sqrt(a2 * sine2 + wo[..., 2] ** 2)
    return np.where(wi[..., 2] > 0, ggx(h, b.alpha) / (2 * (k * wo[..., 2] + t)), 0)


def pdf_refraction(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Where a visible normal lets nothing pass, it reflects, and what it throws down goes on."""
    return pdf_bent(b, wo, wi) + pdf_total_reflection(b, wo, wi) + pdf_thrown(b, wo, wi)


def pdf_bent(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Visible normals (Heitz 2014, equation 16), by Walter 2007, equation 17."""
    with np.errstate(all="ignore"):
        h = refraction_normal(b, wo, wi)
        oh, ih = dot(wo, h), dot(wi, h)
        visible = ggx(h, b.alpha) * oh / (1 + smith_lambda(wo, b.alpha)) / wo[..., 2]
        pdf = visible * b.eta**2 * np.abs(ih) / (oh + b.eta * ih) ** 2
    return np.where((wi[..., 2] < 0) & (oh > 0) & (ih < 0), pdf, 0)


def pdf_total_reflection(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Visible normals again, by Walter 2007, equation 14; 0 but where nothing can pass."""
    h = unit(wo + wi)
    visible = ggx(h, b.alpha) / (1 + smith_lambda(wo, b.alpha)) / wo[..., 2]
    closed = refract(wo, h, b.eta)[..., 2] >= 0
    return np.where((wi[..., 2] > 0) & closed, visible / 4, 0)


def pdf_diffuse(b: Bsdf, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    return np.maximum(wi[..., 2], 0) / np.pi


def reflect(wo: np.ndarray, h: np.ndarray) -> np.ndarray:
    return 2 * dot(wo, h)[..., None] * h - wo


def refract(wo: np.ndarray, h: np.ndarray, eta: float) -> np.ndarray:
    """Snell's law; (0, 0, 0) under total reflection."""
    oh = dot(wo, h)
    cos2 = 1 - (1 - oh**2) / eta**2
    along = oh / eta - np.sqrt(np.maximum(cos2, 0))
    bent = -wo / eta + along[..., None] * h
    return np.where(((cos2 > 0) & (oh > 0))[..., None], bent, 0)


def normal_at(t: np.ndarray, phi: np.ndarray, alpha: float) -> np.ndarray:
    """Microfacet normal with tan(theta) = alpha sqrt(t / (1 - t)): GGX is about uniform in t."""
    slope = alpha * np.sqrt(t / (1 - t))
    return unit(np.stack([slope * np.cos(phi), slope * np.sin(phi), np.ones_like(t)], axis=-1))


def place_of(h: np.ndarray, alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of normal_at: t in [0, 1) and phi in [0, 2 pi)."""
    slope2 = (h[..., 0] ** 2 + h[..., 1] ** 2) / h[..., 2] ** 2 / alpha**2
    return slope2 / (1 + slope2), np.arctan2(h[..., 1], h[..., 0]) % (2 * np.pi)


UP = np.array([0.0, 0.0, 1.0])


class Lobe:
    """One lobe as a map from the unit square, with the solid angle that a cell of it covers.

    The solid angles come from differences of the map itself, so that no analytic Jacobian is
    shared with what is tested.

    Args:
        kind: "reflect", "refract", "diffuse", "returned" or "thrown".
        cells: bins along each side.
        fine: quadrature points along each side of a bin.
    """

    def __init__(self, kind: str, b: Bsdf, wo: np.ndarray, cells: int = 12, fine: int = 8) -> None:
        self.kind, self.b, self.wo, self.cells = kind, b, np.asarray(wo, np.float64), cells
        side = cells * fine
        step = 1e-3 / side
        # Jittered: a horizon that follows a row of points would be off by half a row.
        jitter = np.random.default_rng(0).uniform(
            2 * step * side, 1 - 2 * step * side, (2, side, side)
        )
        s, t = (np.mgrid[:side, :side] + jitter) / side
        ends = [self.direction(s + step, t), self.direction(s - step, t)]
        ends += [self.direction(s, t + step), self.direction(s, t - step)]
        area = np.linalg.norm(np.cross(ends[0] - ends[1], ends[2] - ends[3]), axis=-1)
        self.wi = self.direction(s, t)
        # A difference across the end of the lobe means nothing.
        known = self.mask(self.wi) & np.all([end.any(axis=-1) for end in ends], axis=0)
        self.solid_angle = np.where(known, area / (2 * step * side) ** 2, 0)

    def mask(self, wi: np.ndarray) -> np.ndarray:
        return wi[..., 2] < 0 if self.kind in ("refract", "thrown") else wi[..., 2] > 0

    def direction(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        if self.kind == "diffuse":
            radius, phi = np.sqrt(s), 2 * np.pi * t
            return np.stack(
                [radius * np.cos(phi), radius * np.sin(phi), np.sqrt(np.maximum(1 - s, 0))], axis=-1
            )
        # Squared at the end: normals near the horizon are seen from grazing directions.
        h = normal_at(1 - (1 - s) ** 2, 2 * np.pi * t, self.b.alpha)
        if self.kind == "refract":
            return refract(self.wo, h, self.b.eta)
        mirrored = reflect(self.wo, h)
        if self.kind == "returned":
            return mirrored * np.array([1, 1, -1])
        return refract(mirrored * -1, UP, self.b.eta) if self.kind == "thrown" else mirrored

    def bin_of(self, wi: np.ndarray) -> np.ndarray:
        """Index of the bin that each direction is in, ``cells^2`` where it is not of the lobe."""
        wi = np.asarray(wi, np.float64)
        with np.errstate(all="ignore"):
            if self.kind == "diffuse":
                s = wi[..., 0] ** 2 + wi[..., 1] ** 2
                phi = np.arctan2(wi[..., 1], wi[..., 0]) % (2 * np.pi)
            else:
                h = (
                    unit(self.wo + wi)
                    if self.kind == "reflect"
                    else refraction_normal(self.b, self.wo, wi)
                )
                t, phi = place_of(h, self.b.alpha)
                s = 1 - np.sqrt(np.maximum(1 - t, 0))
                if self.kind == "refract":
                    # Facets of glass throw light where none of them bends it to.
                    s = np.where((dot(self.wo, h) > 0) & (dot(wi, h) < 0), s, np.nan)
        inside = self.mask(wi) & np.isfinite(s)
        row = np.clip(np.where(inside, s, 0) * self.cells, 0, self.cells - 1).astype(int)
        column = np.clip(phi / (2 * np.pi) * self.cells, 0, self.cells - 1)
        column = np.where(inside, column, 0).astype(int)
        return np.where(inside, row * self.cells + column, self.cells**2)

    def integrate(self, function) -> np.ndarray:
        """Return the integral of ``function(b, wo, wi)`` over each bin, ``(cells^2, ...)``."""
        with np.errstate(all="ignore"):
            values = np.asarray(function(self.b, self.wo, self.wi))
        extra = values.ndim - 2
        weights = self.solid_angle.reshape(self.solid_angle.shape + (1,) * extra)
        values = np.where(weights > 0, values * weights, 0)
        n = self.cells
        fine = values.shape[0] // n
        binned = values.reshape(n, fine, n, fine, *values.shape[2:]).sum(axis=(1, 3))
        return binned.reshape(n * n, *values.shape[2:])


PDFS = {"reflect": pdf_reflection, "refract": pdf_refraction, "diffuse": pdf_diffuse}
VALUES = {
    "reflect": eval_reflection,
    "refract": eval_refraction,
    "diffuse": eval_diffuse,
    "returned": eval_returned,
    "thrown": eval_thrown,
}


def albedo(b: Bsdf, wo: np.ndarray) -> np.ndarray:
    """Return the integral of f |cos| over all directions by quadrature, ``(3,)``."""
    kinds = ["reflect"]
    kinds += ["diffuse"] if b.metallic < 1 and b.transmission < 1 else []
    kinds += ["refract"] if b.metallic < 1 and b.transmission > 0 else []
    kinds += ["returned", "thrown"] if is_rough_glass(b) and b.eta < 1 else []
    return sum(Lobe(kind, b, wo, cells=1, fine=160).integrate(VALUES[kind])[0] for kind in kinds)


def white(b: Bsdf) -> Bsdf:
    return replace(b, base_color=(1.0, 1.0, 1.0))
