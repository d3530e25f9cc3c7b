// Rays through a tree, timed or counted.  COUNTED: the traversal's box and triangle tests each add 1
// to a word of their ray's, through the parameter that cut-outs would have; no rays share their way.

#define FEW 0
#include "../cl/common/geometry.h"
#include "../cl/common/lanes.h"

#if COUNTED
#define ALPHA_PARAMETERS , uint *visits
#define ALPHA_ARGUMENTS , visits
#define ALPHA_ARGUMENTS_OF(lane) , visits + 2u * (lane)
#define LANES_APART W
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
    uint visits[2 * W] = {0};
    const Hits hits = trace_closest(nodes, blocks, &setups ALPHA_ARGUMENTS);
    uint lane_triangle[W];
    float lane_t[W];
    store_lanes_u(hits.triangle, lane_triangle);
    store_lanes(hits.t, lane_t);
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const size_t i = first + k;
        triangles[i] = lane_triangle[k];
        distances[i] = lane_t[k];
        counts[2 * i] = visits[2 * k];
        counts[2 * i + 1] = visits[2 * k + 1];
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
    uint visits[2 * W] = {0};
    const uint blocked = lane_bits(trace_any(nodes, blocks, &setups ALPHA_ARGUMENTS));
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const size_t i = first + k;
        triangles[i] = blocked >> k & 1u ? 0 : NO_HIT;
        counts[2 * i] = visits[2 * k];
        counts[2 * i + 1] = visits[2 * k + 1];
    }
}
