// Random numbers as a function of (seed, pixel, sample, dimension): nothing else, so that an image does
// not depend on where or when a path is computed.
#pragma once

#include "lanes.h"
#include "layout.h"

// Dimensions come in pairs.  A vertex at `depth` owns VERTEX_PAIRS of them from PAIR_VERTEX on.
#define PAIR_PIXEL 0u
#define PAIR_LENS 1u
// From here on by depth: where a vertex is moved to before it looks for photons.
#define PAIR_PARTICLES 0xff000000u
// From here on by depth and number: all pairs of a vertex's shadow rays after the first.
#define PAIR_RAYS 0xc0000000u
#define PAIR_BSDF 0u
#define PAIR_LIGHT 1u
#define PAIR_CHOICE 2u      // which lobe, then whether to go on; which light
#define PAIR_ENVIRONMENT 3u // which texel; which side of its alias slot

/// Mix all bits of `x`; a bijection.  Wellons, hash-prospector: "lowbias32".
static inline UInt mix_bits(UInt x)
{
    x ^= x >> 16;
    x *= 0x7feb352du;
    x ^= x >> 15;
    x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}

static inline UInt reverse_bits(UInt x)
{
    x = (x >> 16) | (x << 16);
    x = ((x & 0xff00ff00u) >> 8) | ((x & 0x00ff00ffu) << 8);
    x = ((x & 0xf0f0f0f0u) >> 4) | ((x & 0x0f0f0f0fu) << 4);
    x = ((x & 0xccccccccu) >> 2) | ((x & 0x33333333u) << 2);
    x = ((x & 0xaaaaaaaau) >> 1) | ((x & 0x55555555u) << 1);
    return x;
}

/// Owen scrambling of a number whose most significant digit is bit 0: a digit is flipped by a hash of
/// the digits before it.
///
/// Laine, Karras: Stratified Sampling for Stochastic Transparency, 2011; Burley: Practical Hash-Based
/// Owen Scrambling, JCGT 9 (4), 2020; constants by Vegdahl, "Building a Better LK Hash", 2021.
static inline UInt scramble_reversed(UInt x, UInt seed)
{
    x ^= x * 0x3d20adeau;
    x += seed;
    x *= (seed >> 16) | 1u;
    x ^= x * 0x05526c56u;
    x ^= x * 0x53a22864u;
    return x;
}

/// Second Sobol' dimension of `index`, most significant digit in bit 0: digit k is the sum modulo 2 of
/// the index digits j with C(j, k) odd.  By Lucas' theorem the matrix is a tensor power, hence five steps.
static inline UInt sobol_reversed(UInt index)
{
    index ^= (index & 0xaaaaaaaau) >> 1;
    index ^= (index & 0xccccccccu) >> 2;
    index ^= (index & 0xf0f0f0f0u) >> 4;
    index ^= (index & 0xff00ff00u) >> 8;
    index ^= (index & 0xffff0000u) >> 16;
    return index;
}

/// Top 24 bits as a number in [0, 1).
static inline Float unit_float(UInt x) { return to_float(x >> 8) * 5.9604645e-8f; }

/// What tells pixels apart; `pixel` counts over the whole film, so a crop has the same numbers.
static inline UInt pixel_seed(UInt pixel, uint seed) { return mix_bits(pixel ^ mix_bits((UInt)(seed ^ 0x9e3779b9u))); }

/// Two uniform 32-bit numbers for a `key` of the seed and the pair.
static inline void random_bits(UInt key, UInt index, UInt *first, UInt *second)
{
    const UInt number = mix_bits(index + key);
    *first = mix_bits(number ^ 0x68bc21ebu);
    *second = mix_bits(number ^ 0x02e5be93u);
}

/// What the numbers of a pair of dimensions depend on, beside the index of the sample.
static inline UInt pair_key(UInt seed, UInt pair) { return mix_bits(seed + pair * 0x9e3779b9u); }

/// The index of a sample in a pair's own order.
static inline UInt shuffled_index(UInt reversed_index, UInt key)
{
    return reverse_bits(scramble_reversed(reversed_index, key));
}

// Seeds of their own for both digits' scrambles: rotations of a mixed number.
static inline UInt first_sobol(UInt shuffled, UInt key)
{
    return reverse_bits(scramble_reversed(shuffled, rotate(key, (UInt)(11u)) ^ 0x68bc21ebu));
}
static inline UInt second_sobol(UInt shuffled, UInt key)
{
    return reverse_bits(scramble_reversed(sobol_reversed(shuffled), rotate(key, (UInt)(22u)) ^ 0x02e5be93u));
}

/// Two uniform 32-bit numbers, stratified over the samples of a pixel if the sampler is Sobol'.
///
/// `reversed_index` is the sample's index with its bits reversed: once for all pairs of a vertex.
LARGE_FUNCTION void new_bits(
    UInt seed, UInt reversed_index, UInt pair, uint sampler, UInt *first, UInt *second)
{
    const UInt key = pair_key(seed, pair);
    if (sampler == SAMPLER_SOBOL) {
        const UInt shuffled = shuffled_index(reversed_index, key);
        *first = first_sobol(shuffled, key);
        *second = second_sobol(shuffled, key);
    } else {
        random_bits(key, reversed_index, first, second);
    }
}

