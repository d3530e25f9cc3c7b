// A point's material: the record and its textures become the parameters of the BSDF and of emission.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "bsdf.h"
#include "surface.h"
#include "texture.h"

#define GATHER_COLOR(array, index, member)                                                         \
    vec3(GATHER(array, index, member[0]), GATHER(array, index, member[1]), GATHER(array, index, member[2]))

// The texture `member` of material `m` at a point of a triangle; `alpha` gets its fourth channel.
#define LOOK_UP(mask, m, member, alpha)                                                            \
    look_up_lanes(mask, TEXTURE_OF(mask, m, member), s.triangle, u, v TEXTURE_ARGUMENTS, alpha)
#if TEXTURE_LEVELS
#define TEXTURE_OF(mask, m, member)                                                                \
    level_for(mask, GATHER_U(materials, m, member), s.triangle, s.footprint, uvs, textures)
#else
#define TEXTURE_OF(mask, m, member) GATHER_U(materials, m, member)
#endif

#if AREA_LIGHTS
/// Radiance that the lanes of `mask` give away, on either side.
static inline Vec3 fetch_emission(
    Mask mask, SurfacePoint s, Float u, Float v, __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS)
{
    Vec3 emission = GATHER_COLOR(materials, s.material, emission);
#if TEXTURES
    emission = textured(mask, emission, GATHER_U(materials, s.material, emission_texture), s.triangle, u,
                        v TEXTURE_ARGUMENTS);
#endif
#if VERTEX_COLORS
    const Mask unlit = mask & ((GATHER_U(materials, s.material, flags) & MATERIAL_UNLIT) != 0u);
    if (any_lane(unlit))
        emission = pick_v(unlit, mul(emission, corner_color(s.triangle, u, v, colors)), emission);
#endif
    return emission;
}
#endif

#if TANGENTS
/// `ns` turned so far that the mirrored direction of `wo` does not go below the real surface.
///
/// Otherwise steep parts of a normal map would be black.
static inline Vec3 with_visible_mirror(Vec3 ns, Vec3 ng, Vec3 wo)
{
    const Vec3 mirrored = add_scaled(scale(wo, (Float)(-1.0f)), ns, 2.0f * dot3(ns, wo));
    const Float least = min(0.9f * dot3(ng, wo), (Float)(0.01f));
    const Float lacks = least - dot3(ng, mirrored);
    const Vec3 lifted = normalize3(add_scaled(mirrored, ng, lacks));
    return pick_v(lacks > 0.0f, normalize3(add(lifted, wo)), ns);
}

#if INSTANCES
/// The unit direction `t` of a mesh in the world, unit; none stays none.
static inline Vec3 placed_tangent(__global const Instance *instances, UInt instance, Vec3 t)
{
    return pick_v(dot3(t, t) > 0.0f, normalize3(placed_direction(instances, instance, t)), t);
}
#endif

/// The unit direction across `n` that is nearest to `t`.
static inline Vec3 tangent_across(Vec3 n, Vec3 t)
{
    Vec3 any_t;
    Vec3 any_b;
    make_frame(n, &any_t, &any_b);
    t = add_scaled(t, n, -dot3(t, n));
    return normalize3(pick_v(dot3(t, t) > 1e-12f, t, any_t));
}

