// The guide: where light comes from, learned in cells of space, and directions drawn by it.
//
// A cell holds the mean radiance that arrives at its surface from GUIDE_BINS parts of the hemisphere.
// The unit square, mapped to the disk by Shirley's and Chiu's equal-area map and from there up to the
// hemisphere, is dense as the cosine: equal squares of it are parts with equal shares of the cosine.
// So the product with the cosine is exact and costs nothing, and a part of the drawing that is uniform
// in the square is what the diffuse lobe does without a guide.
//
// Shirley, Chiu: A Low Distortion Map Between Disk and Square, 1997.
// Dahm, Keller: Learning Light Transport the Reinforced Way, 2017.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "hash_map.h"
#include "cells.h"
#include "unit_vector.h"

// Bounces that are guided.  Each multiplies what a path is worth by what the guide is wrong by, which after a
// thousand bounces leaves all light to a few paths.
#define GUIDED_BOUNCES 16u

#define NO_PART 0xffffffffu

/// Angle of `y` / `x` over pi / 4, for a ratio in [-1, 1]: an odd polynomial (error below 3e-6).
static inline Float eighths_of(Float ratio)
{
    const Float z = ratio * ratio;
    return ratio
           * (1.27321054f
              + z * (-0.42350853f + z * (0.24642319f + z * (-0.14823862f + z * (0.0670325f - 0.0149212f * z)))));
}

/// Point of the unit disk for a point of the unit square, area in proportion.
static inline void disk_of_square(Float u1, Float u2, Float *x, Float *y)
{
    const Float a = 2.0f * u1 - 1.0f;
    const Float b = 2.0f * u2 - 1.0f;
    const Mask wide = fabs(a) > fabs(b);
    const Float radius = pick(wide, a, b);
    const Float other = pick(wide, b, a);
    const Float angle = other / pick(radius == 0.0f, (Float)(1.0f), radius) * 0.785398163397448f;
    const Float z = angle * angle;
    const Float s = angle * (1.0f + z * (-1.6666667e-1f + z * (8.3333333e-3f + z * -1.9841270e-4f)));
    const Float c = 1.0f + z * (-0.5f + z * (4.1666667e-2f + z * (-1.3888889e-3f + z * 2.4801587e-5f)));
    *x = radius * pick(wide, c, s);
    *y = radius * pick(wide, s, c);
}

/// Point of the unit square for a point of the unit disk: the way back.
static inline void square_of_disk(Float x, Float y, Float *u1, Float *u2)
{
    const Float radius = sqrt(x * x + y * y);
    const Mask wide = fabs(x) > fabs(y);
    const Float longer = pick(wide, x, y);
    const Float shorter = pick(wide, y, x);
    const Float signed_radius = pick(longer < 0.0f, -radius, radius);
    const Float other = signed_radius * eighths_of(shorter / pick(longer == 0.0f, (Float)(1.0f), longer));
    *u1 = 0.5f + 0.5f * pick(wide, signed_radius, other);
    *u2 = 0.5f + 0.5f * pick(wide, other, signed_radius);
}

/// Which part of the hemisphere a direction is in, by its x and y in the guide's frame.
static inline UInt guide_bin(Float x, Float y)
{
    Float u1;
    Float u2;
    square_of_disk(x, y, &u1, &u2);
    const Float most = (Float)(GUIDE_SIDE - 1.0f);
    const UInt i = to_uint(clamp(u1 * (float)GUIDE_SIDE, (Float)(0.0f), most));
    const UInt j = to_uint(clamp(u2 * (float)GUIDE_SIDE, (Float)(0.0f), most));
    return i * GUIDE_SIDE + j;
}

/// Tangents of the unit vector `n` that turn little where `n` does, as long as its cube_face stays.
static inline void guide_frame(Vec3 n, Vec3 *s, Vec3 *t)
{
    const UInt axis = cube_face(n) >> 1;
    const Float zero = (Float)(0.0f);
    const Float one = (Float)(1.0f);
    // The axis after that of the face, made upright.
    const Vec3 next = vec3(pick(axis == 2u, one, zero), pick(axis == 0u, one, zero), pick(axis == 1u, one, zero));
    *s = normalize3(add_scaled(next, n, -dot3(next, n)));
    *t = cross3(n, *s);
}

