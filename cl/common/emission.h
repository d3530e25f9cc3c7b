// Light that leaves emitters: where a photon starts, and what it carries.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "light.h"
#include "rng.h"

/// A photon as it leaves its light.
typedef struct {
    Vec3 origin;
    Vec3 direction;
    Vec3 power;  // radiant flux over the chance of all that was drawn
    UInt light;
    UInt point;  // of an area light: the two numbers that its point was drawn with, 16 bits each
} Emission;

/// Direction around `axis` at the angle whose cosine is given, `turns` around it.
static inline Vec3 around(Vec3 axis, Float cosine, Float turns)
{
    Vec3 s;
    Vec3 t;
    Float c;
    Float si;
    make_frame(axis, &s, &t);
    cos_sin_turns(turns, &c, &si);
    const Float radius = sqrt(max(1.0f - cosine * cosine, 0.0f));
    return add_scaled(add_scaled(scale(s, radius * c), t, radius * si), axis, cosine);
}

/// Draw a light by the chances of the table, then where and along what a photon leaves it.
///
/// Of lights infinitely far photons start on a disk outside of the scene.
LARGE_FUNCTION Emission emit(
    __global const Params *params,
    __global const Light *lights,
    __global const Surface *surfaces,
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS,
#if ENVIRONMENT == 2
    __global const EnvironmentCell *cells,
#endif
    Mask active,
    Seed seed,
    UInt reversed_index)
{
    const UInt pair = (UInt)(PAIR_VERTEX);
    UInt side_bits;
    UInt light_bits;
    sample_bits(seed, reversed_index, pair + PAIR_CHOICE, params->sampler, &side_bits, &light_bits);
    Float alias_u;
    const UInt slot = alias_slot(light_bits, (UInt)(params->light_count), &alias_u);
    const UInt light = pick_u(alias_u < GATHER(lights, slot, keep), slot, GATHER_U(lights, slot, other));
    const UInt kind = GATHER_U(lights, light, kind);
    const Float weight = 1.0f / max(GATHER(lights, light, pmf), 1e-30f);
    UInt a;
    UInt b;
    sample_bits(seed, reversed_index, pair + PAIR_LIGHT, params->sampler, &a, &b);
    Float v1;
    Float v2;
    sample_pair(seed, reversed_index, pair + PAIR_BSDF, params->sampler, &v1, &v2);
    const Vec3 position = vec3(GATHER(lights, light, position[0]), GATHER(lights, light, position[1]),
                               GATHER(lights, light, position[2]));
    const Vec3 axis = vec3(GATHER(lights, light, direction[0]), GATHER(lights, light, direction[1]),
                           GATHER(lights, light, direction[2]));
    const Vec3 intensity = vec3(GATHER(lights, light, intensity[0]), GATHER(lights, light, intensity[1]),
                                GATHER(lights, light, intensity[2]));

    Emission e;
    e.light = light;
    e.point = (a >> 16) | (b & 0xffff0000u);
    e.origin = position;
    e.direction = axis;
    e.power = vec3_all((Float)(0.0f));

#if AREA_LIGHTS
    const Mask on_triangle = active & (kind == LIGHT_TRIANGLE);
    if (any_lane(on_triangle)) {
        const UInt triangle = pick_u(on_triangle, GATHER_U(lights, light, triangle), (UInt)(0u));
        const Vec3 e1 = vec3(GATHER(lights, light, e1[0]), GATHER(lights, light, e1[1]),
                             GATHER(lights, light, e1[2]));
        const Vec3 e2 = vec3(GATHER(lights, light, e2[0]), GATHER(lights, light, e2[1]),
                             GATHER(lights, light, e2[2]));
        Float u1;
        Float u2;
        light_point(e.point, &u1, &u2);
        const UInt flags = GATHER_U(lights, light, flags);
        Float b1;
        Float b2;
        sample_flat(on_triangle, flags, u1, u2, &b1, &b2);
        const Mask two_sided = (flags & MATERIAL_TWO_SIDED_EMISSION) != 0u;
        const Float side = pick(two_sided & (side_bits >= 0x80000000u), (Float)(-1.0f), (Float)(1.0f));
        Vec3 outward = axis;
        Vec3 origin = add_scaled(add_scaled(position, e1, b1), e2, b2);
        Float area = GATHER(lights, light, area);
#if SPHERES
        const Mask round = on_triangle & ((flags & LIGHT_SPHERE) != 0u);
        if (any_lane(round)) {
            const Sphere sphere = fetch_sphere(lights, light);
            const Vec3 n = around(sphere.y, 1.0f - 2.0f * u1, u2);
            Vec3 face;
            const Float r = face_along(sphere, n, &face);
            origin = pick_v(round, add_scaled(sphere.center, n, r), origin);
            outward = pick_v(round, face, outward);
            area = pick(round, area_along((Float)(0.25f * INV_PI), n, r, face), area);
        }
#endif
        outward = scale(outward, side);
        origin = add_scaled(origin, outward, GATHER(lights, light, offset));
        Vec3 emission = intensity;
#if TEXTURES
        emission = textured(on_triangle, emission, GATHER_U(lights, light, emission_texture), triangle, b1,
                            b2 TEXTURE_ARGUMENTS);
#endif
#if ALPHA
        emission = scale(emission, alpha_share(on_triangle, triangle, b1, b2 ALPHA_BUFFER_ARGUMENTS));
#endif
        const Float sides = pick(two_sided, (Float)(2.0f), (Float)(1.0f));
        const Vec3 power = scale(emission, PI * area * sides * weight);
        e.origin = pick_v(on_triangle, origin, e.origin);
        e.direction = pick_v(on_triangle, around(outward, sqrt(1.0f - v1), v2), e.direction);
        e.power = pick_v(on_triangle, power, e.power);
    }
#endif

#if PUNCTUAL_LIGHTS
    const Mask from_point = active & ((kind == LIGHT_POINT) | (kind == LIGHT_SPOT));
    if (any_lane(from_point)) {
        const Float cos_outer = pick(kind == LIGHT_SPOT, GATHER(lights, light, cos_outer), (Float)(-1.0f));
        const Float cosine = 1.0f - v1 * (1.0f - cos_outer);
        const Float ramp = clamp((cosine - cos_outer) * GATHER(lights, light, spot_scale), (Float)(0.0f), (Float)(1.0f));
        const Float share = pick(kind == LIGHT_SPOT, ramp * ramp, (Float)(1.0f));
        const Vec3 power = scale(intensity, 2.0f * PI * (1.0f - cos_outer) * share * weight);
        e.direction = pick_v(from_point, around(axis, cosine, v2), e.direction);
        e.power = pick_v(from_point, power, e.power);
    }
#endif

#if PUNCTUAL_LIGHTS || ENVIRONMENT
    const float radius = params->scene_radius;
    const Mask far = active & ((kind == LIGHT_DIRECTIONAL) | (kind == LIGHT_ENVIRONMENT));
    if (any_lane(far)) {
        Vec3 direction = axis;
        Vec3 irradiance = intensity;
#if ENVIRONMENT
        const Mask in_sky = active & (kind == LIGHT_ENVIRONMENT);
        if (any_lane(in_sky)) {
            Float density;
            Vec3 radiance;
            const Vec3 wi = sample_environment(params,
#if ENVIRONMENT == 2
                                               cells,
#endif
                                               seed, reversed_index, pair, unit_float(a), unit_float(b),
                                               &radiance, &density);
            direction = pick_v(in_sky, scale(wi, (Float)(-1.0f)), direction);
            const Mask lit = density > 0.0f;
            const Float inverse = pick(lit, 1.0f / pick(lit, density, (Float)(1.0f)), (Float)(0.0f));
            irradiance = pick_v(in_sky, scale(radiance, inverse), irradiance);
        }
#endif
        Vec3 s;
        Vec3 t;
        Float c;
        Float si;
        make_frame(direction, &s, &t);
        cos_sin_turns(v2, &c, &si);
        const Float r = sqrt(v1) * radius;
        Vec3 origin = add_scaled(vec3_of(params->scene_center), direction, (Float)(-1.01f * radius));
        origin = add_scaled(add_scaled(origin, s, r * c), t, r * si);
        e.origin = pick_v(far, origin, e.origin);
        e.direction = pick_v(far, direction, e.direction);
        e.power = pick_v(far, scale(irradiance, PI * radius * radius * weight), e.power);
    }
#endif
    return e;
}
