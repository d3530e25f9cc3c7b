// The one BSDF: a diffuse base under a GGX coat, or a metal, or glass, by metallic, roughness and
// transmission as in glTF.
//
// wo points to the camera side, wi to the light side; `_local` is in the frame of the shading normal,
// z along it, wo.z > 0.  eval_bsdf returns f times |cos wi|; pdfs are per solid angle.
//
// f = (1 - metallic) ((1 - transmission) diffuse + transmission btdf) + GGX(F_mixed)
// diffuse = base / pi (1 - E(cos o)) (1 - E(cos i)) / (1 - E_average), E the albedo of the coat: light
// enters through the coat and leaves through it, so a white base under any coat gives back nearly all
// that it gets and never more (glTF's 1 - F(o.h) gains up to four fifths at grazing angles).  Kelemen,
// Szirmay-Kalos: A Microfacet Based Coupled Specular-Matte BRDF Model, 2001.
// GGX: Walter et al. 2007; height-correlated masking: Heitz 2014; sampled by its bounded visible
// normals: Dupuy and Benyoub 2023, Eto and Tokuyoshi 2023.  Single scattering: rough metals lose
// energy (up to half at roughness 1).
#pragma once

#include "lanes.h"
#include "surface.h"

// Below this a lobe is sharper than float can evaluate; roughness 0 is drawn with it.
#define ALPHA_GGX_MIN 1e-3f

/// Chance of each lobe and what all of them share, for one wo.
typedef struct {
#if GLOSSY
    Float reflect;
#endif
#if TRANSMISSION
    Float refract;
#endif
    Float diffuse;
} LobeChances;

#if !GLOSSY
// Nothing but the base: a scene of matt materials.

inline LobeChances lobe_chances(Bsdf b, Float cos_o)
{
    LobeChances c;
    c.diffuse = (Float)(1.0f);
    return c;
}

inline Vec3 eval_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Vec3 wi, Float wi_side, Float *pdf)
{
    const Mask above = (wi.z > 0.0f) & (wi_side > 0.0f);
    *pdf = pick(above, wi.z * INV_PI, (Float)(0.0f));
    return scale(b.base_color, *pdf);
}

inline Float left_of_choice(LobeChances chances, Float u_lobe) { return u_lobe; }
#endif

/// Cosine-weighted direction about z: Malley's method.
inline Vec3 sample_cosine(Float u1, Float u2)
{
    const Float radius = sqrt(u1);
    Float c;
    Float s;
    cos_sin_turns(u2, &c, &s);
    return vec3(radius * c, radius * s, sqrt(max(1.0f - u1, 0.0f)));
}

#if !GLOSSY
inline Vec3 sample_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Float u_lobe, Float u1, Float u2)
{
    return sample_cosine(u1, u2);
}
#else

inline Float fifth_power_of_one_minus(Float x)
{
    const Float y = max(1.0f - x, 0.0f);
    const Float y2 = y * y;
    return y2 * y2 * y;
}

inline Float schlick(Float f0, Float f90, Float cosine)
{
    return f0 + (f90 - f0) * fifth_power_of_one_minus(cosine);
}

#if TRANSMISSION
/// Reflectance of a dielectric boundary for light that meets it at `cosine` > 0, with `eta` the index
/// beyond over the index here; 1 under total reflection.
inline Float fresnel_dielectric(Float cosine, Float eta)
{
    const Float sin2 = (1.0f - cosine * cosine) / (eta * eta);
    const Mask total = sin2 >= 1.0f;
    const Float cos_t = sqrt(max(1.0f - sin2, 0.0f));
    const Float parallel = (eta * cosine - cos_t) / (eta * cosine + cos_t);
    const Float vertical = (cosine - eta * cos_t) / (cosine + eta * cos_t);
    return pick(total, (Float)(1.0f), 0.5f * (parallel * parallel + vertical * vertical));
}
#endif

/// Part of the light from one direction that the rough coat of `b` reflects into all directions.
///
/// E = F0 R + (F90 - F0) B, where R is the albedo of a GGX mirror and B that of the (1 - cos)^5 of
/// Schlick's reflectance.  Both are fits to quadrature, rather from above: E is at most 0.012 too
/// small; it is up to 0.13 too large within 15 degrees of the horizon, and 0.04 elsewhere.
inline Float coat_albedo(Bsdf b, Float cosine)
{
    const Float x = 1.0f - cosine;
    const Float x3 = x * x * x;
    const Float x5 = x3 * x * x;
    const Float mirror = 1.0f - 0.6f * b.alpha * (1.0f - 0.9f * x3);
    const Float edge = x5 / (1.0f + b.alpha * (8.0f * b.alpha + 10.0f * x5 * x5));
    return b.f0 * mirror + (b.specular - b.f0) * edge;
}

