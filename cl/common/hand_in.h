// Finished paths: what they bring has to be finite, and their pass counts them.
#pragma once

#include "lanes.h"
#include "layout.h"

/// Exponent bits of the largest of three numbers; tested on bits, for a compiler may assume that no
/// float is NaN.
static inline UInt exponent_bits(Vec3 v)
{
    return max(as_bits(v.x) & 0x7f800000u, max(as_bits(v.y) & 0x7f800000u, as_bits(v.z) & 0x7f800000u));
}

// From 2^96 on, a film's sums could overflow.
#define MAX_EXPONENT_BITS 0x6f800000u

// Passes that the paths of a work item end in at about the same time.
#define TALLY_PASSES 4u

/// What a work item counts on its way, to disturb the others seldom.
typedef struct {
    uint pass;                   // of the ring
    uint finished[TALLY_PASSES]; // samples of that pass and of those after it
    uint started;                // paths
    uint dark;                   // samples that gathered nothing
} Tally;

static inline void clear_tally(Tally *tally)
{
    tally->pass = 0;
    for (uint k = 0; k < TALLY_PASSES; ++k)
        tally->finished[k] = 0;
    tally->started = 0;
    tally->dark = 0;
}

static inline void hand_in(Tally *tally, uint ring, volatile __global uint *counters)
{
    for (uint k = 0; k < TALLY_PASSES; ++k) {
        if (tally->finished[k] > 0)
            atomic_add(&counters[COUNTER_FINISHED + ((tally->pass + k) & (ring - 1u))], tally->finished[k]);
        tally->finished[k] = 0;
    }
}

/// Count the samples of the lanes in `done` to their passes of the ring.
static inline void count_finished(
    Tally *tally, Mask done, UInt pass, uint ring, volatile __global uint *counters)
{
    uint lane_pass[W];
    store_lanes_u(pass, lane_pass);
    for (uint k = 0; k < W; ++k) {
        const uint left = lane_bits(done);
        if (!left)
            break;
        const uint counted = lane_pass[lowest_bit(left)];
        const Mask same = done & (pass == counted);
        if (((counted - tally->pass) & (ring - 1u)) >= TALLY_PASSES) {
            hand_in(tally, ring, counters);
            // The next may be of the pass before.
            tally->pass = (counted - 1u) & (ring - 1u);
        }
        tally->finished[(counted - tally->pass) & (ring - 1u)] += count_lanes(same);
        done &= !same;
    }
}
