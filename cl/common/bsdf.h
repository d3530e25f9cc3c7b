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
// normals: Dupuy and Benyoub 2023, Eto and Tokuyoshi 2023.
//
// Scattering between facets: a metal's lobe is raised by 1 + F0 (1 - R(o)) / R(o), R the albedo of a
// white one (Turquin: Practical Multiple Scattering Compensation for Microfacet Models, 2019), and both
// lobes of glass by 1 / (what they leave of white light): of a sheet 1 / R, of a solid by a table.  That
// gives up reciprocity, for no further lobe has to be drawn.  Light that can't leave a solid is
// reflected, whatever the specular factor says.
//
// LAYERS: f = sheen + (1 - S(cos o)) (coat + (1 - C(cos o)) f), S and C the albedos of sheen and coat.
// Sheen: Estevez and Kulla, Production Friendly Microfacet Sheen BRDF, 2017, with the visibility of
// Neubelt and Pettineo; scaled down where it would reflect more than all.
#pragma once

#include "lanes.h"
#include "surface.h"
#include "albedo.h"

// Below this a lobe is sharper than float can evaluate; roughness 0 is drawn with it.
#define ALPHA_GGX_MIN 1e-3f

// Stands for the density of directions that no light is sampled for: those of delta lobes.
#define PDF_DELTA 1e30f

/// Chance of each lobe and what all of them share, for one wo.
typedef struct {
#if GLOSSY
    Float reflect;
#endif
#if TRANSMISSION
    Float refract;
    Float raised; // factor of both lobes of glass, for what scatters between facets
#endif
    Float diffuse;
#if LAYERS
    Float coat;
    Float under_coat;  // share of the light that coat and sheen leave to what is below
    Float under_sheen;
#endif
#if GLOSSY
    Facets facets;
    Float gain;   // what scattering between facets adds to a white mirror, relatively
    Float enters; // share of the light that comes to the diffuse base, over that which leaves it
#endif
} LobeChances;

#if !GLOSSY
// Nothing but the base: a scene of matt materials.

static inline LobeChances lobe_chances(Bsdf b, Vec3 wo)
{
    LobeChances c;
    c.diffuse = (Float)(1.0f);
    return c;
}

static inline Vec3 eval_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Vec3 wi, Float wi_side, Float *pdf)
{
    const Mask above = (wi.z > 0.0f) & (wi_side > 0.0f);
    *pdf = pick(above, wi.z * INV_PI, (Float)(0.0f));
    return scale(b.base_color, *pdf);
}

static inline Float left_of_choice(LobeChances chances, Float u_lobe) { return u_lobe; }

static inline Mask is_delta(Bsdf b) { return !MASK_ALL; }
#endif

/// Cosine-weighted direction about z: Malley's method.
static inline Vec3 sample_cosine(Float u1, Float u2)
{
    const Float radius = sqrt(u1);
    Float c;
    Float s;
    cos_sin_turns(u2, &c, &s);
    return vec3(radius * c, radius * s, sqrt(max(1.0f - u1, 0.0f)));
}

#if !GLOSSY
static inline Vec3 sample_bsdf(Bsdf b, LobeChances chances, Vec3 wo, Float u_lobe, Float u1, Float u2)
{
    return sample_cosine(u1, u2);
}
#else

static inline Float schlick(Float f0, Float f90, Float cosine)
{
    return f0 + (f90 - f0) * fifth_power_of_one_minus(cosine);
}

#if TRANSMISSION
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
#endif

/// Part of the light that the rough coat of `b` reflects, of what white facets do.
static inline Float coat_albedo(Bsdf b, Reflected r)
{
    return min(b.f0 * r.white + (b.specular - b.f0) * r.edge, (Float)(1.0f));
}

/// Its cosine-weighted mean over the hemisphere, to 5e-4.
static inline Float average_coat_albedo(Bsdf b, Float alpha)
{
    const Float mirror = polynomial(MIRROR_MEAN_FIT[0], MEAN_TERMS, 2.0f * sqrt(alpha) - 1.0f);
    const Float edge = polynomial(EDGE_MEAN_FIT[0], MEAN_TERMS, place_of_edge(alpha));
    return b.f0 * min(mirror, (Float)(1.0f)) + (b.specular - b.f0) * edge;
}

