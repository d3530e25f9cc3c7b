// Surfaces that are there in part: masks, and blending by chance.  Include before traverse.h.
//
// With blending (ALPHA 2) a ray has a seed, and the random number of a hit is a function of that and the
// triangle: the same whatever else the ray meets, in whatever order.  With BACK_FACES a ray also says
// whether it is the camera's (sides.h); what both take goes by the name of ALPHA.
#pragma once

#include "lanes.h"
#include "rng.h"
#include "texture.h"

// What functions need of their rays, beside the kernel's buffers.
#if ALPHA == 2
#define SEED_PARAMETER , const uint *ray_seeds
#define SEED_ARGUMENT_OF(lane) , ray_seeds + (lane)
#else
#define SEED_PARAMETER
#define SEED_ARGUMENT_OF(lane)
#endif
#if BACK_FACES
#define RAY_PARAMETERS SEED_PARAMETER, const uint *camera_rays
#define RAY_ARGUMENTS_OF(lane) SEED_ARGUMENT_OF(lane), camera_rays + (lane)
#else
#define RAY_PARAMETERS SEED_PARAMETER
#define RAY_ARGUMENTS_OF(lane) SEED_ARGUMENT_OF(lane)
#endif
#define RAY_ARGUMENTS RAY_ARGUMENTS_OF(0)

#if ALPHA || BACK_FACES
// What a kernel needs.
#define ALPHA_BUFFERS                                                                              \
    , __global const Surface *surfaces,                                                            \
        __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS
#define ALPHA_BUFFER_ARGUMENTS , surfaces, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS
#define ALPHA_PARAMETERS ALPHA_BUFFERS RAY_PARAMETERS
#define ALPHA_ARGUMENTS ALPHA_BUFFER_ARGUMENTS RAY_ARGUMENTS
#define ALPHA_ARGUMENTS_OF(lane) ALPHA_BUFFER_ARGUMENTS RAY_ARGUMENTS_OF(lane)
#else
#define ALPHA_BUFFERS
#define ALPHA_BUFFER_ARGUMENTS
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#define ALPHA_ARGUMENTS_OF(lane)
#endif

#if ALPHA

/// Opacity of a triangle at barycentrics (u, v).
static inline float opacity(
    __global const Material *material, uint triangle, float u, float v TEXTURE_PARAMETERS COLOR_PARAMETERS)
{
    float alpha = material->alpha;
#if VERTEX_COLORS
    alpha *= (1.0f - u - v) * colors[triangle].c0[3] + u * colors[triangle].c1[3] + v * colors[triangle].c2[3];
#endif
    const uint texture = material->base_color_texture;
    if (texture != NO_TEXTURE)
        alpha *= look_up_on_triangle(uvs, textures, texels, srgb_to_linear, texture, triangle, u, v).w;
    return alpha;
}

/// Whether a hit on the triangle at barycentrics (u, v) is there.
static inline int alpha_passes(uint triangle, float u, float v ALPHA_PARAMETERS)
{
    __global const Material *material = &materials[surfaces[triangle].material];
    const float alpha = opacity(material, triangle, u, v TEXTURE_ARGUMENTS COLOR_ARGUMENTS);
#if ALPHA == 2
    if (material->flags & MATERIAL_ALPHA_BLEND) {
        // The mixer of rng.h, for one lane.
        uint x = *ray_seeds ^ triangle * 0x9e3779b9u;
        x = (x ^ (x >> 16)) * 0x7feb352du;
        x = (x ^ (x >> 15)) * 0x846ca68bu;
        return (float)((x ^ (x >> 16)) >> 8) * 5.9604645e-8f < alpha;
    }
#endif
    return alpha >= material->alpha_cutoff;
}

/// The same for the lanes of `mask`, true also where the material is opaque.
static inline Mask alpha_passes_lanes(Mask mask, UInt triangle, Float u, Float v ALPHA_PARAMETERS)
{
    const UInt material = GATHER_U(surfaces, triangle, material);
    mask &= (GATHER_U(materials, material, flags) & (MATERIAL_ALPHA_MASK | MATERIAL_ALPHA_BLEND)) != 0u;
    if (!any_lane(mask))
        return MASK_ALL;
    float wanted[W];
    uint id[W];
    float lane_u[W];
    float lane_v[W];
    float there[W];
    store_lanes(pick(mask, (Float)(1.0f), (Float)(0.0f)), wanted);
    store_lanes_u(triangle, id);
    store_lanes(u, lane_u);
    store_lanes(v, lane_v);
    for (uint k = 0; k < W; ++k)
        there[k] = wanted[k] == 0.0f || alpha_passes(id[k], lane_u[k], lane_v[k] ALPHA_ARGUMENTS_OF(k));
    return load_lanes(there) != 0.0f;
}

/// Share of the light that points of the lanes of `mask` block or give: 0 or 1 for a mask.
static inline Float alpha_share(Mask mask, UInt triangle, Float u, Float v ALPHA_BUFFERS)
{
    const UInt material = GATHER_U(surfaces, triangle, material);
    const UInt flags = GATHER_U(materials, material, flags);
    mask &= (flags & (MATERIAL_ALPHA_MASK | MATERIAL_ALPHA_BLEND)) != 0u;
    if (!any_lane(mask))
        return (Float)(1.0f);
    Float alpha;
    look_up_lanes(mask, GATHER_U(materials, material, base_color_texture), triangle, u, v TEXTURE_ARGUMENTS,
                  &alpha);
    alpha *= GATHER(materials, material, alpha);
#if VERTEX_COLORS
    alpha *= (1.0f - u - v) * GATHER(colors, triangle, c0[3]) + u * GATHER(colors, triangle, c1[3])
             + v * GATHER(colors, triangle, c2[3]);
#endif
    const Mask there = alpha >= GATHER(materials, material, alpha_cutoff);
    alpha = pick((flags & MATERIAL_ALPHA_MASK) != 0u, pick(there, (Float)(1.0f), (Float)(0.0f)), alpha);
    return pick(mask, alpha, (Float)(1.0f));
}

#endif

// Before rays are traced: seeds of the paths' rays number `number`, if a hit may be left to chance, and
// which of them are the camera's: the first, number 0.
#if ALPHA == 2
#define DEFINE_RAY_SEEDS(path, number)                                                             \
    uint ray_seeds[W];                                                                             \
    store_lanes_u(mix_bits(get_u(path, PATH_SEED)                                                  \
                           ^ mix_bits(get_u(path, PATH_SAMPLE) * 0x9e3779b9u + (number))),         \
                  ray_seeds);
#else
#define DEFINE_RAY_SEEDS(path, number)
#endif
#if BACK_FACES
#define DEFINE_RAY_TRAITS(path, number)                                                            \
    DEFINE_RAY_SEEDS(path, number)                                                                 \
    uint camera_rays[W];                                                                           \
    store_lanes_u(pick_u((number) == 0u, (UInt)(1u), (UInt)(0u)), camera_rays)
#else
#define DEFINE_RAY_TRAITS(path, number) DEFINE_RAY_SEEDS(path, number)
#endif
