// Cut-out surfaces: whether a hit is really there.  Include before traverse.h.
#pragma once

#if ALPHA
#include "texture.h"

#define ALPHA_PARAMETERS                                                                           \
    , __global const Surface *surfaces, __global const Material *materials,                        \
        __global const Uvs *uvs, __global const TextureInfo *textures,                             \
        __global const uchar4 *texels, __global const float *srgb_to_linear
#define ALPHA_ARGUMENTS , surfaces, materials, uvs, textures, texels, srgb_to_linear

/// Whether the alpha of the triangle at barycentrics (u, v) reaches its material's cutoff.
inline int alpha_passes(uint triangle, float u, float v ALPHA_PARAMETERS)
{
    __global const Material *material = &materials[surfaces[triangle].material];
    float alpha = 1.0f;
    if (material->base_color_texture != NO_TEXTURE) {
        const float2 uv = triangle_uv(uvs, triangle, u, v);
        alpha = look_up_texture(textures, texels, srgb_to_linear, material->base_color_texture, uv.x, uv.y).w;
    }
    return alpha >= material->alpha_cutoff;
}
#else
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif
