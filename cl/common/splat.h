// Light that goes to any pixel: integer sums, the same whatever the order.
#pragma once

#include "hash_map.h"
#include "lanes.h"
#include "layout.h"
#include "rng.h"

/// Add `light` to pixels of passes of the ring; what the sums cannot hold is left out and counted.
static inline void splat(
    __global const Params *params,
    volatile __global SplatSum *splats,
    volatile __global uint *counters,
    Mask mask,
    UInt pass,
    UInt pixel,
    Vec3 light,
    UInt random)
{
    const float limit = 0x1p60f / params->splat_steps / (float)params->pixel_count;
    const Mask fits = max3(light) < limit;
    const uint rejected = count_lanes(mask & !fits);
    if (rejected > 0u)
        atomic_add(&counters[COUNTER_REJECTED_SAMPLES], rejected);
    uint lane_pass[W];
    uint lane_pixel[W];
    uint lane_low[3][W];
    uint lane_high[3][W];
    store_lanes_u(pass, lane_pass);
    store_lanes_u(pixel, lane_pixel);
    const Float value[3] = {light.x, light.y, light.z};
    for (uint c = 0; c < 3; ++c) {
        UInt low;
        UInt high;
        to_fixed(pick(fits, value[c], (Float)(0.0f)), (Float)(params->splat_steps), unit_float(random), &low, &high);
        store_lanes_u(low, lane_low[c]);
        store_lanes_u(high, lane_high[c]);
        random = mix_bits(random + 0x9e3779b9u);
    }
    for (uint left = lane_bits(mask & fits); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        volatile __global SplatSum *sum = &splats[(ulong)lane_pass[k] * params->pixel_count + lane_pixel[k]];
        for (uint c = 0; c < 3; ++c)
            add_fixed(&sum->low[c], &sum->high[c], lane_low[c][k], lane_high[c][k]);
    }
}
