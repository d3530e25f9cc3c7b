// The parameter cloud: what textures give to materials, averaged in cells of space, is fetched once a cell.
//
// What the camera sees first looks its textures up as ever.  Later vertices take the mean of their cell, if it
// is known; else they look up, and what they find is what later epochs know of the cell.
//
// Binder, Keller: Ray-Traced Global Illumination for Games: Massively Parallel Path Space Filtering, 2019.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "guide.h"
#include "material.h"

#if MATERIAL_CELLS
#define MATERIAL_CELL_PARAMETERS                                                                   \
    , volatile __global uint *material_keys, __global uint *material_full,                         \
        __global MaterialSum *material_sums, __global const MaterialCell *material_cells
#define MATERIAL_CELL_ARGUMENTS , material_keys, material_full, material_sums, material_cells

/// Add what textures gave to the sums of cells.
static inline void learn_factors(__global MaterialSum *sums, Mask wanted, UInt slot, Factors t)
{
    if (!any_lane(wanted))
        return;
    const Float values[5] = {t.color.x, t.color.y, t.color.z, t.roughness, t.metallic};
    uint lane_slot[W];
    uint lane_value[5][W];
    store_lanes_u(slot, lane_slot);
    for (uint c = 0; c < 5; ++c)
        store_lanes_u(to_uint(values[c] * TEXEL_STEPS + 0.5f), lane_value[c]);
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        volatile __global MaterialSum *sum = &sums[lane_slot[k]];
        for (uint c = 0; c < 5; ++c)
            add_fixed(&sum->low[c], &sum->high[c], lane_value[c][k], 0u);
        atomic_inc(&sum->count);
    }
}

/// What textures give to the points of the lanes in `hit`; of those in `later`, if it is known, by their cell.
static inline Factors shared_factors(
    __global const Params *params,
    volatile __global uint *counters,
    Mask hit,
    Mask later,
    SurfacePoint s,
    Float u,
    Float v,
    UInt random,
    __global const Material *materials TEXTURE_PARAMETERS MATERIAL_CELL_PARAMETERS)
{
    const Mask textured = (GATHER_U(materials, s.material, base_color_texture) != NO_TEXTURE)
                          | (GATHER_U(materials, s.material, metallic_roughness_texture) != NO_TEXTURE);
    const Mask wanted = hit & later & textured;
    if (!any_lane(wanted))
        return fetch_factors(hit, s, u, v, materials TEXTURE_ARGUMENTS);
    const Vec3 away = sub(s.p, vec3_of(params->camera_origin));
    const Float width = params->material_width * sqrt(dot3(away, away));
    CellKey key = coarse_cell_of(params, s.p, s.ng, random, width, params->material_slots);
    key.key = fingerprint(mix_bits_too(key.key ^ (s.material * 0x9e3779b9u)));
    const UInt slot = find_or_make(material_keys, material_full, &counters[COUNTER_MATERIAL_FAILED], wanted, wanted,
                                   key.bucket, bucket_size(params->material_slots), key.key);
    const Mask there = slot != NO_SLOT;
    const UInt at = pick_u(there, slot, (UInt)(0u));
    const Mask known = there & (GATHER_U(material_cells, at, visits) > 0u);
    Factors t = fetch_factors(hit & !known, s, u, v, materials TEXTURE_ARGUMENTS);
    learn_factors(material_sums, there & !known, slot, t);
    t.color = pick_v(known, GATHER_COLOR(material_cells, at, color), t.color);
    t.roughness = pick(known, GATHER(material_cells, at, roughness), t.roughness);
    t.metallic = pick(known, GATHER(material_cells, at, metallic), t.metallic);
    return t;
}
#endif
