// The functions of rng.h, one value a lane.

#include "planes.h"
#include "../../cl/common/rng.h"

kernel void mix_numbers(global const uint *x, global uint *mixed)
{
    STORE_U(mixed, 0, mix_bits(LOAD_U(x, 0)));
}

kernel void reverse_numbers(global const uint *x, global uint *reversed, global uint *second_dimension)
{
    STORE_U(reversed, 0, reverse_bits(LOAD_U(x, 0)));
    STORE_U(second_dimension, 0, sobol_reversed(LOAD_U(x, 0)));
}

kernel void to_unit_floats(global const uint *x, global float *units)
{
    STORE(units, 0, unit_float(LOAD_U(x, 0)));
}

/// bits: the first and the second number; units: the same in [0, 1).
kernel void draw_samples(
    global const uint *pixel,
    global const uint *index,
    global const uint *pair,
    global uint *bits,
    global float *units,
    const uint seed,
    const uint sampler)
{
    const UInt key = pixel_seed(LOAD_U(pixel, 0), seed);
    const UInt reversed = reverse_bits(LOAD_U(index, 0));
    UInt a;
    UInt b;
    sample_bits(key, reversed, LOAD_U(pair, 0), sampler, &a, &b);
    STORE_U(bits, 0, a);
    STORE_U(bits, 1, b);
    Float x;
    Float y;
    sample_pair(key, reversed, LOAD_U(pair, 0), sampler, &x, &y);
    STORE(units, 0, x);
    STORE(units, 1, y);
}
