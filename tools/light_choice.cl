// Choices of lights at many points, as shade_paths makes them.

#include "../cl/common/features.h"
#include "../cl/common/lanes.h"
#include "../cl/common/layout.h"
#include "../cl/common/light.h"

// Points that a work item asks for, for each lane.
#define POINTS 64u

/// Choose a light at points on a square of `side` m that lies in y = 0; W * POINTS a work item.
///
/// writes  chosen: a number that depends on all choices, for each work item
kernel void choose_lights(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    __global float *chosen,
    const float side)
{
    const uint item = get_global_id(0);
    Float sum = (Float)(0.0f);
    for (uint k = 0; k < POINTS; ++k) {
        const UInt number = lanes_before(MASK_ALL) + (item * POINTS + k) * W;
        LightQuery q;
        q.p = vec3((unit_float(mix_bits(number)) - 0.5f) * side, (Float)(0.0f),
                   (unit_float(mix_bits_too(number)) - 0.5f) * side);
        q.n = vec3((Float)(0.0f), (Float)(1.0f), (Float)(0.0f));
#if LIGHT_PHOTONS
        q.row = find_row(params, particle_table, MASK_ALL, q.p, q.n);
#endif
        const LightChoice choice =
            choose_light(params, lights CHOICE_ARGUMENTS, MASK_ALL, q, mix_bits(number ^ 0x5bd1e995u));
        sum += choice.pmf;
    }
    float lane[W];
    store_lanes(sum, lane);
    float total = 0.0f;
    for (uint k = 0; k < W; ++k)
        total += lane[k];
    chosen[item] = total;
}
