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
//
// Scattering between facets: a metal's lobe is raised by 1 + F0 (1 - R(o)) / R(o), R the albedo of a
// white one (Turquin: Practical Multiple Scattering Compensation for Microfacet Models, 2019), and both
// lobes of a sheet by 1 / R; solid glass shares it as glass.h says.  That gives up reciprocity, for no
// further lobe has to be drawn.  Light that can't leave a solid is reflected, whatever the specular
// factor says.
//
// LAYERS: f = sheen + (1 - S(cos o)) (coat + (1 - C(cos o)) f), S and C the albedos of sheen and coat.
// Sheen: Estevez and Kulla, Production Friendly Microfacet Sheen BRDF, 2017, with the visibility of
// Neubelt and Pettineo; scaled down where it would reflect more than all.
#pragma once

#include "lanes.h"
#include "surface.h"
#include "albedo.h"
#include "ggx.h"
#include "glass.h"

// Stands for the density of directions that no light is sampled for: those of delta lobes.
#define PDF_DELTA 1e30f

/// Chance of each lobe and what all of them share, for one wo.
typedef struct {
#if GLOSSY
    Float reflect;
#endif
#if TRANSMISSION
    Float refract;
    Float raised; // factor of both lobes of a sheet, for what scatters between facets
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
    Float coated; // part of the light that the dielectric over the base reflects
    Float edge;   // part that white facets reflect beside their f0
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
    c.coated = (1.0f - b.metallic) * reflected;
    c.edge = seen.edge;
    c.enters = (1.0f - b.metallic) * (1.0f - reflected) / max(1.0f - average_coat_albedo(b, alpha), 1e-6f);
#if TRANSMISSION
    c.enters *= 1.0f - b.transmission;
    c.raised = 1.0f + pick(b.thin, c.gain, (Float)(0.0f));
    Float clear = clear_reflectance(b, cos_o);
    // Facets of rough glass that reflect all do so whichever lobe they are drawn for.
    clear = pick(is_rough_glass(b) & (clear >= 1.0f), max(b.f0, (Float)(0.1f)), clear);
    const Float f = reflected + (clear - reflected) * b.transmission;
#else
    const Float f = reflected;
#endif
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

/// About the part of light from everywhere that goes to wo; 0 where nothing does.  Of glass, what its far side
/// lets through is not counted.
static inline Vec3 reflectance(Bsdf b, LobeChances chances)
{
    const Vec3 white = vec3_all((Float)(1.0f));
    const Float single = 1.0f / (1.0f + chances.gain) - chances.edge;
    const Vec3 metal = mul(add_scaled(vec3_all(chances.edge), b.base_color, single), add_scaled(white, b.base_color, chances.gain));
#if LAYERS
    const Vec3 tint = lerp3(b.tint, white, chances.edge);
    const Vec3 mirrored = scale(add(scale(tint, chances.coated), scale(metal, b.metallic)), chances.under_coat);
    const Float fuzz = (1.0f - chances.under_sheen) / max(max3(b.sheen), 1e-6f);
    const Vec3 over = add_scaled(vec3_all(chances.under_sheen - chances.under_coat), b.sheen, fuzz);
    return add(add_scaled(mirrored, b.base_color, base_gate(chances)), over);
#else
    const Vec3 mirrored = add_scaled(vec3_all(chances.coated), metal, b.metallic);
    return add_scaled(mirrored, b.base_color, base_gate(chances));
#endif
}

/// The least alpha of what reflects light beside the base, sheen as of 1; 0 where nothing does.
static inline Float least_alpha(Bsdf b)
{
    const Mask mirrors = (b.metallic > 0.0f) | (b.f0 > 0.0f) | (b.specular > 0.0f);
#if LAYERS
    Float least = pick(mirrors, min(b.alpha, b.alpha_y), (Float)(1.0f));
    least = pick(b.coat > 0.0f, min(least, b.coat_alpha), least);
    return pick(mirrors | (b.coat > 0.0f) | (max3(b.sheen) > 0.0f), least, (Float)(0.0f));
#else
    return pick(mirrors, b.alpha, (Float)(0.0f));
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
    Float f = b.f0 + (b.specular - b.f0) * edge;
#if TRANSMISSION
    const Float share = (1.0f - b.metallic) * b.transmission;
    const Mask rough = is_rough_glass(b);
    const Mask inside = rough & (b.eta < 1.0f);
    const Float single = clear_reflectance(b, cos_h);
    Float clear = single * chances.raised;
    if (any_lane(rough & above))
        clear = pick(rough, shares_of_facet(b, alpha, wo, h, cos_h).mirrored, clear);
    f += (clear - f) * b.transmission;
#endif
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
    Mask returns = 1.0f - cos_h * cos_h >= b.eta * b.eta;
    if (any_lane(above & inside)) {
        Vec3 none;
        returns |= inside & cannot_pass(b, wo, h, cos_h, &none);
        const Thrown thrown = thrown_back(b, alpha, wo, vec3(wi.x, wi.y, -cos_i));
        value = add(value, vec3_all(pick(inside, share * thrown.light, (Float)(0.0f))));
        density += pick(inside, chances.refract * thrown.drawn, (Float)(0.0f));
    }
    returns &= (chances.refract > 0.0f) & !b.thin;
    density += pick(returns, chances.refract * ggx_d(h, alpha) / (2.0f * (wo.z + ggx_stretch(wo, alpha))), (Float)(0.0f));
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
    if (any_lane(behind)) {
        const Float sheet = (1.0f - single) * share * mirror * chances.raised;
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
        Float through = 1.0f - fresnel_dielectric(max(oh, 1e-6f), b.eta) * b.specular;
        if (any_lane(rough & meets))
            through = pick(rough, shares_of_facet(b, alpha, wo, ht, oh).bent, through);
        const Float seen = 2.0f * d * max(oh, 0.0f) / (wo.z + ggx_stretch(wo, alpha));
        Float light = pick(meets, weight * through, (Float)(0.0f));
        Float drawn = pick(meets, seen * jacobian, (Float)(0.0f));
        if (any_lane(bent & inside)) {
            const Thrown thrown = thrown_through(b, alpha, wo, beyond, cos_t);
            light += pick(inside, thrown.light, (Float)(0.0f));
            drawn += pick(inside, thrown.drawn, (Float)(0.0f));
        }
        value = pick_v(bent, scale(b.base_color, light * share), value);
        density = pick(bent, chances.refract * drawn, density);
        passes |= bent & (drawn > 0.0f);
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
    Vec3 bent;
    const Mask passes = refract & !cannot_pass(b, wo, h, oh, &bent);
    const Mask thrown = refract & !passes & (wi.z < 0.0f) & is_rough_glass(b);
    wi = pick_v(passes, bent, wi);
    if (any_lane(thrown))
        wi = pick_v(thrown, beyond_boundary(b.eta, wi), wi);
    // A draw that crosses its lobe's horizon has failed: it is not one of the other lobe's.  One that cannot pass
    // its facet is reflected: were it lost, what is left of paths that go round in smooth glass would grow by 1 %
    // at each of a thousand bounces.
    wi.z = pick(thrown, wi.z, pick(passes, min(wi.z, 0.0f), max(wi.z, 0.0f)));
    wi.z = pick(through & b.thin, -wi.z, wi.z);
#endif
    return wi;
}
#endif