/// Cosine-weighted mean of coat_albedo over the hemisphere, to 3e-4.
inline Float average_coat_albedo(Bsdf b)
{
    const Float mirror = 1.0f - 0.546f * b.alpha;
    const Float edge = 1.0f / (21.0f + b.alpha * (27.0f + 165.0f * b.alpha));
    return b.f0 * mirror + (b.specular - b.f0) * edge;
}

/// Reflectance of the dielectric part of `b`, where its opaque share reflects `opaque`.
inline Float dielectric_reflectance(Bsdf b, Float opaque, Float cosine)
{
#if TRANSMISSION
    const Float clear = fresnel_dielectric(max(cosine, 1e-6f), b.eta) * b.specular;
    return opaque + (clear - opaque) * b.transmission;
#else
    return opaque;
#endif
}

LARGE_FUNCTION LobeChances lobe_chances(Bsdf b, Float cos_o)
{
    const Float f = dielectric_reflectance(b, coat_albedo(b, cos_o), cos_o);
    const Float color = max3(b.base_color);
    const Float metal_part = b.metallic * schlick(color, (Float)(1.0f), cos_o);
    const Float reflect = (1.0f - b.metallic) * f + metal_part;
    const Float below = (1.0f - b.metallic) * (1.0f - f);
    LobeChances c;
#if TRANSMISSION
    const Float diffuse = below * (1.0f - b.transmission) * color;
    const Float refract = below * b.transmission;
#else
    const Float diffuse = below * color;
    const Float refract = (Float)(0.0f);
#endif
    const Float sum = reflect + diffuse + refract;
    const Float inverse = 1.0f / pick(sum > 0.0f, sum, (Float)(1.0f));
    // A lobe that exists keeps at least a tenth of the samples, or a wrong guess would make noise.
    const Float tenth = (Float)(0.1f);
    Float r = pick(reflect > 0.0f, max(reflect * inverse, tenth), (Float)(0.0f));
    Float d = pick(diffuse > 0.0f, max(diffuse * inverse, tenth), (Float)(0.0f));
#if TRANSMISSION
    // Where the mean normal reflects all, tilted facets still let light through.
    const Float least = pick(refract > 0.0f, tenth, clamp(b.alpha, 0.1f * tenth, tenth));
    Float t = pick((1.0f - b.metallic) * b.transmission > 0.0f, max(refract * inverse, least), (Float)(0.0f));
    const Float total = r + d + t;
#else
    const Float total = r + d;
#endif
    const Float norm = 1.0f / pick(total > 0.0f, total, (Float)(1.0f));
    c.reflect = r * norm;
    c.diffuse = pick(total > 0.0f, d * norm, (Float)(1.0f));
#if TRANSMISSION
    c.refract = t * norm;
#endif
    return c;
}

/// GGX density of the microfacet normal `h` (local, unit).  From the slopes, because 1 - h.z^2 has
/// cancelled away where the lobe is sharp.
inline Float ggx_d(Vec3 h, Float alpha)
{
    const Float a2 = alpha * alpha;
    const Float e = (h.x * h.x + h.y * h.y) / a2 + h.z * h.z;
    return INV_PI / (a2 * e * e);
}

/// Length of (alpha x, alpha y, z) for a unit vector with cosine z.
inline Float ggx_stretch(Float z, Float alpha) { return sqrt(alpha * alpha * max(1.0f - z * z, 0.0f) + z * z); }

/// Height-correlated masking and shadowing over 4 cos_o cos_i.
inline Float ggx_visibility(Float cos_o, Float cos_i, Float alpha)
{
    return 0.5f / max(cos_o * ggx_stretch(cos_i, alpha) + cos_i * ggx_stretch(cos_o, alpha), 1e-20f);
}

/// Share of the cap of visible normals that can reflect above the horizon (the k of Eto, Tokuyoshi).
inline Float ggx_bound(Vec3 wo, Float alpha)
{
    const Float s = 1.0f + sqrt(max(1.0f - wo.z * wo.z, 0.0f));
    const Float a2 = alpha * alpha;
    const Float s2 = s * s;
    return (1.0f - a2) * s2 / (s2 + a2 * wo.z * wo.z);
}

