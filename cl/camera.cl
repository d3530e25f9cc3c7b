// Paths start here, and hand in what they gathered when their slot is taken again.

#include "common/camera_ray.h"
#include "common/features.h"
#include "common/hand_in.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pixels.h"
#include "common/pool.h"
#include "common/rng.h"
#include "common/splits.h"
#include "common/hash_map.h"

/// Slots that have nothing to do but take the next sample.
static inline Mask is_free(UInt status)
{
    return ((status & STATUS_MASK) == STATUS_DONE) | ((status & STATUS_MASK) == STATUS_IDLE);
}

/// Regenerate the W paths of a work item.
///
/// `claimed` is the next entry of the queue that is theirs; returns the one after the last they took.
static inline uint regenerate(
    __global const Params *params,
    __global Float *path,
    uint claimed,
    Tally *tally,
    volatile __global uint *counters,
#if AOV_DIRECT
    __global float *direct,
#endif
#if AOV_BOUNCES
    __global float *bounces,
#endif
#if BASE
    __global float *base,
#endif
#if CELLS
    __global Beyond *beyond,
#endif
    __global float *samples)
{
    UInt status = get_u(path, PATH_STATUS);
    UInt sample = get_u(path, PATH_SAMPLE);
    UInt pixel = get_u(path, PATH_PIXEL);
    const uint pixel_count = params->pixel_count;
    const uint ring_mask = params->ring - 1u;

    const Mask done = (status & STATUS_MASK) == STATUS_DONE;
    if (any_lane(done)) {
        Vec3 radiance = get_v(path, PATH_RADIANCE_R);
        UInt exponent = exponent_bits(radiance);
#if AOV_DIRECT
        Vec3 direct_part = get_v(path, PATH_DIRECT_R);
        exponent = max(exponent, exponent_bits(direct_part));
#endif
#if CELLS
        const Vec3 shared = get_v(path, PATH_BEYOND_R);
        exponent = max(exponent, exponent_bits(shared));
#endif
#if BASE
        Vec3 base_part = get_v(path, PATH_BASE_R);
        exponent = max(exponent, exponent_bits(base_part));
#endif
        const Mask bad = done & (exponent >= MAX_EXPONENT_BITS);
        const Vec3 black = vec3_all((Float)(0.0f));
        radiance = pick_v(bad, black, radiance);
        if (any_lane(bad))
            atomic_add(&counters[COUNTER_REJECTED_SAMPLES], count_lanes(bad));

        const Mask dark = done & (exponent == 0u);
        tally->dark += count_lanes(dark);

        const UInt pass = sample & ring_mask;
        uint lane_pass[W];
        uint lane_pixel[W];
        float lane_value[3][W];
        store_lanes_u(pass, lane_pass);
        store_lanes_u(pixel, lane_pixel);
        store_lanes(radiance.x, lane_value[0]);
        store_lanes(radiance.y, lane_value[1]);
        store_lanes(radiance.z, lane_value[2]);
#if AOV_DIRECT
        direct_part = pick_v(bad, black, direct_part);
        float lane_direct[3][W];
        store_lanes(direct_part.x, lane_direct[0]);
        store_lanes(direct_part.y, lane_direct[1]);
        store_lanes(direct_part.z, lane_direct[2]);
#endif
#if AOV_BOUNCES
        float lane_bounces[W];
        store_lanes(to_float(status & DEPTH_MASK), lane_bounces);
#endif
#if BASE
        base_part = pick_v(bad, black, base_part);
        float lane_base[3][W];
        store_lanes(base_part.x, lane_base[0]);
        store_lanes(base_part.y, lane_base[1]);
        store_lanes(base_part.z, lane_base[2]);
#endif
#if CELLS
        // What is rejected is not shared.
        uint lane_vertex[W];
        float lane_shared[3][W];
        store_lanes_u(pick_u(bad, (UInt)(0u), get_u(path, PATH_VERTEX)), lane_vertex);
        store_lanes(shared.x, lane_shared[0]);
        store_lanes(shared.y, lane_shared[1]);
        store_lanes(shared.z, lane_shared[2]);
#endif
        for (uint left = lane_bits(done); left; left &= left - 1u) {
            const uint k = lowest_bit(left);
            const ulong at = (ulong)lane_pass[k] * pixel_count + lane_pixel[k];
            vstore4((float4)(lane_value[0][k], lane_value[1][k], lane_value[2][k], 1.0f), at, samples);
#if AOV_DIRECT
            vstore4((float4)(lane_direct[0][k], lane_direct[1][k], lane_direct[2][k], 1.0f), at, direct);
#endif
#if AOV_BOUNCES
            vstore4((float4)(lane_bounces[k], 0.0f, 0.0f, 1.0f), at, bounces);
#endif
#if BASE
            vstore4((float4)(lane_base[0][k], lane_base[1][k], lane_base[2][k], 1.0f), at, base);
#endif
#if CELLS
            vstore4((float4)(lane_shared[0][k], lane_shared[1][k], lane_shared[2][k], as_float(lane_vertex[k])),
                    at, (__global float *)beyond);
#endif
        }
        count_finished(tally, done, pass, params->ring, counters);
    }

    const Mask free = is_free(status);
    if (any_lane(free)) {
        const uint first = claimed;
        claimed += count_lanes(free);
        const uint first_pass = first / pixel_count;
        UInt next = lanes_before(free) + (first - first_pass * pixel_count);
        UInt pass = (UInt)(counters[COUNTER_NEXT_PASS] + first_pass);
        // At most W steps, and only where an image has fewer pixels than a block has lanes.
        for (uint k = 0; k < W; ++k) {
            const Mask over = next >= pixel_count;
            if (!any_lane(over))
                break;
            next = pick_u(over, next - pixel_count, next);
            pass = pick_u(over, pass + 1u, pass);
        }
        sample = pick_u(free, pass, sample);
        pixel = pick_u(free, next, pixel);
        status = pick_u(free, (UInt)(STATUS_WAITING), status);
        put_u(path, PATH_SAMPLE, sample);
        put_u(path, PATH_PIXEL, pixel);
    }

    const uint limit = counters[COUNTER_PASS_LIMIT];
    const uint window = counters[COUNTER_FILM_PASS] + params->ring;
    const Mask start = (status == STATUS_WAITING) & (sample < min(limit, window));
    if (any_lane(start)) {
        tally->started += count_lanes(start);
        UInt x;
        UInt y;
        pixel_place(params, pick_u(start, pixel, (UInt)(0u)), &x, &y);
        const UInt seed = pixel_seed(y * params->width + x, params->seed);
        Float u1;
        Float u2;
        const UInt index = reversed_index(params, sample, (UInt)(0u));
        sample_pair(seed, index, (UInt)(PAIR_PIXEL), params->sampler, &u1, &u2);
        Float lens_1 = (Float)(0.0f);
        Float lens_2 = (Float)(0.0f);
#if LENS == 1
        sample_pair(seed, index, (UInt)(PAIR_LENS), params->sampler, &lens_1, &lens_2);
#endif
        Vec3 origin;
        const Vec3 direction =
            camera_ray(params, to_float(x) + u1, to_float(y) + u2, lens_1, lens_2, &origin);
        const Vec3 zero = vec3_all((Float)(0.0f));
        put_v(path, PATH_ORIGIN_X, pick_v(start, origin, get_v(path, PATH_ORIGIN_X)));
        put_v(path, PATH_DIRECTION_X, pick_v(start, direction, get_v(path, PATH_DIRECTION_X)));
        put_v(path, PATH_BETA_R, pick_v(start, vec3_all((Float)(1.0f)), get_v(path, PATH_BETA_R)));
        put_v(path, PATH_RADIANCE_R, pick_v(start, zero, get_v(path, PATH_RADIANCE_R)));
#if AOV_DIRECT
        put_v(path, PATH_DIRECT_R, pick_v(start, zero, get_v(path, PATH_DIRECT_R)));
#endif
#if BASE
        put_v(path, PATH_BASE_R, pick_v(start, zero, get_v(path, PATH_BASE_R)));
#endif
        put_u(path, PATH_SEED, pick_u(start, seed, get_u(path, PATH_SEED)));
        status = pick_u(start, (UInt)(STATUS_ALIVE), status);
    }
    put_u(path, PATH_STATUS, status);
    return claimed;
}

