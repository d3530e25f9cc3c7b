// Clear boundaries: what they reflect, and how the facets of rough solid glass give away all of their light.
//
// A facet sends light from wo on in two directions, mirrored and bent; others stand before parts of both, by Smith.
// What they stop on one way leaves on the other: of a facet's light, F S(mirrored) : (1 - F) S(bent) go the two ways,
// with Fresnel's F and Smith's S.  Seen from inside there are facets for which neither way is open.  What they mirror
// downwards meets the boundary once more, as if it were smooth there.  Nothing is lost, whatever the widths and
// the index are, and light between the two sides is nearly in balance (tests/test_white_furnace.py).
#pragma once

#include "ggx.h"

#if GLOSSY && TRANSMISSION

/// Reflectance of a dielectric boundary for light that meets it at `cosine` > 0, with `eta` the index
/// beyond over the index here; 1 under total reflection.
static inline Float fresnel_dielectric(Float cosine, Float eta)
{
    const Float sin2 = (1.0f - cosine * cosine) / (eta * eta);
    const Mask total = sin2 >= 1.0f;
    const Float cos_t = sqrt(max(1.0f - sin2, 0.0f));
    const Float parallel = (eta * cosine - cos_t) / (eta * cosine + cos_t);
    const Float vertical = (cosine - eta * cos_t) / (cosine + eta * cos_t);
    return pick(total, (Float)(1.0f), 0.5f * (parallel * parallel + vertical * vertical));
}

/// Reflectance of the clear part of `b`.
static inline Float clear_reflectance(Bsdf b, Float cosine)
{
    const Float clear = fresnel_dielectric(max(cosine, 1e-6f), b.eta);
    // Between the two faces of a sheet light goes to and fro.  What can't leave a solid is reflected.
    const Mask total = (clear >= 1.0f) & !b.thin;
    return pick(b.thin, 2.0f * clear / (1.0f + clear), clear) * pick(total, (Float)(1.0f), b.specular);
}

/// Whether the facets of `b` share their light: of sharper ones others stop next to nothing.
static inline Mask is_rough_glass(Bsdf b)
{
    return (b.transmission > 0.0f) & !b.thin & (b.metallic < 1.0f) & (b.alpha > 2.0f * ALPHA_GGX_MIN);
}

/// Light from wo behind a facet with the normal `h`, oh = wo.h, and whether there is none: it is bent
/// away from the inside, or not at all.
static inline Mask cannot_pass(Bsdf b, Vec3 wo, Vec3 h, Float oh, Vec3 *bent)
{
    const Float cos2 = 1.0f - (1.0f - oh * oh) / (b.eta * b.eta);
    *bent = add_scaled(scale(wo, -1.0f / b.eta), h, oh / b.eta - sqrt(max(cos2, 0.0f)));
    return (cos2 <= 0.0f) | (bent->z >= 0.0f);
}

/// What a facet's light is multiplied with on its two ways, beside Smith's masking.
typedef struct {
    Float mirrored;
    Float bent;
} FacetShares;

static inline FacetShares shares_of_facet(Bsdf b, Alphas alpha, Vec3 wo, Vec3 h, Float oh)
{
    Vec3 bent;
    const Mask closed = cannot_pass(b, wo, h, oh, &bent);
    const Vec3 up = sub(scale(h, 2.0f * oh), wo);
    const Float stretch = ggx_stretch(wo, alpha);
    const Float one = (Float)(1.0f);
    const Float zero = (Float)(0.0f);
    const Float f = pick(closed, one, fresnel_dielectric(max(oh, 1e-6f), b.eta) * b.specular);
    const Float above = pick(up.z > 0.0f, ggx_seen_too(wo, stretch, up, up.z, alpha), zero);
    const Float below = pick(closed, zero, ggx_seen_too(wo, stretch, bent, -bent.z, alpha));
    const Float inverse = 1.0f / max(f * above + (1.0f - f) * below, 1e-6f);
    FacetShares s;
    s.mirrored = f * inverse;
    s.bent = (1.0f - f) * inverse;
    return s;
}

/// Density of directions, `down`.z < 0, into which facets mirror light from wo for which no way is open.
static inline Float thrown_down(Bsdf b, Alphas alpha, Vec3 wo, Vec3 down)
{
    const Vec3 sum = add(wo, down);
    const Vec3 h = normalize3(sum);
    Vec3 bent;
    const Mask there = (sum.z > 0.0f) & cannot_pass(b, wo, h, dot3(wo, h), &bent);
    return pick(there, ggx_d(h, alpha) / (2.0f * (wo.z + ggx_stretch(wo, alpha))), (Float)(0.0f));
}

/// Light that was thrown down, as f cos is given, and the density with which beyond_boundary draws its direction.
typedef struct {
    Float light;
    Float drawn;
} Thrown;

/// What the boundary reflects of it; `down` is the mirror image of wi.
static inline Thrown thrown_back(Bsdf b, Alphas alpha, Vec3 wo, Vec3 down)
{
    const Float density = thrown_down(b, alpha, wo, down);
    Thrown t;
    t.light = clear_reflectance(b, -down.z) * density;
    t.drawn = pick(1.0f - down.z * down.z >= b.eta * b.eta, density, (Float)(0.0f));
    return t;
}

/// What leaves it with wi, cos_t = |wi.z|, where eta < 1: Snell's law, and its derivative.
static inline Thrown thrown_through(Bsdf b, Alphas alpha, Vec3 wo, Vec3 wi, Float cos_t)
{
    const Float cos_d = sqrt(max(1.0f - b.eta * b.eta * (1.0f - cos_t * cos_t), 1e-12f));
    const Float density = thrown_down(b, alpha, wo, vec3(b.eta * wi.x, b.eta * wi.y, -cos_d)) * cos_t / cos_d;
    Thrown t;
    t.light = (1.0f - clear_reflectance(b, cos_d)) * density;
    t.drawn = b.eta * b.eta * density;
    return t;
}

/// Where light that is thrown down goes to: through the boundary, or back where that reflects all.
static inline Vec3 beyond_boundary(Float eta, Vec3 down)
{
    const Float x = down.x / eta;
    const Float y = down.y / eta;
    const Float cos2 = 1.0f - (x * x + y * y);
    const Mask passes = cos2 > 0.0f;
    return vec3(pick(passes, x, down.x), pick(passes, y, down.y), pick(passes, -sqrt(max(cos2, 0.0f)), -down.z));
}

#endif
