// What samples handed in to be shared, as the filters of path space read it.
#pragma once

#include "lanes.h"
#include "layout.h"

static inline Vec3 load_gate(__global const CellVertex *vertices, UInt pixel)
{
    return vec3(GATHER(vertices, pixel, gate[0]), GATHER(vertices, pixel, gate[1]), GATHER(vertices, pixel, gate[2]));
}

static inline Vec3 load_beyond(__global const Beyond *beyond, UInt pixel)
{
    return vec3(GATHER(beyond, pixel, radiance[0]), GATHER(beyond, pixel, radiance[1]),
                GATHER(beyond, pixel, radiance[2]));
}

#if BASE
/// Part of the light from beyond a sample's vertex that the base of the first surface reflects.
static inline float4 base_share_of(__global const Beyond *beyond, __global const Seen *seen, ulong sample)
{
#if BASE == 2
    const uint vertex = beyond[sample].vertex;
    if ((vertex & VERTEX_MASK) > 1u || (vertex & VERTEX_GLOSSY) != 0u)
        return (float4)(vload3(0, seen[sample].share), 0.0f);
#endif
    return (float4)(1.0f);
}
#endif

/// Width of the cells of a pass, m per m of the path.
static inline float cell_width_of(__global const Params *params, uint pass)
{
    return params->cell_width * exp2(params->cell_shrink * log2((float)(pass - params->first_pass + 1u)));
}

/// Add what a sample of an interrupted first pass gathered behind its vertex, as it is.
static inline void add_as_it_is(
    __global const Params *params,
    __global const float *samples,
    __global const Beyond *beyond,
    __global FilmSum *film,
    uint pixel)
{
    const ulong at = (ulong)(params->first_pass & (params->ring - 1u)) * params->pixel_count + pixel;
    if (vload4(at, samples).w <= 0.0f || beyond[at].vertex == 0u)
        return;
    for (uint c = 0; c < 3; ++c)
        film[pixel].sum[c] += beyond[at].radiance[c];
}
