// Rays through a tree, timed or counted.  COUNTED: the traversal's box and triangle tests each add 1
// to a word, through the parameter that cut-outs would have.

#define FEW 0
#include "../cl/common/geometry.h"
#include "../cl/common/lanes.h"

#if COUNTED
#define ALPHA_PARAMETERS , uint *visits
#define ALPHA_ARGUMENTS , visits
#define intersect_boxes(...) (++visits[0], intersect_boxes(__VA_ARGS__))
#define intersect_block(...) (++visits[1], intersect_block(__VA_ARGS__))
#endif

#include "../cl/common/traverse.h"

/// Set up rays `first` to `first + W - 1`; those that are not there have a t_max of 0.
static inline void load_rays(
    RaySetups *setups, global const float *rays, uint first, uint ray_count)
{
    float fields[7][W];
    for (uint k = 0; k < W; ++k) {
        for (uint c = 0; c < 7; ++c)
            fields[c][k] = first + k < ray_count ? rays[7 * (size_t)(first + k) + c] : 0.0f;
    }
    const Vec3 origin =
        vec3(load_lanes(fields[0]), load_lanes(fields[1]), load_lanes(fields[2]));
    const Vec3 direction =
        vec3(load_lanes(fields[3]), load_lanes(fields[4]), load_lanes(fields[5]));
    set_up_rays(setups, MASK_ALL, origin, direction, load_lanes(fields[6]));
}

/// W rays a work item.
///
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
    const uint first = get_global_id(0) * W;
    if (first >= ray_count)
        return;
    RaySetups setups;
    load_rays(&setups, rays, first, ray_count);
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const RaySetup ray = ray_setup(&setups, k);
        uint visits[2] = {0, 0};
        const Hit hit = trace_closest(nodes, blocks, &ray ALPHA_ARGUMENTS);
        const size_t i = first + k;
        triangles[i] = hit.triangle;
        distances[i] = hit.t;
        counts[2 * i] = visits[0];
        counts[2 * i + 1] = visits[1];
    }
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
    const uint first = get_global_id(0) * W;
    if (first >= ray_count)
        return;
    RaySetups setups;
    load_rays(&setups, rays, first, ray_count);
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const RaySetup ray = ray_setup(&setups, k);
        uint visits[2] = {0, 0};
        const size_t i = first + k;
        triangles[i] = trace_any(nodes, blocks, &ray ALPHA_ARGUMENTS) ? 0 : NO_HIT;
        counts[2 * i] = visits[0];
        counts[2 * i + 1] = visits[1];
    }
}
