// The parameter cloud between passes: what later vertices have looked up becomes what is known of cells.

#include "common/features.h"
#include "common/layout.h"
#include "common/hash_map.h"

// Look-ups that make a cell known: of a fine texture one alone would stay wrong for ever.
#define MATERIAL_LEAST_VISITS 16u

/// Make known what was gathered in cells of which nothing was.  One work item a slot, while no path is on its
/// way.
///
/// What is known stays: nobody adds to it.  Nothing new is known of buckets that overflowed, for which keys
/// they hold depends on the order in which they came.
///
/// reads   material_keys, material_full, material_sums
/// writes  material_cells
kernel void freeze_materials(
    __global const Params *params,
    __global const uint *material_keys,
    __global const uint *material_full,
    __global const MaterialSum *material_sums,
    __global MaterialCell *material_cells)
{
    const uint slot = get_global_id(0);
    const uint slots = params->material_slots;
    if (slot >= slots || material_keys[slot] == 0u || material_full[slot / bucket_size(slots)] != 0u)
        return;
    __global const MaterialSum *sum = &material_sums[slot];
    __global MaterialCell *cell = &material_cells[slot];
    if (cell->visits != 0u || sum->count < MATERIAL_LEAST_VISITS)
        return;
    float mean[5];
    for (uint c = 0; c < 5; ++c)
        mean[c] = ((float)sum->high[c] * 0x1p32f + (float)sum->low[c]) / (TEXEL_STEPS * (float)sum->count);
    for (uint c = 0; c < 3; ++c)
        cell->color[c] = mean[c];
    cell->roughness = mean[3];
    cell->metallic = mean[4];
    cell->visits = sum->count;
}
