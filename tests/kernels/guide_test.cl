// Directions by the guide: draw them, and ask for their densities.

#define GUIDE 1
#include "planes.h"
#include "../../cl/common/guide.h"

/// Draw from cell `slot` by (u1, u2): `direction` on the hemisphere, `part` that it was drawn from and is in.
kernel void draw(
    global const float *u1,
    global const float *u2,
    global const uint *slot,
    global const GuideCell *cells,
    global float *direction,
    global uint *part,
    global float *density)
{
    Float a = LOAD(u1, 0);
    Float b = LOAD(u2, 0);
    const UInt from = LOAD_U(slot, 0);
    warp_by_guide(cells, from, &a, &b);
    const Float side = (Float)((float)GUIDE_SIDE);
    STORE_U(part, 0, to_uint(a * side) * GUIDE_SIDE + to_uint(b * side));
    Float x;
    Float y;
    disk_of_square(a, b, &x, &y);
    store_vec3(direction, 0, vec3(x, y, sqrt(max(1.0f - x * x - y * y, (Float)(0.0f)))));
    const UInt found = guide_bin(x, y);
    STORE_U(part, 1, found);
    STORE(density, 0, guide_density(cells, from, found));
}

/// Density of directions, over that of the cosine.
kernel void density_of(
    global const float *direction, global const uint *slot, global const GuideCell *cells, global float *density)
{
    STORE(density, 0, guide_density(cells, LOAD_U(slot, 0), guide_bin(LOAD(direction, 0), LOAD(direction, 1))));
}

/// The guide's frame of normals.
kernel void frame_of(global const float *normal, global float *frame)
{
    Vec3 s;
    Vec3 t;
    guide_frame(LOAD_V(normal, 0), &s, &t);
    store_vec3(frame, 0, s);
    store_vec3(frame, 3, t);
}
