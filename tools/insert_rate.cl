// Samples into the table of cells, beside as many bare atomic adds at random places of the same table.

#include "../cl/common/lanes.h"
#include "../cl/common/layout.h"
#include "../cl/common/hash_map.h"

// Samples that a work item inserts for each lane.
#define SAMPLES 64u

/// Keys of W samples: one of `distinct`, at random.
static inline UInt random_keys(uint number, uint distinct)
{
    return mul_hi(mix_bits(lanes_before(MASK_ALL) + number * W), (UInt)(distinct));
}

/// Insert samples as store_cells does, SAMPLES * W a work item.
///
/// writes  keys, cells; failed (atomic)
kernel void insert_samples(
    volatile global uint *keys, volatile global Cell *cells, volatile global uint *failed, const uint slots, const uint distinct)
{
    const uint size = bucket_size(slots);
    uint lost = 0;
    for (uint s = 0; s < SAMPLES; ++s) {
        const UInt number = random_keys(get_global_id(0) * SAMPLES + s, distinct);
        const UInt bucket = bucket_of(mix_bits(number), slots);
        const UInt key = fingerprint(mix_bits_too(number));
        uint lane_slot[W];
        uint lane_same[W];
        uint lane_low[3][W];
        uint lane_high[3][W];
        for (uint c = 0; c < 3; ++c) {
            store_lanes_u((number >> 4) + c + 1u, lane_low[c]);
            store_lanes_u((UInt)(0u), lane_high[c]);
        }
        uint left = claim_lanes(keys, cells, MASK_ALL, bucket, key, size, lane_slot, lane_same);
        for (; left; left &= left - 1u) {
            const uint i = lowest_bit(left);
            if (lane_slot[i] == NO_SLOT)
                lost += popcount(lane_same[i]);
            else
                add_lanes(&cells[lane_slot[i]], lane_same[i], lane_low, lane_high);
        }
    }
    if (lost != 0u)
        atomic_add(failed, lost);
}

/// Add to the four words of the cells that the keys name, without a search; as many samples, and as many atomics.
///
/// writes  cells
kernel void add_bare(volatile global Cell *cells, const uint slots, const uint distinct)
{
    for (uint s = 0; s < SAMPLES; ++s) {
        const UInt number = random_keys(get_global_id(0) * SAMPLES + s, distinct);
        uint lane_slot[W];
        uint lane_value[W];
        store_lanes_u(mix_bits(number) & (slots - 1u), lane_slot);
        store_lanes_u((number >> 4) + 1u, lane_value);
        for (uint i = 0; i < W; ++i) {
            volatile global Cell *cell = &cells[lane_slot[i]];
            uint none;
            add_words(&cell->low[0], lane_value[i], lane_value[i] + 1u, &none);
            add_words(&cell->low[2], lane_value[i] + 2u, 1u, &none);
        }
    }
}

/// Look samples up; writes something that depends on all of them.
///
/// reads   keys, cells, full
/// writes  found
kernel void look_up_samples(
    global const uint *keys, global const Cell *cells, global const uint *full, global uint *found, const uint slots,
    const uint distinct)
{
    UInt sum = (UInt)(0u);
    for (uint s = 0; s < SAMPLES; ++s) {
        const UInt number = random_keys(get_global_id(0) * SAMPLES + s, distinct);
        const UInt slot = find_lanes(keys, full, MASK_ALL, bucket_of(mix_bits(number), slots), bucket_size(slots),
                                     fingerprint(mix_bits_too(number)));
        const UInt at = pick_u(slot != NO_SLOT, slot, (UInt)(0u));
        sum += GATHER_U(cells, at, low[0]) + GATHER_U(cells, at, low[1]) + GATHER_U(cells, at, low[2]);
    }
    uint lane[W];
    store_lanes_u(sum, lane);
    uint all = 0;
    for (uint i = 0; i < W; ++i)
        all += lane[i];
    found[get_global_id(0)] = all;
}

/// Count the slots that are in use, and those that were looked at to find each once.  One work item a slot.
///
/// reads   keys
/// writes  counts: both
kernel void count_probes(global const uint *keys, volatile global uint *counts, const uint slots)
{
    const uint slot = get_global_id(0);
    if (slot >= slots || keys[slot] == 0u)
        return;
    atomic_inc(&counts[0]);
    atomic_add(&counts[1], probes_before(slot, bucket_size(slots), keys[slot]) + 1u);
}
