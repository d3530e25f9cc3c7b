// The rays of all lanes through the scene: a tree, one of two levels, or all triangles of FEW.
//
// GEOMETRY_BUFFERS are what a kernel needs for it; before it calls, it says DEFINE_RAY_TRAITS.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "plates.h"
#include "traverse.h"
#include "instances.h"

#if FEW
#define TRIANGLE_BUFFERS LIST_BUFFERS
#define TRIANGLE_ARGUMENTS LIST_ARGUMENTS
#elif INSTANCES
#define TRIANGLE_BUFFERS                                                                           \
    __global const BvhNode *nodes, __global const TriangleBlock *blocks, __global const Instance *instances
#define TRIANGLE_ARGUMENTS nodes, blocks, instances
#else
#define TRIANGLE_BUFFERS __global const BvhNode *nodes, __global const TriangleBlock *blocks
#define TRIANGLE_ARGUMENTS nodes, blocks
#endif
#define GEOMETRY_BUFFERS TRIANGLE_BUFFERS ALPHA_BUFFERS
#define GEOMETRY_BUFFER_ARGUMENTS TRIANGLE_ARGUMENTS ALPHA_BUFFER_ARGUMENTS
#define GEOMETRY_ARGUMENTS TRIANGLE_ARGUMENTS ALPHA_ARGUMENTS
#define GEOMETRY_PARAMETERS TRIANGLE_BUFFERS ALPHA_PARAMETERS

/// Return what the rays of the lanes in `active` hit first; the others hit nothing.
static inline Hits closest_hits(
    __global const Params *params, Mask active, Vec3 origin, Vec3 direction, GEOMETRY_PARAMETERS)
{
#if FEW
    return trace_closest_few(params, active, origin, direction, GEOMETRY_ARGUMENTS);
#else
    RaySetups rays;
    set_up_rays(&rays, active, origin, direction, (Float)(INFINITY));
#if INSTANCES
    return trace_closest_levels(nodes, blocks, instances, &rays, origin, direction ALPHA_ARGUMENTS);
#else
    return trace_closest(nodes, blocks, &rays ALPHA_ARGUMENTS);
#endif
#endif
}

/// The same for what lies between `origin` and `origin` + `toward`, where t is 1.
static inline Hits closest_hits_before(
    __global const Params *params, Mask active, Vec3 origin, Vec3 toward, GEOMETRY_PARAMETERS)
{
#if FEW
    Hits hits = trace_closest_few(params, active, origin, toward, GEOMETRY_ARGUMENTS);
    hits.triangle = pick_u(hits.t < 1.0f, hits.triangle, (UInt)(NO_HIT));
    return hits;
#else
    RaySetups rays;
    set_up_rays(&rays, active, origin, toward, (Float)(1.0f));
#if INSTANCES
    return trace_closest_levels(nodes, blocks, instances, &rays, origin, toward ALPHA_ARGUMENTS);
#else
    return trace_closest(nodes, blocks, &rays ALPHA_ARGUMENTS);
#endif
#endif
}

/// Return for the lanes in `active` whether anything lies between `origin` and `origin` + `toward`.
static inline Mask blocked_rays(
    __global const Params *params, Mask active, Vec3 origin, Vec3 toward, GEOMETRY_PARAMETERS)
{
#if FEW
    return trace_any_few(params, active, origin, toward, GEOMETRY_ARGUMENTS);
#else
    RaySetups rays;
    set_up_rays(&rays, active, origin, toward, (Float)(1.0f));
#if INSTANCES
    return trace_any_levels(nodes, blocks, instances, &rays, origin, toward ALPHA_ARGUMENTS);
#else
    return trace_any(nodes, blocks, &rays ALPHA_ARGUMENTS);
#endif
#endif
}
