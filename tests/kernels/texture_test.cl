// The functions of texture.h, one look-up a lane.

#include "planes.h"
#include "../../cl/common/texture.h"

kernel void look_up(
    global const TextureInfo *textures,
    global const uchar4 *texels,
    global const float *srgb_to_linear,
    global const uint *index,
    global const float *uv,
    global float *colors)
{
    uint id[W];
    float u[W];
    float v[W];
    float c[4][W];
    store_lanes_u(LOAD_U(index, 0), id);
    store_lanes(LOAD(uv, 0), u);
    store_lanes(LOAD(uv, 1), v);
    for (uint k = 0; k < W; ++k) {
        const float4 color = look_up_texture(textures, texels, srgb_to_linear, id[k], u[k], v[k]);
        c[0][k] = color.x;
        c[1][k] = color.y;
        c[2][k] = color.z;
        c[3][k] = color.w;
    }
    for (uint k = 0; k < 4; ++k)
        STORE(colors, k, load_lanes(c[k]));
}

/// The same by the function that looks up all lanes at once.
kernel void look_up_all(
    global const TextureInfo *textures,
    global const uchar4 *texels,
    global const float *srgb_to_linear,
    global const uint *index,
    global const float *uv,
    global float *colors)
{
    Float alpha;
    store_vec3(colors, 0, look_up_textures(textures, texels, srgb_to_linear, LOAD_U(index, 0), LOAD(uv, 0),
                                           LOAD(uv, 1), &alpha));
    STORE(colors, 3, alpha);
}

/// barycentrics: of the second and third corner.
kernel void color_points(
    global const TextureInfo *textures,
    global const uchar4 *texels,
    global const float *srgb_to_linear,
    global const Uvs *uvs,
    global const uint *mask,
    global const uint *index,
    global const uint *triangle,
    global const float *barycentrics,
    global const float *color,
    global float *colors)
{
    store_vec3(colors, 0,
               textured(LOAD_U(mask, 0) != 0u, LOAD_V(color, 0), LOAD_U(index, 0), LOAD_U(triangle, 0),
                        LOAD(barycentrics, 0), LOAD(barycentrics, 1), uvs, textures, texels, srgb_to_linear));
}
