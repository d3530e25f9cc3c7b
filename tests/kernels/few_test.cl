// The functions of plates.h and few.h, one ray a lane.
//
// rays: origin, direction.  `active` of 0 is a dead lane.

#include "planes.h"
#include "../../cl/common/plates.h"

/// hits: t, u, v.
kernel void trace_closest_listed(
    global const Params *params,
    LIST_BUFFERS ALPHA_PARAMETERS,
    global const float *rays,
    global const uint *active,
    global uint *triangles,
    global float *hits)
{
    const Hits found = trace_closest_few(params, LOAD_U(active, 0) != 0u, LOAD_V(rays, 0), LOAD_V(rays, 3),
                                         LIST_ARGUMENTS ALPHA_ARGUMENTS);
    STORE_U(triangles, 0, found.triangle);
    STORE(hits, 0, found.t);
    STORE(hits, 1, found.u);
    STORE(hits, 2, found.v);
}

kernel void trace_any_listed(
    global const Params *params,
    LIST_BUFFERS ALPHA_PARAMETERS,
    global const float *rays,
    global const uint *active,
    global uint *blocked)
{
    const Mask found = trace_any_few(params, LOAD_U(active, 0) != 0u, LOAD_V(rays, 0), LOAD_V(rays, 3),
                                     LIST_ARGUMENTS ALPHA_ARGUMENTS);
    STORE_U(blocked, 0, pick_u(found, (UInt)(1u), (UInt)(0u)));
}