#if LAYERS
#define COAT_F0 0.04f // of an index of 1.5
/// Part of the light that the clear coat reflects.
static inline Float clear_coat_albedo(Float alpha, Float cosine)
{
    const Reflected r = reflected_by(facets_of(alpha), cosine);
    return COAT_F0 * r.white + (1.0f - COAT_F0) * r.edge;
}

/// White sheen times cos i, without its scale.
static inline Float eval_sheen(Float roughness, Float cos_o, Float cos_i, Float cos_h)
{
    const Float inverse = 1.0f / (roughness * roughness);
    const Float sine2 = max(1.0f - cos_h * cos_h, (Float)(1e-12f));
    const Float d = (2.0f + inverse) * (0.5f * INV_PI) * native_exp(0.5f * inverse * native_log(sine2));
    return d * cos_i / (4.0f * (cos_o + cos_i - cos_o * cos_i));
}
#endif

/// Reflectance of the dielectric part of `b`, where its opaque share reflects `opaque` and its clear one
/// is raised.
static inline Float dielectric_reflectance(Bsdf b, Float opaque, Float cosine, Float raised)
{
#if TRANSMISSION
    Float clear = fresnel_dielectric(max(cosine, 1e-6f), b.eta);
    // Between the two faces of a sheet light goes to and fro.  What can't leave a solid is reflected.
    const Mask total = (clear >= 1.0f) & !b.thin;
    clear = pick(b.thin, 2.0f * clear / (1.0f + clear), clear) * pick(total, (Float)(1.0f), b.specular);
    return opaque + (clear * raised - opaque) * b.transmission;
#else
    return opaque;
#endif
}

LARGE_FUNCTION LobeChances lobe_chances(Bsdf b, Vec3 wo)
{
    LobeChances c;
    const Float cos_o = wo.z;
#if LAYERS
    // Light leaves the base through stretched facets as through round ones: that loses nothing.
    const Mask stretched = b.alpha != b.alpha_y;
    const Float alpha = pick(stretched, sqrt(b.alpha * b.alpha_y), b.alpha);
#else
    const Float alpha = b.alpha;
#endif
    c.facets = facets_of(alpha);
    Reflected seen = reflected_by(c.facets, cos_o);
#if LAYERS
    if (any_lane(stretched))
        seen = reflected_by_stretched(stretched, b.alpha, b.alpha_y, wo, seen);
    c.under_sheen = 1.0f - max3(b.sheen) * sheen_albedo(b.sheen_roughness, cos_o);
    const Float coat = b.coat * clear_coat_albedo(b.coat_alpha, cos_o);
    c.under_coat = c.under_sheen * (1.0f - coat);
#endif
    c.gain = (1.0f - seen.white) / seen.white;
    const Float reflected = coat_albedo(b, seen);
    c.enters = (1.0f - b.metallic) * (1.0f - reflected) / max(1.0f - average_coat_albedo(b, alpha), 1e-6f);
#if TRANSMISSION
    c.enters *= 1.0f - b.transmission;
    c.raised = 1.0f + pick(b.thin, c.gain, (Float)(0.0f));
    const Mask rough = (b.transmission > 0.0f) & !b.thin & (b.metallic < 1.0f) & (b.alpha > 2.0f * ALPHA_GGX_MIN);
    if (any_lane(rough)) {
        Float kept = glass_albedo(rough, b.alpha, b.eta, b.specular, cos_o);
#if LAYERS
        // There is no table of two widths: what the better one keeps, rather than too little.
        const Mask both = rough & stretched;
        if (any_lane(both))
            kept = max(kept, pick(both, glass_albedo(both, b.alpha_y, b.eta, b.specular, cos_o), kept));
#endif
        c.raised = pick(rough, 1.0f / kept, c.raised);
    }
#endif
    const Float f = dielectric_reflectance(b, reflected, cos_o, (Float)(1.0f));
    const Float color = max3(b.base_color);
    const Float metal_part = b.metallic * schlick(color, (Float)(1.0f), cos_o);
    const Float reflect = (1.0f - b.metallic) * f + metal_part;
    const Float below = (1.0f - b.metallic) * (1.0f - f);
#if TRANSMISSION
    Float diffuse = below * (1.0f - b.transmission) * color;
    const Float refract = below * b.transmission;
#else
    Float diffuse = below * color;
    const Float refract = (Float)(0.0f);
#endif
    Float sum = reflect + diffuse + refract;
#if LAYERS
    // Sheen is drawn as the base is.
    diffuse += max3(b.sheen);
    const Float coated = b.coat * schlick((Float)(COAT_F0), (Float)(1.0f), cos_o);
    sum = reflect + diffuse + refract + coated;
#endif
    const Float inverse = 1.0f / pick(sum > 0.0f, sum, (Float)(1.0f));
    // A lobe that exists keeps at least a tenth of the samples, or a wrong guess would make noise.
    const Float tenth = (Float)(0.1f);
    Float r = pick(reflect > 0.0f, max(reflect * inverse, tenth), (Float)(0.0f));
    Float d = pick(diffuse > 0.0f, max(diffuse * inverse, tenth), (Float)(0.0f));
#if TRANSMISSION
    // Where the mean normal reflects all, tilted facets still let light through.
    const Float least = pick(refract > 0.0f, tenth, clamp(b.alpha, 0.1f * tenth, tenth));
    Float t = pick((1.0f - b.metallic) * b.transmission > 0.0f, max(refract * inverse, least), (Float)(0.0f));
    Float total = r + d + t;
#else
    Float total = r + d;
#endif
#if LAYERS
    const Float above = pick(b.coat > 0.0f, max(coated * inverse, tenth), (Float)(0.0f));
    total += above;
#endif
    const Float norm = 1.0f / pick(total > 0.0f, total, (Float)(1.0f));
    c.reflect = r * norm;
    c.diffuse = pick(total > 0.0f, d * norm, (Float)(1.0f));
#if TRANSMISSION
    c.refract = t * norm;
#endif
#if LAYERS
    c.coat = above * norm;
#endif
    return c;
}

