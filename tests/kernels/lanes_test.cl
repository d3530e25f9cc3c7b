// The functions of lanes.h, one value a lane.

#include "planes.h"

kernel void turn(global const float *turns, global float *cosines, global float *sines)
{
    Float c;
    Float s;
    cos_sin_turns(LOAD(turns, 0), &c, &s);
    STORE(cosines, 0, c);
    STORE(sines, 0, s);
}

kernel void angle_of(global const float *y, global const float *x, global float *angles)
{
    STORE(angles, 0, atan2_lanes(LOAD(y, 0), LOAD(x, 0)));
}

kernel void normalize_vectors(global const float *v, global float *units)
{
    store_vec3(units, 0, normalize3(LOAD_V(v, 0)));
}

kernel void renormalize_vectors(global const float *v, global float *units)
{
    store_vec3(units, 0, renormalize3(LOAD_V(v, 0)));
}

kernel void frame_of(global const float *n, global float *s, global float *t)
{
    Vec3 a;
    Vec3 b;
    make_frame(LOAD_V(n, 0), &a, &b);
    store_vec3(s, 0, a);
    store_vec3(t, 0, b);
}

/// Masks of the lanes where `flags` is not 0.
kernel void mask_lanes(
    global const uint *flags,
    global const float *then,
    global const float *otherwise,
    global uint *counts,
    global uint *ranks,
    global uint *some,
    global uint *inverted,
    global float *picked,
    global uint *picked_bits,
    global float *picked_vectors)
{
    const Mask mask = LOAD_U(flags, 0) != 0u;
    const Float a = LOAD(then, 0);
    const Float b = LOAD(otherwise, 0);
    STORE_U(counts, 0, (UInt)(count_lanes(mask)));
    STORE_U(ranks, 0, lanes_before(mask));
    STORE_U(some, 0, (UInt)((uint)(any_lane(mask) != 0)));
    STORE_U(inverted, 0, (UInt)(count_lanes(!mask)));
    STORE(picked, 0, pick(mask, a, b));
    STORE_U(picked_bits, 0, pick_u(mask, as_bits(a), as_bits(b)));
    store_vec3(picked_vectors, 0, pick_v(mask, vec3(a, b, a), vec3(b, a, b)));
}

/// Masks as bits, and back.
kernel void mask_bits(global const uint *flags, global uint *bits, global uint *back)
{
    const uint lanes = lane_bits(LOAD_U(flags, 0) != 0u);
    STORE_U(bits, 0, (UInt)(lanes));
    STORE_U(back, 0, pick_u(lanes_of(lanes), (UInt)(1u), (UInt)(0u)));
}

kernel void least_of(global const float *x, global float *least)
{
    STORE(least, 0, (Float)(least_lane(LOAD(x, 0))));
}

typedef struct {
    float value;
    uint number;
} Entry;

kernel void gather_entries(
    global const uint *indices,
    global const float *entries,
    global float *values,
    global uint *numbers,
    global uint *words)
{
    global const Entry *table = (global const Entry *)entries;
    STORE(values, 0, GATHER(table, LOAD_U(indices, 0), value));
    STORE_U(numbers, 0, GATHER_U(table, LOAD_U(indices, 0), number));
    STORE_U(words, 0, GATHER_WORD((global const uint *)entries, LOAD_U(indices, 0)));
}
