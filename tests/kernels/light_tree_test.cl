// The functions of light_tree.h, one point a lane.

#include "planes.h"
#include "../../cl/common/light_tree.h"

/// Lights drawn for points (position, normal) with random `bits`; what chance_in_tree says of them.
kernel void draw_lights(
    global const LightPair *light_pairs,
    global const uint *light_places,
    const uint light_count,
    global const float *points,
    global const uint *bits,
    global uint *drawn,
    global float *pmfs,
    global float *chances)
{
    const Vec3 p = LOAD_V(points, 0);
    const Vec3 n = LOAD_V(points, 3);
    const LightChoice choice = choose_in_tree(light_pairs, light_count, MASK_ALL, p, n, LOAD_U(bits, 0));
    STORE_U(drawn, 0, choice.light);
    STORE(pmfs, 0, choice.pmf);
    const Mask any = choice.pmf > 0.0f;
    STORE(chances, 0, chance_in_tree(light_pairs, light_places, light_count, any, choice.light, p, n));
}

/// Chances of `light` at points.
kernel void list_chances(
    global const LightPair *light_pairs,
    global const uint *light_places,
    const uint light_count,
    global const float *points,
    global const uint *light,
    global float *chances)
{
    STORE(chances, 0, chance_in_tree(light_pairs, light_places, light_count, MASK_ALL, LOAD_U(light, 0),
                                     LOAD_V(points, 0), LOAD_V(points, 3)));
}