/// Whether all lobes are as sharp as they can be: mirrors and clear glass, for which only their own
/// directions count.  A sharp lobe over a base is an ordinary one.
static inline Mask is_delta(Bsdf b)
{
    Float base = (1.0f - b.metallic) * max3(b.base_color);
#if TRANSMISSION
    base *= 1.0f - b.transmission;
#endif
    Mask sharp = (base == 0.0f) & (b.alpha <= ALPHA_GGX_MIN);
#if LAYERS
    sharp &= (b.alpha_y <= ALPHA_GGX_MIN) & ((b.coat == 0.0f) | (b.coat_alpha <= ALPHA_GGX_MIN));
    sharp &= max3(b.sheen) == 0.0f;
#endif
    return sharp;
}

// Alphas along x and y.
#if LAYERS
typedef struct {
    Float x;
    Float y;
} Alphas;
static inline Alphas alphas_of(Bsdf b)
{
    Alphas a;
    a.x = b.alpha;
    a.y = b.alpha_y;
    return a;
}
static inline Alphas alphas_equal(Float alpha)
{
    Alphas a;
    a.x = alpha;
    a.y = alpha;
    return a;
}
#define ALPHA_X(a) ((a).x)
#define ALPHA_Y(a) ((a).y)
#define ALPHA_LEAST(a) min((a).x, (a).y)
#else
typedef Float Alphas;
static inline Alphas alphas_of(Bsdf b) { return b.alpha; }
#define ALPHA_X(a) (a)
#define ALPHA_Y(a) (a)
#define ALPHA_LEAST(a) (a)
#endif

/// GGX density of the microfacet normal `h` (local, unit).  From the slopes, because 1 - h.z^2 has
/// cancelled away where the lobe is sharp.
static inline Float ggx_d(Vec3 h, Alphas alpha)
{
#if LAYERS
    const Float x = h.x / alpha.x;
    const Float y = h.y / alpha.y;
    const Float e = x * x + y * y + h.z * h.z;
    return INV_PI / (alpha.x * alpha.y * e * e);
#else
    const Float a2 = alpha * alpha;
    const Float e = (h.x * h.x + h.y * h.y) / a2 + h.z * h.z;
    return INV_PI / (a2 * e * e);
#endif
}

