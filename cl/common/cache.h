// The radiance cache: what matt surfaces reflect, gathered in cells of space, where paths may end.
//
// A path carries one open record: the cell of a vertex that it learns for, and what light from where it is
// now would bring to that vertex.  At the first vertex whose cell is known the record is closed with what
// that cell knows.
//
// Ends are a control variate: with C for what the cell knows and X for what tracing on brings, C is taken,
// and with the chance q of tracing on (X - C) / q in addition: X on average, whatever C and q are, as long
// as they do not depend on X.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "guide.h"

// Reflectance from which a channel can be divided by.
#define CACHE_LEAST_REFLECTANCE 1e-3f

// Steps of a squared luminance, and the largest that is summed; relative to the mean of the cell.
#define CACHE_SQUARE_STEPS 256.0f
#define CACHE_MOST_SQUARE 65536.0f

/// What the cache has for a point, per lane.
typedef struct {
    UInt slot;    // NO_SLOT: none
    Vec3 mean;    // radiance that a white diffuse surface reflects there, direct light included
    Float ends;   // chance that a path ends here
    Float edge;   // about that of the cell, m
    Mask known;
} Cached;

/// Find the cells of these points; those of the lanes of `learning` are made.
static inline Cached find_cached(
    __global const Params *params,
    volatile __global uint *keys,
    __global const CacheCell *cells,
    __global uint *full,
    volatile __global uint *counters,
    Mask wanted,
    Mask learning,
    Vec3 p,
    Vec3 n,
    UInt random)
{
    Cached c;
    c.slot = (UInt)(NO_SLOT);
    c.mean = vec3_all((Float)(0.0f));
    c.ends = (Float)(0.0f);
    c.edge = (Float)(0.0f);
    c.known = c.slot != NO_SLOT;
    if (!any_lane(wanted))
        return c;
    const Vec3 away = sub(p, vec3_of(params->camera_origin));
    const Float width = params->cache_width * sqrt(dot3(away, away));
    c.edge = clamp(width, (Float)(params->guide_least), (Float)(params->guide_most));
    const CellKey key = coarse_cell_of(params, p, n, random, c.edge, params->cache_slots);
    const uint size = bucket_size(params->cache_slots);
    c.slot = find_or_make(keys, full, &counters[COUNTER_CACHE_FAILED], wanted, learning, key.bucket, size, key.key);
    const Mask there = c.slot != NO_SLOT;
    const UInt at = pick_u(there, c.slot, (UInt)(0u));
    const Float visits = GATHER(cells, at, visits);
    c.known = there & (visits > 0.0f);
    const Float zero = (Float)(0.0f);
    c.mean = vec3(pick(c.known, GATHER(cells, at, mean[0]), zero), pick(c.known, GATHER(cells, at, mean[1]), zero),
                  pick(c.known, GATHER(cells, at, mean[2]), zero));
    c.ends = pick(c.known, GATHER(cells, at, ends), zero);
    return c;
}

/// What divides by a reflectance; nothing is known of a channel that reflects next to nothing.
static inline Float inverse_reflectance(Float reflectance)
{
    const Mask there = reflectance > CACHE_LEAST_REFLECTANCE;
    return pick(there, 1.0f / pick(there, reflectance, (Float)(1.0f)), (Float)(0.0f));
}

/// Count a visit of each cell; of those in `near` the path came from nearer than the cell's edge.
static inline void visit_cached(__global CacheSum *sums, Mask wanted, Mask near, UInt slot)
{
    uint lane_slot[W];
    store_lanes_u(slot, lane_slot);
    const uint close = lane_bits(near);
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        atomic_inc((volatile __global uint *)&sums[lane_slot[k]].count);
        if ((close >> k) & 1u)
            atomic_inc((volatile __global uint *)&sums[lane_slot[k]].near);
    }
}

/// Add radiance to the sums of cells.  What is not finite, or too large for them, is left out and counted.
LARGE_FUNCTION void learn_cached(
    __global const Params *params,
    __global CacheSum *sums,
    __global const CacheCell *cells,
    volatile __global uint *counters,
    Mask wanted,
    UInt slot,
    Vec3 radiance,
    UInt random)
{
    const UInt most = max(as_bits(radiance.x), max(as_bits(radiance.y), as_bits(radiance.z)));
    wanted &= (slot != NO_SLOT) & (most != 0u);
    const Mask rejected = wanted & (most >= as_uint(params->cache_limit));
    if (any_lane(rejected)) {
        atomic_add(&counters[COUNTER_CACHE_REJECTED], count_lanes(rejected));
        wanted &= !rejected;
    }
    if (!any_lane(wanted))
        return;
    const UInt at = pick_u(wanted, slot, (UInt)(0u));
    const Vec3 mean = vec3(GATHER(cells, at, mean[0]), GATHER(cells, at, mean[1]), GATHER(cells, at, mean[2]));
    const Vec3 taken = pick_v(wanted, radiance, vec3_all((Float)(0.0f)));
    const Float expected = luminance(mean);
    const Mask sure = wanted & (expected > 0.0f);
    const Float ratio = luminance(taken) / pick(sure, expected, (Float)(1.0f));
    const Float square = pick(sure, min(ratio * ratio, (Float)(CACHE_MOST_SQUARE)), (Float)(0.0f));
    const Float values[4] = {taken.x, taken.y, taken.z, square};
    const float steps[4] = {params->cache_steps, params->cache_steps, params->cache_steps, CACHE_SQUARE_STEPS};
    uint lane_slot[W];
    uint lane_low[4][W];
    uint lane_high[4][W];
    store_lanes_u(slot, lane_slot);
    UInt bits = random;
    for (uint c = 0; c < 4; ++c) {
        UInt low;
        UInt high;
        bits = mix_bits(bits + 0x9e3779b9u);
        to_fixed(values[c], (Float)(steps[c]), unit_float(bits), &low, &high);
        store_lanes_u(low, lane_low[c]);
        store_lanes_u(high, lane_high[c]);
    }
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        volatile __global CacheSum *sum = &sums[lane_slot[k]];
        for (uint c = 0; c < 4; ++c)
            if (lane_low[c][k] | lane_high[c][k])
                add_fixed(&sum->low[c], &sum->high[c], lane_low[c][k], lane_high[c][k]);
    }
}
