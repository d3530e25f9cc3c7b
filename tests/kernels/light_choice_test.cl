// The chances of light.h on a scene that is open, with the photons that it has.

#include "../../cl/common/features.h"
#include "planes.h"
#include "../../cl/common/light.h"

/// Chance of `light` at points (position, normal), and whether photons came there.
kernel void list_chances(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    __global const float *points,
    __global const uint *light,
    __global float *chances,
    __global uint *known)
{
    LightQuery q;
    q.p = LOAD_V(points, 0);
    q.n = LOAD_V(points, 3);
    q.row = find_row(params, particle_table, MASK_ALL, q.p, q.n);
    STORE(chances, 0, light_chance(params, lights CHOICE_ARGUMENTS, MASK_ALL, LOAD_U(light, 0), q));
    STORE_U(known, 0, pick_u(q.row != NO_PLACE, (UInt)(1u), (UInt)(0u)));
}

/// A light drawn at points with random `bits`; its chance as it is drawn.
kernel void draw_lights(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    __global const float *points,
    __global const uint *bits,
    __global uint *drawn,
    __global float *chances)
{
    LightQuery q;
    q.p = LOAD_V(points, 0);
    q.n = LOAD_V(points, 3);
    q.row = find_row(params, particle_table, MASK_ALL, q.p, q.n);
    const LightChoice choice = choose_light(params, lights CHOICE_ARGUMENTS, MASK_ALL, q, LOAD_U(bits, 0));
    STORE_U(drawn, 0, choice.light);
    STORE(chances, 0, choice.pmf);
}
