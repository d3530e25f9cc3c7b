// Metropolis light transport: every slot of the pool is a chain, whose paths follow one another.

#include "common/camera_ray.h"
#include "common/chain.h"
#include "common/features.h"
#include "common/hand_in.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pixels.h"
#include "common/pool.h"
#include "common/rng.h"
#include "common/splat.h"

/// Let finished mutations bring their light to the film; return which chains move to them.
///
/// Proposal and state both count, each with its chance; large steps count also as the independent samples
/// that they are, by the balance heuristic (Kelemen et al. 2002, section 4).
static inline Mask settle(
    __global const Params *params,
    __global Float *chain,
    __global const float *brightness,
    volatile __global SplatSum *splats,
    volatile __global uint *counters,
    Mask done,
    Seed seed,
    UInt reversed_index,
    UInt pixel,
    Vec3 radiance)
{
    const Vec3 state = get_v(chain, CHAIN_RADIANCE_R);
    const Float from = luminance(state);
    const Float to = luminance(radiance);
    const Float chance = acceptance(from, to);
    const Mask large = seed.known == 0u;

    // As long as nothing bright is known, only the independent samples count.
    const float mean = *brightness;
    const float unit = mean > 0.0f ? 1.0f / mean : 1.0f;
    const float walks = mean > 0.0f ? 1.0f : 0.0f;
    const Float weight = (chance * walks + pick(large, (Float)(1.0f), (Float)(0.0f)))
                         / (to * unit * walks + params->large_steps);
    const Float weight_of_state = (1.0f - chance) * walks / (from * unit * walks + params->large_steps);
    const UInt pass = get_u(chain, CHAIN_PASS) & (params->ring - 1u);
    UInt random;
    UInt random_of_state;
    random_bits(pair_key(seed.key, (UInt)(PAIR_SPLAT)), reversed_index, &random, &random_of_state);
    splat(params, splats, counters, done & (to > 0.0f), pass, pixel, scale(radiance, weight * unit), random);
    splat(params, splats, counters, done & (from > 0.0f) & (chance < 1.0f), pass, get_u(chain, CHAIN_PIXEL),
          scale(state, weight_of_state * unit), random_of_state);

    const Mask moves = done & accepts(chance, seed.key, reversed_index);
    const Mask independent = done & large;
    const Mask dependent = done & !large;
    // A compensated sum (Kahan 1965).
    const Float sum = FIELD(chain, CHAIN_INDEPENDENT);
    const Float lost = FIELD(chain, CHAIN_LOST);
    const Float more = to - lost;
    const Float total = sum + more;
    FIELD(chain, CHAIN_INDEPENDENT) = pick(independent, total, sum);
    FIELD(chain, CHAIN_LOST) = pick(independent, (total - sum) - more, lost);
    const UInt zero = (UInt)(0u);
    const UInt one = (UInt)(1u);
    put_u(chain, CHAIN_LARGE, get_u(chain, CHAIN_LARGE) + pick_u(independent, one, zero));
    put_u(chain, CHAIN_LARGE_ACCEPTED, get_u(chain, CHAIN_LARGE_ACCEPTED) + pick_u(independent & moves, one, zero));
    put_u(chain, CHAIN_SMALL, get_u(chain, CHAIN_SMALL) + pick_u(dependent, one, zero));
    put_u(chain, CHAIN_SMALL_ACCEPTED, get_u(chain, CHAIN_SMALL_ACCEPTED) + pick_u(dependent & moves, one, zero));
    return moves;
}