/// Give `s` its mapped normal, and the frame of the shading normal the direction of the tangent.
///
/// What is seen from behind is mapped as from the front and then turned: a bump is a dent there.
/// Returns the strength of the anisotropy along that direction.
LARGE_FUNCTION Float map_normal(
    Mask mask,
    SurfacePoint *point,
    Float u,
    Float v,
    Vec3 wo,
    __global const Material *materials,
    __global const Tangents *tangents TEXTURE_PARAMETERS INSTANCE_PARAMETERS,
    Vec3 *tangent,
    Vec3 *bitangent)
{
    const SurfacePoint s = *point;
    const Float side = pick(s.front, (Float)(1.0f), (Float)(-1.0f));
    const Vec3 n = scale(s.ns, side);
    const Float w = 1.0f - u - v;
    Vec3 t0 = GATHER_COLOR(tangents, s.triangle, t0);
    Vec3 t1 = GATHER_COLOR(tangents, s.triangle, t1);
    Vec3 t2 = GATHER_COLOR(tangents, s.triangle, t2);
    Float handedness = GATHER(tangents, s.triangle, t0[3]);
#if INSTANCES
    t0 = placed_tangent(instances, s.instance, t0);
    t1 = placed_tangent(instances, s.instance, t1);
    t2 = placed_tangent(instances, s.instance, t2);
    handedness *= GATHER(instances, s.instance, mirroring);
#endif
    Vec3 t = add_scaled(add_scaled(scale(t0, w), t1, u), t2, v);
    t = add_scaled(t, n, -dot3(t, n));
    Vec3 b;
    Vec3 any_t;
    make_frame(n, &any_t, &b);
    t = normalize3(pick_v(dot3(t, t) > 1e-12f, t, any_t));
    b = scale(cross3(n, t), pick(handedness < 0.0f, (Float)(-1.0f), (Float)(1.0f)));

    Vec3 mapped = n;
    Float anisotropy = (Float)(0.0f);
#if TEXTURES
    Float alpha;
    const Mask bumpy = mask & (GATHER_U(materials, s.material, normal_texture) != NO_TEXTURE);
    if (any_lane(bumpy)) {
        const Vec3 c = LOOK_UP(bumpy, s.material, normal_texture, &alpha);
        const Float strength = GATHER(materials, s.material, normal_scale);
        const Vec3 m = add_scaled(add_scaled(scale(t, strength * (2.0f * c.x - 1.0f)), b,
                                             strength * (2.0f * c.y - 1.0f)),
                                  n, 2.0f * c.z - 1.0f);
        mapped = pick_v(bumpy & (dot3(m, m) > 1e-12f), normalize3(m), mapped);
        const Vec3 ns = with_visible_mirror(scale(mapped, side), s.ng, wo);
        point->ns = pick_v(bumpy, ns, s.ns);
        mapped = scale(point->ns, side);
    }
#endif
#if LAYERS
    anisotropy = GATHER(materials, s.material, anisotropy);
    Float x = GATHER(materials, s.material, anisotropy_direction[0]);
    Float y = GATHER(materials, s.material, anisotropy_direction[1]);
#if TEXTURES
    const Mask turned = mask & (GATHER_U(materials, s.material, anisotropy_texture) != NO_TEXTURE);
    if (any_lane(turned)) {
        const Vec3 c = LOOK_UP(turned, s.material, anisotropy_texture, &alpha);
        const Float cx = 2.0f * c.x - 1.0f;
        const Float cy = 2.0f * c.y - 1.0f;
        const Float old_x = x;
        x = pick(turned, old_x * cx - y * cy, old_x);
        y = pick(turned, old_x * cy + y * cx, y);
        anisotropy = pick(turned, anisotropy * c.z, anisotropy);
    }
#endif
    t = add_scaled(scale(t, x), b, y);
#endif
    *tangent = tangent_across(point->ns, t);
    *bitangent = cross3(point->ns, *tangent);
    return anisotropy;
}
#endif

/// Factors of a material's parameters that textures give: 1 where there is no texture.
typedef struct {
    Vec3 color;
    Float roughness;
    Float metallic;
} Factors;

/// Look the textures of the base colour, of roughness and metal up in the lanes of `mask`.
static inline Factors fetch_factors(
    Mask mask, SurfacePoint s, Float u, Float v, __global const Material *materials TEXTURE_PARAMETERS)
{
    Factors t;
    t.color = vec3_all((Float)(1.0f));
    t.roughness = (Float)(1.0f);
    t.metallic = (Float)(1.0f);
#if TEXTURES
    Float alpha;
    t.color = LOOK_UP(mask, s.material, base_color_texture, &alpha);
#if GLOSSY
    const Vec3 metal = LOOK_UP(mask, s.material, metallic_roughness_texture, &alpha);
    t.roughness = metal.y;
    t.metallic = metal.z;
#endif
#endif
    return t;
}

