// What becomes of photons, counted.
#pragma once

#include "lanes.h"

static inline void count_photons(volatile __global uint *photon_counters, uint which, Mask mask)
{
    if (any_lane(mask))
        atomic_add(&photon_counters[which], count_lanes(mask));
}
