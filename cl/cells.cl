// Path space filtering: the light that paths carry beyond a vertex is averaged per cell.
//
// A complete pass is stored in a table of its own, looked up, added to the film and cleared, all in the
// order of the pixels: paths of other passes go on meanwhile.
//
// Binder, Fricke, Keller: Massively Parallel Path Space Filtering, 2019.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/passes.h"
#include "common/cells.h"
#include "common/cell_samples.h"
#include "common/hash_map.h"
#include "common/pixel_queue.h"
#include "common/cell_history.h"
#include "common/shared_samples.h"
#include "common/walls.h"

#if SPARSE
/// Count the samples of complete passes where they would be stored.  One work item W pixels, RUN times, first
/// of all.
///
/// reads   beyond, vertices, counters
/// writes  crowds (atomic)
kernel void count_crowds(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    const volatile __global uint *counters,
    volatile __global uint *crowds)
{
    const PixelQueue own = pixel_queue(params->pixel_count);
    const uint passes = own.next < own.end ? complete_passes(params, counters) : 0u;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        PixelQueue queue = own;
        PixelBlock block;
        while (take_block(&queue, &block)) {
            const UInt vertex = GATHER_U(beyond + place.samples, block.pixel, vertex);
            const Mask there = block.inside & (vertex != 0u);
            if (!any_lane(there))
                continue;
            const CellQuery query = load_query(params, vertices + place.samples, block.pixel, vertex, place.width);
            const UInt at = entry_of(params, first_place_to_store(params, &query, block.pixel, place.pass));
            uint lane_at[W];
            store_lanes_u(at, lane_at);
            for (uint left = lane_bits(there); left;) {
                const uint entry = lane_at[lowest_bit(left)];
                const uint same = left & lane_bits(at == entry);
                left &= ~same;
                atomic_add(&crowds[place.slots + entry], popcount(same));
            }
        }
    }
}
#endif

#if WALLS
/// Mark the cells where samples of complete passes met something within a cell's width with the side that it
/// faces: those that they are stored in, and those that they are in.  One work item W pixels, RUN times,
/// before store_cells.
///
/// reads   beyond, vertices, counters
/// writes  near_cells (atomic)
kernel void mark_near_cells(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    const volatile __global uint *counters,
    volatile __global uint *near_cells CROWD_BUFFERS)
{
    const PixelQueue own = pixel_queue(params->pixel_count);
    const uint passes = own.next < own.end ? complete_passes(params, counters) : 0u;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        volatile __global uint *marks = near_cells + place.slots;
        PixelQueue queue = own;
        PixelBlock block;
        while (take_block(&queue, &block)) {
            const UInt vertex = GATHER_U(beyond + place.samples, block.pixel, vertex);
            const Mask near = block.inside & ((vertex & VERTEX_NEAR) != 0u);
            const Mask ready = near & !put_off(&queue, &block, near);
            if (!any_lane(ready))
                continue;
            const CellQuery query = load_query(params, vertices + place.samples, block.pixel, vertex, place.width);
            const CellPlace stored = place_to_store(
                params, &query, block.pixel, place.pass CROWD_ARGUMENTS_OF(crowds + place.slots));
            const CellPlace at = place_to_look_up(
                params, &query, block.pixel, place.pass, 0 CROWD_ARGUMENTS_OF(crowds + place.slots));
            mark_cells(params, marks, ready, stored, vertex);
            mark_cells(params, marks, ready, at, vertex);
        }
    }
}
#endif

#if AOV_CELLS
/// Steps of the sum of (luminance / cell_limit)^2 of as many samples as there are pixels.
static inline Float square_steps(__global const Params *params) { return (Float)(0x1p63f / (float)params->cell_slots); }
#endif

