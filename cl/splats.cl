// Splats to samples: what the mutations of a pass brought to a pixel is the pixel's sample of that pass.

#include "common/hash_map.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/passes.h"

/// Hand in the sums of every complete pass, and clear them.  One work item W pixels, before add_samples.
///
/// A pass has as many mutations as pixels, so that the sum is an estimate of the radiance.
///
/// reads   splats, brightness, counters
/// writes  samples, splats
kernel void collect_splats(
    __global const Params *params,
    const volatile __global uint *counters,
    __global const float *brightness,
    __global SplatSum *splats,
    __global float *samples)
{
    const uint passes = complete_passes(params, counters);
    const uint first = get_global_id(0) * W;
    const uint end = min(first + W, params->pixel_count);
    const float scale = (*brightness > 0.0f ? *brightness : 1.0f) / params->splat_steps;
    for (uint k = 0; k < passes; ++k) {
        const uint pass = (counters[COUNTER_FILM_PASS] + k) & (params->ring - 1u);
        for (uint pixel = first; pixel < end; ++pixel) {
            const ulong at = (ulong)pass * params->pixel_count + pixel;
            float value[3];
            for (uint c = 0; c < 3; ++c) {
                value[c] = ((float)splats[at].high[c] * 0x1p32f + (float)splats[at].low[c]) * scale;
                splats[at].low[c] = 0u;
                splats[at].high[c] = 0u;
            }
            vstore4((float4)(value[0], value[1], value[2], 1.0f), at, samples);
        }
    }
}
