// Splitting: samples whose paths begin alike and part at a vertex.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "pixels.h"
#include "rng.h"

/// Index of the random numbers of the vertex of `number` (0: the camera), with its bits reversed.
///
/// Before the vertex where paths part, `splits` samples in a row have the numbers of one.
static inline UInt reversed_index(__global const Params *params, UInt sample, UInt number)
{
    if (params->splits > 1u)
        sample = pick_u(number < params->split_vertex, divide(sample, params->splits), sample);
    return reverse_bits(sample);
}
