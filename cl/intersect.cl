// Closest hits of the paths' rays.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/trace.h"

/// Trace the rays of the W paths of work item `item`; returns how many rays had bounced.
static inline uint trace_paths(__global const Params *params, __global Float *path, GEOMETRY_BUFFERS)
{
    const UInt status = get_u(path, PATH_STATUS);
    const Mask alive = (status & STATUS_MASK) == STATUS_ALIVE;
    if (!any_lane(alive))
        return 0;
    DEFINE_RAY_TRAITS(path, (status & DEPTH_MASK) * 2u);
    const Hits hits = closest_hits(params, alive, get_v(path, PATH_ORIGIN_X), get_v(path, PATH_DIRECTION_X),
                                   GEOMETRY_ARGUMENTS);
    put_u(path, PATH_HIT_TRIANGLE, hits.triangle);
    FIELD(path, PATH_HIT_T) = hits.t;
    FIELD(path, PATH_HIT_U) = hits.u;
    FIELD(path, PATH_HIT_V) = hits.v;
    return count_lanes(alive & ((status & DEPTH_MASK) > 0u));
}

/// Find what the ray of every living path hits.
///
/// reads   pool.{status, origin, direction}; geometry
/// writes  pool.hit_*; counters.pending_bounce
kernel void intersect_closest(
    __global const Params *params,
    __global float *pool,
    volatile __global uint *counters,
    GEOMETRY_BUFFERS)
{
    const uint first = get_global_id(0) * RUN;
    const uint end = min(first + RUN, params->slots / W);
    uint bounced = 0;
    for (uint item = first; item < end; ++item)
        bounced += trace_paths(params, pool_at(pool, item), GEOMETRY_BUFFER_ARGUMENTS);
    if (bounced > 0)
        atomic_add(&counters[COUNTER_PENDING_BOUNCE], bounced);
}