/// Draw a microfacet normal visible from wo; `bound` is ggx_bound for a reflection, 1 for all of them.
inline Vec3 sample_ggx(Vec3 wo, Float alpha, Float bound, Float u1, Float u2)
{
    const Vec3 stretched = normalize3(vec3(alpha * wo.x, alpha * wo.y, wo.z));
    const Float lowest = bound * stretched.z;
    const Float z = (1.0f - u1) * (1.0f + lowest) - lowest;
    const Float radius = sqrt(clamp(1.0f - z * z, (Float)(0.0f), (Float)(1.0f)));
    Float c;
    Float s;
    cos_sin_turns(u2, &c, &s);
    const Vec3 h = vec3(radius * c + stretched.x, radius * s + stretched.y, z + stretched.z);
    return normalize3(vec3(alpha * h.x, alpha * h.y, max(h.z, (Float)(1e-6f))));
}

/// Density of the direction that sample_ggx with ggx_bound reflects into.
inline Float pdf_ggx_reflect(Vec3 wo, Vec3 h, Float alpha)
{
    return ggx_d(h, alpha) / (2.0f * (ggx_bound(wo, alpha) * wo.z + ggx_stretch(wo.z, alpha)));
}

/// Factors of f cos of the diffuse base beside its colour: that of wo, and that of the light.
inline Float base_gate(Bsdf b, Float cos_o)
{
    const Float stays = 1.0f - average_coat_albedo(b);
    Float gate = (1.0f - b.metallic) * (1.0f - coat_albedo(b, cos_o)) / max(stays, 1e-6f);
#if TRANSMISSION
    gate *= 1.0f - b.transmission;
#endif
    return gate;
}

inline Float base_light(Bsdf b, Float cos_i) { return (1.0f - coat_albedo(b, cos_i)) * cos_i * INV_PI; }

/// Share of `f`, which eval_bsdf gave for wo and wi, that the diffuse base has.
inline Vec3 base_share(Bsdf b, Float gate, Vec3 wi, Vec3 f)
{
    const Float under = pick(wi.z > 0.0f, gate * base_light(b, max(wi.z, 0.0f)), (Float)(0.0f));
    const Vec3 base = scale(b.base_color, under);
    const Float one = (Float)(1.0f);
    const Float zero = (Float)(0.0f);
    return vec3(pick(f.x > 0.0f, min(base.x / pick(f.x > 0.0f, f.x, one), one), zero),
                pick(f.y > 0.0f, min(base.y / pick(f.y > 0.0f, f.y, one), one), zero),
                pick(f.z > 0.0f, min(base.z / pick(f.z > 0.0f, f.z, one), one), zero));
}