/// Length of (alpha_x x, alpha_y y, z) for a unit vector.
static inline Float ggx_stretch(Vec3 w, Alphas alpha)
{
#if LAYERS
    const Float x = alpha.x * w.x;
    const Float y = alpha.y * w.y;
    return sqrt(x * x + y * y + w.z * w.z);
#else
    return sqrt(alpha * alpha * max(1.0f - w.z * w.z, 0.0f) + w.z * w.z);
#endif
}

/// Height-correlated masking and shadowing over 4 cos_o cos_i; wi.z > 0 is given apart.
static inline Float ggx_visibility(Vec3 wo, Vec3 wi, Float cos_i, Alphas alpha)
{
    const Vec3 i = vec3(wi.x, wi.y, cos_i);
    return 0.5f / max(wo.z * ggx_stretch(i, alpha) + cos_i * ggx_stretch(wo, alpha), 1e-20f);
}

/// Share of the cap of visible normals that can reflect above the horizon (the k of Eto, Tokuyoshi).
static inline Float ggx_bound(Vec3 wo, Alphas alpha)
{
    const Float s = 1.0f + sqrt(max(1.0f - wo.z * wo.z, 0.0f));
    const Float least = ALPHA_LEAST(alpha);
    const Float a2 = least * least;
    const Float s2 = s * s;
    return (1.0f - a2) * s2 / (s2 + a2 * wo.z * wo.z);
}

/// Draw a microfacet normal visible from wo; `bound` is ggx_bound for a reflection, 1 for all of them.
static inline Vec3 sample_ggx(Vec3 wo, Alphas alpha, Float bound, Float u1, Float u2)
{
    const Vec3 stretched = normalize3(vec3(ALPHA_X(alpha) * wo.x, ALPHA_Y(alpha) * wo.y, wo.z));
    const Float lowest = bound * stretched.z;
    const Float z = (1.0f - u1) * (1.0f + lowest) - lowest;
    const Float radius = sqrt(clamp(1.0f - z * z, (Float)(0.0f), (Float)(1.0f)));
    Float c;
    Float s;
    cos_sin_turns(u2, &c, &s);
    const Vec3 h = vec3(radius * c + stretched.x, radius * s + stretched.y, z + stretched.z);
    return normalize3(vec3(ALPHA_X(alpha) * h.x, ALPHA_Y(alpha) * h.y, max(h.z, (Float)(1e-6f))));
}

/// Density of the direction that sample_ggx with ggx_bound reflects into.
static inline Float pdf_ggx_reflect(Vec3 wo, Vec3 h, Alphas alpha)
{
    return ggx_d(h, alpha) / (2.0f * (ggx_bound(wo, alpha) * wo.z + ggx_stretch(wo, alpha)));
}

/// Factor of the light in f cos of the diffuse base; that of wo is LobeChances.enters.
static inline Float base_light(Bsdf b, LobeChances chances, Float cos_i)
{
    return (1.0f - coat_albedo(b, reflected_by(chances.facets, cos_i))) * cos_i * INV_PI;
}

/// Factor of wo of the diffuse base, beside its colour, under all that lies over it.
static inline Float base_gate(LobeChances chances)
{
#if LAYERS
    return chances.enters * chances.under_coat;
#else
    return chances.enters;
#endif
}

