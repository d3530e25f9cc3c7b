// Texture look-ups: scalar, one lane after the other.
#pragma once

#include "lanes.h"
#include "layout.h"

/// Texel index along one axis, wrapped into [0, size).
inline uint wrap_texel(int i, int size, int clamped, int mirrored)
{
    if (clamped)
        return (uint)clamp(i, 0, size - 1);
    const int period = mirrored ? 2 * size : size;
    int r = i % period;
    r = r < 0 ? r + period : r;
    return (uint)(r < size ? r : period - 1 - r);
}

/// Colour (linear, RGB) and alpha of texture `index` at (u, v).
///
/// A coordinate that is not finite, or too large for its texel to be told, reads texel 0.
inline float4 look_up_texture(
    __global const TextureInfo *textures,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear,
    uint index,
    float u,
    float v)
{
    const TextureInfo info = textures[index];
    const int width = (int)info.width;
    const int height = (int)info.height;
    const int clamp_u = (info.flags & TEXTURE_CLAMP_U) != 0;
    const int clamp_v = (info.flags & TEXTURE_CLAMP_V) != 0;
    const int mirror_u = (info.flags & TEXTURE_MIRROR_U) != 0;
    const int mirror_v = (info.flags & TEXTURE_MIRROR_V) != 0;
    const int nearest = (info.flags & TEXTURE_NEAREST) != 0;

    float x = u * (float)width - (nearest ? 0.0f : 0.5f);
    float y = v * (float)height - (nearest ? 0.0f : 0.5f);
    x = fabs(x) < 1e9f ? x : 0.0f;
    y = fabs(y) < 1e9f ? y : 0.0f;
    const float x0 = floor(x);
    const float y0 = floor(y);
    const float fx = nearest ? 0.0f : x - x0;
    const float fy = nearest ? 0.0f : y - y0;

    float4 sum = (float4)(0.0f);
    for (int k = 0; k < 4; ++k) {
        const float weight = ((k & 1) ? fx : 1.0f - fx) * ((k & 2) ? fy : 1.0f - fy);
        if (weight > 0.0f) {
            const uint i = wrap_texel((int)x0 + (k & 1), width, clamp_u, mirror_u);
            const uint j = wrap_texel((int)y0 + (k >> 1), height, clamp_v, mirror_v);
            const uchar4 texel = texels[info.offset + j * info.width + i];
            float4 c = convert_float4(texel) * (1.0f / 255.0f);
            if (info.flags & TEXTURE_SRGB) {
                c.x = srgb_to_linear[texel.x];
                c.y = srgb_to_linear[texel.y];
                c.z = srgb_to_linear[texel.z];
            }
            sum += weight * c;
        }
    }
    return sum;
}

/// Texture coordinates of a point of a triangle.
inline float2 triangle_uv(__global const Uvs *uvs, uint triangle, float u, float v)
{
    const Uvs c = uvs[triangle];
    const float w = 1.0f - u - v;
    return (float2)(w * c.uv0[0] + u * c.uv1[0] + v * c.uv2[0],
                    w * c.uv0[1] + u * c.uv1[1] + v * c.uv2[1]);
}

/// Multiply `color` by a texture in the lanes of `mask`; `texture` may be NO_TEXTURE.
LARGE_FUNCTION Vec3 textured(
    Mask mask,
    Vec3 color,
    UInt texture,
    UInt triangle,
    Float u,
    Float v,
    __global const Uvs *uvs,
    __global const TextureInfo *textures,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear)
{
    mask &= texture != NO_TEXTURE;
    if (!any_lane(mask))
        return color;
    uint index[W];
    uint id[W];
    float lane_u[W];
    float lane_v[W];
    float r[W];
    float g[W];
    float b[W];
    store_lanes_u(pick_u(mask, texture, (UInt)(NO_TEXTURE)), index);
    store_lanes_u(triangle, id);
    store_lanes(u, lane_u);
    store_lanes(v, lane_v);
    for (uint k = 0; k < W; ++k) {
        float4 c = (float4)(1.0f);
        if (index[k] != NO_TEXTURE) {
            const float2 uv = triangle_uv(uvs, id[k], lane_u[k], lane_v[k]);
            c = look_up_texture(textures, texels, srgb_to_linear, index[k], uv.x, uv.y);
        }
        r[k] = c.x;
        g[k] = c.y;
        b[k] = c.z;
    }
    return mul(color, vec3(load_lanes(r), load_lanes(g), load_lanes(b)));
}
