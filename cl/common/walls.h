// Walls inside cells: what they separate must not share light.
//
// A short ray goes from the vertex of a sample to the middle of its cell, just above the surface.  Where
// something is in its way, the sample shares with those alone that see the same side of it: the two sides
// of a wall never meet, wherever in the cell it stands.  Only cells where surfaces were seen that face
// opposite ways need rays: paths that went on from there met them within a cell's width.  Of a wall that
// ends the room they see one side alone, and nobody is behind it.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "cells.h"
#include "rng.h"
#include "surface.h"
#include "trace.h"
#include "unit_vector.h"

#if WALLS
// How far above the surface rays go, in edges of the cell.
#define WALL_LIFT (1.0f / 16.0f)

// What is cut out has the surfaces among its own buffers.
#if ALPHA
#define SURFACE_BUFFER
#define SURFACE_ARGUMENT
#else
#define SURFACE_BUFFER , __global const Surface *surfaces
#define SURFACE_ARGUMENT , surfaces
#endif
#define WALL_BUFFERS , __global const uint *near_cells SURFACE_BUFFER, GEOMETRY_BUFFERS
#define WALL_ARGUMENTS_OF(marks) , marks SURFACE_ARGUMENT, GEOMETRY_BUFFER_ARGUMENTS
#define WALL_ARGUMENTS WALL_ARGUMENTS_OF(near_cells)

/// Mark the cells of the lanes in `near` with the sides that what is near their samples faces.
static inline void mark_cells(
    __global const Params *params, volatile __global uint *near_cells, Mask near, CellPlace place, UInt vertex)
{
    uint lane_at[W];
    uint lane_side[W];
    store_lanes_u(entry_of(params, place), lane_at);
    store_lanes_u((UInt)(1u) << ((vertex >> VERTEX_FACE_SHIFT) & VERTEX_FACE_MASK), lane_side);
    for (uint left = lane_bits(near); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        if (!(LOOK(&near_cells[lane_at[k]]) & lane_side[k]))
            atomic_or(&near_cells[lane_at[k]], lane_side[k]);
    }
}

/// Lanes of `mask` in whose cells opposite sides were seen: a wall may be in between.
static inline Mask may_have_wall(__global const Params *params, Mask mask, CellPlace place WALL_BUFFERS)
{
    const UInt sides = GATHER_WORD(near_cells, entry_of(params, place));
    return mask & ((sides & (sides >> 1) & 0x15u) != 0u);
}

/// Return what separates points from the middles of their cells: 0 for nothing, or 1 + the side of the cube
/// that what is in between faces.
LARGE_FUNCTION UInt walls_met(
    __global const Params *params, Mask mask, const CellQuery *query, CellPlace place, UInt seed WALL_BUFFERS)
{
#if ALPHA == 2
    uint ray_seeds[W];
    store_lanes_u(seed, ray_seeds);
#endif
    const Vec3 n = normalize3(query->ng);
    const Vec3 from = add_scaled(query->p, n, WALL_LIFT * cell_edge(place.level));
    Vec3 toward = sub(cell_middle(place), from);
    // Both ends are as far above the plane of the surface.
    toward = add_scaled(toward, n, -dot3(toward, n));
    const Hits hits = closest_hits_before(params, mask, from, toward, GEOMETRY_ARGUMENTS);
    const Mask hit = mask & (hits.triangle != NO_HIT);
    if (!any_lane(hit))
        return (UInt)(0u);
    const SurfacePoint s = surface_point(pick_u(hit, hits.triangle, (UInt)(0u)), hits.u, hits.v,
                                         scale(toward, (Float)(-1.0f)), surfaces INSTANCE_ARGUMENTS);
    return pick_u(hit, 1u + cube_face(s.ng), (UInt)(0u));
}

/// The same for the lanes of `mask`; 0 for the others.
static inline UInt wall_before(
    __global const Params *params, Mask mask, const CellQuery *query, CellPlace place, uint pass, UInt pixel WALL_BUFFERS)
{
    if (!any_lane(mask))
        return (UInt)(0u);
    return walls_met(params, mask, query, place, mix_bits(pixel * 0x9e3779b9u + pass) WALL_ARGUMENTS);
}

#else
#define WALL_BUFFERS
#define WALL_ARGUMENTS_OF(marks)
#define WALL_ARGUMENTS
#define may_have_wall(params, mask, place) ((Mask)(0))
#define wall_before(params, mask, query, place, pass, pixel) ((UInt)(0u))
#endif
