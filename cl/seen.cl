// What each pixel sees: means of the first surface over its samples.

#include "common/layout.h"
#include "common/passes.h"

/// Move a mean towards one more value; `step` is 1 / count.
static inline void add_to_mean(__global float *mean, __global const float *value, float step)
{
    for (uint c = 0; c < 3; ++c)
        mean[c] += (value[c] - mean[c]) * step;
}

/// Add what the samples of every complete pass see.  One work item W pixels, before advance_film.
///
/// reads   seen, counters
/// writes  surfaces_seen
kernel void add_seen(
    __global const Params *params,
    __global const Seen *seen,
    const volatile __global uint *counters,
    __global SeenMean *surfaces_seen)
{
    const uint passes = complete_passes(params, counters);
    if (passes == 0)
        return;
    const uint first = get_global_id(0) * W;
    const uint end = min(first + W, params->pixel_count);
    for (uint pixel = first; pixel < end; ++pixel) {
        __global SeenMean *mean = surfaces_seen + pixel;
        for (uint k = 0; k < passes; ++k) {
            const ulong pass = (counters[COUNTER_FILM_PASS] + k) & (params->ring - 1u);
            __global const Seen *one = seen + pass * params->pixel_count + pixel;
            mean->count += 1u;
            add_to_mean(mean->gate, one->gate, 1.0f / (float)mean->count);
            if (!one->there)
                continue;
            mean->hits += 1u;
            add_to_mean(mean->p, one->p, 1.0f / (float)mean->hits);
            add_to_mean(mean->ns, one->ns, 1.0f / (float)mean->hits);
        }
    }
}
