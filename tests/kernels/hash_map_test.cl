// The hash map of cells: insert samples, look keys up.

#include "planes.h"
#include "../../cl/common/hash_map.h"

/// Insert samples; `slot` receives NO_SLOT where the bucket is full.
kernel void insert_samples(
    global const uint *key,
    global const float *value,
    global const float *u,
    volatile global uint *keys,
    volatile global Cell *cells,
    global uint *slot,
    const uint slots,
    const float steps)
{
    const UInt number = LOAD_U(key, 0);
    uint lane_bucket[W];
    uint lane_key[W];
    store_lanes_u(bucket_of(mix_bits(number), slots), lane_bucket);
    store_lanes_u(fingerprint(mix_bits_too(number)), lane_key);
    uint lane_low[3][W];
    uint lane_high[3][W];
    for (uint c = 0; c < 3; ++c) {
        UInt low;
        UInt high;
        to_fixed(LOAD(value, c), (Float)(steps), LOAD(u, c), &low, &high);
        store_lanes_u(low, lane_low[c]);
        store_lanes_u(high, lane_high[c]);
    }
    uint lane_slot[W];
    for (uint k = 0; k < W; ++k)
        lane_slot[k] = find_or_insert(keys, lane_bucket[k], bucket_size(slots), lane_key[k]);
    const UInt place = load_lanes_u(lane_slot);
    for (uint left = lane_bits(place != NO_SLOT); left;) {
        const uint at = lane_slot[lowest_bit(left)];
        const uint same = left & lane_bits(place == at);
        left &= ~same;
        add_lanes(&cells[at], same, lane_low, lane_high);
    }
    STORE_U(slot, 0, place);
}

/// Look up keys in buckets, all of them usable.
kernel void find_keys(
    global const uint *key, global const uint *keys, global const uint *full, global uint *slot, const uint slots)
{
    const UInt number = LOAD_U(key, 0);
    const UInt place = find_lanes(keys, full, MASK_ALL, bucket_of(mix_bits(number), slots), bucket_size(slots),
                                  fingerprint(mix_bits_too(number)));
    STORE_U(slot, 0, place);
}

/// Fixed-point numbers and back.
kernel void fix_numbers(
    global const float *value, global const float *u, global uint *low, global uint *high, const float steps)
{
    UInt low_word;
    UInt high_word;
    to_fixed(LOAD(value, 0), (Float)(steps), LOAD(u, 0), &low_word, &high_word);
    STORE_U(low, 0, low_word);
    STORE_U(high, 0, high_word);
}