/// Share of `f`, which eval_bsdf gave for wo and wi, that the diffuse base has.
static inline Vec3 base_share(Bsdf b, LobeChances chances, Float gate, Vec3 wi, Vec3 f)
{
    const Float under = pick(wi.z > 0.0f, gate * base_light(b, chances, max(wi.z, 0.0f)), (Float)(0.0f));
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
    const Alphas alpha = alphas_of(b);
    const Mask above = (wi.z > 0.0f) & (wi_side > 0.0f);
    Mask facing = above;
#if TRANSMISSION
    // Behind a sheet there is the mirror image of the reflection.
    const Mask below = (wi.z < 0.0f) & (wi_side < 0.0f) & (chances.refract > 0.0f);
    const Mask behind = below & b.thin;
    facing |= behind;
    const Vec3 beyond = wi;
    wi.z = pick(behind, -wi.z, wi.z);
#endif
    const Float cos_i = pick(facing, wi.z, (Float)(1.0f));
    const Vec3 h = normalize3(add(wo, pick_v(facing, wi, wo)));
    const Float cos_h = clamp(dot3(wo, h), (Float)(0.0f), (Float)(1.0f));

    const Float edge = fifth_power_of_one_minus(cos_h);
#if TRANSMISSION
    const Float raised = chances.raised;
#else
    const Float raised = (Float)(1.0f);
#endif
    const Float f = dielectric_reflectance(b, b.f0 + (b.specular - b.f0) * edge, cos_h, raised);
    const Vec3 white = vec3_all((Float)(1.0f));
    Vec3 metal = add_scaled(b.base_color, sub(white, b.base_color), edge);
    metal = mul(metal, add_scaled(white, b.base_color, chances.gain));
    Vec3 coat = vec3_all(f);
#if LAYERS
    coat = scale(add_scaled(b.tint, sub(white, b.tint), edge), f);
#endif
    const Vec3 fresnel = lerp3(coat, metal, b.metallic);
    const Float mirror = ggx_d(h, alpha) * ggx_visibility(wo, wi, cos_i, alpha) * cos_i;

    const Float under = chances.enters * base_light(b, chances, cos_i);
    Vec3 value = add_scaled(scale(fresnel, mirror), b.base_color, under);
    const Float seen_mirrored = pdf_ggx_reflect(wo, h, alpha);
    Float density = chances.diffuse * cos_i * INV_PI;
    density += pick(chances.reflect > 0.0f, chances.reflect * seen_mirrored, (Float)(0.0f));
#if TRANSMISSION
    // What was to be refracted by a facet that reflects all.
    const Mask total = (chances.refract > 0.0f) & !b.thin & (1.0f - cos_h * cos_h >= b.eta * b.eta);
    density += pick(total, chances.refract * ggx_d(h, alpha) / (2.0f * (wo.z + ggx_stretch(wo, alpha))), (Float)(0.0f));
#endif
#if LAYERS
    value = scale(value, chances.under_coat);
    if (any_lane(above & (b.coat > 0.0f))) {
        const Alphas a = alphas_equal(b.coat_alpha);
        const Float coated = b.coat * chances.under_sheen * schlick((Float)(COAT_F0), (Float)(1.0f), cos_h)
                             * ggx_d(h, a) * ggx_visibility(wo, wi, cos_i, a) * cos_i;
        const Mask there = b.coat > 0.0f;
        value = pick_v(there, add(value, vec3_all(coated)), value);
        density += pick(there, chances.coat * pdf_ggx_reflect(wo, h, a), (Float)(0.0f));
    }
    const Mask fuzzy = above & (max3(b.sheen) > 0.0f);
    if (any_lane(fuzzy)) {
        const Float fuzz = sheen_scale(b.sheen_roughness) * eval_sheen(b.sheen_roughness, wo.z, cos_i, h.z);
        value = pick_v(fuzzy, add_scaled(value, b.sheen, fuzz), value);
    }
#endif

#if TRANSMISSION
    Mask passes = behind;
    const Float share = (1.0f - b.metallic) * b.transmission;
    if (any_lane(behind)) {
        const Float kept_back = fresnel_dielectric(cos_h, b.eta);
        const Float sheet = (1.0f - 2.0f * kept_back / (1.0f + kept_back) * b.specular) * share * mirror * chances.raised;
        value = pick_v(behind, scale(b.base_color, sheet), value);
        density = pick(behind, chances.refract * seen_mirrored, density);
    }
    const Mask bent = below & !b.thin;
    if (any_lane(bent)) {
        // The generalised half vector points to the side of the lower index; h is turned to wo's side.
        Vec3 ht = normalize3(add_scaled(wo, beyond, b.eta));
        ht = scale(ht, pick(ht.z < 0.0f, (Float)(-1.0f), (Float)(1.0f)));
        const Float oh = dot3(wo, ht);
        const Float ih = dot3(beyond, ht);
        const Mask meets = bent & (oh > 0.0f) & (ih < 0.0f);
        const Float root = ih + oh / b.eta;
        const Float root2 = max(root * root, 1e-12f);
        const Float jacobian = fabs(ih) / root2;
        const Float d = ggx_d(ht, alpha);
        const Float cos_t = max(-beyond.z, 1e-6f);
        // Masking times 1 / cos_o is 4 cos_i visibility; the radiance is compressed by 1 / eta^2.
        const Float weight = d * 4.0f * cos_t * ggx_visibility(wo, beyond, cos_t, alpha) * max(oh, 0.0f)
                             * jacobian / (b.eta * b.eta);
        const Float through =
            (1.0f - fresnel_dielectric(max(oh, 1e-6f), b.eta) * b.specular) * share * chances.raised;
        const Float seen = 2.0f * d * max(oh, 0.0f) / (wo.z + ggx_stretch(wo, alpha));
        value = pick_v(meets, scale(b.base_color, weight * through), value);
        density = pick(meets, chances.refract * seen * jacobian, density);
        passes |= meets;
    }
#if LAYERS
    value = pick_v(passes, scale(value, chances.under_coat), value);
#endif
    *pdf = pick(above | passes, density, (Float)(0.0f));
    return pick_v(above | passes, value, vec3_all((Float)(0.0f)));
#else
    *pdf = pick(above, density, (Float)(0.0f));
    return pick_v(above, value, vec3_all((Float)(0.0f)));
#endif
}

