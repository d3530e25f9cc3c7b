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
#include "common/pixels.h"
#include "common/cells.h"
#include "common/hash_map.h"

/// W samples of a pass, as the cells see them.
typedef struct {
    Mask there;       // it has a vertex, and what it gathered behind it can be summed
    Mask rejected;    // it has a vertex, but what it gathered is too large, or not a number
    UInt pixel;       // place in the order of pixels
    Vec3 beyond;      // radiance at the camera
    Vec3 gate;        // what became of light on its way from the vertex to the camera
    CellQuery query;
} CellSamples;

static inline CellSamples load_cell_samples(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    uint first,
    uint pass)
{
    const ulong base = (ulong)(pass & (params->ring - 1u)) * params->pixel_count;
    beyond += base;
    vertices += base;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const Mask inside = wanted < params->pixel_count;
    CellSamples s;
    s.pixel = pick_u(inside, wanted, (UInt)(0u));
    s.beyond = vec3(GATHER(beyond, s.pixel, radiance[0]), GATHER(beyond, s.pixel, radiance[1]),
                    GATHER(beyond, s.pixel, radiance[2]));
    const UInt vertex = GATHER_U(beyond, s.pixel, vertex);
    s.gate = vec3(GATHER(vertices, s.pixel, gate[0]), GATHER(vertices, s.pixel, gate[1]),
                  GATHER(vertices, s.pixel, gate[2]));
    s.query.p = vec3(GATHER(vertices, s.pixel, p[0]), GATHER(vertices, s.pixel, p[1]),
                     GATHER(vertices, s.pixel, p[2]));
    s.query.ng = unpack_unit(GATHER_U(vertices, s.pixel, ng));
    s.query.seen = (vertex & VERTEX_MASK) == 1u;
    s.query.near = params->cell_flags & CELL_NEAR ? vertex >> 31 : (UInt)(0u);
    s.query.extra = params->cell_flags & CELL_IDENTITY ? s.pixel + 1u : (UInt)(0u);
    const float shrunk = params->cell_width * exp2(params->cell_shrink * log2((float)(pass - params->first_pass + 1u)));
    s.query.width = GATHER(vertices, s.pixel, length) * shrunk;
    s.there = inside & (vertex != 0u);

    const Vec3 light = demodulated(s.beyond, s.gate);
    const UInt largest = max(as_bits(light.x), max(as_bits(light.y), as_bits(light.z)));
    s.rejected = s.there & (largest >= as_uint(params->cell_limit));
    s.there &= !s.rejected;
    return s;
}

/// Random bits of the samples for one purpose.
static inline void cell_random(
    __global const Params *params, UInt pixel, uint pass, uint pair, UInt *a, UInt *b)
{
    UInt x;
    UInt y;
    pixel_place(params, pixel, &x, &y);
    const UInt seed = pixel_seed(y * params->width + x, params->seed);
    sample_bits(seed, reverse_bits((UInt)(pass)), (UInt)(pair), params->sampler, a, b);
}

