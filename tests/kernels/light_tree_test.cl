// The functions of light_tree.h, one point a lane.

#include "planes.h"
#include "../../cl/common/light_tree.h"

/// Lights drawn for points (position, normal) with random `bits`; what climbing says of them.
kernel void draw_lights(
    global const LightPair *light_pairs,
    global const uint *light_places,
    global const uint *light_clusters,
    const uint light_count,
    global const float *points,
    global const uint *bits,
    global uint *drawn,
    global float *pmfs,
    global float *chances)
{
    const Vec3 p = LOAD_V(points, 0);
    const Vec3 n = LOAD_V(points, 3);
    const TreeChoice choice = descend_tree(
        light_pairs, light_clusters, light_count, MASK_ALL, (UInt)(0u), (UInt)(0u), p, n, LOAD_U(bits, 0));
    const TreeChoice back = climb_tree(light_pairs, light_places, light_clusters, light_count, MASK_ALL,
                                       MASK_ALL, choice.light, p, n);
    const TreeChoice inside = climb_tree(light_pairs, light_places, light_clusters, light_count, (Mask)(0),
                                         MASK_ALL, choice.light, p, n);
    STORE_U(drawn, 0, choice.light);
    STORE(pmfs, 0, choice.above * choice.inside);
    STORE(chances, 0, back.above * inside.inside);
}

/// Chances of `light` at points.
kernel void list_chances(
    global const LightPair *light_pairs,
    global const uint *light_places,
    global const uint *light_clusters,
    const uint light_count,
    global const float *points,
    global const uint *light,
    global float *chances)
{
    const TreeChoice choice = climb_tree(light_pairs, light_places, light_clusters, light_count, MASK_ALL,
                                         MASK_ALL, LOAD_U(light, 0), LOAD_V(points, 0), LOAD_V(points, 3));
    STORE(chances, 0, choice.above * choice.inside);
}
