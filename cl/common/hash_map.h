// A hash map of cells: slots claimed by atomics, sums in fixed point, the same result in any order.
//
// A key is a bucket and a 32-bit fingerprint, 0 for an empty slot.  Probing is linear, starts at a slot
// that the fingerprint names, and wraps inside the bucket of up to BUCKET_SLOTS: whether a bucket has
// room for all its keys then does not depend on the order in which they come.  A bucket that overflowed
// is given up as a whole, for which keys it holds does depend on it.
//
// Binder, Fricke, Keller: Massively Parallel Path Space Filtering, 2019 (second hash in place of keys).
#pragma once

#include "lanes.h"
#include "layout.h"
#include "rng.h"
#include "word_pairs.h"

#define NO_SLOT 0xffffffffu

/// Slots of a bucket in a table of `slots`, a power of two.
static inline uint bucket_size(uint slots) { return min(slots, BUCKET_SLOTS); }

/// Mix all bits of `x` by another bijection than mix_bits.  Appleby: MurmurHash3, finalizer.
static inline UInt mix_bits_too(UInt x)
{
    x ^= x >> 16;
    x *= 0x85ebca6bu;
    x ^= x >> 13;
    x *= 0xc2b2ae35u;
    x ^= x >> 16;
    return x;
}

/// Fingerprint of a hash: 0 means an empty slot.
static inline UInt fingerprint(UInt hash) { return max(hash, (UInt)(1u)); }

/// First slot of the bucket that a hash names.
static inline UInt bucket_of(UInt hash, uint slots) { return hash & (slots - 1u) & ~(bucket_size(slots) - 1u); }

// A look at a word that others may be claiming: it is 0 or the key that is there for good.  In OpenCL C 1.2
// that is a race in letter; an atomic for every look would cost more than it is worth.
#ifdef PLAIN_C
#define LOOK(word) atomic_or((volatile __global uint *)(word), 0u)
#define MARK(word) atomic_or((volatile __global uint *)(word), 1u)
static inline UInt look_lanes(const __global uint *words, UInt at)
{
    uint lane[W];
    store_lanes_u(at, lane);
    for (uint k = 0; k < W; ++k)
        lane[k] = LOOK(&words[lane[k]]);
    return load_lanes_u(lane);
}
#else
#define LOOK(word) (*(word))
#define MARK(word) (*(word) = 1u)
static inline UInt look_lanes(const __global uint *words, UInt at) { return GATHER_WORD(words, at); }
#endif

/// Slot of the key in its bucket, claimed if it was not there; NO_SLOT if the bucket is full.
static inline uint find_or_insert(volatile __global uint *keys, uint bucket, uint size, uint key)
{
    for (uint i = 0; i < size; ++i) {
        const uint slot = bucket + ((key + i) & (size - 1u));
        uint found = LOOK(&keys[slot]);
        if (found == 0u)
            found = atomic_cmpxchg(&keys[slot], 0u, key);
        if (found == 0u || found == key)
            return slot;
    }
    return NO_SLOT;
}

/// Slot of the key in its bucket, NO_SLOT if it is not there.
static inline uint find(const __global uint *keys, uint bucket, uint size, uint key)
{
    for (uint i = 0; i < size; ++i) {
        const uint slot = bucket + ((key + i) & (size - 1u));
        const uint found = LOOK(&keys[slot]);
        if (found == key)
            return slot;
        if (found == 0u)
            break;
    }
    return NO_SLOT;
}

/// Slots of the keys of the lanes in `mask`, NO_SLOT of those that are not there.
///
/// Nearly all keys are in the slot where probing starts: all lanes look there at once.
static inline UInt find_in_buckets(const __global uint *keys, Mask mask, UInt bucket, uint size, UInt key)
{
    const UInt start = bucket + (key & (size - 1u));
    const UInt first = look_lanes(keys, start);
    const Mask there = mask & (first == key);
    UInt slot = pick_u(there, start, (UInt)(NO_SLOT));
    const Mask further = mask & !there & (first != 0u);
    if (any_lane(further)) {
        uint lane_bucket[W];
        uint lane_key[W];
        uint lane_slot[W];
        store_lanes_u(bucket, lane_bucket);
        store_lanes_u(key, lane_key);
        store_lanes_u(slot, lane_slot);
        for (uint left = lane_bits(further); left; left &= left - 1u) {
            const uint k = lowest_bit(left);
            lane_slot[k] = find(keys, lane_bucket[k], size, lane_key[k]);
        }
        slot = load_lanes_u(lane_slot);
    }
    return slot;
}

/// The same, and NO_SLOT of those in a full bucket.
static inline UInt find_lanes(
    const __global uint *keys, const __global uint *full_buckets, Mask mask, UInt bucket, uint size, UInt key)
{
    const uint shift = popcount(size - 1u);
    const Mask usable = mask & (look_lanes(full_buckets, bucket >> shift) == 0u);
    return find_in_buckets(keys, usable, bucket, size, key);
}

