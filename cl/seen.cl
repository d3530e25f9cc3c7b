// What each pixel sees: means of the first surface over its samples.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/passes.h"
#include "common/pixels.h"
#include "common/view.h"

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
            mean->shape = (mean->count == 0u ? one->shape : mean->shape) | (one->shape & SHAPE_SHINES);
            mean->count += 1u;
            add_to_mean(mean->gate, one->gate, 1.0f / (float)mean->count);
            if (!one->shape)
                continue;
            mean->hits += 1u;
            add_to_mean(mean->p, one->p, 1.0f / (float)mean->hits);
            add_to_mean(mean->ns, one->ns, 1.0f / (float)mean->hits);
            add_to_mean(mean->before, one->before, 1.0f / (float)mean->hits);
        }
    }
}

#if SEEN == 2
/// Find how far what each pixel sees has moved since the frame before, in pixels to the right and down.  One
/// work item W pixels.
///
/// What is infinitely far away only moves with the camera.  A point that was behind the camera has moved out
/// of the film.
///
/// reads   surfaces_seen
/// writes  motion (two words)
kernel void find_motion(
    __global const Params *params, __global const SeenMean *surfaces_seen, __global float *motion)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt pixel = min(lanes_before(MASK_ALL) + first, (UInt)(params->pixel_count - 1u));
    UInt x;
    UInt y;
    pixel_place(params, pixel, &x, &y);
    const View now = view_of(params);
    const View then = previous_view_of(params);
    const Mask there = GATHER_U(surfaces_seen, pixel, hits) > 0u;
    const Vec3 p = vec3(GATHER(surfaces_seen, pixel, p[0]), GATHER(surfaces_seen, pixel, p[1]),
                        GATHER(surfaces_seen, pixel, p[2]));
    const Vec3 before = vec3(GATHER(surfaces_seen, pixel, before[0]), GATHER(surfaces_seen, pixel, before[1]),
                             GATHER(surfaces_seen, pixel, before[2]));
    const Vec3 sky = direction_through(params, now, x, y);
    const FilmPlace to = place_on_film(params, now, pick_v(there, sub(p, now.origin), sky));
    const FilmPlace from = place_on_film(params, then, pick_v(there, sub(before, then.origin), sky));
    const Mask known = to.ahead & from.ahead;
    const Float away = (Float)(2.0f * (float)(params->width + params->height));
    float right[W];
    float down[W];
    store_lanes(pick(known, to.x - from.x, away), right);
    store_lanes(pick(known, to.y - from.y, away), down);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k)
        vstore2((float2)(right[k], down[k]), first + k, motion);
}
#endif
