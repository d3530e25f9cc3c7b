// Texture look-ups: of all lanes for shading, of one where traversal meets a cut-out.
#pragma once

#include "lanes.h"
#include "layout.h"

// What a function needs to look textures up, or to pass that on.
#if TEXTURES || ALPHA
#define TEXTURE_PARAMETERS                                                                         \
    , __global const Uvs *uvs, __global const TextureInfo *textures,                               \
        __global const uchar4 *texels, __global const float *srgb_to_linear
#define TEXTURE_ARGUMENTS , uvs, textures, texels, srgb_to_linear
#else
#define TEXTURE_PARAMETERS
#define TEXTURE_ARGUMENTS
#endif

// The same for the colours of corners.
#if VERTEX_COLORS
#define COLOR_PARAMETERS , __global const VertexColors *colors
#define COLOR_ARGUMENTS , colors
#else
#define COLOR_PARAMETERS
#define COLOR_ARGUMENTS
#endif

/// Texel index along one axis, wrapped into [0, size).
static inline uint wrap_texel(int i, int size, int clamped, int mirrored)
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
static inline float4 look_up_texture(
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
    // From here on a float does not tell texels apart; NaN fails as well.
    x = fabs(x) < 0x1p23f ? x : 0.0f;
    y = fabs(y) < 0x1p23f ? y : 0.0f;
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

/// The two texels beside coordinate `x` along one axis, and the second one's weight, for all lanes.
static inline Float wrap_texels(
    Float x, Float size, Mask clamped, Mask mirrored, Mask nearest, UInt *first, UInt *second)
{
    x = x * size - pick(nearest, (Float)(0.0f), (Float)(0.5f));
    // From here on a float does not tell texels apart; NaN fails as well.
    x = pick(fabs(x) < 0x1p23f, x, (Float)(0.0f));
    const Float low = floor(x);
    const Float period = pick(mirrored, size + size, size);
    // The quotient may be off by one where it is nearly an integer.
    Float a = low - floor(low / period) * period;
    a = pick(a < 0.0f, a + period, a);
    a = pick(a >= period, a - period, a);
    Float b = a + 1.0f;
    b = pick(b >= period, (Float)(0.0f), b);
    a = pick(a < size, a, period - 1.0f - a);
    b = pick(b < size, b, period - 1.0f - b);
    const Float last = size - 1.0f;
    *first = to_uint(pick(clamped, clamp(low, (Float)(0.0f), last), a));
    *second = to_uint(pick(clamped, clamp(low + 1.0f, (Float)(0.0f), last), b));
    return pick(nearest, (Float)(0.0f), x - low);
}

/// Add a texel of all lanes to a colour and its alpha.
static inline void add_texel(
    UInt at,
    Float weight,
    Mask srgb,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear,
    Vec3 *color,
    Float *alpha)
{
    const UInt texel = GATHER_WORD((__global const uint *)texels, at);
    const UInt r = texel & 255u;
    const UInt g = texel >> 8 & 255u;
    const UInt b = texel >> 16 & 255u;
    Vec3 c = scale(vec3(to_float(r), to_float(g), to_float(b)), (Float)(1.0f / 255.0f));
    if (any_lane(srgb))
        c = pick_v(srgb, vec3(gather_words(srgb_to_linear, r), gather_words(srgb_to_linear, g),
                              gather_words(srgb_to_linear, b)), c);
    *color = add_scaled(*color, c, weight);
    *alpha += weight * (1.0f / 255.0f) * to_float(texel >> 24);
}

/// As look_up_texture for all lanes; `index` is that of a texture in every lane.
LARGE_FUNCTION Vec3 look_up_textures(
    __global const TextureInfo *textures,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear,
    UInt index,
    Float u,
    Float v,
    Float *alpha)
{
    const UInt offset = GATHER_U(textures, index, offset);
    const UInt width = GATHER_U(textures, index, width);
    const UInt height = GATHER_U(textures, index, height);
    const UInt flags = GATHER_U(textures, index, flags);
    const Mask nearest = (flags & TEXTURE_NEAREST) != 0u;
    const Mask srgb = (flags & TEXTURE_SRGB) != 0u;
    UInt i0;
    UInt i1;
    UInt j0;
    UInt j1;
    const Float fx = wrap_texels(u, to_float(width), (flags & TEXTURE_CLAMP_U) != 0u,
                                 (flags & TEXTURE_MIRROR_U) != 0u, nearest, &i0, &i1);
    const Float fy = wrap_texels(v, to_float(height), (flags & TEXTURE_CLAMP_V) != 0u,
                                 (flags & TEXTURE_MIRROR_V) != 0u, nearest, &j0, &j1);
    const UInt row0 = offset + j0 * width;
    const UInt row1 = offset + j1 * width;
    Vec3 color = vec3_all((Float)(0.0f));
    *alpha = (Float)(0.0f);
    add_texel(row0 + i0, (1.0f - fx) * (1.0f - fy), srgb, texels, srgb_to_linear, &color, alpha);
    add_texel(row0 + i1, fx * (1.0f - fy), srgb, texels, srgb_to_linear, &color, alpha);
    add_texel(row1 + i0, (1.0f - fx) * fy, srgb, texels, srgb_to_linear, &color, alpha);
    add_texel(row1 + i1, fx * fy, srgb, texels, srgb_to_linear, &color, alpha);
    return color;
}

/// Colour and alpha of texture `index` at a point of a triangle.
static inline float4 look_up_on_triangle(
    __global const Uvs *uvs,
    __global const TextureInfo *textures,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear,
    uint index,
    uint triangle,
    float u,
    float v)
{
    __global const TextureInfo *info = &textures[index];
    const Uvs c = uvs[triangle + info->uv_offset];
    const float w = 1.0f - u - v;
    const float s = w * c.uv0[0] + u * c.uv1[0] + v * c.uv2[0];
    const float t = w * c.uv0[1] + u * c.uv1[1] + v * c.uv2[1];
    __global const float *m = info->matrix;
    return look_up_texture(textures, texels, srgb_to_linear, index, m[0] * s + m[1] * t + m[2],
                           m[3] * s + m[4] * t + m[5]);
}

/// Colour and alpha of a texture in the lanes of `mask`; all 1 elsewhere and for NO_TEXTURE.
LARGE_FUNCTION Vec3 look_up_lanes(
    Mask mask,
    UInt texture,
    UInt triangle,
    Float u,
    Float v,
    __global const Uvs *uvs,
    __global const TextureInfo *textures,
    __global const uchar4 *texels,
    __global const float *srgb_to_linear,
    Float *alpha)
{
    *alpha = (Float)(1.0f);
    mask &= texture != NO_TEXTURE;
    if (!any_lane(mask))
        return vec3_all((Float)(1.0f));
    const UInt index = pick_u(mask, texture, (UInt)(0u));
    const UInt at = pick_u(mask, triangle + GATHER_U(textures, index, uv_offset), (UInt)(0u));
    const Float w = 1.0f - u - v;
    const Float s = w * GATHER(uvs, at, uv0[0]) + u * GATHER(uvs, at, uv1[0]) + v * GATHER(uvs, at, uv2[0]);
    const Float t = w * GATHER(uvs, at, uv0[1]) + u * GATHER(uvs, at, uv1[1]) + v * GATHER(uvs, at, uv2[1]);
    const Float x = GATHER(textures, index, matrix[0]) * s + GATHER(textures, index, matrix[1]) * t
                    + GATHER(textures, index, matrix[2]);
    const Float y = GATHER(textures, index, matrix[3]) * s + GATHER(textures, index, matrix[4]) * t
                    + GATHER(textures, index, matrix[5]);
    Float found_alpha;
    const Vec3 color = look_up_textures(textures, texels, srgb_to_linear, index, x, y, &found_alpha);
    *alpha = pick(mask, found_alpha, (Float)(1.0f));
    return pick_v(mask, color, vec3_all((Float)(1.0f)));
}

/// Multiply `color` by a texture in the lanes of `mask`; `texture` may be NO_TEXTURE.
static inline Vec3 textured(
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
    Float alpha;
    return mul(color, look_up_lanes(mask, texture, triangle, u, v, uvs, textures, texels, srgb_to_linear, &alpha));
}

#if TEXTURE_LEVELS
/// Whole part of the binary logarithm of x >= 1; large where x is no number.
static inline UInt whole_log2(Float x) { return ((as_bits(x) >> 23) & 255u) - 127u; }

/// The level of `texture` whose texels are about as large as `footprint`, in m^2, on a triangle.
static inline UInt level_for(
    Mask mask,
    UInt texture,
    UInt triangle,
    Float footprint,
    __global const Uvs *uvs,
    __global const TextureInfo *textures)
{
    mask &= (texture != NO_TEXTURE) & (footprint > 0.0f);
    if (!any_lane(mask))
        return texture;
    const UInt index = pick_u(mask, texture, (UInt)(0u));
    const UInt smaller = GATHER_U(textures, index, smaller);
    mask &= smaller != 0u;
    if (!any_lane(mask))
        return texture;
    const UInt at = pick_u(mask, triangle + GATHER_U(textures, index, uv_offset), (UInt)(0u));
    const Float width = to_float(GATHER_U(textures, index, width));
    const Float height = to_float(GATHER_U(textures, index, height));
    const Float turn = fabs(GATHER(textures, index, matrix[0]) * GATHER(textures, index, matrix[4])
                            - GATHER(textures, index, matrix[1]) * GATHER(textures, index, matrix[3]));
    const Float covered = footprint * GATHER(uvs, at, density) * turn * width * height;
    const UInt last = whole_log2(max(width, height));
    const UInt level = min(whole_log2(max(covered, 1.0f)) >> 1, last);
    return pick_u(mask & (level > 0u), smaller + level - 1u, texture);
}
#endif

#if VERTEX_COLORS
/// Colour at a point of a triangle.
static inline Vec3 corner_color(UInt triangle, Float u, Float v, __global const VertexColors *colors)
{
    const Float w = 1.0f - u - v;
    return vec3(w * GATHER(colors, triangle, c0[0]) + u * GATHER(colors, triangle, c1[0])
                    + v * GATHER(colors, triangle, c2[0]),
                w * GATHER(colors, triangle, c0[1]) + u * GATHER(colors, triangle, c1[1])
                    + v * GATHER(colors, triangle, c2[1]),
                w * GATHER(colors, triangle, c0[2]) + u * GATHER(colors, triangle, c1[2])
                    + v * GATHER(colors, triangle, c2[2]));
}
#endif