/// Add what the samples of every complete pass gathered behind their vertices to cells.  One work item W
/// pixels, after the passes are complete and before look_up_cells.
///
/// A sample whose bucket is full marks it: nobody uses the bucket.  One that is too large for the sums is
/// left out.  Both are counted.
///
/// reads   beyond, vertices, counters
/// writes  cell_keys, cells, full_buckets, counters.{failed_inserts, rejected_cells} (atomic)
kernel void store_cells(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    volatile __global uint *cell_keys,
    volatile __global Cell *cells,
    __global uint *full_buckets)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const uint passes = complete_passes(params, counters);
    for (uint k = 0; k < passes; ++k) {
        const uint pass = counters[COUNTER_FILM_PASS] + k;
        const CellSamples s = load_cell_samples(params, beyond, vertices, first, pass);
        if (any_lane(s.rejected))
            atomic_add(&counters[COUNTER_REJECTED_CELLS], count_lanes(s.rejected));
        if (!any_lane(s.there))
            continue;
        UInt a;
        UInt b;
        cell_random(params, s.pixel, pass, PAIR_CELL_STORE, &a, &b);
        const CellKey key = cell_of(params, s.query, a, b);
        const Vec3 light = demodulated(s.beyond, s.gate);
        const Float value[3] = {light.x, light.y, light.z};
        UInt low[3];
        UInt high[3];
        UInt random = mix_bits(a + rotate(b, (UInt)(11u)));
        for (uint c = 0; c < 3; ++c) {
            to_fixed(value[c], (Float)(params->cell_steps), unit_float(random), &low[c], &high[c]);
            random = mix_bits(random + 0x9e3779b9u);
        }
        uint lane_bucket[W];
        uint lane_key[W];
        store_lanes_u(key.bucket, lane_bucket);
        store_lanes_u(key.key, lane_key);
        const uint slots = params->cell_slots;
        const uint size = bucket_size(slots);
        const uint table = pass & (params->ring - 1u);
        volatile __global uint *keys = cell_keys + (ulong)table * slots;
        volatile __global Cell *sums = cells + (ulong)table * slots;
        uint lane_slot[W];
        store_lanes_u((UInt)(NO_SLOT), lane_slot);
        for (uint left = lane_bits(s.there); left; left &= left - 1u) {
            const uint i = lowest_bit(left);
            lane_slot[i] = find_or_insert(keys, lane_bucket[i], size, lane_key[i]);
            if (lane_slot[i] == NO_SLOT)
                full_buckets[(ulong)table * (slots / size) + lane_bucket[i] / size] = 1u;
        }
        const UInt slot = load_lanes_u(lane_slot);
        const Mask stored = slot != NO_SLOT;
        const uint failed = count_lanes(s.there & !stored);
        if (failed != 0u)
            atomic_add(&counters[COUNTER_FAILED_INSERTS], failed);
        add_lanes(sums, stored, slot, low, high);
    }
}

#if BASE
/// Part of the light from beyond a sample's vertex that the base of the first surface reflects.
static inline float4 base_share_of(__global const Beyond *beyond, __global const Seen *seen, ulong sample)
{
#if BASE == 2
    if ((beyond[sample].vertex & VERTEX_MASK) > 1u)
        return vload4(0, seen[sample].share);
#endif
    return (float4)(1.0f);
}
#endif

