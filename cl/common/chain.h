// Chains of paths: each path is a mutation of the state of its chain, the last path that was accepted.
//
// A state is the vector of the random numbers that its path took.  The numbers beyond those are not known,
// for nothing depends on them: whoever wants one takes a new one.
//
// Kelemen, Szirmay-Kalos, Antal, Csonka: A Simple and Robust Mutation Strategy for the Metropolis Light
// Transport Algorithm, 2002.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "pool.h"
#include "rng.h"

#if METROPOLIS
// Beyond the pairs of any vertex: whether a step is accepted; how splats are rounded.
#define PAIR_STEP 0xffffffe0u
#define PAIR_SPLAT 0xffffffe1u

/// Address of the first field of the W chains of work item `item`: FIELD, get_u and put_u as of paths.
static inline __global Float *chain_at(__global float *chains, uint item)
{
    return (__global Float *)chains + (item / ITEMS_PER_BLOCK) * (CHAIN_FIELD_COUNT * ITEMS_PER_BLOCK)
           + item % ITEMS_PER_BLOCK;
}

/// The numbers of the states of these chains, one chain after the other.
static inline __global uint *chain_numbers_at(__global const Params *params, __global uint *numbers, uint item)
{
    return numbers + (ulong)item * W * params->chain_numbers;
}

/// What tells the random numbers of the paths of a chain apart.
///
/// It is the same for all chains: together, their new numbers are the samples of one pixel, stratified.
static inline UInt path_key(__global const Params *params, UInt path)
{
    // Chains begin anew with each frame, their numbers do not.
    return mix_bits(path ^ mix_bits(mix_bits((UInt)(params->seed ^ 0x85ebca77u)) + params->first_pass));
}

/// Whether path number `path` of every chain is a large step: `share` of the paths, as evenly as can be.
static inline Mask is_large(UInt path, uint seed, float share)
{
    return unit_float(path * 0x9e3779b9u + mix_bits((UInt)(seed))) < share;
}

/// What the numbers of a path are a function of.
static inline Seed chain_seed(
    __global const Params *params, UInt key, __global Float *chain, __global const uint *numbers)
{
    Seed seed;
    seed.key = key;
    seed.known = get_u(chain, CHAIN_KNOWN);
    seed.numbers = numbers;
    seed.stride = params->chain_numbers;
    return seed;
}

/// The same in the middle of the path.
static inline Seed path_seed(
    __global const Params *params, __global Float *path, __global float *chains, __global uint *numbers, uint item)
{
    return chain_seed(params, get_u(path, PATH_SEED), chain_at(chains, item),
                      chain_numbers_at(params, numbers, item));
}

/// Two numbers that say where on the film a path starts.
///
/// The new ones of a path number are those of all chains together: the samples of one stratified set.
static inline void film_bits(Seed seed, UInt reversed_index, uint sampler, UInt *first, UInt *second)
{
    sample_bits(seed, reversed_index, (UInt)(PAIR_PIXEL), sampler, first, second);
    const Mask known = seed.known > PAIR_PIXEL;
    if (any_lane(!known)) {
        UInt a;
        UInt b;
        new_bits(seed.key, reversed_index, (UInt)(PAIR_PIXEL), sampler, &a, &b);
        *first = pick_u(known, *first, a);
        *second = pick_u(known, *second, b);
    }
}

/// Let the paths of the lanes in `starting` begin: with the state's numbers, or with new ones if `large`.
static inline void take_step(__global Float *chain, Mask starting, Mask large)
{
    const UInt known = pick_u(large, (UInt)(0u), get_u(chain, CHAIN_PAIRS));
    put_u(chain, CHAIN_KNOWN, pick_u(starting, known, get_u(chain, CHAIN_KNOWN)));
}

/// Chance that a step from brightness `from` to brightness `to` is accepted (Metropolis et al. 1953).
static inline Float acceptance(Float from, Float to)
{
    const Mask up = to >= from;
    return pick(up, (Float)(1.0f), to / pick(up, (Float)(1.0f), from));
}

/// Whether it is.
static inline Mask accepts(Float chance, UInt key, UInt reversed_index)
{
    UInt bits;
    UInt unused;
    random_bits(pair_key(key, (UInt)(PAIR_STEP)), reversed_index, &bits, &unused);
    return unit_float(bits) < chance;
}

/// Make the first `pairs` pairs of a path's numbers those of the state, in the lanes of `moves`.
///
/// One chain after the other, W of its numbers at once: few of W chains move at the same time.
LARGE_FUNCTION void keep_numbers(
    __global Float *chain,
    __global uint *numbers,
    Mask moves,
    Seed seed,
    UInt reversed_index,
    uint sampler,
    UInt pairs)
{
    put_u(chain, CHAIN_PAIRS, pick_u(moves, pairs, get_u(chain, CHAIN_PAIRS)));
    uint lane_key[W];
    uint lane_known[W];
    uint lane_index[W];
    uint lane_pairs[W];
    store_lanes_u(seed.key, lane_key);
    store_lanes_u(seed.known, lane_known);
    store_lanes_u(reversed_index, lane_index);
    store_lanes_u(pairs, lane_pairs);
    for (uint left = lane_bits(moves); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        const UInt key = (UInt)(lane_key[k]);
        const UInt index = (UInt)(lane_index[k]);
        for (uint first = 0; first < 2u * lane_pairs[k]; first += W) {
            __global UInt *words = (__global UInt *)(numbers + k * seed.stride + first);
            const UInt word = lanes_before(MASK_ALL) + first;
            const UInt pair = word >> 1;
            const Mask odd = (word & 1u) != 0u;
            const Mask known = pair < lane_known[k];
            UInt a;
            UInt b;
            random_bits(pair_key(key, pair), index, &a, &b);
            UInt number = pick_u(odd, b, a);
            number = pick_u(known, mutated(*words, number), number);
            if (first <= 2u * PAIR_PIXEL && lane_known[k] == 0u) {
                new_bits(key, index, (UInt)(PAIR_PIXEL), sampler, &a, &b);
                number = pick_u(pair == PAIR_PIXEL, pick_u(odd, b, a), number);
            }
            *words = number;
        }
    }
}
#endif
