// The traversal over arrays of rays.  CUT_OUT: hits on triangles with ALPHA_BIT count where u < v.

#include "../../cl/common/layout.h"

#if CUT_OUT
#define ALPHA 1
#define ALPHA_PARAMETERS , const uint inverted
#define ALPHA_ARGUMENTS , inverted

static inline int alpha_passes(uint triangle, float u, float v ALPHA_PARAMETERS)
{
    return inverted ? u >= v : u < v;
}
#else
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif

#include "../../cl/common/traverse.h"

static inline Ray load_ray(global const float *rays, uint i)
{
    Ray ray;
    for (uint axis = 0; axis < 3; ++axis) {
        ray.origin[axis] = rays[7 * (size_t)i + axis];
        ray.direction[axis] = rays[7 * (size_t)i + 3 + axis];
    }
    ray.t_max = rays[7 * (size_t)i + 6];
    return ray;
}

/// reads   rays[7 * i + (0..6)]: origin, direction, t_max
/// writes  triangles[i]; distances[3 * i + (0..2)]: t, u, v
kernel void trace_closest_rays(
    global const BvhNode *nodes,
    global const TriangleBlock *blocks,
    global const float *rays,
    global uint *triangles,
    global float *distances,
    const uint ray_count,
    const uint inverted)
{
    const uint i = get_global_id(0);
    if (i >= ray_count)
        return;
    const Hit hit = trace_closest(nodes, blocks, load_ray(rays, i) ALPHA_ARGUMENTS);
    triangles[i] = hit.triangle;
    distances[3 * (size_t)i] = hit.t;
    distances[3 * (size_t)i + 1] = hit.u;
    distances[3 * (size_t)i + 2] = hit.v;
}

/// reads   rays, as above
/// writes  blocked[i], 0 or 1
kernel void trace_any_rays(
    global const BvhNode *nodes,
    global const TriangleBlock *blocks,
    global const float *rays,
    global uint *blocked,
    const uint ray_count,
    const uint inverted)
{
    const uint i = get_global_id(0);
    if (i >= ray_count)
        return;
    blocked[i] = trace_any(nodes, blocks, load_ray(rays, i) ALPHA_ARGUMENTS) ? 1 : 0;
}
