// Passes in flight: which of them are complete.
#pragma once

#include "layout.h"

/// Whether the counters say that pass `film_pass + k` is complete and wanted.
static inline int pass_is_complete(__global const Params *params, const volatile __global uint *counters, uint k)
{
    const uint pass = counters[COUNTER_FILM_PASS] + k;
    return k < params->ring && pass < counters[COUNTER_PASS_LIMIT]
           && counters[COUNTER_FINISHED + (pass & (params->ring - 1u))] == params->pixel_count;
}

/// Passes that are complete and wanted, from film_pass on.
static inline uint complete_passes(__global const Params *params, const volatile __global uint *counters)
{
    uint done = 0;
    while (pass_is_complete(params, counters, done)) // at most params->ring
        ++done;
    return done;
}

/// Whether a pass belongs to the second half of the samples.
///
/// Halves have to differ as independent renders would.  Every other Sobol' point would not do: these
/// are opposites in the first dimension.  Runs of about sqrt(pass) points have each half the pattern
/// of a whole sequence; the halves are equal whenever the number of passes is a power of two.
static inline int pass_is_in_half(uint pass)
{
    return (pass >> ((31u - clz(pass | 1u)) >> 1)) & 1u;
}