/// f(wo, wi) |cos wi|, and the density with which sample_bsdf draws wi.
///
/// `wi_side` > 0 where wi is on wo's side of the real surface: shading normals must not leak light.
LARGE_FUNCTION Vec3 eval_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Vec3 wi, Float wi_side, Float *pdf)
{
    const Mask above = (wi.z > 0.0f) & (wi_side > 0.0f);
    const Float cos_i = pick(above, wi.z, (Float)(1.0f));
    const Vec3 h = normalize3(add(wo, pick_v(above, wi, wo)));
    const Float cos_h = clamp(dot3(wo, h), (Float)(0.0f), (Float)(1.0f));

    const Float f = dielectric_reflectance(b, schlick(b.f0, b.specular, cos_h), cos_h);
    const Float edge = fifth_power_of_one_minus(cos_h);
    const Vec3 metal = add_scaled(b.base_color, sub(vec3_all((Float)(1.0f)), b.base_color), edge);
    const Vec3 fresnel = lerp3(vec3_all(f), metal, b.metallic);
    const Float mirror = ggx_d(h, b.alpha) * ggx_visibility(wo.z, cos_i, b.alpha) * cos_i;

    const Float under = base_gate(b, wo.z) * base_light(b, cos_i);
    Vec3 value = add_scaled(scale(fresnel, mirror), b.base_color, under);
    Float density = chances.diffuse * cos_i * INV_PI;
    density += pick(chances.reflect > 0.0f, chances.reflect * pdf_ggx_reflect(wo, h, b.alpha), (Float)(0.0f));

#if TRANSMISSION
    // The generalised half vector points to the side of the lower index; h is turned to wo's side.
    const Mask below = (wi.z < 0.0f) & (wi_side < 0.0f) & (chances.refract > 0.0f);
    if (any_lane(below)) {
        Vec3 ht = normalize3(add_scaled(wo, wi, b.eta));
        ht = scale(ht, pick(ht.z < 0.0f, (Float)(-1.0f), (Float)(1.0f)));
        const Float oh = dot3(wo, ht);
        const Float ih = dot3(wi, ht);
        const Mask meets = below & (oh > 0.0f) & (ih < 0.0f);
        const Float root = ih + oh / b.eta;
        const Float root2 = max(root * root, 1e-12f);
        const Float jacobian = fabs(ih) / root2;
        const Float d = ggx_d(ht, b.alpha);
        const Float cos_t = max(-wi.z, 1e-6f);
        // Masking times 1 / cos_o is 4 cos_i visibility; the radiance is compressed by 1 / eta^2.
        const Float weight = d * 4.0f * cos_t * ggx_visibility(wo.z, cos_t, b.alpha) * max(oh, 0.0f)
                             * jacobian / (b.eta * b.eta);
        const Float through = (1.0f - fresnel_dielectric(max(oh, 1e-6f), b.eta) * b.specular)
                              * (1.0f - b.metallic) * b.transmission;
        const Float seen = 2.0f * d * max(oh, 0.0f) / (wo.z + ggx_stretch(wo.z, b.alpha));
        value = pick_v(meets, scale(b.base_color, weight * through), value);
        density = pick(meets, chances.refract * seen * jacobian, density);
        *pdf = pick(above | meets, density, (Float)(0.0f));
        return pick_v(above | meets, value, vec3_all((Float)(0.0f)));
    }
#endif
    *pdf = pick(above, density, (Float)(0.0f));
    return pick_v(above, value, vec3_all((Float)(0.0f)));
}

/// What is left of a number in [0, 1) that has chosen the lobe: uniform in [0, 1) again.
inline Float left_of_choice(LobeChances chances, Float u_lobe)
{
    const Mask diffuse = u_lobe < chances.diffuse;
    Float low = pick(diffuse, (Float)(0.0f), chances.diffuse);
    Float width = pick(diffuse, chances.diffuse, 1.0f - chances.diffuse);
#if TRANSMISSION
    const Float second = chances.diffuse + chances.reflect;
    const Mask refract = u_lobe >= second;
    width = pick(diffuse | refract, width, chances.reflect);
    low = pick(refract, second, low);
    width = pick(refract, 1.0f - second, width);
#endif
    return clamp((u_lobe - low) / max(width, 1e-6f), (Float)(0.0f), (Float)(0x1.fffffep-1f));
}

/// Draw wi (local); the caller evaluates it.  Returns z = 0 where the draw failed.
LARGE_FUNCTION Vec3 sample_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Float u_lobe, Float u1, Float u2)
{
    Vec3 wi = sample_cosine(u1, u2);
    const Mask glossy = u_lobe >= chances.diffuse;
    if (!any_lane(glossy))
        return wi;

#if TRANSMISSION
    const Mask refract = glossy & (u_lobe >= chances.diffuse + chances.reflect);
    const Float bound = pick(refract, (Float)(1.0f), ggx_bound(wo, b.alpha));
#else
    const Float bound = ggx_bound(wo, b.alpha);
#endif
    const Vec3 h = sample_ggx(wo, b.alpha, bound, u1, u2);
    const Float oh = dot3(wo, h);
    wi = pick_v(glossy, sub(scale(h, 2.0f * oh), wo), wi);
#if TRANSMISSION
    const Float cos2 = 1.0f - (1.0f - oh * oh) / (b.eta * b.eta);
    const Mask passes = refract & (cos2 > 0.0f);
    const Vec3 bent = add_scaled(scale(wo, -1.0f / b.eta), h, oh / b.eta - sqrt(max(cos2, 0.0f)));
    wi = pick_v(passes, bent, wi);
    // A draw that crosses its lobe's horizon has failed: it is not one of the other lobe's.
    wi.z = pick(refract, pick(passes, min(wi.z, 0.0f), (Float)(0.0f)), max(wi.z, 0.0f));
#endif
    return wi;
}
#endif
