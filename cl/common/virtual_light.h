// Virtual point lights: where photons came to, as lights that stand for all that the surface reflects.
//
// Of all that came to a slot of the table the one with the least random number stays, and a counter says how many
// it stands for, as in the map of photons.  Which slot one comes to is as random.
//
// Keller: Instant Radiosity, SIGGRAPH 1997.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "rng.h"
#include "unit_vector.h"

/// Slot of the table for a random number of 32 bits.
static inline UInt virtual_slot(UInt bits) { return bits >> VIRTUAL_SHIFT; }

/// What a shadow ray goes to.
typedef struct {
    Vec3 toward;    // from the point to the light, m, not normalised
    Vec3 wi;        // the same, unit
    Vec3 radiance;  // that arrives, over the chance of the light; 0 where there is none
} VirtualSample;

/// Return the light of a slot as seen from `origin`.
///
/// Nearer than `virtual_clearance` times the radius of the scene it gets no brighter: corners are too dark.
static inline VirtualSample sample_virtual_light(
    __global const Params *params,
    __global const VirtualLight *lights,
    __global const uint *counts,
    __global const uint *photon_counters,
    Mask active,
    UInt slot,
    Vec3 origin)
{
    slot = pick_u(active, slot, (UInt)(0u));
    const UInt count = GATHER_WORD(counts, slot);
    const Vec3 p = vec3(GATHER(lights, slot, p[0]), GATHER(lights, slot, p[1]), GATHER(lights, slot, p[2]));
    const Vec3 power =
        vec3(GATHER(lights, slot, power[0]), GATHER(lights, slot, power[1]), GATHER(lights, slot, power[2]));
    const float drawn = (float)(photon_counters[PHOTONS_EMITTED] + photon_counters[PHOTONS_DARK]);
    VirtualSample s;
    s.toward = sub(p, origin);
    const Float d2 = dot3(s.toward, s.toward);
    const Mask there = active & (count > 0u) & (d2 > 0.0f);
    s.toward = pick_v(there, s.toward, vec3((Float)(0.0f), (Float)(0.0f), (Float)(1.0f)));
    s.wi = normalize3(s.toward);
    const Float cosine = max(-dot3(unpack_unit(GATHER_U(lights, slot, ng)), s.wi), (Float)(0.0f));
    const float least = params->virtual_clearance * params->scene_radius;
    const float each = (float)VIRTUAL_LIGHTS_MOST * INV_PI / max(drawn, 1.0f);
    const Float factor = to_float(count) * each * cosine / max(d2, (Float)(max(least * least, 1e-30f)));
    s.radiance = pick_v(there, scale(power, factor), vec3_all((Float)(0.0f)));
    return s;
}