/// Add what W samples gathered behind their vertices to cells.
static inline void store_samples(
    __global const Params *params,
    __global Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    volatile __global uint *keys,
    volatile __global Cell *cells,
#if AOV_CELLS
    volatile __global CellSquares *squares,
#endif
    __global uint *full_buckets,
    PixelQueue *queue,
    const PixelBlock *block,
    const PassPlace *place CHANGE_BUFFER CROWD_BUFFERS WALL_BUFFERS)
{
    const UInt pixel = block->pixel;
    const UInt vertex = GATHER_U(beyond, pixel, vertex);
    const Vec3 light = demodulated(load_beyond(beyond, pixel), load_gate(vertices, pixel));
    const UInt largest = max(as_bits(light.x), max(as_bits(light.y), as_bits(light.z)));
    Mask there = block->inside & (vertex != 0u);
    uint lane_pixel[W];
    store_lanes_u(pixel, lane_pixel);
    const Mask rejected = there & (largest >= as_uint(params->cell_limit));
    if (any_lane(rejected)) {
        count_up(&counters[COUNTER_REJECTED_CELLS], count_lanes(rejected));
        for (uint left = lane_bits(rejected); left; left &= left - 1u)
            beyond[lane_pixel[lowest_bit(left)]].vertex |= VERTEX_REJECTED;
        there &= !rejected;
    }
    if (!any_lane(there))
        return;
    const CellQuery query = load_query(params, vertices, pixel, vertex, place->width);
    const CellPlace at = place_to_store(params, &query, pixel, place->pass CROWD_ARGUMENTS);
    const Mask near = may_have_wall(params, there, at WALL_ARGUMENTS);
    there &= !put_off(queue, block, near);
    const UInt wall = wall_before(params, near & there, &query, at, place->pass, pixel WALL_ARGUMENTS);
    if (any_lane(wall != 0u)) {
        uint lane_wall[W];
        store_lanes_u(wall << VERTEX_WALL_SHIFT, lane_wall);
        for (uint left = lane_bits(wall != 0u); left; left &= left - 1u)
            beyond[lane_pixel[lowest_bit(left)]].vertex |= lane_wall[lowest_bit(left)];
    }
    const CellKey key = cell_key(params, &query, at, wall);

    const Float value[3] = {light.x, light.y, light.z};
    uint lane_low[3][W];
    uint lane_high[3][W];
    UInt random = mix_bits(pixel * 0x9e3779b9u + place->pass);
    for (uint c = 0; c < 3; ++c) {
        UInt low;
        UInt high;
        to_fixed(value[c], (Float)(params->cell_steps), unit_float(random), &low, &high);
        store_lanes_u(low, lane_low[c]);
        store_lanes_u(high, lane_high[c]);
        random = mix_bits(random + 0x9e3779b9u);
    }
#if AOV_CELLS
    const Float part = luminance(light) / params->cell_limit;
    UInt square_low;
    UInt square_high;
    to_fixed(part * part, square_steps(params), unit_float(random), &square_low, &square_high);
    uint lane_square_low[W];
    uint lane_square_high[W];
    store_lanes_u(square_low, lane_square_low);
    store_lanes_u(square_high, lane_square_high);
#endif
#if CELL_HISTORY == 2
    UInt a;
    UInt b;
    cell_random(params, pixel / CELL_TILE, place->pass, CELL_STORE, &a, &b);
    float lane_change[W];
    store_lanes(change_in_cell(params, &query, at, a, b, params->cell_flags & CELL_JITTER CHANGE_ARGUMENT), lane_change);
#endif
    const uint size = bucket_size(params->cell_slots);
    uint lane_bucket[W];
    uint lane_slot[W];
    uint lane_same[W];
    store_lanes_u(key.bucket, lane_bucket);
    uint left = claim_lanes(keys, cells, there, key.bucket, key.key, size, lane_slot, lane_same);
    uint failed = 0;
    for (; left; left &= left - 1u) {
        const uint i = lowest_bit(left);
        const uint slot = lane_slot[i];
        if (slot == NO_SLOT) {
            full_buckets[lane_bucket[i] / size] = 1u;
            failed += popcount(lane_same[i]);
        } else {
            add_lanes(&cells[slot], lane_same[i], lane_low, lane_high);
#if CELL_HISTORY == 2
            float change = 0.0f;
            for (uint same = lane_same[i]; same; same &= same - 1u)
                change = max(change, lane_change[lowest_bit(same)]);
            if (change > 0.0f)
                atomic_max(&cells[slot].change, as_uint(change));
#endif
#if AOV_CELLS
            for (uint same = lane_same[i]; same; same &= same - 1u)
                add_fixed(&squares[slot].low, &squares[slot].high, lane_square_low[lowest_bit(same)],
                          lane_square_high[lowest_bit(same)]);
#endif
        }
    }
    if (failed != 0u)
        count_up(&counters[COUNTER_FAILED_INSERTS], failed);
}