/// Find the coarse cell that a point is in, after it was moved in its tangent plane by up to half a cell.
///
/// The edge is a power of two of about `width`, within the bounds of the guide's cells.
static inline CellKey coarse_cell_of(
    __global const Params *params, Vec3 p, Vec3 n, UInt random, Float width, uint slots)
{
    const Float low = (Float)(params->guide_least);
    const Float high = (Float)(params->guide_most);
    const UInt level = cell_level(clamp(width, low, high), (Float)(1.0f));
    const Float edge = cell_edge(level);
    Vec3 s;
    Vec3 t;
    make_frame(n, &s, &t);
    const UInt more = mix_bits(random);
    const Float jitter = params->cell_flags & CELL_JITTER ? 1.0f : 0.0f;
    p = add_scaled(p, s, (unit_float(random) - 0.5f) * edge * jitter);
    p = add_scaled(p, t, (unit_float(more) - 0.5f) * edge * jitter);
    const Float inverse = 1.0f / edge;
    const UInt x = as_bits(floor(p.x * inverse + 0.37f) + 0.0f);
    const UInt y = as_bits(floor(p.y * inverse + 0.61f) + 0.0f);
    const UInt z = as_bits(floor(p.z * inverse + 0.83f) + 0.0f);
    const UInt index = mix_bits(mix_bits(mix_bits(mix_bits(level) + x) + y) + z);
    UInt print = mix_bits_too(level + cube_face(n) * 0x01000193u);
    print = mix_bits_too(print ^ x);
    print = mix_bits_too(print ^ y);
    print = mix_bits_too(print ^ z);
    CellKey key;
    key.bucket = bucket_of(index, slots);
    key.key = fingerprint(print);
    return key;
}

/// What the guide has for a point, per lane.
typedef struct {
    UInt slot;     // of its cell, for learning; NO_SLOT if there is none
    UInt known;    // the same if something is known there, else NO_SLOT
    Float mean;    // what a white diffuse surface reflects there of what no shadow ray finds, as far as known
} Guide;

/// Find the cells of these points; those of the lanes of `learning` are made.
static inline Guide find_guide(
    __global const Params *params,
    volatile __global uint *keys,
    __global const GuideCell *cells,
    __global uint *full,
    volatile __global uint *counters,
    Mask wanted,
    Mask learning,
    Vec3 p,
    Vec3 n,
    UInt random)
{
    Guide g;
    g.slot = (UInt)(NO_SLOT);
    g.known = g.slot;
    g.mean = (Float)(0.0f);
    if (!any_lane(wanted))
        return g;
    const Vec3 away = sub(p, vec3_of(params->camera_origin));
    const Float width = params->guide_width * sqrt(dot3(away, away));
    const CellKey key = coarse_cell_of(params, p, n, random, width, params->guide_slots);
    const uint size = bucket_size(params->guide_slots);
    g.slot = find_or_make(keys, full, &counters[COUNTER_GUIDE_FAILED], wanted, learning, key.bucket, size, key.key);
    const Mask there = g.slot != NO_SLOT;
    const UInt at = pick_u(there, g.slot, (UInt)(0u));
    g.mean = pick(there, GATHER(cells, at, mean), (Float)(0.0f));
    g.known = pick_u(there & (GATHER(cells, at, visits) > 0.0f), g.slot, (UInt)(NO_SLOT));
    return g;
}

/// Part of a cell that a ray leaves through, by its part of the hemisphere; NO_PART where none learns.
static inline UInt guide_part(Guide guide, UInt part, Mask learns)
{
    return pick_u(learns & (guide.slot != NO_SLOT), guide.slot * GUIDE_BINS + part, (UInt)(NO_PART));
}

