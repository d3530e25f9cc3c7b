// Samples of complete passes, and where in the grid of cells they are.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "cells.h"
#include "hash_map.h"
#include "shared_samples.h"

/// Where in the rings a pass is.
typedef struct {
    uint pass;
    ulong samples;    // first sample
    ulong slots;      // first slot of its table
    ulong buckets;    // first bucket
    float width;      // edge of a cell, m per m of the path
} PassPlace;

static inline PassPlace place_of(__global const Params *params, uint pass)
{
    const ulong at = pass & (params->ring - 1u);
    PassPlace place;
    place.pass = pass;
    place.samples = at * params->pixel_count;
    place.slots = at * params->cell_slots;
    place.buckets = place.slots / bucket_size(params->cell_slots);
    place.width = cell_width_of(params, pass);
    return place;
}

/// What the cells are asked for by the samples of the lanes in `mask`; `pixel` is in the order of pixels.
static inline CellQuery load_query(
    __global const Params *params, __global const CellVertex *vertices, UInt pixel, UInt vertex, float width)
{
    CellQuery query;
    query.p = vec3(GATHER(vertices, pixel, p[0]), GATHER(vertices, pixel, p[1]), GATHER(vertices, pixel, p[2]));
    query.ng = unpack_direction(GATHER_U(vertices, pixel, ng));
    query.seen = (vertex & VERTEX_MASK) == 1u;
    query.near = params->cell_flags & CELL_NEAR ? vertex >> 31 : (UInt)(0u);
    query.extra = params->cell_flags & CELL_IDENTITY ? pixel + 1u : (UInt)(0u);
#if CELL_LAYERS
    const Mask glossy = (vertex & VERTEX_GLOSSY) != 0u;
    query.extra += pick_u(glossy, gloss_of(GATHER_U(vertices, pixel, ng)), (UInt)(0u));
#endif
    query.width = GATHER(vertices, pixel, length) * width;
    return query;
}

#if SPARSE
#define CROWD_BUFFERS , __global const uint *crowds
#define CROWD_ARGUMENTS_OF(entries) , entries
#define CROWD_ARGUMENTS , crowds
#else
#define CROWD_BUFFERS
#define CROWD_ARGUMENTS_OF(entries)
#define CROWD_ARGUMENTS
#endif

/// Return where points are; where too few samples are stored, the cell that is twice or four times as wide.
static inline CellPlace crowded_place(
    __global const Params *params, const CellQuery *query, UInt a, UInt b, uint jitter CROWD_BUFFERS)
{
    CellPlace place = cell_place(params, query, a, b, jitter, (UInt)(0u));
#if SPARSE
    const UInt crowd = GATHER_WORD(crowds, entry_of(params, place));
    const UInt least = (UInt)(params->cell_min_count);
    const Mask few = crowd < least;
    if (any_lane(few)) {
        const UInt raise = pick_u(few, pick_u(crowd * 4u < least, (UInt)(2u), (UInt)(1u)), (UInt)(0u));
        place = cell_place(params, query, a, b, jitter, raise);
    }
#endif
    return place;
}

/// Where samples would be stored if there were no other ones.  Neighbours are moved alike: most of a tile
/// meets in one cell, and is added to it at once.
static inline CellPlace first_place_to_store(
    __global const Params *params, const CellQuery *query, UInt pixel, uint pass)
{
    UInt a;
    UInt b;
    cell_random(params, pixel / CELL_TILE, pass, CELL_STORE, &a, &b);
    return cell_place(params, query, a, b, params->cell_flags & CELL_JITTER, (UInt)(0u));
}

/// Where samples are stored.
static inline CellPlace place_to_store(
    __global const Params *params, const CellQuery *query, UInt pixel, uint pass CROWD_BUFFERS)
{
    UInt a;
    UInt b;
    cell_random(params, pixel / CELL_TILE, pass, CELL_STORE, &a, &b);
    return crowded_place(params, query, a, b, params->cell_flags & CELL_JITTER CROWD_ARGUMENTS);
}

/// Where samples look for the average that they use; without `jitter` where they are.
static inline CellPlace place_to_look_up(
    __global const Params *params, const CellQuery *query, UInt pixel, uint pass, uint jitter CROWD_BUFFERS)
{
    UInt a;
    UInt b;
    cell_random(params, pixel, pass, CELL_LOOK_UP, &a, &b);
    return crowded_place(params, query, a, b, jitter CROWD_ARGUMENTS);
}

/// What separates samples from the middle of the cell that they are stored in: 0 for nothing.
static inline UInt wall_at_store(UInt vertex) { return (vertex >> VERTEX_WALL_SHIFT) & VERTEX_WALL_MASK; }
