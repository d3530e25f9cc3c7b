// What of a path is shared: the vertex behind which light goes to a cell, and that light; what of it the
// base of the first surface reflected.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "pool.h"
#include "unit_vector.h"

#if CELLS
/// Whether the sky is even where it has this radiance: its shadows are soft.
static inline Mask is_even_sky(__global const Params *params, Vec3 radiance)
{
    return luminance(radiance) <= params->sky_limit;
}

/// Whether light that arrives at the vertex of `depth`, which found it itself, is shared; `even` where it is
/// that of an even sky.
static inline Mask shares_emission(__global const Params *params, UInt vertex, UInt depth, Mask even)
{
    const UInt direct = pick_u(even, (UInt)(1u), (UInt)(params->filter_direct));
    return (vertex != 0u) & (depth + direct > vertex);
}

/// Whether light of a shadow ray from the vertex of `depth` is shared.
static inline Mask shares_connection(__global const Params *params, UInt vertex, UInt depth, Mask even)
{
    const UInt direct = pick_u(even, (UInt)(1u), (UInt)(params->filter_direct));
    return (vertex != 0u) & (depth + direct >= vertex);
}

/// Add radiance to what a path gathered: `share` of the lanes of `shared` to what came from beyond its
/// vertex.  Returns the rest, which goes straight to the pixel.
static inline Vec3 gather_light(__global Float *path, Mask shared, Vec3 share, Vec3 radiance)
{
    const Vec3 part = pick_v(shared, mul(share, radiance), vec3_all((Float)(0.0f)));
    const Vec3 rest = sub(radiance, part);
    put_v(path, PATH_RADIANCE_R, add(get_v(path, PATH_RADIANCE_R), rest));
    put_v(path, PATH_BEYOND_R, add(get_v(path, PATH_BEYOND_R), part));
    return rest;
}

/// Whether this vertex is the one whose light is shared.
///
/// `spread` is the density of the direction that led here: a wide lobe has a low one.  A lobe's share
/// of the surface is about distance^2 / density.
static inline Mask wants_cell(__global const Params *params, UInt depth, Float length, Float distance, Float spread)
{
    if (params->filter_vertex != FILTER_AUTO)
        return depth + 1u >= params->filter_vertex;
    const Float width = params->cell_width * length;
    return (depth > 0u) & (distance * distance > width * width * max(spread, 3.0f));
}

/// VERTEX_NEAR where the path has just met a surface within a cell of the vertex whose light it shares, with
/// the side that the surface faces.
///
/// In corners and slits the light changes within a cell; samples of near and of far light have cells of
/// their own, so that each place gets both in the parts in which it sees them.
static inline UInt near_bit(
    __global const Params *params, Mask hit, UInt vertex, UInt depth, Float length, Float distance, Vec3 ng)
{
    const Mask next = hit & (vertex != 0u) & (depth == vertex);
    return pick_u(next & (distance < params->cell_width * (length - distance)),
                  VERTEX_NEAR | (cube_face(ng) << VERTEX_FACE_SHIFT), (UInt)(0u));
}

/// Hand in the vertices of the lanes in `chosen`; `ng` is packed.
static inline void store_cell_vertices(
    __global const Params *params,
    __global CellVertex *vertices,
    Mask chosen,
    UInt sample,
    UInt pixel,
    Vec3 p,
    UInt ng,
    Vec3 gate,
    Float length)
{
    uint lane_sample[W];
    uint lane_pixel[W];
    uint lane_ng[W];
    float lane_value[7][W];
    store_lanes_u(sample & (params->ring - 1u), lane_sample);
    store_lanes_u(pixel, lane_pixel);
    store_lanes_u(ng, lane_ng);
    const Float values[7] = {p.x, p.y, p.z, gate.x, gate.y, gate.z, length};
    for (uint c = 0; c < 7; ++c)
        store_lanes(values[c], lane_value[c]);
    for (uint left = lane_bits(chosen); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        const ulong at = (ulong)lane_sample[k] * params->pixel_count + lane_pixel[k];
        vstore8((float8)(lane_value[0][k], lane_value[1][k], lane_value[2][k], as_float(lane_ng[k]),
                         lane_value[3][k], lane_value[4][k], lane_value[5][k], lane_value[6][k]),
                at, (__global float *)vertices);
    }
}
#endif

#if BASE
/// Keep apart what the base of the first surface reflected of radiance that goes straight to the pixel:
/// `share` of the lanes of `reflected`.
static inline void keep_base(__global Float *path, Mask reflected, Vec3 share, Vec3 radiance)
{
    const Vec3 part = pick_v(reflected, mul(share, radiance), vec3_all((Float)(0.0f)));
    put_v(path, PATH_BASE_R, add(get_v(path, PATH_BASE_R), part));
}
#endif
