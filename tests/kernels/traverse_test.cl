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
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const RaySetup ray = ray_setup(&setups, k);
        const Hit hit = trace_closest(nodes, blocks, &ray ALPHA_ARGUMENTS);
        const size_t i = first + k;
        triangles[i] = hit.triangle;
        distances[3 * i] = hit.t;
        distances[3 * i + 1] = hit.u;
        distances[3 * i + 2] = hit.v;
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
    for (uint k = 0; k < W && first + k < ray_count; ++k) {
        const RaySetup ray = ray_setup(&setups, k);
        blocked[first + k] = trace_any(nodes, blocks, &ray ALPHA_ARGUMENTS) ? 1 : 0;
    }
}