/// Take in the finished paths of W chains.
static inline void finish(
    __global const Params *params,
    __global Float *path,
    __global Float *chain,
    __global uint *numbers,
    UInt id,
    Mask done,
    __global const float *brightness,
    __global float *candidates,
    volatile __global SplatSum *splats,
    volatile __global uint *counters,
    Tally *tally)
{
    Vec3 radiance = get_v(path, PATH_RADIANCE_R);
    const Mask bad = done & (exponent_bits(radiance) >= MAX_EXPONENT_BITS);
    radiance = pick_v(bad, vec3_all((Float)(0.0f)), radiance);
    if (any_lane(bad))
        atomic_add(&counters[COUNTER_REJECTED_SAMPLES], count_lanes(bad));

    const Seed seed = chain_seed(params, get_u(path, PATH_SEED), chain, numbers);
    const UInt index = reverse_bits(get_u(path, PATH_SAMPLE));
    const UInt pixel = get_u(path, PATH_PIXEL);
    const UInt paths = get_u(chain, CHAIN_PATHS);
    const Mask candidate = done & (paths < params->chain_start);
    const Mask mutation = done & (paths > params->chain_start);
    const Mask first = done & (paths == params->chain_start);
    const uint starts = count_lanes(done & !mutation);
    if (starts > 0u) {
        float lane_luminance[W];
        uint lane_at[W];
        store_lanes(luminance(radiance), lane_luminance);
        store_lanes_u(paths * params->slots + id, lane_at);
        for (uint left = lane_bits(candidate); left; left &= left - 1u) {
            const uint k = lowest_bit(left);
            candidates[lane_at[k]] = lane_luminance[k];
        }
        atomic_add(&counters[COUNTER_CHAIN_STARTS], starts);
    }
    Mask moves = first;
    if (any_lane(mutation)) {
        moves |= settle(params, chain, brightness, splats, counters, mutation, seed, index, pixel, radiance);
        count_finished(tally, mutation, get_u(chain, CHAIN_PASS) & (params->ring - 1u), params->ring, counters);
    }
    if (any_lane(moves)) {
        const UInt depth = get_u(path, PATH_STATUS) & DEPTH_MASK;
        const UInt pairs = min(PAIR_VERTEX + (depth + 1u) * VERTEX_PAIRS, (UInt)(params->chain_pairs));
        keep_numbers(chain, numbers, moves, seed, index, params->sampler, pairs);
        put_v(chain, CHAIN_RADIANCE_R, pick_v(moves, radiance, get_v(chain, CHAIN_RADIANCE_R)));
        put_u(chain, CHAIN_PIXEL, pick_u(moves, pixel, get_u(chain, CHAIN_PIXEL)));
    }
    put_u(chain, CHAIN_PATHS, paths + pick_u(done, (UInt)(1u), (UInt)(0u)));
    // Mutations of all chains take turns in a queue of pixel_count a pass.
    const UInt place = get_u(chain, CHAIN_PLACE);
    const UInt next = pick_u(first, id, place + params->slots);
    const UInt further = divide(next, params->pixel_count);
    const Mask queued = first | mutation;
    put_u(chain, CHAIN_PLACE, pick_u(queued, next - further * params->pixel_count, place));
    const UInt pass = pick_u(first, (UInt)(params->first_pass), get_u(chain, CHAIN_PASS));
    put_u(chain, CHAIN_PASS, pass + pick_u(queued, further, (UInt)(0u)));
}

