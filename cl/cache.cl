// The radiance cache between passes: what was gathered becomes what paths end by.

#include "common/features.h"
#include "common/layout.h"
#include "common/cache.h"

// Visits before a cell is known, and squared relative deviation of a visit that is taken for granted before
// any was measured.
#define CACHE_LEAST_VISITS 16.0f
#define CACHE_FIRST_VARIANCE 8.0f

// Share of the visits that come from nearer than a cell's edge, from which on nothing is known of the cell: in
// corners, gaps and under doors light changes within less than a cell.
#define CACHE_MOST_NEAR 0.125f

static inline float cache_sum(__global const CacheSum *sums, uint c)
{
    return (float)sums->high[c] * 0x1p32f + (float)sums->low[c];
}

/// Begin parts of the table anew that have run over: what came late had no place there.  One work item a
/// bucket, while no path is on its way.
///
/// reads   cache_full
/// writes  cache_keys, cache_full, cache_sums, cache_cells
kernel void renew_cache(
    __global const Params *params,
    __global uint *cache_keys,
    __global uint *cache_full,
    __global CacheSum *cache_sums,
    __global CacheCell *cache_cells)
{
    const uint size = bucket_size(params->cache_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->cache_slots / max(size, 1u) || cache_full[bucket] == 0u)
        return;
    cache_full[bucket] = 0u;
    for (uint slot = bucket * size; slot < (bucket + 1u) * size; ++slot) {
        cache_keys[slot] = 0u;
        vstore8((float8)(0.0f), slot, (__global float *)cache_cells);
        for (uint c = 0; c < 4; ++c) {
            cache_sums[slot].low[c] = 0u;
            cache_sums[slot].high[c] = 0u;
        }
        cache_sums[slot].count = 0u;
        cache_sums[slot].near = 0u;
    }
}

/// Make what all cells know anew from their sums, and the chances that paths end there.  One work item a
/// slot, while no path is on its way.
///
/// The chance of tracing on is at least params->cache_trace, and 1 where the mean has an error of a quarter
/// or more, by the variance and the number of its visits.  Cells in buckets that overflowed are given up,
/// for which of them are there depends on the order in which they came.
///
/// reads   cache_keys, cache_full, cache_sums
/// writes  cache_cells, cache_sums
kernel void freeze_cache(
    __global const Params *params,
    __global const uint *cache_keys,
    __global const uint *cache_full,
    __global CacheSum *cache_sums,
    __global CacheCell *cache_cells,
    const uint fades)
{
    const uint slot = get_global_id(0);
    const uint slots = params->cache_slots;
    if (slot >= slots || cache_keys[slot] == 0u)
        return;
    __global CacheSum *sums = &cache_sums[slot];
    __global CacheCell *cell = &cache_cells[slot];
    const float visits = (float)sums->count;
    const float inverse = 1.0f / (params->cache_steps * max(visits, 1.0f));
    const float before = 0.2126f * cell->mean[0] + 0.7152f * cell->mean[1] + 0.0722f * cell->mean[2];
    float mean[3];
    for (uint c = 0; c < 3; ++c)
        mean[c] = cache_sum(sums, c) * inverse;
    const float now = 0.2126f * mean[0] + 0.7152f * mean[1] + 0.0722f * mean[2];
    const int given_up = cache_full[slot / bucket_size(slots)] != 0u;
    const int crowded = (float)sums->near > CACHE_MOST_NEAR * visits;
    const int known = visits >= CACHE_LEAST_VISITS && now < INFINITY && !crowded && !given_up;
    // Squares are relative to the mean that there was: now to that of now.
    float squares = visits * (1.0f + CACHE_FIRST_VARIANCE);
    if (before > 0.0f && now > 0.0f)
        squares = min(cache_sum(sums, 3) / CACHE_SQUARE_STEPS * (before / now) * (before / now),
                      visits * CACHE_MOST_SQUARE);
    const float variance = max(squares / max(visits, 1.0f) - 1.0f, 0.0f);
    const float unsure = min(16.0f * variance / max(visits, 1.0f), 1.0f);
    const float trace = params->cache_trace;
    const float ends = trace > 0.0f ? (1.0f - trace) * (1.0f - unsure) : 1.0f;
    for (uint c = 0; c < 3; ++c)
        cell->mean[c] = known ? mean[c] : 0.0f;
    cell->ends = known ? ends : 0.0f;
    cell->visits = known ? visits : 0.0f;
    const float steps = (known && now > 0.0f ? squares : 0.0f) * CACHE_SQUARE_STEPS;
    const float upper = floor(steps * 0x1p-32f);
    sums->high[3] = (uint)upper;
    sums->low[3] = (uint)(steps - upper * 0x1p32f);
    // Half of an odd number of visits is no number of visits: it must not count where there are few.
    if (fades && visits >= 2.0f * CACHE_LEAST_VISITS) {
        for (uint c = 0; c < 4; ++c) {
            sums->low[c] = (sums->low[c] >> 1) | (sums->high[c] << 31);
            sums->high[c] >>= 1;
        }
        sums->count >>= 1;
        sums->near >>= 1;
    }
}
