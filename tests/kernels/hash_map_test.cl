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
    UInt low[3];
    UInt high[3];
    for (uint c = 0; c < 3; ++c)
        to_fixed(LOAD(value, c), (Float)(steps), LOAD(u, c), &low[c], &high[c]);
    uint lane_slot[W];
    for (uint k = 0; k < W; ++k)
        lane_slot[k] = find_or_insert(keys, lane_bucket[k], bucket_size(slots), lane_key[k]);
    const UInt place = load_lanes_u(lane_slot);
    add_lanes(cells, place != NO_SLOT, place, low, high);
    STORE_U(slot, 0, place);
}

kernel void find_keys(global const uint *key, global const uint *keys, global uint *slot, const uint slots)
{
    const UInt number = LOAD_U(key, 0);
    uint lane_bucket[W];
    uint lane_key[W];
    uint lane_slot[W];
    store_lanes_u(bucket_of(mix_bits(number), slots), lane_bucket);
    store_lanes_u(fingerprint(mix_bits_too(number)), lane_key);
    for (uint k = 0; k < W; ++k)
        lane_slot[k] = find(keys, lane_bucket[k], bucket_size(slots), lane_key[k]);
    STORE_U(slot, 0, load_lanes_u(lane_slot));
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
