"""psf_cl's BSDF written for Mitsuba's just-in-time compiler, for comparisons of equal work.

Import after the variant is set, which must be a Dr.Jit one.  The formulas are those that
``cl/common/bsdf.h`` names the sources of; here they are written a second time, from them.
Light between facets, layers and sheets are left out.
Mitsuba's ``wi`` points to the camera; here o does, and i to the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

NAME = "psf_cl"

_SHARPEST_ALPHA = 1e-3


@dataclass(frozen=True)
class _Point:
    """Parameters at a point; ``o`` and all directions with it are turned so that o.z > 0."""

    o: Any
    flip: Any
    color: Any
    eta: Any


class _Bsdf(mi.BSDF):
    def __init__(self, properties: mi.Properties) -> None:
        super().__init__(properties)
        self.base_color = properties.get_texture("base_color")
        # Data, not constants of the code: all materials share it.
        self.metallic = dr.opaque(mi.Float, properties["metallic"])
        self.specular = dr.opaque(mi.Float, properties["specular"])
        self.transmission = dr.opaque(mi.Float, properties["transmission"])
        self.ior = dr.opaque(mi.Float, properties["ior"])
        self.alpha = dr.opaque(mi.Float, max(properties["roughness"] ** 2, _SHARPEST_ALPHA))
        self.clear = properties["transmission"] > 0.0
        self.f0 = dr.square((self.ior - 1.0) / (self.ior + 1.0)) * self.specular
        dr.make_opaque(self.f0)
        kinds = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.GlossyReflection
        if self.clear:
            kinds |= mi.BSDFFlags.GlossyTransmission | mi.BSDFFlags.NonSymmetric
        self.m_components = [kinds | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
        self.m_flags = self.m_components[0]

    # What Mitsuba calls.

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> Any:
        p = self._point(si, active)
        return self._sample(p, self._chances(p), sample1, sample2, active)

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        p = self._point(si, active)
        return self._eval_pdf(p, self._chances(p), wo, active)

    def eval_pdf_sample(
        self, ctx: Any, si: Any, wo: Any, sample1: Any, sample2: Any, active: Any = True
    ) -> Any:
        p = self._point(si, active)
        chances = self._chances(p)
        evaluated = self._eval_pdf(p, chances, wo, active)
        return *evaluated, *self._sample(p, chances, sample1, sample2, active)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def to_string(self) -> str:
        return NAME

    def _sample(self, p: _Point, chances: Any, sample1: Any, sample2: Any, active: Any) -> Any:
        i = self._draw(p, chances, sample1, sample2)
        value, pdf = self._evaluate(p, chances, i)
        drawn = mi.BSDFSample3f()
        drawn.wo = mi.Vector3f(i.x, i.y, i.z * p.flip)
        drawn.pdf = pdf
        drawn.eta = dr.select(i.z < 0.0, p.eta, 1.0)
        drawn.sampled_type = mi.UInt32(+self.m_flags)
        drawn.sampled_component = mi.UInt32(0)
        good = active & (pdf > 0.0)
        return drawn, dr.select(good, value / dr.select(good, pdf, 1.0), 0.0)

    def _eval_pdf(self, p: _Point, chances: Any, wo: Any, active: Any) -> Any:
        i = mi.Vector3f(wo.x, wo.y, wo.z * p.flip)
        value, pdf = self._evaluate(p, chances, i)
        return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

    # The model.

    def _point(self, si: Any, active: Any) -> _Point:
        front = si.wi.z >= 0.0
        o = mi.Vector3f(si.wi.x, si.wi.y, dr.maximum(dr.abs(si.wi.z), 1e-6))
        return _Point(
            o,
            dr.select(front, mi.Float(1.0), -1.0),
            self.base_color.eval(si, active),
            dr.select(front, self.ior, 1.0 / self.ior),
        )

    def _coat_albedo(self, cosine: Any) -> Any:
        x = 1.0 - cosine
        x3 = x * x * x
        x5 = x3 * x * x
        a = self.alpha
        mirror = 1.0 - 0.6 * a * (1.0 - 0.9 * x3)
        edge = x5 / (1.0 + a * (8.0 * a + 10.0 * x5 * x5))
        return self.f0 * mirror + (self.specular - self.f0) * edge

    def _average_coat_albedo(self) -> Any:
        a = self.alpha
        mirror = 1.0 - 0.546 * a
        return self.f0 * mirror + (self.specular - self.f0) / (21.0 + a * (27.0 + 165.0 * a))

    def _clear_reflectance(self, cosine: Any, eta: Any) -> Any:
        sin2 = (1.0 - cosine * cosine) / (eta * eta)
        cos_t = dr.sqrt(dr.maximum(1.0 - sin2, 0.0))
        parallel = (eta * cosine - cos_t) / (eta * cosine + cos_t)
        vertical = (cosine - eta * cos_t) / (cosine + eta * cos_t)
        part = 0.5 * (dr.square(parallel) + dr.square(vertical))
        return dr.select(sin2 >= 1.0, 1.0, part) * self.specular

    def _reflectance(self, p: _Point, opaque: Any, cosine: Any) -> Any:
        if not self.clear:
            return opaque
        clear = self._clear_reflectance(dr.maximum(cosine, 1e-6), p.eta)
        return opaque + (clear - opaque) * self.transmission

    def _chances(self, p: _Point) -> tuple[Any, Any, Any]:
        """Return the chances of the diffuse, the reflecting and the refracting lobe."""
        f = self._reflectance(p, self._coat_albedo(p.o.z), p.o.z)
        color = dr.max(p.color)
        reflect = (1.0 - self.metallic) * f
        reflect += self.metallic * (color + (1.0 - color) * _fifth_power(p.o.z))
        below = (1.0 - self.metallic) * (1.0 - f)
        diffuse = below * (1.0 - self.transmission) * color
        refract = below * self.transmission
        total = reflect + diffuse + refract
        inverse = 1.0 / dr.select(total > 0.0, total, 1.0)
        reflect = dr.select(reflect > 0.0, dr.maximum(reflect * inverse, 0.1), 0.0)
        diffuse = dr.select(diffuse > 0.0, dr.maximum(diffuse * inverse, 0.1), 0.0)
        if self.clear:
            least = dr.select(refract > 0.0, 0.1, dr.clip(self.alpha, 0.01, 0.1))
            there = (1.0 - self.metallic) * self.transmission > 0.0
            refract = dr.select(there, dr.maximum(refract * inverse, least), 0.0)
        total = reflect + diffuse + refract
        norm = 1.0 / dr.select(total > 0.0, total, 1.0)
        return dr.select(total > 0.0, diffuse * norm, 1.0), reflect * norm, refract * norm

    def _d(self, h: Any) -> Any:
        a2 = dr.square(self.alpha)
        e = (dr.square(h.x) + dr.square(h.y)) / a2 + dr.square(h.z)
        return dr.inv_pi / (a2 * e * e)

    def _stretch(self, z: Any) -> Any:
        z2 = z * z
        return dr.sqrt(dr.square(self.alpha) * dr.maximum(1.0 - z2, 0.0) + z2)

    def _visibility(self, cos_o: Any, cos_i: Any) -> Any:
        return 0.5 / (cos_o * self._stretch(cos_i) + cos_i * self._stretch(cos_o))

    def _bound(self, o: Any) -> Any:
        s2 = dr.square(1.0 + dr.sqrt(dr.maximum(1.0 - o.z * o.z, 0.0)))
        a2 = dr.square(self.alpha)
        return (1.0 - a2) * s2 / (s2 + a2 * o.z * o.z)

    def _evaluate(self, p: _Point, chances: tuple[Any, Any, Any], i: Any) -> tuple[Any, Any]:
        """Return f |cos i| and the density with which ``i`` is drawn."""
        o = p.o
        diffuse, reflect, refract = chances
        above = i.z > 0.0
        cos_i = dr.select(above, i.z, 1.0)
        h = dr.normalize(o + dr.select(above, i, o))
        cos_h = dr.clip(dr.dot(o, h), 0.0, 1.0)
        edge = _fifth_power(cos_h)
        f = self._reflectance(p, self.f0 + (self.specular - self.f0) * edge, cos_h)
        metal = p.color + (1.0 - p.color) * edge
        fresnel = f + (metal - f) * self.metallic
        mirror = self._d(h) * self._visibility(o.z, cos_i) * cos_i
        enters = 1.0 - self._coat_albedo(o.z)
        leaves = 1.0 - self._coat_albedo(cos_i)
        stays = dr.maximum(1.0 - self._average_coat_albedo(), 1e-6)
        share = (1.0 - self.metallic) * (1.0 - self.transmission)
        under = share * enters * leaves / stays * cos_i * dr.inv_pi
        value = fresnel * mirror + p.color * under
        seen = self._d(h) / (2.0 * (self._bound(o) * o.z + self._stretch(o.z)))
        density = diffuse * cos_i * dr.inv_pi + reflect * seen
        value = dr.select(above, value, 0.0)
        density = dr.select(above, density, 0.0)
        if self.clear:
            value_t, density_t, meets = self._evaluate_refraction(p, refract, i)
            value = dr.select(meets, value_t, value)
            density = dr.select(meets, density_t, density)
        return value, density

    def _evaluate_refraction(self, p: _Point, refract: Any, i: Any) -> tuple[Any, Any, Any]:
        o = p.o
        h = dr.normalize(o + i * p.eta)
        h = dr.select(h.z < 0.0, -h, h)
        oh, ih = dr.dot(o, h), dr.dot(i, h)
        meets = (i.z < 0.0) & (refract > 0.0) & (oh > 0.0) & (ih < 0.0)
        jacobian = dr.abs(ih) / dr.maximum(dr.square(ih + oh / p.eta), 1e-12)
        d = self._d(h)
        cos_t = dr.maximum(-i.z, 1e-6)
        weight = d * 4.0 * cos_t * self._visibility(o.z, cos_t) * dr.maximum(oh, 0.0)
        weight *= jacobian / dr.square(p.eta)
        through = 1.0 - self._clear_reflectance(dr.maximum(oh, 1e-6), p.eta)
        through *= (1.0 - self.metallic) * self.transmission
        seen = 2.0 * d * dr.maximum(oh, 0.0) / (o.z + self._stretch(o.z))
        return p.color * weight * through, refract * seen * jacobian, meets

    def _draw(self, p: _Point, chances: tuple[Any, Any, Any], lobe: Any, u: Any) -> Any:
        diffuse, reflect, _ = chances
        cosine = mi.warp.square_to_cosine_hemisphere(u)
        glossy = lobe >= diffuse
        refracts = glossy & (lobe >= diffuse + reflect)
        o = p.o
        bound = self._bound(o)
        if self.clear:
            bound = dr.select(refracts, 1.0, bound)
        stretched = dr.normalize(mi.Vector3f(self.alpha * o.x, self.alpha * o.y, o.z))
        lowest = bound * stretched.z
        z = (1.0 - u.x) * (1.0 + lowest) - lowest
        radius = dr.sqrt(dr.clip(1.0 - z * z, 0.0, 1.0))
        s, c = dr.sincos(2.0 * dr.pi * u.y)
        cap = mi.Vector3f(radius * c, radius * s, z) + stretched
        h = dr.normalize(
            mi.Vector3f(self.alpha * cap.x, self.alpha * cap.y, dr.maximum(cap.z, 1e-6))
        )
        oh = dr.dot(o, h)
        i = dr.select(glossy, 2.0 * oh * h - o, cosine)
        if self.clear:
            cos2 = 1.0 - (1.0 - oh * oh) / dr.square(p.eta)
            passes = refracts & (cos2 > 0.0)
            bent = -o / p.eta + h * (oh / p.eta - dr.sqrt(dr.maximum(cos2, 0.0)))
            i = dr.select(passes, bent, i)
            through = dr.select(passes, dr.minimum(i.z, 0.0), 0.0)
            i.z = dr.select(refracts, through, dr.maximum(i.z, 0.0))
        return i


def _fifth_power(cosine: Any) -> Any:
    x = dr.maximum(1.0 - cosine, 0.0)
    return dr.square(dr.square(x)) * x


mi.register_bsdf(NAME, _Bsdf)
