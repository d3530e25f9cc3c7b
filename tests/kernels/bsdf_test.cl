// The functions of bsdf.h, one material and one pair of directions a lane.
//
// materials: base colour (3), metallic, alpha, f0, specular, transmission, eta, thin; with LAYERS also
// tint (3), coat, its alpha, sheen (3), its roughness, alpha along y.
// chances: reflect, refract, diffuse, coat; of lobe_chances if the first is negative.

#include "planes.h"
#include "../../cl/common/bsdf.h"

static inline Bsdf load_bsdf(global const float *materials)
{
    Bsdf b;
    b.base_color = LOAD_V(materials, 0);
#if GLOSSY
    b.metallic = LOAD(materials, 3);
    b.alpha = LOAD(materials, 4);
    b.f0 = LOAD(materials, 5);
    b.specular = LOAD(materials, 6);
#endif
#if TRANSMISSION
    b.transmission = LOAD(materials, 7);
    b.eta = LOAD(materials, 8);
    b.thin = LOAD(materials, 9) > 0.0f;
#endif
#if LAYERS
    b.tint = LOAD_V(materials, 10);
    b.coat = LOAD(materials, 13);
    b.coat_alpha = LOAD(materials, 14);
    b.sheen = LOAD_V(materials, 15);
    b.sheen_roughness = LOAD(materials, 18);
    b.alpha_y = LOAD(materials, 19);
#endif
    return b;
}

static inline LobeChances load_chances(global const float *chances, Bsdf b, Vec3 wo)
{
    LobeChances c = lobe_chances(b, wo);
    const Mask given = LOAD(chances, 0) >= 0.0f;
#if GLOSSY
    c.reflect = pick(given, LOAD(chances, 0), c.reflect);
#endif
#if TRANSMISSION
    c.refract = pick(given, LOAD(chances, 1), c.refract);
#endif
    c.diffuse = pick(given, LOAD(chances, 2), c.diffuse);
#if LAYERS
    c.coat = pick(given, LOAD(chances, 3), c.coat);
#endif
    return c;
}

kernel void list_chances(global const float *materials, global const float *wo, global float *chances)
{
    const LobeChances c = lobe_chances(load_bsdf(materials), LOAD_V(wo, 0));
#if GLOSSY
    STORE(chances, 0, c.reflect);
#else
    STORE(chances, 0, (Float)(0.0f));
#endif
#if TRANSMISSION
    STORE(chances, 1, c.refract);
#else
    STORE(chances, 1, (Float)(0.0f));
#endif
    STORE(chances, 2, c.diffuse);
#if LAYERS
    STORE(chances, 3, c.coat);
#else
    STORE(chances, 3, (Float)(0.0f));
#endif
}

/// left: what left_of_choice makes of the first of `numbers`.
kernel void list_left_of_choice(
    global const float *materials, global const float *wo, global const float *numbers, global float *left)
{
    STORE(left, 0, left_of_choice(lobe_chances(load_bsdf(materials), LOAD_V(wo, 0)), LOAD(numbers, 0)));
}

kernel void eval_pairs(
    global const float *materials,
    global const float *given,
    global const float *wo,
    global const float *wi,
    global const float *side,
    global float *values,
    global float *pdfs)
{
    const Bsdf b = load_bsdf(materials);
    const Vec3 o = LOAD_V(wo, 0);
    Float pdf;
    store_vec3(values, 0, eval_bsdf(b, load_chances(given, b, o), o, LOAD_V(wi, 0), LOAD(side, 0), &pdf));
    STORE(pdfs, 0, pdf);
}

/// numbers: u_lobe, u1, u2.
kernel void sample_directions(
    global const float *materials,
    global const float *given,
    global const float *wo,
    global const float *numbers,
    global float *wi,
    global float *values,
    global float *pdfs)
{
    const Bsdf b = load_bsdf(materials);
    const Vec3 o = LOAD_V(wo, 0);
    const LobeChances c = load_chances(given, b, o);
    const Vec3 i = sample_bsdf(b, c, o, LOAD(numbers, 0), LOAD(numbers, 1), LOAD(numbers, 2));
    Float pdf;
    const Vec3 value = eval_bsdf(b, c, o, i, i.z, &pdf);
    store_vec3(wi, 0, i);
    store_vec3(values, 0, value);
    STORE(pdfs, 0, pdf);
}

#if GLOSSY
/// parts: what `reflectance` says for wo; least: what `least_alpha` does.
kernel void list_reflectances(
    global const float *materials, global const float *wo, global float *parts, global float *least)
{
    const Bsdf b = load_bsdf(materials);
    store_vec3(parts, 0, reflectance(b, lobe_chances(b, LOAD_V(wo, 0))));
    STORE(least, 0, least_alpha(b));
}
#endif
