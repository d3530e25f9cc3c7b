// The film: sums of whole passes, in the order of the passes.

#include "common/layout.h"
#include "common/passes.h"

/// Add one value to a compensated sum, so that the millionth sample still counts (Kahan 1965).
static inline void add_compensated(FilmSum *sum, uint c, float value)
{
    const float y = value - sum->lost[c];
    const float t = sum->sum[c] + y;
    sum->lost[c] = (t - sum->sum[c]) - y;
    sum->sum[c] = t;
}

static inline void add_sample(FilmSum *sum, float4 sample)
{
    if (sample.w <= 0.0f)
        return;
    sum->count += 1u;
    add_compensated(sum, 0, sample.x);
    add_compensated(sum, 1, sample.y);
    add_compensated(sum, 2, sample.z);
    // Running variance of the luminance (Welford 1962).
    const float y = LUMINANCE_RED * sample.x + LUMINANCE_GREEN * sample.y + LUMINANCE_BLUE * sample.z;
    const float delta = y - sum->mean;
    sum->mean += delta / (float)sum->count;
    const float more = delta * (y - sum->mean) - sum->lost_squares;
    const float squares = min(sum->squares + more, FLT_MAX);
    // A sum that is full has lost more than float can say.
    sum->lost_squares = squares < FLT_MAX ? (squares - sum->squares) - more : 0.0f;
    sum->squares = squares;
}

/// Add every complete pass to the film.  One work item W sums: mostly there is nothing to add.
///
/// `planes` of `ring * pixel_count` weighted samples each; a weight of 0 means that there is none.
/// With `partial` set, the samples of the first pass that are there (an interrupted first pass).
///
/// reads   samples, counters
/// writes  film
kernel void add_samples(
    __global const Params *params,
    __global const float *samples,
    const volatile __global uint *counters,
    __global FilmSum *film,
    const uint planes,
    const uint partial)
{
    const uint passes = partial ? 1u : complete_passes(params, counters);
    if (passes == 0)
        return;
    const uint first = get_global_id(0) * W;
    const uint end = min(first + W, params->pixel_count * planes);
    for (uint i = first; i < end; ++i) {
        const uint plane = i / params->pixel_count;
        const uint pixel = i - plane * params->pixel_count;
        FilmSum sum = film[i];
        for (uint k = 0; k < passes; ++k) {
            const ulong pass = (counters[COUNTER_FILM_PASS] + k) & (params->ring - 1u);
            const ulong at = ((ulong)plane * params->ring + pass) * params->pixel_count + pixel;
            add_sample(&sum, vload4(at, samples));
        }
        film[i] = sum;
    }
}

/// Add every complete pass of the second half.  One work item W pixels, before advance_film.
///
/// reads   samples, counters
/// writes  film_half
kernel void add_half(
    __global const Params *params,
    __global const float *samples,
    const volatile __global uint *counters,
    __global FilmSum *film_half)
{
    const uint passes = complete_passes(params, counters);
    if (passes == 0)
        return;
    const uint first = get_global_id(0) * W;
    const uint end = min(first + W, params->pixel_count);
    for (uint pixel = first; pixel < end; ++pixel) {
        FilmSum sum = film_half[pixel];
        for (uint k = 0; k < passes; ++k) {
            const uint pass = counters[COUNTER_FILM_PASS] + k;
            const ulong at = (ulong)(pass & (params->ring - 1u)) * params->pixel_count + pixel;
            if (pass_is_in_half(pass - params->first_pass))
                add_sample(&sum, vload4(at, samples));
        }
        film_half[pixel] = sum;
    }
}

/// Let the window move past the passes that add_samples has added.  One work item.
///
/// reads, writes  counters
kernel void advance_film(__global const Params *params, volatile __global uint *counters)
{
    if (get_global_id(0) != 0 || params->pixel_count == 0)
        return;
    const uint done = complete_passes(params, counters);
    const uint pass = counters[COUNTER_FILM_PASS];
    for (uint k = 0; k < done; ++k)
        counters[COUNTER_FINISHED + ((pass + k) & (params->ring - 1u))] = 0;
    counters[COUNTER_FILM_PASS] = pass + done;

    // Keep next_pixel small: it would wrap after 2^32 samples.
    const uint whole = counters[COUNTER_NEXT_PIXEL] / params->pixel_count;
    counters[COUNTER_NEXT_PIXEL] -= whole * params->pixel_count;
    counters[COUNTER_NEXT_PASS] += whole;

    for (uint k = 0; k < 3; ++k) {
        const uint rays = counters[COUNTER_PENDING_CAMERA + k];
        const uint low = counters[COUNTER_CAMERA_RAYS + 2 * k];
        counters[COUNTER_CAMERA_RAYS + 2 * k] = low + rays;
        counters[COUNTER_CAMERA_RAYS + 2 * k + 1] += low + rays < low;
        counters[COUNTER_PENDING_CAMERA + k] = 0;
    }
}

/// Count the paths of the pool by depth (the last bin holds all beyond).  One work item a slot.
///
/// reads   pool.status
/// writes  census
kernel void count_depths(
    __global const Params *params, __global const float *pool, volatile __global uint *census, const uint bins)
{
    const uint slot = get_global_id(0);
    if (slot >= params->slots)
        return;
    const uint at = (slot / BLOCK * PATH_FIELD_COUNT + PATH_STATUS) * BLOCK + slot % BLOCK;
    const uint status = as_uint(pool[at]);
    if ((status & STATUS_MASK) == STATUS_ALIVE)
        atomic_inc(&census[min(status & DEPTH_MASK, bins - 1u)]);
}