/// Add the light from behind the vertices to the samples of every complete pass: the average of the cell,
/// or the sample's own where there is none.  One work item W pixels, after store_cells.
///
/// reads   beyond, vertices, cell_keys, cells, full_buckets, seen
/// writes  samples, base; counters.unfiltered_samples (atomic)
kernel void look_up_cells(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    __global const uint *cell_keys,
    __global const Cell *cells,
    __global const uint *full_buckets,
#if BASE
    __global const Seen *seen,
    __global float *base,
#endif
    __global float *samples)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const uint passes = complete_passes(params, counters);
    for (uint k = 0; k < passes; ++k) {
        const uint pass = counters[COUNTER_FILM_PASS] + k;
        const CellSamples s = load_cell_samples(params, beyond, vertices, first, pass);
        const Mask wanted = s.there | s.rejected;
        if (!any_lane(wanted))
            continue;
        UInt a;
        UInt b;
        cell_random(params, s.pixel, pass, PAIR_CELL_LOOK_UP, &a, &b);
        const CellKey key = cell_of(params, s.query, a, b);
        uint lane_bucket[W];
        uint lane_key[W];
        uint lane_slot[W];
        store_lanes_u(key.bucket, lane_bucket);
        store_lanes_u(key.key, lane_key);
        store_lanes_u((UInt)(NO_SLOT), lane_slot);
        const uint slots = params->cell_slots;
        const uint size = bucket_size(slots);
        const uint table = pass & (params->ring - 1u);
        __global const uint *keys = cell_keys + (ulong)table * slots;
        __global const Cell *sums = cells + (ulong)table * slots;
        for (uint left = lane_bits(s.there); left; left &= left - 1u) {
            const uint i = lowest_bit(left);
            if (!full_buckets[(ulong)table * (slots / size) + lane_bucket[i] / size])
                lane_slot[i] = find(keys, lane_bucket[i], size, lane_key[i]);
        }
        const UInt slot = load_lanes_u(lane_slot);
        const Mask found = slot != NO_SLOT;
        const UInt at = pick_u(found, slot, (UInt)(0u));
        const Float count = to_float(max(GATHER_U(sums, at, count), 1u));
        const Float inverse = 1.0f / (params->cell_steps * count);
        const Vec3 mean = vec3(from_fixed(GATHER_U(sums, at, low[0]), GATHER_U(sums, at, high[0])) * inverse,
                               from_fixed(GATHER_U(sums, at, low[1]), GATHER_U(sums, at, high[1])) * inverse,
                               from_fixed(GATHER_U(sums, at, low[2]), GATHER_U(sums, at, high[2])) * inverse);
        const Vec3 light = pick_v(found, mul(s.gate, mean), s.beyond);
        const Mask alone = wanted & !found;
        if (any_lane(alone))
            atomic_add(&counters[COUNTER_UNFILTERED_SAMPLES], count_lanes(alone));
        float lane_light[3][W];
        store_lanes(light.x, lane_light[0]);
        store_lanes(light.y, lane_light[1]);
        store_lanes(light.z, lane_light[2]);
        const ulong at_first = (ulong)table * params->pixel_count + first;
        for (uint left = lane_bits(wanted); left; left &= left - 1u) {
            const uint i = lowest_bit(left);
            const float4 more = (float4)(lane_light[0][i], lane_light[1][i], lane_light[2][i], 0.0f);
            vstore4(vload4(at_first + i, samples) + more, at_first + i, samples);
#if BASE
            vstore4(vload4(at_first + i, base) + more * base_share_of(beyond, seen, at_first + i), at_first + i, base);
#endif
        }
    }
}

/// Empty the tables of every complete pass and count what was in them.  One work item a bucket.
///
/// reads   counters
/// writes  cell_keys, cells, full_buckets; counters.{cells_used, cell_probes} (atomic)
kernel void clear_cells(
    __global const Params *params,
    volatile __global uint *counters,
    __global uint *cell_keys,
    __global Cell *cells,
    __global uint *full_buckets)
{
    const uint slots = params->cell_slots;
    const uint size = bucket_size(slots);
    const uint bucket = get_global_id(0);
    if (slots == 0u || bucket >= slots / size)
        return;
    const uint passes = complete_passes(params, counters);
    uint used = 0;
    uint probes = 0;
    for (uint k = 0; k < passes; ++k) {
        const uint table = (counters[COUNTER_FILM_PASS] + k) & (params->ring - 1u);
        const ulong at = (ulong)table * slots + bucket * size;
        for (uint i = 0; i < size; ++i) {
            const uint key = cell_keys[at + i];
            if (key == 0u)
                continue;
            ++used;
            probes += probes_before(i, size, key) + 1u;
            cell_keys[at + i] = 0u;
            vstore8((uint8)(0u), at + i, (__global uint *)cells);
        }
        full_buckets[(ulong)table * (slots / size) + bucket] = 0u;
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
    if (pixel >= params->pixel_count)
        return;
    const ulong at = (ulong)(params->first_pass & (params->ring - 1u)) * params->pixel_count + pixel;
    if (vload4(at, samples).w <= 0.0f || beyond[at].vertex == 0u)
        return;
    for (uint c = 0; c < 3; ++c)
        film[pixel].sum[c] += beyond[at].radiance[c];
}