/// Density of the part, relative to that of the cosine; 1 where there is no guide.
static inline Float guide_density(__global const GuideCell *cells, UInt slot, UInt bin)
{
    const Mask known = slot != NO_SLOT;
    const UInt at = pick_u(known, slot * (UInt)(sizeof(GuideCell) / 4) + bin, (UInt)(0u));
    return pick(known, gather_words((__global const float *)cells, at), (Float)(1.0f));
}

/// Bend a uniform point of the square so that it is dense as the guide says.
static inline void warp_by_guide(__global const GuideCell *cells, UInt slot, Float *u1, Float *u2)
{
    const Mask known = slot != NO_SLOT;
    if (!any_lane(known))
        return;
    const UInt at = pick_u(known, slot, (UInt)(0u)) * (UInt)(sizeof(GuideCell) / 4);
    __global const float *words = (__global const float *)cells;
    // The row, by halving: rows hold the share of all rows up to them.
    const UInt rows = at + GUIDE_BINS;
    UInt row = (UInt)(0u);
    for (uint step = GUIDE_SIDE / 2u; step > 0u; step /= 2u)
        row = pick_u(*u1 >= gather_words(words, rows + row + (step - 1u)), row + step, row);
    row = min(row, (UInt)(GUIDE_SIDE - 1u));
    const Float below = pick(row == 0u, (Float)(0.0f), gather_words(words, rows + max(row, (UInt)(1u)) - 1u));
    const Float share = gather_words(words, rows + row) - below;
    const Float along = (*u1 - below) / max(share, 1e-9f);
    // The part of the row, one after the other.
    const Float target = *u2 * share * (float)GUIDE_BINS;
    Float sum = (Float)(0.0f);
    Float before = (Float)(0.0f);
    Float width = (Float)(1.0f);
    UInt column = (UInt)(0u);
    for (uint k = 0; k < GUIDE_SIDE; ++k) {
        const Float density = gather_words(words, at + row * GUIDE_SIDE + k);
        const Mask here = sum <= target;
        column = pick_u(here, (UInt)(k), column);
        before = pick(here, sum, before);
        width = pick(here, density, width);
        sum += density;
    }
    const Float across = (target - before) / max(width, 1e-9f);
    const Float side = (Float)(1.0f / GUIDE_SIDE);
    const Float most = (Float)(0x1.fffffep-1f);
    *u1 = pick(known, (to_float(row) + clamp(along, (Float)(0.0f), most)) * side, *u1);
    *u2 = pick(known, (to_float(column) + clamp(across, (Float)(0.0f), most)) * side, *u2);
}

/// Add radiance to the sums of parts of cells, and with `count` a visit.
///
/// What is not finite, or too large for the sums, is left out and counted.
static inline void learn(
    __global const Params *params,
    __global GuideSum *sums,
    volatile __global uint *counters,
    Mask wanted,
    UInt part,
    Float radiance,
    int count,
    UInt random)
{
    wanted &= part != NO_PART;
    const Mask rejected = wanted & (as_bits(radiance) >= as_uint(params->guide_limit));
    if (any_lane(rejected)) {
        atomic_add(&counters[COUNTER_GUIDE_REJECTED], count_lanes(rejected));
        wanted &= !rejected;
    }
    if (!any_lane(wanted))
        return;
    UInt low;
    UInt high;
    to_fixed(pick(wanted, radiance, (Float)(0.0f)), (Float)(params->guide_steps), unit_float(random), &low, &high);
    uint lane_part[W];
    uint lane_low[W];
    uint lane_high[W];
    store_lanes_u(part, lane_part);
    store_lanes_u(low, lane_low);
    store_lanes_u(high, lane_high);
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        volatile __global GuideSum *sum = &sums[lane_part[k] / GUIDE_BINS];
        const uint bin = lane_part[k] % GUIDE_BINS;
        if (count)
            atomic_inc(&sum->count[bin]);
        if (lane_low[k] | lane_high[k])
            add_fixed(&sum->low[bin], &sum->high[bin], lane_low[k], lane_high[k]);
    }
}
