// The guide between passes: what was learned becomes what paths are drawn by.

#include "common/features.h"
#include "common/layout.h"
#include "common/hash_map.h"

// Visits that what is known of the square around is worth.
#define TRUST 8.0f

static inline float sum_of(__global const GuideSum *sums, uint k)
{
    return (float)sums->high[k] * 0x1p32f + (float)sums->low[k];
}

/// Begin parts of the table anew that have run over: what came late had no place there.  One work item a
/// bucket, while no path is on its way.
///
/// reads   guide_full
/// writes  guide_keys, guide_full, guide_sums, guide_cells
kernel void renew_guide(
    __global const Params *params,
    __global uint *guide_keys,
    __global uint *guide_full,
    __global GuideSum *guide_sums,
    __global GuideCell *guide_cells)
{
    const uint size = bucket_size(params->guide_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->guide_slots / max(size, 1u) || guide_full[bucket] == 0u)
        return;
    guide_full[bucket] = 0u;
    for (uint slot = bucket * size; slot < (bucket + 1u) * size; ++slot) {
        guide_keys[slot] = 0u;
        guide_cells[slot].mean = 0.0f;
        guide_cells[slot].visits = 0.0f;
        for (uint k = 0; k < GUIDE_BINS; ++k) {
            guide_sums[slot].low[k] = 0u;
            guide_sums[slot].high[k] = 0u;
            guide_sums[slot].count[k] = 0u;
        }
    }
}

/// Make the densities of all cells anew from their sums.  One work item a slot, while no path is on its
/// way.
///
/// A part's value is the mean of its visits, with the mean of the cell as one more; the density is a mix
/// of that and of the cosine.  Cells in buckets that overflowed are given up, for which of them are there
/// depends on the order in which they came.
///
/// reads   guide_keys, guide_full, guide_sums
/// writes  guide_cells
kernel void freeze_guide(
    __global const Params *params,
    __global const uint *guide_keys,
    __global const uint *guide_full,
    __global GuideSum *guide_sums,
    __global GuideCell *guide_cells,
    const uint fades)
{
    const uint slot = get_global_id(0);
    const uint slots = params->guide_slots;
    if (slot >= slots || guide_keys[slot] == 0u)
        return;
    __global GuideSum *sums = &guide_sums[slot];
    __global GuideCell *cell = &guide_cells[slot];
    float total = 0.0f;
    float visits = 0.0f;
    for (uint k = 0; k < GUIDE_BINS; ++k) {
        total += sum_of(sums, k);
        visits += (float)sums->count[k];
    }
    const float inverse = 1.0f / params->guide_steps;
    // From the whole square to ever smaller ones: each begins with what the one around it knows.
    float value[GUIDE_BINS];
    value[0] = total * inverse / max(visits, 1.0f);
    for (uint side = 2; side <= GUIDE_SIDE; side *= 2) {
        const uint edge = GUIDE_SIDE / side;
        // The last first: a square takes the place of one whose own squares are done.
        for (uint square = side * side; square-- > 0;) {
            const uint i = square / side;
            const uint j = square % side;
            const float around = value[(i / 2) * (side / 2) + j / 2];
            float seen = 0.0f;
            float n = 0.0f;
            for (uint a = i * edge; a < (i + 1) * edge; ++a)
                for (uint b = j * edge; b < (j + 1) * edge; ++b) {
                    seen += sum_of(sums, a * GUIDE_SIDE + b);
                    n += (float)sums->count[a * GUIDE_SIDE + b];
                }
            value[square] = (seen * inverse + TRUST * around) / (n + TRUST);
        }
    }
    float sum = 0.0f;
    for (uint k = 0; k < GUIDE_BINS; ++k)
        sum += value[k];
    const int given_up = guide_full[slot / bucket_size(slots)] != 0u;
    const int knows = visits >= (float)GUIDE_BINS && sum > 0.0f && sum < INFINITY && !given_up;
    const float by_guide = knows ? params->guide_share : 0.0f;
    const float norm = knows ? GUIDE_BINS / sum : 0.0f;
    float below = 0.0f;
    for (uint i = 0; i < GUIDE_SIDE; ++i) {
        for (uint j = 0; j < GUIDE_SIDE; ++j) {
            const uint k = i * GUIDE_SIDE + j;
            const float density = 1.0f - by_guide + by_guide * value[k] * norm;
            cell->density[k] = density;
            below += density;
        }
        cell->rows[i] = below;
    }
    for (uint i = 0; i < GUIDE_SIDE; ++i)
        cell->rows[i] /= below;
    cell->mean = given_up ? 0.0f : sum / GUIDE_BINS;
    cell->visits = given_up ? 0.0f : visits;
    if (fades)
        for (uint k = 0; k < GUIDE_BINS; ++k) {
            sums->low[k] = (sums->low[k] >> 1) | (sums->high[k] << 31);
            sums->high[k] >>= 1;
            sums->count[k] >>= 1;
        }
}