#if METROPOLIS
/// What the numbers of a path are a function of, beside its chain, which is its sample.
typedef struct {
    UInt key;                     // of the number of the path in its chain
    UInt known;                   // pairs of numbers of the chain's state; 0: all of the path's are new
    __global const uint *numbers; // of the chain's state, of the first of W chains
    uint stride;                  // numbers of a chain
} Seed;

/// A number a bit further on, or back, on the circle from 0 to 2^32: steps of 2^-10 to 2^-6 of it, each
/// octave as likely as any other.
///
/// Kelemen et al.: A Simple and Robust Mutation Strategy for the Metropolis Light Transport Algorithm, 2002.
static inline UInt mutated(UInt number, UInt random)
{
    // Random mantissas and two random bits of the exponent.
    const UInt distance = to_uint(from_bits(0x3a800000u + (random >> 7)) * 0x1p32f);
    return number + pick_u((random & 1u) != 0u, distance, -distance);
}

/// Two uniform 32-bit numbers: those of the chain's state, mutated, or new and independent ones.
///
/// `sampler` is not looked at.
LARGE_FUNCTION void sample_bits(
    Seed seed, UInt reversed_index, UInt pair, uint sampler, UInt *first, UInt *second)
{
    random_bits(pair_key(seed.key, pair), reversed_index, first, second);
    const Mask known = pair < seed.known;
    if (any_lane(known)) {
        const UInt at = lanes_before(MASK_ALL) * seed.stride + pick_u(known, pair, (UInt)(0u)) * 2u;
        *first = pick_u(known, mutated(GATHER_WORD(seed.numbers, at), *first), *first);
        *second = pick_u(known, mutated(GATHER_WORD(seed.numbers, at + 1u), *second), *second);
    }
}
#else
/// What the numbers of a path are a function of, beside its sample: its pixel.
typedef UInt Seed;

static inline void sample_bits(
    Seed seed, UInt reversed_index, UInt pair, uint sampler, UInt *first, UInt *second)
{
    new_bits(seed, reversed_index, pair, sampler, first, second);
}
#endif

/// Two uniform 32-bit numbers.
typedef struct {
    UInt first;
    UInt second;
} BitPair;

/// The pairs that every vertex draws.
typedef struct {
    BitPair choice;
    BitPair bsdf;
    BitPair light;
} VertexBits;

/// What sample_bits gives for the pairs of a vertex, of which `pair` is the first.
///
/// Side by side: one number after the other, most of the time is spent waiting for products.
#if METROPOLIS
static inline VertexBits vertex_bits(Seed seed, UInt reversed_index, UInt pair, uint sampler)
{
    VertexBits b;
    sample_bits(seed, reversed_index, pair + PAIR_CHOICE, sampler, &b.choice.first, &b.choice.second);
    sample_bits(seed, reversed_index, pair + PAIR_BSDF, sampler, &b.bsdf.first, &b.bsdf.second);
    sample_bits(seed, reversed_index, pair + PAIR_LIGHT, sampler, &b.light.first, &b.light.second);
    return b;
}
#else
LARGE_FUNCTION VertexBits vertex_bits(Seed seed, UInt reversed_index, UInt pair, uint sampler)
{
    const UInt choice = pair_key(seed, pair + PAIR_CHOICE);
    const UInt bsdf = pair_key(seed, pair + PAIR_BSDF);
    const UInt light = pair_key(seed, pair + PAIR_LIGHT);
    VertexBits b;
    if (sampler == SAMPLER_SOBOL) {
        const UInt choice_index = shuffled_index(reversed_index, choice);
        const UInt bsdf_index = shuffled_index(reversed_index, bsdf);
        const UInt light_index = shuffled_index(reversed_index, light);
        b.choice.first = first_sobol(choice_index, choice);
        b.bsdf.first = first_sobol(bsdf_index, bsdf);
        b.light.first = first_sobol(light_index, light);
        b.choice.second = second_sobol(choice_index, choice);
        b.bsdf.second = second_sobol(bsdf_index, bsdf);
        b.light.second = second_sobol(light_index, light);
    } else {
        random_bits(choice, reversed_index, &b.choice.first, &b.choice.second);
        random_bits(bsdf, reversed_index, &b.bsdf.first, &b.bsdf.second);
        random_bits(light, reversed_index, &b.light.first, &b.light.second);
    }
    return b;
}
#endif

/// Two uniform numbers in [0, 1).
static inline void sample_pair(Seed seed, UInt reversed_index, UInt pair, uint sampler, Float *first, Float *second)
{
    UInt a;
    UInt b;
    sample_bits(seed, reversed_index, pair, sampler, &a, &b);
    *first = unit_float(a);
    *second = unit_float(b);
}

/// Slot of an alias table for 32 random bits; what is left of them is uniform in the slot.
///
/// Vose: A Linear Algorithm for Generating Random Numbers with a Given Distribution, 1991.
static inline UInt alias_slot(UInt bits, UInt count, Float *left)
{
    *left = unit_float(bits * count);
    return mul_hi(bits, count);
}

/// 32 uniform bits of `u`, which is what is left of a number of 24 bits after a choice of chance `part`: it has
/// only so many values, and the digits between them come from `more`.
static inline UInt digits_left(Float u, Float part, UInt more)
{
    const Float whole = u + unit_float(more) * 0x1p-24f / max(part, 0x1p-24f);
    return to_uint(clamp(whole, (Float)(0.0f), (Float)(0x1.fffffep-1f)) * 0x1p32f) ^ (more & 0xffu);
}