/// Add what the samples of every complete pass gathered behind their vertices to cells.  One work item W
/// pixels, RUN times, after the passes are complete and before resolve_cells.
///
/// A sample whose bucket is full marks it: nobody uses the bucket.  One that is too large for the sums is
/// left out, and marked.  Both are counted.
///
/// reads   beyond, vertices, counters; with WALLS near_cells, geometry
/// writes  cell_keys, cells, cell_squares, full_buckets, beyond.vertex, counters.{failed_inserts, rejected_cells} (atomic)
kernel void store_cells(
    __global const Params *params,
    __global Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    volatile __global uint *cell_keys,
    volatile __global Cell *cells,
#if AOV_CELLS
    volatile __global CellSquares *cell_squares,
#endif
    __global uint *full_buckets CHANGE_BUFFER CROWD_BUFFERS WALL_BUFFERS)
{
    const PixelQueue own = pixel_queue(params->pixel_count);
    const uint passes = own.next < own.end ? complete_passes(params, counters) : 0u;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        PixelQueue queue = own;
        PixelBlock block;
        while (take_block(&queue, &block))
            store_samples(params, beyond + place.samples, vertices + place.samples, counters,
                          cell_keys + place.slots, cells + place.slots,
#if AOV_CELLS
                          cell_squares + place.slots,
#endif
                          full_buckets + place.buckets, &queue, &block,
                          &place CHANGE_ARGUMENT CROWD_ARGUMENTS_OF(crowds + place.slots)
                                  WALL_ARGUMENTS_OF(near_cells + place.slots));
    }
}

/// Turn the sums of the cells of every complete pass into averages.  One work item a bucket, between
/// store_cells and look_up_cells.
///
/// reads   cell_keys, counters
/// writes  cells, cell_squares
kernel void resolve_cells(
    __global const Params *params,
    const volatile __global uint *counters,
    __global const uint *cell_keys,
#if AOV_CELLS
    __global CellSquares *cell_squares,
#endif
    __global Cell *cells)
{
    const uint size = bucket_size(params->cell_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->cell_slots / max(size, 1u))
        return;
    const uint passes = complete_passes(params, counters);
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        const ulong at = place.slots + bucket * size;
        if (bucket_is_empty(cell_keys + at, size))
            continue;
        for (uint i = 0; i < size; ++i) {
            if (cell_keys[at + i] == 0u)
                continue;
            __global Cell *cell = &cells[at + i];
            const float inverse = 1.0f / (params->cell_steps * (float)cell->count);
            for (uint c = 0; c < 3; ++c)
                cell->low[c] = as_uint(((float)cell->high[c] * 0x1p32f + (float)cell->low[c]) * inverse);
#if AOV_CELLS
            __global CellSquares *square = &cell_squares[at + i];
            const float mean = 0.2126f * as_float(cell->low[0]) + 0.7152f * as_float(cell->low[1])
                               + 0.0722f * as_float(cell->low[2]);
            const float sum = (float)square->high * 0x1p32f + (float)square->low;
            const float limit = params->cell_limit;
            const float second = sum * (0x1p-63f * (float)params->cell_slots) * limit / (float)cell->count * limit;
            square->low = as_uint(max(second - mean * mean, 0.0f));
#endif
        }
    }
}