/// Hand in finished paths, give free slots the next (pixel, sample), start those whose pass may start.
///
/// A slot that took a sample of a pass that may not start yet keeps it and waits, so every sample is
/// started exactly once.  Which slot gets which sample does not show in the image.
///
/// A sample that is not finite, or too large to be summed, is handed in as black and counted.
///
/// reads   pool, counters
/// writes  pool; samples (direct, bounces, base, beyond) of finished paths; counters.{next_pixel, finished[],
///         rejected_samples, pending_camera}
kernel void regenerate_paths(
    __global const Params *params,
    __global float *pool,
    volatile __global uint *counters,
#if AOV_DIRECT
    __global float *direct,
#endif
#if AOV_BOUNCES
    __global float *bounces,
#endif
#if BASE
    __global float *base,
#endif
#if CELLS
    __global Beyond *beyond,
#endif
    __global float *samples)
{
    const uint first = get_global_id(0) * RUN;
    const uint end = min(first + RUN, params->slots / W);
    uint wanted = 0;
    for (uint item = first; item < end; ++item)
        wanted += count_lanes(is_free(get_u(pool_at(pool, item), PATH_STATUS)));
    uint claimed = wanted > 0 ? atomic_add(&counters[COUNTER_NEXT_PIXEL], wanted) : 0;
    Tally tally;
    clear_tally(&tally);
    for (uint item = first; item < end; ++item)
        claimed = regenerate(params, pool_at(pool, item), claimed, &tally, counters,
#if AOV_DIRECT
                             direct,
#endif
#if AOV_BOUNCES
                             bounces,
#endif
#if BASE
                             base,
#endif
#if CELLS
                             beyond,
#endif
                             samples);
    hand_in(&tally, params->ring, counters);
    if (tally.dark > 0)
        add_fixed(&counters[COUNTER_DARK_SAMPLES], &counters[COUNTER_DARK_SAMPLES_HIGH], tally.dark, 0u);
    if (tally.started > 0)
        atomic_add(&counters[COUNTER_PENDING_CAMERA], tally.started);
}