/// Start the next paths of the W chains of a work item, where they may; returns how many.
static inline uint start(
    __global const Params *params,
    __global Float *path,
    __global Float *chain,
    __global uint *numbers,
    UInt id,
    Mask free,
    uint pass_limit,
    uint chain_limit,
    __global const uint *starts)
{
    const UInt paths = get_u(chain, CHAIN_PATHS);
    const Mask mutation = paths > params->chain_start;
    const Mask starting = free & (paths < chain_limit) & (!mutation | (get_u(chain, CHAIN_PASS) < pass_limit));
    if (!any_lane(starting))
        return 0;
    // The first state is a path of any chain, traced again.
    const Mask again = paths == params->chain_start;
    const UInt source = GATHER_WORD(starts, id);
    const UInt from = divide(source, params->slots);
    const UInt sample = pick_u(again, source - from * params->slots, id);
    const UInt key = path_key(params, pick_u(again, from, paths));
    const UInt index = reverse_bits(sample);
    take_step(chain, starting, !mutation | is_large(paths, params->seed, params->large_steps));

    const Seed seed = chain_seed(params, key, chain, numbers);
    UInt across;
    UInt down;
    film_bits(seed, index, params->sampler, &across, &down);
    const UInt column = mul_hi(across, (UInt)(params->crop_width));
    const UInt row = mul_hi(down, (UInt)(params->crop_height));
    Float lens_1 = (Float)(0.0f);
    Float lens_2 = (Float)(0.0f);
#if LENS == 1
    sample_pair(seed, index, (UInt)(PAIR_LENS), params->sampler, &lens_1, &lens_2);
#endif
    const Float x = to_float(column + params->crop_x) + unit_float(across * params->crop_width);
    const Float y = to_float(row + params->crop_y) + unit_float(down * params->crop_height);
    Vec3 origin;
    const Vec3 direction = camera_ray(params, x, y, lens_1, lens_2, &origin);
    put_v(path, PATH_ORIGIN_X, pick_v(starting, origin, get_v(path, PATH_ORIGIN_X)));
    put_v(path, PATH_DIRECTION_X, pick_v(starting, direction, get_v(path, PATH_DIRECTION_X)));
    put_v(path, PATH_BETA_R, pick_v(starting, vec3_all((Float)(1.0f)), get_v(path, PATH_BETA_R)));
    put_v(path, PATH_RADIANCE_R, pick_v(starting, vec3_all((Float)(0.0f)), get_v(path, PATH_RADIANCE_R)));
    put_u(path, PATH_SEED, pick_u(starting, key, get_u(path, PATH_SEED)));
    put_u(path, PATH_SAMPLE, pick_u(starting, sample, get_u(path, PATH_SAMPLE)));
    put_u(path, PATH_PIXEL, pick_u(starting, pixel_entry(params, column, row), get_u(path, PATH_PIXEL)));
    put_u(path, PATH_STATUS, pick_u(starting, (UInt)(STATUS_ALIVE), get_u(path, PATH_STATUS)));
    return count_lanes(starting);
}

/// Take in finished paths, move their chains or leave them where they are, and start the next mutations.
///
/// Before the first pass the paths of a chain are independent ones, whose luminance is noted, and then the
/// one among all of these that the host chose as its first state.  A mutation whose pass may not start yet
/// waits.  A path that is not finite, or too large to be summed, is black, so that no chain stays there.
///
/// reads   pool, chains, starts, brightness, counters
/// writes  pool, chains, chain_numbers; candidates; splats (atomic); counters.{finished[], rejected_samples, next_pass,
///         chain_starts, pending_camera}
kernel void mutate_paths(
    __global const Params *params,
    __global float *pool,
    __global float *chains,
    __global uint *chain_numbers,
    volatile __global uint *counters,
    __global const float *brightness,
    __global const uint *starts,
    __global float *candidates,
    volatile __global SplatSum *splats)
{
    const uint first = get_global_id(0) * RUN;
    const uint end = min(first + RUN, params->slots / W);
    const uint pass_limit = min(counters[COUNTER_PASS_LIMIT], counters[COUNTER_FILM_PASS] + params->ring);
    const uint chain_limit = counters[COUNTER_CHAIN_LIMIT];
    Tally tally;
    clear_tally(&tally);
    for (uint item = first; item < end; ++item) {
        __global Float *path = pool_at(pool, item);
        __global Float *chain = chain_at(chains, item);
        __global uint *numbers = chain_numbers_at(params, chain_numbers, item);
        const UInt id = lanes_before(MASK_ALL) + item * W;
        const UInt status = get_u(path, PATH_STATUS);
        const Mask done = (status & STATUS_MASK) == STATUS_DONE;
        if (any_lane(done)) {
            finish(params, path, chain, numbers, id, done, brightness, candidates, splats, counters, &tally);
            put_u(path, PATH_STATUS, pick_u(done, (UInt)(STATUS_WAITING), status));
        }
        const Mask free = (status & STATUS_MASK) != STATUS_ALIVE;
        if (any_lane(free))
            tally.started += start(params, path, chain, numbers, id, free, pass_limit, chain_limit, starts);
    }
    hand_in(&tally, params->ring, counters);
    if (tally.started > 0)
        atomic_add(&counters[COUNTER_PENDING_CAMERA], tally.started);
    // The last pass that may have begun.
    if (first == 0 && params->slots > 0)
        counters[COUNTER_NEXT_PASS] = max(pass_limit, 1u) - 1u;
}