#if AOV_CELLS
/// Add what a sample saw of the cell in `slot` to what its pixel did; nothing if there is none.
static inline void view_cell(
    __global CellView *view,
    __global const Cell *cells,
    __global const CellSquares *squares,
    __global const uint *keys,
    uint slot,
    uint size,
    int is_first)
{
    if (slot == NO_SLOT)
        return;
    const uint bucket = slot & ~(size - 1u);
    uint taken = 0;
    for (uint i = 0; i < size; ++i)
        taken += LOOK(&keys[bucket + i]) != 0u;
    view->occupancy += (float)taken / (float)size;
    view->count += (float)LOOK(&cells[slot].count);
    view->variance += as_float(squares[slot].low);
    view->weight += 1.0f;
    // The slot with the key, for keys of different buckets may be the same.
    uint bits = LOOK(&keys[slot]) * 0x9e3779b9u + slot * 0x85ebca77u;
    for (uint c = 0; is_first && c < 3; ++c) {
        bits = (bits ^ (bits >> 15)) * 0x2c1b3c6du;
        view->color[c] = (float)(bits >> 8) * 5.9604645e-8f;
    }
}
#endif

/// Add the light from behind the vertices to W samples.
static inline void look_up_samples(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    __global const uint *keys,
    __global const Cell *cells,
#if AOV_CELLS
    __global const CellSquares *squares,
    __global CellView *views,
#endif
    __global const uint *full_buckets,
#if BASE
    __global const Seen *seen,
    __global float *base,
#endif
#if RESTORE
    __global Lost *film_lost,
    __global float *film_shared,
#endif
#if CELL_HISTORY
    __global SharedLight *shared,
#endif
    __global float *samples,
    PixelQueue *queue,
    const PixelBlock *block,
    const PassPlace *place KNOWN_BUFFERS CROWD_BUFFERS WALL_BUFFERS)
{
    const UInt pixel = block->pixel;
    const UInt vertex = GATHER_U(beyond, pixel, vertex);
    Mask wanted = block->inside & (vertex != 0u);
    if (!any_lane(wanted))
        return;
    Mask there = wanted & ((vertex & VERTEX_REJECTED) == 0u);
    const CellQuery query = load_query(params, vertices, pixel, vertex, place->width);
    const uint size = bucket_size(params->cell_slots);
    const CellPlace at =
        place_to_look_up(params, &query, pixel, place->pass, params->cell_flags & CELL_JITTER CROWD_ARGUMENTS);
    const Mask near = may_have_wall(params, there, at WALL_ARGUMENTS);
    const Mask later = put_off(queue, block, near);
    wanted &= !later;
    there &= !later;
    const UInt wall = wall_before(params, near & there, &query, at, place->pass, pixel WALL_ARGUMENTS);
    CellKey key = cell_key(params, &query, at, wall);
    UInt slot = find_lanes(keys, full_buckets, there, key.bucket, size, key.key);
    const Mask empty = there & (slot == NO_SLOT);
    if (any_lane(empty)) {
        // Nothing was stored there: the cell that the sample itself went to.
        key = cell_key(params, &query, place_to_store(params, &query, pixel, place->pass CROWD_ARGUMENTS), wall_at_store(vertex));
        slot = pick_u(empty, find_lanes(keys, full_buckets, empty, key.bucket, size, key.key), slot);
    }
    const Mask found = slot != NO_SLOT;
    const UInt cell = pick_u(found, slot, (UInt)(0u));
    const Vec3 mean = vec3(from_bits(GATHER_U(cells, cell, low[0])), from_bits(GATHER_U(cells, cell, low[1])),
                           from_bits(GATHER_U(cells, cell, low[2])));
    Vec3 light = mul(load_gate(vertices, pixel), mean);
    const Mask alone = wanted & !found;
#if RESTORE
    const Vec3 own = load_beyond(beyond, pixel);
#endif
    if (any_lane(alone)) {
        light = pick_v(alone, load_beyond(beyond, pixel), light);
        count_up(&counters[COUNTER_UNFILTERED_SAMPLES], count_lanes(alone));
    }
#if RESTORE
    const Vec3 lost = sub(own, light);
    const float sign = pass_is_in_half((place->pass - params->first_pass) / params->splits) ? -1.0f : 1.0f;
    const Float brightness = sign * luminance(lost);
    float lane_lost[4][W];
    float lane_shared[W];
    store_lanes(lost.x, lane_lost[0]);
    store_lanes(lost.y, lane_lost[1]);
    store_lanes(lost.z, lane_lost[2]);
    store_lanes(brightness, lane_lost[3]);
    store_lanes(luminance(light), lane_shared);
#endif
#if AOV_CELLS
    uint lane_slot[W];
    store_lanes_u(slot, lane_slot);
#endif
#if CELL_HISTORY
    const CellKnown known =
        known_of(params, found, &query, at, wall, pixel, place->pass KNOWN_ARGUMENTS);
    const Mask is_known = known.frames > 0.0f;
    const Vec3 before = pick_v(is_known, mul(load_gate(vertices, pixel), known.mean), light);
    float lane_before[4][W];
    store_lanes(before.x, lane_before[0]);
    store_lanes(before.y, lane_before[1]);
    store_lanes(before.z, lane_before[2]);
    store_lanes(known.frames, lane_before[3]);
    const uint cell_lanes = lane_bits(found);
#endif
    uint lane_pixel[W];
    float lane_light[3][W];
    store_lanes_u(pixel, lane_pixel);
    store_lanes(light.x, lane_light[0]);
    store_lanes(light.y, lane_light[1]);
    store_lanes(light.z, lane_light[2]);
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint i = lowest_bit(left);
        const uint own_pixel = lane_pixel[i];
        const float4 more = (float4)(lane_light[0][i], lane_light[1][i], lane_light[2][i], 0.0f);
        const float4 before = vload4(own_pixel, samples);
        vstore4(before + more, own_pixel, samples);
#if CELL_HISTORY
        if (before.w > 0.0f && (cell_lanes >> i & 1u)) {
            __global float *sums = (__global float *)&shared[own_pixel];
            const float4 older = (float4)(lane_before[0][i], lane_before[1][i], lane_before[2][i], 1.0f);
            float4 base_part = (float4)(older.xyz, 0.0f);
#if BASE
            base_part *= base_share_of(beyond, seen, own_pixel);
#endif
            vstore4(vload4(0, sums) + (float4)(more.xyz, lane_before[3][i]), 0, sums);
            vstore4(vload4(1, sums) + older, 1, sums);
            vstore4(vload4(2, sums) + base_part, 2, sums);
        }
#endif
#if RESTORE
        // Of a sample that the film does not take nothing is known.
        if (before.w > 0.0f) {
            __global float *sums = (__global float *)&film_lost[own_pixel];
            __global float *excess = (__global float *)&film_lost[params->pixel_count + own_pixel];
            const float4 all = (float4)(lane_lost[0][i], lane_lost[1][i], lane_lost[2][i], lane_lost[3][i]);
            // Kahan (1965): what rounding added too much goes from the next sample.
            const float4 added = all - vload4(0, excess);
            const float4 sum = vload4(0, sums) + added;
            vstore4((sum - vload4(0, sums)) - added, 0, excess);
            vstore4(sum, 0, sums);
            // It is only compared with noise: that it stands still after some millions does no harm.
            film_shared[own_pixel] += lane_shared[i];
        }
#endif
#if AOV_CELLS
        if (before.w > 0.0f)
            view_cell(&views[own_pixel], cells, squares, keys, lane_slot[i], size, place->pass == params->first_pass);
#endif
#if BASE
        vstore4(vload4(own_pixel, base) + more * base_share_of(beyond, seen, own_pixel), own_pixel, base);
#endif
    }
}

