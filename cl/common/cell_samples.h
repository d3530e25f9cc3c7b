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
    query.width = GATHER(vertices, pixel, length) * width;
    return query;
}

/// Where samples are stored.  Neighbours are moved alike: most of a tile meets in one cell, and is added
/// to it at once.
static inline CellPlace place_to_store(__global const Params *params, const CellQuery *query, UInt pixel, uint pass)
{
    UInt a;
    UInt b;
    cell_random(params, pixel / CELL_TILE, pass, CELL_STORE, &a, &b);
    return cell_place(params, query, a, b, params->cell_flags & CELL_JITTER);
}

/// Where samples look for the average that they use.
static inline CellPlace place_to_look_up(__global const Params *params, const CellQuery *query, UInt pixel, uint pass)
{
    UInt a;
    UInt b;
    cell_random(params, pixel, pass, CELL_LOOK_UP, &a, &b);
    return cell_place(params, query, a, b, params->cell_flags & CELL_JITTER);
}

/// Where samples are, at the level that they look for.
static inline CellPlace place_of_vertex(__global const Params *params, const CellQuery *query, UInt pixel, uint pass)
{
    UInt a;
    UInt b;
    cell_random(params, pixel, pass, CELL_LOOK_UP, &a, &b);
    return cell_place(params, query, a, b, 0);
}

/// What separates samples from the middle of the cell that they are stored in: 0 for nothing.
static inline UInt wall_at_store(UInt vertex) { return (vertex >> VERTEX_WALL_SHIFT) & VERTEX_WALL_MASK; }
