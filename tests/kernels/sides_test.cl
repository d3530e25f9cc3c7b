// First hits through whatever a scene has: a tree, one of two levels, or a list.
//
// rays: origin, direction.  `of_camera` says whether a ray is the camera's.

#include "planes.h"
#include "../../cl/common/trace.h"

kernel void trace_first_hits(
    __global const Params *params,
    global const float *rays,
    global const uint *of_camera,
    global uint *triangles,
    global float *distances,
    GEOMETRY_BUFFERS)
{
    uint camera_rays[W];
    store_lanes_u(LOAD_U(of_camera, 0), camera_rays);
    const Hits hits = closest_hits(params, MASK_ALL, LOAD_V(rays, 0), LOAD_V(rays, 3), GEOMETRY_ARGUMENTS);
    STORE_U(triangles, 0, hits.triangle);
    STORE(distances, 0, hits.t);
}
