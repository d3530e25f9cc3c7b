// Cut-out surfaces: whether a hit is really there.  Include before traverse.h.
#pragma once

#include "lanes.h"
#include "texture.h"

#if ALPHA

#define ALPHA_PARAMETERS                                                                           \
    , __global const Surface *surfaces, __global const Material *materials,                        \
        __global const Uvs *uvs, __global const TextureInfo *textures,                             \
        __global const uchar4 *texels, __global const float *srgb_to_linear
#define ALPHA_ARGUMENTS , surfaces, materials, uvs, textures, texels, srgb_to_linear

/// Whether the alpha of the triangle at barycentrics (u, v) reaches its material's cutoff.
inline int alpha_passes(uint triangle, float u, float v ALPHA_PARAMETERS)
{
    __global const Material *material = &materials[surfaces[triangle].material];
    if (material->base_color_texture == NO_TEXTURE)
        return 1;
    const float2 uv = triangle_uv(uvs, triangle, u, v);
    const float4 texel =
        look_up_texture(textures, texels, srgb_to_linear, material->base_color_texture, uv.x, uv.y);
    return texel.w >= material->alpha_cutoff;
}

/// The same for the lanes of `mask`, true also where the material is not cut out.
inline Mask alpha_passes_lanes(Mask mask, UInt triangle, Float u, Float v ALPHA_PARAMETERS)
{
    const UInt material = GATHER_U(surfaces, triangle, material);
    mask &= (GATHER_U(materials, material, flags) & MATERIAL_ALPHA_MASK) != 0u;
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
        there[k] = wanted[k] == 0.0f || alpha_passes(id[k], lane_u[k], lane_v[k] ALPHA_ARGUMENTS);
    return load_lanes(there) != 0.0f;
}
#else
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif
