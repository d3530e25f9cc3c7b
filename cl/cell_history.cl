// Cells keep what they know from frame to frame.
//
// What is kept has a table of its own, with the buckets of those of passes: what happens in one bucket is
// the work of one item, in the order of passes.  Which slot of its bucket a cell has depends on the order in
// which samples came; what it knows does not.
//
// N. Binder, A. Keller: Ray-Traced Global Illumination for Games: Massively Parallel Path Space Filtering,
// GTC 2019.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/passes.h"
#include "common/cells.h"
#include "common/cell_samples.h"
#include "common/hash_map.h"
#include "common/history.h"

/// Add the sums of the cells of every complete pass to those of the frame.  One work item a bucket, between
/// store_cells and resolve_cells.
///
/// A bucket that has no room is marked: nobody asks it, and it begins anew with the next frame.  What had no
/// place is counted.
///
/// reads   cell_keys, cells, full_buckets
/// writes  kept_keys, kept_full, kept_cells.{sum, fresh, change}; counters.failed_histories (atomic)
kernel void gather_cells(
    __global const Params *params,
    volatile __global uint *counters,
    __global const uint *cell_keys,
    __global const Cell *cells,
    __global const uint *full_buckets,
    volatile __global uint *kept_keys,
    __global uint *kept_full,
    __global CellHistory *kept_cells)
{
    const uint size = bucket_size(params->cell_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->cell_slots / max(size, 1u))
        return;
    const uint passes = complete_passes(params, counters);
    uint failed = 0;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        const ulong at = place.slots + bucket * size;
        if (full_buckets[place.buckets + bucket] != 0u || bucket_is_empty(cell_keys + at, size))
            continue;
        for (uint i = 0; i < size; ++i) {
            const uint key = cell_keys[at + i];
            if (key == 0u)
                continue;
            const uint slot = find_or_insert(kept_keys, bucket * size, size, key);
            if (slot == NO_SLOT) {
                kept_full[bucket] = 1u;
                ++failed;
                continue;
            }
            __global const Cell *cell = &cells[at + i];
            __global CellHistory *to = &kept_cells[slot];
            for (uint c = 0; c < 3; ++c)
                to->sum[c] += ((float)cell->high[c] * 0x1p32f + (float)cell->low[c]) / params->cell_steps;
            to->fresh += (float)cell->count;
            to->change = max(to->change, as_float(cell->change));
        }
    }
    if (failed != 0u)
        count_up(&counters[COUNTER_FAILED_HISTORIES], failed);
}

/// Forget the cell in slot `i` of a bucket, and close the gap: no key may have a free slot before it.
static inline void forget_cell(__global uint *keys, __global CellHistory *cells, uint size, uint i)
{
    uint gap = i;
    for (uint step = 1; step < size; ++step) {
        const uint j = (i + step) & (size - 1u);
        if (keys[j] == 0u)
            break;
        // It may move if that does not bring it before the slot where its probing starts.
        const uint probes = probes_before(j, size, keys[j]);
        if (probes >= ((j - gap) & (size - 1u))) {
            keys[gap] = keys[j];
            cells[gap] = cells[j];
            gap = j;
        }
    }
    keys[gap] = 0u;
    for (uint part = 0; part < 3; ++part)
        vstore4((float4)(0.0f), part, (__global float *)&cells[gap]);
}

/// Blend what W cells gathered in this frame with what they knew.  `largest` is the largest change of all.
static inline void blend_cells(
    __global const Params *params,
    __global const uint *keys,
    __global CellHistory *cells,
    uint first,
    uint size,
    float largest)
{
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const Mask inside = wanted < size;
    const UInt at = pick_u(inside, wanted, (UInt)(0u));
    const Mask there = inside & (GATHER_WORD(keys, at) != 0u);
    if (!any_lane(there))
        return;
    const Vec3 known = vec3(GATHER(cells, at, mean[0]), GATHER(cells, at, mean[1]), GATHER(cells, at, mean[2]));
    const Vec3 sum = vec3(GATHER(cells, at, sum[0]), GATHER(cells, at, sum[1]), GATHER(cells, at, sum[2]));
    const Float count = GATHER(cells, at, count);
    const Float square = GATHER(cells, at, square);
    const Float fresh = GATHER(cells, at, fresh);
    const Float frames = GATHER(cells, at, frames);
    const Mask seen = fresh > 0.0f;
    const Float inverse = 1.0f / max(fresh, 1.0f);
    const Vec3 rgb = scale(sum, inverse);
    const Float scatter = scatter_of(luminance(known), square);
    const Share share = share_of_frame(params, count, scatter, GATHER(cells, at, change), fresh);
    const Vec3 mean = pick_v(seen, add_scaled(scale(known, 1.0f - share.alpha), rgb, share.alpha), known);
    const Float brightness = luminance(rgb);
    const Float mean_square =
        pick(seen, (1.0f - share.alpha) * square + share.alpha * brightness * brightness, square);
    // What nobody sees may have changed as much as anything.
    const Float worth = worth_of(scatter, count, (Float)(largest), count / max(frames, 1e-6f));
    const Float kept = pick(seen, share.count - fresh, worth);
    const Float left = frames * (kept / max(count, 1e-6f));
    const Float values[6] = {mean.x, mean.y, mean.z, pick(seen, share.count, worth), mean_square,
                             pick(seen, left + 1.0f, left)};
    float lane[6][W];
    for (uint c = 0; c < 6; ++c)
        store_lanes(values[c], lane[c]);
    for (uint bits = lane_bits(there); bits; bits &= bits - 1u) {
        const uint k = lowest_bit(bits);
        __global float *words = (__global float *)&cells[first + k];
        const float when = lane_bits(seen) >> k & 1u ? params->frame_time : cells[first + k].seen;
        vstore4((float4)(lane[0][k], lane[1][k], lane[2][k], lane[3][k]), 0, words);
        vstore4((float4)(0.0f), 1, words);
        vstore4((float4)(lane[4][k], lane[5][k], when, 0.0f), 2, words);
    }
}

/// Blend what cells gathered in the frame that ends with what they knew, and build their table anew without
/// those that nobody has seen for too long.  One work item a bucket.
///
/// reads   cell_changes
/// writes  kept_keys, kept_full, kept_cells
kernel void keep_cells(
    __global const Params *params,
#if CELL_HISTORY == 2
    __global const uint *cell_changes,
#endif
    __global uint *kept_keys,
    __global uint *kept_full,
    __global CellHistory *kept_cells)
{
    const uint size = bucket_size(params->cell_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->cell_slots / max(size, 1u))
        return;
    __global uint *keys = kept_keys + bucket * size;
    __global CellHistory *cells = kept_cells + bucket * size;
    if (kept_full[bucket] != 0u) {
        // Which cells found room depends on the order in which they came.
        kept_full[bucket] = 0u;
        for (uint i = 0; i < size; ++i) {
            keys[i] = 0u;
            for (uint part = 0; part < 3; ++part)
                vstore4((float4)(0.0f), part, (__global float *)&cells[i]);
        }
        return;
    }
    if (bucket_is_empty(keys, size))
        return;
    float largest = 0.0f;
#if CELL_HISTORY == 2
    if ((params->history_flags & HISTORY_CHANGED) && params->temporal_rule == RULE_ADAPTIVE)
        largest = max(as_float(cell_changes[params->cell_slots]) - 1.0f, 0.0f);
#endif
    for (uint first = 0; first < size; first += W)
        blend_cells(params, keys, cells, first, size, largest);
    for (uint i = 0; i < size; ++i)
        while (keys[i] != 0u && !(fabs(params->frame_time - cells[i].seen) <= params->cell_history))
            forget_cell(keys, cells, size, i);
}
