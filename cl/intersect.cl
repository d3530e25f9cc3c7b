// Closest hits of the paths' rays.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/trace.h"

/// Find what the ray of every living path hits.
///
/// reads   pool.{status, origin, direction}; geometry
/// writes  pool.hit_*; counters.pending_bounce
kernel void intersect_closest(
    __global const Params *params,
    __global float *pool,
    volatile __global uint *counters,
    GEOMETRY_PARAMETERS)
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

    const Hits hits = closest_hits(params, alive, get_v(path, PATH_ORIGIN_X), get_v(path, PATH_DIRECTION_X),
                                   GEOMETRY_ARGUMENTS);
    put_u(path, PATH_HIT_TRIANGLE, hits.triangle);
    FIELD(path, PATH_HIT_T) = hits.t;
    FIELD(path, PATH_HIT_U) = hits.u;
    FIELD(path, PATH_HIT_V) = hits.v;
}
