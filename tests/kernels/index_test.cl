// Indices that may be too large, in every way in which kernels access arrays.

#include "../../cl/common/layout.h"
#include "../../cl/common/lanes.h"

static inline float second(__global const float *words, uint at) { return words[at]; }

kernel void read_item(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        target[0] = second(source, at[0]); // Not source[99].
}

kernel void write_item(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0) {
        __global float *to = &target[at[0]];
        to[0] = source[0];
    }
}

kernel void read_group(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        vstore4(vload4(at[0], source), 0, target);
}

kernel void write_group(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        vstore4((float4)(source[0]), at[0], target);
}

kernel void gather_words_of_lanes(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        target[0] = least_lane(gather_words(source, (UInt)(at[0])));
}

kernel void gather_records(__global const uint *at, __global const FilmSum *source, __global float *target)
{
    if (get_global_id(0) == 0)
        target[0] = least_lane(GATHER(source, (UInt)(at[0]), sum[1]));
}

kernel void begin_inside(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        target[0] = *(source + at[0]);
}

static inline __global const float4 *group_at(__global const float *source, uint index)
{
    return (__global const float4 *)source + index;
}

kernel void begin_group_inside(__global const uint *at, __global const float *source, __global float *target)
{
    if (get_global_id(0) == 0)
        target[0] = group_at(source, at[0])->x;
}
