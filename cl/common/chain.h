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
static inline __global Float *chain_at(__global const Params *params, __global float *chains, uint item)
{
    const uint words = CHAIN_NUMBERS + 2u * params->chain_pairs;
    return (__global Float *)chains + (ulong)(item / ITEMS_PER_BLOCK) * (words * ITEMS_PER_BLOCK)
           + item % ITEMS_PER_BLOCK;
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
static inline Seed chain_seed(UInt key, __global Float *chain)
{
    Seed seed;
    seed.key = key;
    seed.known = get_u(chain, CHAIN_KNOWN);
    seed.numbers = (__global const uint *)(chain + CHAIN_NUMBERS * ITEMS_PER_BLOCK);
    return seed;
}

static inline Seed path_seed(__global Float *path, __global Float *chain)
{
    return chain_seed(get_u(path, PATH_SEED), chain);
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
LARGE_FUNCTION void keep_numbers(
    __global Float *chain, Mask moves, Seed seed, UInt reversed_index, uint sampler, UInt pairs)
{
    for (uint pair = 0;; ++pair) {
        const Mask taken = moves & (pair < pairs);
        if (!any_lane(taken))
            break;
        UInt number[2];
        sample_bits(seed, reversed_index, (UInt)(pair), sampler, &number[0], &number[1]);
        for (uint k = 0; k < 2; ++k) {
            const uint at = CHAIN_NUMBERS + 2u * pair + k;
            put_u(chain, at, pick_u(taken, number[k], get_u(chain, at)));
        }
    }
    put_u(chain, CHAIN_PAIRS, pick_u(moves, pairs, get_u(chain, CHAIN_PAIRS)));
}
#endif
