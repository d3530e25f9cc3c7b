// Where points of triangles that move were in the frame before.
#pragma once

#include "lanes.h"
#include "layout.h"

/// Where the point of `triangle` at barycentrics (u, v), now at `p`, was in the frame before.
static inline Vec3 previous_point(
    __global const Params *params, __global const Corners *previous, UInt triangle, Float u, Float v, Vec3 p)
{
    const Mask moves = triangle >= params->first_moving;
    if (!any_lane(moves))
        return p;
    const UInt at = pick_u(moves, triangle - params->first_moving, (UInt)(0u));
    const Float w = 1.0f - u - v;
    const Vec3 before =
        vec3(w * GATHER(previous, at, p[0]) + u * GATHER(previous, at, p[3]) + v * GATHER(previous, at, p[6]),
             w * GATHER(previous, at, p[1]) + u * GATHER(previous, at, p[4]) + v * GATHER(previous, at, p[7]),
             w * GATHER(previous, at, p[2]) + u * GATHER(previous, at, p[5]) + v * GATHER(previous, at, p[8]));
    return pick_v(moves, before, p);
}