/// Add the light from behind the vertices to the samples of every complete pass: the average of the cell,
/// or the sample's own where there is none.  One work item W pixels, RUN times, after resolve_cells.
///
/// reads   beyond, vertices, cell_keys, cells, full_buckets, seen; kept_*, cell_changes; with WALLS near_cells,
///         geometry
/// writes  samples, base, film_lost, film_shared, film_cells, shared_light; counters.unfiltered_samples (atomic)
kernel void look_up_cells(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    __global const uint *cell_keys,
    __global const Cell *cells,
#if AOV_CELLS
    __global const CellSquares *cell_squares,
    __global CellView *film_cells,
#endif
    __global const uint *full_buckets,
#if BASE
    __global const Seen *seen,
    __global float *base,
#endif
#if RESTORE
    __global Lost *film_lost,
    __global float *film_shared,
#endif
#if CELL_HISTORY
    __global SharedLight *shared_light,
#endif
    __global float *samples KNOWN_BUFFERS CROWD_BUFFERS WALL_BUFFERS)
{
    const PixelQueue own = pixel_queue(params->pixel_count);
    const uint passes = own.next < own.end ? complete_passes(params, counters) : 0u;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        PixelQueue queue = own;
        PixelBlock block;
        while (take_block(&queue, &block))
            look_up_samples(params, beyond + place.samples, vertices + place.samples, counters,
                            cell_keys + place.slots, cells + place.slots,
#if AOV_CELLS
                            cell_squares + place.slots, film_cells,
#endif
                            full_buckets + place.buckets,
#if BASE
                            seen + place.samples, base + 4 * place.samples,
#endif
#if RESTORE
                            film_lost, film_shared,
#endif
#if CELL_HISTORY
                            shared_light,
#endif
                            samples + 4 * place.samples, &queue, &block, &place KNOWN_ARGUMENTS CROWD_ARGUMENTS_OF(crowds + place.slots)
                                  WALL_ARGUMENTS_OF(near_cells + place.slots));
    }
}

