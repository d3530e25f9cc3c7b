// The rays of all lanes through the scene: a tree, or every triangle where there are FEW.
//
// GEOMETRY_PARAMETERS are what a kernel needs for it.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "few.h"
#include "traverse.h"

#if FEW
#define GEOMETRY_PARAMETERS __global const float *corners, __global const uint *faces ALPHA_PARAMETERS
#define GEOMETRY_ARGUMENTS corners, faces ALPHA_ARGUMENTS
#else
#define GEOMETRY_PARAMETERS                                                                        \
    __global const BvhNode *nodes, __global const TriangleBlock *blocks ALPHA_PARAMETERS
#define GEOMETRY_ARGUMENTS nodes, blocks ALPHA_ARGUMENTS
#endif

/// Return what the rays of the lanes in `active` hit first; the others hit nothing.
inline Hits closest_hits(
    __global const Params *params, Mask active, Vec3 origin, Vec3 direction, GEOMETRY_PARAMETERS)
{
#if FEW
    return trace_closest_few(params, active, origin, direction, GEOMETRY_ARGUMENTS);
#else
    RaySetups rays;
    set_up_rays(&rays, active, origin, direction, (Float)(INFINITY));
    float t[W];
    float u[W];
    float v[W];
    uint triangle[W];
    for (uint k = 0; k < W; ++k) {
        const RaySetup ray = ray_setup(&rays, k);
        const Hit hit = trace_closest(nodes, blocks, &ray ALPHA_ARGUMENTS);
        t[k] = hit.t;
        u[k] = hit.u;
        v[k] = hit.v;
        triangle[k] = hit.triangle;
    }
    Hits hits;
    hits.t = load_lanes(t);
    hits.u = load_lanes(u);
    hits.v = load_lanes(v);
    hits.triangle = load_lanes_u(triangle);
    return hits;
#endif
}

/// Return for the lanes in `active` whether anything lies between `origin` and `origin` + `toward`.
inline Mask blocked_rays(
    __global const Params *params, Mask active, Vec3 origin, Vec3 toward, GEOMETRY_PARAMETERS)
{
#if FEW
    return trace_any_few(params, active, origin, toward, GEOMETRY_ARGUMENTS);
#else
    RaySetups rays;
    set_up_rays(&rays, active, origin, toward, (Float)(1.0f));
    uint blocked[W];
    for (uint k = 0; k < W; ++k) {
        const RaySetup ray = ray_setup(&rays, k);
        blocked[k] = trace_any(nodes, blocks, &ray ALPHA_ARGUMENTS);
    }
    return load_lanes_u(blocked) != 0u;
#endif
}
