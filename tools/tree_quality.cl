// Rays through a tree, timed or counted.  COUNTED: the traversal's box and triangle tests each add 1
// to a word, through the parameter that cut-outs would have.

#include "../cl/common/geometry.h"

#if COUNTED
#define ALPHA_PARAMETERS , uint *visits
#define ALPHA_ARGUMENTS , visits
#define intersect_boxes(...) (++visits[0], intersect_boxes(__VA_ARGS__))
#define intersect_block(...) (++visits[1], intersect_block(__VA_ARGS__))
#endif

#include "../cl/common/traverse.h"

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
/// writes  triangles[i], NO_HIT for none; distances[i]; counts[2 * i + (0, 1)], nodes and blocks
kernel void trace_closest_rays(
    global const BvhNode *nodes,
    global const TriangleBlock *blocks,
    global const float *rays,
    global uint *triangles,
    global float *distances,
    global uint *counts,
    const uint ray_count)
{
    const uint i = get_global_id(0);
    if (i >= ray_count)
        return;
    uint visits[2] = {0, 0};
    const Hit hit = trace_closest(nodes, blocks, load_ray(rays, i) ALPHA_ARGUMENTS);
    triangles[i] = hit.triangle;
    distances[i] = hit.t;
    counts[2 * (size_t)i] = visits[0];
    counts[2 * (size_t)i + 1] = visits[1];
}

/// reads   rays, as above
/// writes  triangles[i], 0 if something is in the way, else NO_HIT; counts, as above
kernel void trace_any_rays(
    global const BvhNode *nodes,
    global const TriangleBlock *blocks,
    global const float *rays,
    global uint *triangles,
    global uint *counts,
    const uint ray_count)
{
    const uint i = get_global_id(0);
    if (i >= ray_count)
        return;
    uint visits[2] = {0, 0};
    triangles[i] = trace_any(nodes, blocks, load_ray(rays, i) ALPHA_ARGUMENTS) ? 0 : NO_HIT;
    counts[2 * (size_t)i] = visits[0];
    counts[2 * (size_t)i + 1] = visits[1];
}