/// What is left of a number in [0, 1) that has chosen the lobe: uniform in [0, 1) again.
static inline Float left_of_choice(LobeChances chances, Float u_lobe)
{
    // The lobes lie one after the other: diffuse, reflect, coat, refract.
    Float low = (Float)(0.0f);
    Float width = chances.diffuse;
    Float next = chances.diffuse;
    Mask later = u_lobe >= next;
    low = pick(later, next, low);
    width = pick(later, chances.reflect, width);
    next += chances.reflect;
#if LAYERS
    later = (u_lobe >= next) & (chances.coat > 0.0f);
    low = pick(later, next, low);
    width = pick(later, chances.coat, width);
    next += chances.coat;
#endif
#if TRANSMISSION
    later = u_lobe >= next;
    low = pick(later, next, low);
    width = pick(later, 1.0f - next, width);
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

    Alphas alpha = alphas_of(b);
    Float next = chances.diffuse + chances.reflect;
#if LAYERS
    const Mask coated = glossy & (u_lobe >= next) & (u_lobe < next + chances.coat);
    alpha.x = pick(coated, b.coat_alpha, alpha.x);
    alpha.y = pick(coated, b.coat_alpha, alpha.y);
    next += chances.coat;
#endif
    Float bound = ggx_bound(wo, alpha);
#if TRANSMISSION
    const Mask through = glossy & (u_lobe >= next);
    const Mask refract = through & !b.thin;
    bound = pick(refract, (Float)(1.0f), bound);
#endif
    const Vec3 h = sample_ggx(wo, alpha, bound, u1, u2);
    const Float oh = dot3(wo, h);
    wi = pick_v(glossy, sub(scale(h, 2.0f * oh), wo), wi);
#if TRANSMISSION
    const Float cos2 = 1.0f - (1.0f - oh * oh) / (b.eta * b.eta);
    const Mask passes = refract & (cos2 > 0.0f);
    const Vec3 bent = add_scaled(scale(wo, -1.0f / b.eta), h, oh / b.eta - sqrt(max(cos2, 0.0f)));
    wi = pick_v(passes, bent, wi);
    // A draw that crosses its lobe's horizon has failed: it is not one of the other lobe's.  One that cannot pass
    // its facet is reflected: were it lost, what is left of paths that go round in smooth glass would grow by 1 %
    // at each of a thousand bounces.
    wi.z = pick(passes, min(wi.z, 0.0f), max(wi.z, 0.0f));
    wi.z = pick(through & b.thin, -wi.z, wi.z);
#endif
    return wi;
}
#endif
