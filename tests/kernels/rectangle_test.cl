// The functions of rectangle.h, one point a lane.

#include "planes.h"
#include "../../cl/common/rectangle.h"

/// Parts of the edges that random numbers draw, as seen from points; the solid angle, and whether it is
/// drawn by that.  rectangle: a corner and the edges from it.
kernel void draw_in_rectangle(
    global const float *rectangle,
    global const float *points,
    global const float *random,
    global float *parts,
    global float *solid,
    global uint *near)
{
    const Vec3 corner = LOAD_V(rectangle, 0);
    const Vec3 e1 = LOAD_V(rectangle, 3);
    const Vec3 e2 = LOAD_V(rectangle, 6);
    const Mask close = is_close(corner, e1, e2, LOAD_V(points, 0));
    const SeenRectangle seen = see_rectangle(corner, e1, e2, LOAD_V(points, 0));
    Float a;
    Float b;
    sample_rectangle(seen, LOAD(random, 0), LOAD(random, 1), &a, &b);
    STORE(parts, 0, a);
    STORE(parts, 1, b);
    STORE(solid, 0, seen.solid);
    STORE_U(near, 0, pick_u(close & is_wide(seen), (UInt)(1u), (UInt)(0u)));
}