/// Slots of the keys of the lanes in `wanted`; those of `making` are claimed where they were not there.
///
/// A full bucket is marked, and the keys that it had no room for are added to `failed`.  It keeps what it
/// has until somebody gives it up: whatever came first.
static inline UInt find_or_make(
    volatile __global uint *keys,
    __global uint *full_buckets,
    volatile __global uint *failed,
    Mask wanted,
    Mask making,
    UInt bucket,
    uint size,
    UInt key)
{
    UInt slot = find_lanes((const __global uint *)keys, full_buckets, wanted, bucket, size, key);
    const Mask absent = wanted & (slot == NO_SLOT);
    if (!any_lane(absent))
        return slot;
    uint lane_bucket[W];
    uint lane_key[W];
    uint lane_slot[W];
    store_lanes_u(bucket, lane_bucket);
    store_lanes_u(key, lane_key);
    store_lanes_u(slot, lane_slot);
    const uint makes = lane_bits(making);
    uint without = 0;
    for (uint left = lane_bits(absent); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        // Whether a lane inserts must not hang on its neighbours, which are others for another pool.
        const uint inserts = (makes >> k) & 1u;
        lane_slot[k] = inserts ? find_or_insert(keys, lane_bucket[k], size, lane_key[k])
                               : find((const __global uint *)keys, lane_bucket[k], size, lane_key[k]);
        if (inserts && lane_slot[k] == NO_SLOT) {
            MARK(&full_buckets[lane_bucket[k] / size]);
            ++without;
        }
    }
    if (without != 0u)
        atomic_add(failed, without);
    return load_lanes_u(lane_slot);
}

/// Whether no slot of a bucket is taken.
static inline int bucket_is_empty(const __global uint *keys, uint size)
{
    uint any = 0;
    for (uint i = 0; i < size; ++i)
        any |= keys[i];
    return any == 0u;
}

/// Slots that were looked at before the one that a key took.
static inline uint probes_before(uint slot, uint size, uint key) { return (slot - key) & (size - 1u); }

/// Steps of `value` (from 0 on, finite, below 2^63 / steps), rounded up with the chance of the fraction.
///
/// `u` in [0, 1).  From 2^24 steps on a float is a whole number of them.
static inline void to_fixed(Float value, Float steps, Float u, UInt *low, UInt *high)
{
    const Float x = value * steps;
    const Float rounded = pick(x < 0x1p23f, floor(x + u), x);
    const Float upper = floor(rounded * 0x1p-32f);
    *high = to_uint(upper);
    *low = to_uint(rounded - upper * 0x1p32f);
}

/// Add to a 64-bit sum: a carry out of the low word belongs to whoever caused it.
static inline void add_fixed(volatile __global uint *low, volatile __global uint *high, uint more_low, uint more_high)
{
    uint carry = more_high;
    if (more_low != 0u)
        carry += atomic_add(low, more_low) + more_low < more_low;
    if (carry != 0u)
        atomic_add(high, carry);
}

/// Count events in two words.
static inline void count_up(volatile __global uint *words, uint more) { add_fixed(&words[0], &words[1], more, 0u); }

/// Claim slots for the keys of the lanes in `wanted`; returns the first lane of each distinct key.
///
/// Of these, `lane_slot` receives the slot or NO_SLOT, `lane_same` the lanes of that key.  All are found, and
/// their cells touched, before anything is added: atomics wait for the loads before them, so that misses of
/// one sample after the other would add up (measured: 1.6 times as long where no two keys are the same).
static inline uint claim_lanes(
    volatile __global uint *keys,
    const volatile __global Cell *cells,
    Mask wanted,
    UInt bucket,
    UInt key,
    uint size,
    uint *lane_slot,
    uint *lane_same)
{
    const UInt there = find_in_buckets((const __global uint *)keys, wanted, bucket, size, key);
    uint lane_bucket[W];
    uint lane_key[W];
    store_lanes_u(bucket, lane_bucket);
    store_lanes_u(key, lane_key);
    store_lanes_u(there, lane_slot);
    uint firsts = 0;
    for (uint left = lane_bits(wanted); left;) {
        const uint i = lowest_bit(left);
        lane_same[i] = left & lane_bits((bucket == lane_bucket[i]) & (key == lane_key[i]));
        left &= ~lane_same[i];
        firsts |= 1u << i;
        if (lane_slot[i] == NO_SLOT)
            lane_slot[i] = find_or_insert(keys, lane_bucket[i], size, lane_key[i]);
        if (lane_slot[i] != NO_SLOT)
            (void)LOOK(&cells[lane_slot[i]].count);
    }
    return firsts;
}

/// Add samples, `count` of them, whose radiance sums up to the fixed-point numbers given, to a cell.
static inline void add_to_cell(volatile __global Cell *cell, const ulong *sum, uint count)
{
    uint carry_1;
    uint none;
    const uint high_0 = (uint)(sum[0] >> 32) + add_words(&cell->low[0], (uint)sum[0], (uint)sum[1], &carry_1);
    const uint high_1 = (uint)(sum[1] >> 32) + carry_1;
    const uint high_2 = (uint)(sum[2] >> 32) + add_words(&cell->low[2], (uint)sum[2], count, &none);
    if ((high_0 | high_1) != 0u)
        add_words(&cell->high[0], high_0, high_1, &none);
    if (high_2 != 0u)
        atomic_add(&cell->high[2], high_2);
}

/// Add the samples of the lanes in `bits`, fixed-point numbers, to a cell.
static inline void add_lanes(
    volatile __global Cell *cell, uint bits, const uint (*low)[W], const uint (*high)[W])
{
    ulong sum[3] = {0, 0, 0};
    for (uint left = bits; left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        sum[0] += (ulong)high[0][k] << 32 | low[0][k];
        sum[1] += (ulong)high[1][k] << 32 | low[1][k];
        sum[2] += (ulong)high[2][k] << 32 | low[2][k];
    }
    add_to_cell(cell, sum, popcount(bits));
}
