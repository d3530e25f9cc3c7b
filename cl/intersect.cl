// Closest hits of the paths' rays.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/alpha.h"
#include "common/traverse.h"

/// Find what the ray of every living path hits.
///
/// reads   pool.{status, origin, direction}; nodes, blocks
/// writes  pool.hit_*; counters.pending_bounce
kernel void intersect_closest(
    __global const Params *params,
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    __global float *pool,
    volatile __global uint *counters ALPHA_PARAMETERS)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(pool, item);
    const UInt status = get_u(path, PATH_STATUS);
    const Mask alive = (status & STATUS_MASK) == STATUS_ALIVE;
    if (!any_lane(alive))
        return;
    const Mask bounced = alive & ((status & DEPTH_MASK) > 0u);
    if (any_lane(bounced))
        atomic_add(&counters[COUNTER_PENDING_BOUNCE], count_lanes(bounced));

    float origin[3][W];
    float direction[3][W];
    uint lane_status[W];
    for (uint c = 0; c < 3; ++c) {
        store_lanes(FIELD(path, PATH_ORIGIN_X + c), origin[c]);
        store_lanes(FIELD(path, PATH_DIRECTION_X + c), direction[c]);
    }
    store_lanes_u(status, lane_status);
    uint triangle[W];
    float t[W];
    float u[W];
    float v[W];
    for (uint k = 0; k < W; ++k) {
        triangle[k] = NO_HIT;
        t[k] = 0.0f;
        u[k] = 0.0f;
        v[k] = 0.0f;
        if ((lane_status[k] & STATUS_MASK) != STATUS_ALIVE)
            continue;
        Ray ray;
        for (uint c = 0; c < 3; ++c) {
            ray.origin[c] = origin[c][k];
            ray.direction[c] = direction[c][k];
        }
        ray.t_max = INFINITY;
        const Hit hit = trace_closest(nodes, blocks, ray ALPHA_ARGUMENTS);
        triangle[k] = hit.triangle;
        t[k] = hit.t;
        u[k] = hit.u;
        v[k] = hit.v;
    }
    put_u(path, PATH_HIT_TRIANGLE, load_lanes_u(triangle));
    FIELD(path, PATH_HIT_T) = load_lanes(t);
    FIELD(path, PATH_HIT_U) = load_lanes(u);
    FIELD(path, PATH_HIT_V) = load_lanes(v);
}
