// The traversal over arrays of rays.  CUT_OUT: hits on triangles with ALPHA_BIT count where u < v.

#define FEW 0
#include "../../cl/common/layout.h"
#include "../../cl/common/lanes.h"

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

/// Set up rays `first` to `first + W - 1`; those that are not there have a t_max of 0.
static inline void load_rays(RaySetups *setups, global const float *rays, uint first, uint ray_count)
{
    float field[7][W];
    for (uint k = 0; k < W; ++k)
        for (uint f = 0; f < 7; ++f)
            field[f][k] = first + k < ray_count ? rays[7 * (size_t)(first + k) + f] : 0.0f;
    set_up_rays(setups, MASK_ALL, vec3(load_lanes(field[0]), load_lanes(field[1]), load_lanes(field[2])),
                vec3(load_lanes(field[3]), load_lanes(field[4]), load_lanes(field[5])), load_lanes(field[6]));
}

/// W rays a work item.
///
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
    const uint first = get_global_id(0) * W;
    if (first >= ray_count)
        return;
    RaySetups setups;
    load_rays(&setups, rays, first, ray_count);
    const Hits hits = trace_closest(nodes, blocks, &setups ALPHA_ARGUMENTS);
    uint triangle[W];
    float t[W];
    float u[W];
    float v[W];
    store_lanes_u(hits.triangle, triangle);
    store_lanes(hits.t, t);
    store_lanes(hits.u, u);
    store_lanes(hits.v, v);
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const size_t i = first + k;
        triangles[i] = triangle[k];
        distances[3 * i] = t[k];
        distances[3 * i + 1] = u[k];
        distances[3 * i + 2] = v[k];
    }
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
    const uint first = get_global_id(0) * W;
    if (first >= ray_count)
        return;
    RaySetups setups;
    load_rays(&setups, rays, first, ray_count);
    const uint bits = lane_bits(trace_any(nodes, blocks, &setups ALPHA_ARGUMENTS));
    for (uint k = 0; k < W && first + k < ray_count; ++k)
        blocked[first + k] = bits >> k & 1u;
}

/// reads   rays, as above; the first node
/// writes  met[i]: bit k is set if the ray may meet child k
kernel void meet_boxes(
    global const BvhNode *nodes,
    global const float *rays,
    global uint *met,
    const uint ray_count)
{
    const uint first = get_global_id(0) * W;
    if (first >= ray_count)
        return;
    RaySetups setups;
    load_rays(&setups, rays, first, ray_count);
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const RaySetup ray = ray_setup(&setups, k);
        float8 near;
        met[first + k] = bits_of_8(intersect_boxes(&nodes[0], &ray, ray.t_max, &near));
    }
}