/// Empty the tables of every complete pass and count what was in them.  One work item a bucket.
///
/// reads   counters
/// writes  cell_keys, cells, cell_squares, full_buckets, crowds, near_cells; counters.{cells_used, cell_probes} (atomic)
kernel void clear_cells(
    __global const Params *params,
    volatile __global uint *counters,
    __global uint *cell_keys,
    __global Cell *cells,
#if AOV_CELLS
    __global CellSquares *cell_squares,
#endif
#if SPARSE
    __global uint *crowds,
#endif
#if WALLS
    __global uint *near_cells,
#endif
    __global uint *full_buckets)
{
    const uint size = bucket_size(params->cell_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->cell_slots / max(size, 1u))
        return;
    const uint passes = complete_passes(params, counters);
    uint used = 0;
    uint probes = 0;
    for (uint k = 0; k < passes; ++k) {
        const PassPlace place = place_of(params, counters[COUNTER_FILM_PASS] + k);
        const ulong at = place.slots + bucket * size;
#if SPARSE
        for (uint i = 0; i < size; ++i)
            crowds[at + i] = 0u;
#endif
#if WALLS
        for (uint i = 0; i < size; ++i)
            near_cells[at + i] = 0u;
#endif
        if (bucket_is_empty(cell_keys + at, size))
            continue;
        for (uint i = 0; i < size; ++i) {
            const uint key = cell_keys[at + i];
            if (key == 0u)
                continue;
            ++used;
            probes += probes_before(i, size, key) + 1u;
            cell_keys[at + i] = 0u;
            vstore8((uint8)(0u), at + i, (__global uint *)cells);
#if AOV_CELLS
            vstore2((uint2)(0u), at + i, (__global uint *)cell_squares);
#endif
        }
        full_buckets[place.buckets + bucket] = 0u;
    }
    if (used != 0u) {
        add_fixed(&counters[COUNTER_CELLS_USED], &counters[COUNTER_CELLS_USED_HIGH], used, 0u);
        add_fixed(&counters[COUNTER_CELL_PROBES], &counters[COUNTER_CELL_PROBES_HIGH], probes, 0u);
    }
}

/// Add what the samples of an interrupted first pass gathered behind their vertices, as it is.  One work
/// item a pixel, after add_samples.
///
/// reads   samples, beyond
/// writes  film
kernel void add_unfiltered(
    __global const Params *params, __global const float *samples, __global const Beyond *beyond, __global FilmSum *film)
{
    const uint pixel = get_global_id(0);
    if (pixel < params->pixel_count)
        add_as_it_is(params, samples, beyond, film, pixel);
}