/// Parameters of the BSDF in the lanes of `mask`; `anisotropy` is map_normal's, `factors` what fetch_factors gives.
static inline Bsdf bsdf_of(
    Mask mask,
    SurfacePoint s,
    Float u,
    Float v,
    Float anisotropy,
    Factors factors,
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS)
{
    Bsdf b;
    b.base_color = GATHER_COLOR(materials, s.material, base_color);
#if TEXTURES
    b.base_color = mul(b.base_color, factors.color);
#endif
#if VERTEX_COLORS
    b.base_color = mul(b.base_color, corner_color(s.triangle, u, v, colors));
#endif
#if GLOSSY
    b.metallic = GATHER(materials, s.material, metallic);
    Float roughness = GATHER(materials, s.material, roughness);
#if TEXTURES
    Float alpha;
    roughness *= factors.roughness;
    b.metallic *= factors.metallic;
#endif
    b.alpha = max(roughness * roughness, ALPHA_GGX_MIN);
    b.specular = GATHER(materials, s.material, specular);
#if LAYERS
    b.tint = GATHER_COLOR(materials, s.material, specular_color);
    b.coat = GATHER(materials, s.material, clearcoat);
    Float coat_roughness = GATHER(materials, s.material, clearcoat_roughness);
    b.sheen = GATHER_COLOR(materials, s.material, sheen_color);
    b.sheen_roughness = GATHER(materials, s.material, sheen_roughness);
#if TEXTURES
    LOOK_UP(mask, s.material, specular_texture, &alpha);
    b.specular *= alpha;
    b.tint = mul(b.tint, LOOK_UP(mask, s.material, specular_color_texture, &alpha));
    b.coat *= LOOK_UP(mask, s.material, clearcoat_texture, &alpha).x;
    coat_roughness *= LOOK_UP(mask, s.material, clearcoat_roughness_texture, &alpha).y;
    b.sheen = mul(b.sheen, LOOK_UP(mask, s.material, sheen_color_texture, &alpha));
    LOOK_UP(mask, s.material, sheen_roughness_texture, &alpha);
    b.sheen_roughness *= alpha;
#endif
    b.coat_alpha = max(coat_roughness * coat_roughness, ALPHA_GGX_MIN);
    b.sheen_roughness = max(b.sheen_roughness, (Float)(SHEEN_ROUGHNESS_MIN));
    // KHR_materials_anisotropy: rougher along the direction, as before across it.
    b.alpha_y = b.alpha;
    b.alpha += (1.0f - b.alpha) * anisotropy * anisotropy;
#endif
    b.f0 = GATHER(materials, s.material, f0) * b.specular;
#endif
#if TRANSMISSION
    b.transmission = GATHER(materials, s.material, transmission);
#if TEXTURES
    b.transmission *= LOOK_UP(mask, s.material, transmission_texture, &alpha).x;
#endif
    const Float ior = GATHER(materials, s.material, ior);
    b.thin = (GATHER_U(materials, s.material, flags) & MATERIAL_THIN) != 0u;
    b.eta = pick(s.front | b.thin, ior, 1.0f / ior);
#endif
    return b;
}

/// The same, with what the textures of every lane give.
static inline Bsdf fetch_bsdf(
    Mask mask,
    SurfacePoint s,
    Float u,
    Float v,
    Float anisotropy,
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS)
{
    const Factors factors = fetch_factors(mask, s, u, v, materials TEXTURE_ARGUMENTS);
    return bsdf_of(mask, s, u, v, anisotropy, factors, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS);
}

#if TRANSMISSION
/// The normal to shade solid glass by: the real one of `s` where a smooth facet with the shading normal
/// would send `wo`, mirrored or refracted, to the wrong side of the real surface, or would reflect all
/// where the real surface does not.
///
/// eval_bsdf has no light on the wrong side, and what should have left stays in glass for long: walls of a
/// vase whose normals are shared with its rim would be black.
static inline Vec3 normal_of_glass(SurfacePoint s, Bsdf b, Vec3 wo)
{
    const Float cos_o = dot3(s.ns, wo);
    const Float shown = dot3(s.ng, wo);
    const Float agree = dot3(s.ng, s.ns);
    const Float inverse = 1.0f / b.eta;
    const Float cos2_t = 1.0f - (1.0f - cos_o * cos_o) * inverse * inverse;
    const Mask lets_through = cos2_t > 0.0f;
    const Float along = cos_o * inverse - sqrt(max(cos2_t, (Float)(0.0f)));
    const Mask wrong = (2.0f * cos_o * agree <= shown)
                       | (lets_through & (agree * along >= shown * inverse))
                       | (!lets_through & (1.0f - shown * shown < b.eta * b.eta));
    return pick_v(wrong & (b.transmission > 0.0f) & !b.thin, s.ng, s.ns);
}

/// e^x for x <= 0, to 1e-6: library calls are scalar on PoCL.
static inline Float exp_of_negative(Float x)
{
    const Float y = max(x * 1.44269504f, (Float)(-125.0f));
    const Float whole = floor(y);
    const Float z = (y - whole) * 0.69314718f;
    const Float p =
        1.0f
        + z * (1.0f + z * (0.5f + z * (1.6666667e-1f + z * (4.1666667e-2f + z * (8.3333333e-3f + z * 1.3888889e-3f)))));
    return p * from_bits(to_uint(whole + 127.0f) << 23);
}

/// What is left of light after `t` meters, where `s` was met from inside; Beer's law.
static inline Vec3 attenuation(Mask hit, SurfacePoint s, Float t, __global const Material *materials)
{
    const Vec3 one = vec3_all((Float)(1.0f));
    const Mask behind = hit & !s.front;
    if (!any_lane(behind))
        return one;
    const Mask thin = (GATHER_U(materials, s.material, flags) & MATERIAL_THIN) != 0u;
    const Mask inside = behind & !thin & (GATHER(materials, s.material, transmission) > 0.0f);
    const Vec3 lost = scale(GATHER_COLOR(materials, s.material, absorption), -t);
    const Vec3 left = vec3(exp_of_negative(lost.x), exp_of_negative(lost.y), exp_of_negative(lost.z));
    return pick_v(inside, left, one);
}
#endif
