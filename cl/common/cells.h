// Cells of path space: which one a vertex is in.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "hash_map.h"
#include "rng.h"
#include "unit_vector.h"

/// What a cell is asked for, per lane.
typedef struct {
    Vec3 p;
    Vec3 ng;          // geometric normal, of any length
    Float width;      // wanted edge of the cell, m
    Mask seen;        // the camera sees the point: the edge follows its distance
    UInt near;        // 1: its light comes from near
    UInt extra;       // told apart in addition; 0 for nothing
} CellQuery;

/// A cube of the grid, and the side of it that a surface in it faces.
typedef struct {
    UInt x;           // counts up along the axis; any bits
    UInt y;
    UInt z;
    UInt level;
    UInt side;        // 0 to 2 along the axes, 4 to 6 against them
} CellPlace;

/// Where to look in the table.
typedef struct {
    UInt bucket;
    UInt key;
} CellKey;

// What cells of gloss tell apart beside the place lies in the last bits of both halves of a packed normal: the
// direction that light goes to, and the kind of the surface.
#define DIRECTION_BITS 0x000f000fu
#define GLOSS_BITS 0x00300030u

/// The packed normal `ng` with the part of the octahedron's square, of `side` x `side`, that `wo` is in; `random`
/// blurs the borders of the parts.
static inline UInt with_direction(UInt ng, uint side, Vec3 wo, UInt random)
{
    const UInt packed = pack_unit(wo);
    const Float step = (Float)((float)side / 65535.0f);
    const Float last = (Float)((float)max(side, 1u) - 1.0f);
    const Float x = to_float(packed & 0xffffu) * step + unit_float(random) - 0.5f;
    const Float y = to_float(packed >> 16) * step + unit_float(mix_bits(random)) - 0.5f;
    const UInt i = to_uint(clamp(x, (Float)(0.0f), last));
    const UInt j = to_uint(clamp(y, (Float)(0.0f), last));
    return (ng & ~DIRECTION_BITS) | i | (j << 16);
}

/// The packed normal `ng` with the kind of a surface, so that mirrors share no light with matt surfaces beside them:
/// whether it is a metal, and which power of two its GGX `alpha` lies above.
static inline UInt with_gloss(UInt ng, Mask metal, Float alpha)
{
    // Of alphas from 2^-8 to 1.
    const UInt octave = min((as_bits(max(alpha, 0x1p-8f)) >> 23) - 119u, (UInt)(7u));
    const UInt kind = octave + pick_u(metal, (UInt)(8u), (UInt)(0u));
    return (ng & ~GLOSS_BITS) | ((kind & 3u) << 4) | ((kind >> 2) << 20);
}

/// What tells the cells of gloss of one place apart, and from those of diffuse light; never 0.
static inline UInt gloss_of(UInt ng)
{
    const UInt bits = ng & (DIRECTION_BITS | GLOSS_BITS);
    return (1u + (bits & 63u) + (bits >> 10)) * 0x9e3779b1u;
}

// Purposes of random numbers.
#define CELL_STORE 0u
#define CELL_LOOK_UP 0x9e3779b9u

// Pixels, one after the other in their order, that are moved alike before they are stored.
#define CELL_TILE 16u

/// Random bits for one purpose: `key` has a sequence of its own over the passes, which fills the square
/// evenly.
///
/// Roberts: The Unreasonable Effectiveness of Quasirandom Sequences, 2018 (R2).
static inline void cell_random(__global const Params *params, UInt key, uint pass, uint purpose, UInt *a, UInt *b)
{
    const UInt start = mix_bits(key + mix_bits_too((UInt)(params->seed + purpose)));
    *a = start + pass * 0xc13fa9a9u;
    *b = mix_bits(start) + pass * 0x91e10da6u;
}

/// Level of a cell of about `width`: the power of two below, or with the chance of the rest the one
/// above, so that no seam shows where levels change.
static inline UInt cell_level(Float width, Float dither)
{
    const UInt bits = as_bits(clamp(width, (Float)(0x1p-60f), (Float)(0x1p60f)));
    const Float rest = from_bits((bits & 0x007fffffu) | 0x3f800000u) - 1.0f;
    return (bits >> 23) + pick_u(dither < rest, (UInt)(1u), (UInt)(0u));
}

/// Edge of the cells of a level.
static inline Float cell_edge(UInt level) { return from_bits(level << 23); }

/// Nearest integer as bits that count up with it; far from 0, numbers that differ keep different bits.
static inline UInt nearest(Float x) { return as_bits(x + 0x1.8p23f); }

// Walls lie on planes of round numbers: the grid is shifted off these, in edges.
#define CELL_SHIFT_X 0.13f
#define CELL_SHIFT_Y -0.11f
#define CELL_SHIFT_Z -0.33f

/// Return where in the grid a point is; with `jitter` it is moved in its tangent plane by up to half a cell.
/// `raise` is added to the level.
///
/// Along the two axes of the grid that the surface faces less, the move is up to half an edge either way.
/// The level is chosen again after it, or there would be cells of levels that no point that stays has.
static inline CellPlace cell_place(
    __global const Params *params, const CellQuery *q, UInt random_x, UInt random_y, uint jitter, UInt raise)
{
    const Float dither = unit_float(mix_bits(random_x ^ rotate(random_y, (UInt)(16u))));
    UInt level = cell_level(q->width, dither) + raise;
    // The side of the cube that the normal points to: its axis w, then the two others.
    const Vec3 n = q->ng;
    const Float ax = fabs(n.x);
    const Float ay = fabs(n.y);
    const Float az = fabs(n.z);
    const Mask on_x = (ax >= ay) & (ax >= az);
    const Mask on_y = !on_x & (ay >= az);
    const Mask on_z = !on_x & !on_y;
    const Float nw = pick(on_x, n.x, pick(on_y, n.y, n.z));
    Vec3 p = q->p;
    if (jitter) {
        const Float edge = cell_edge(level);
        const Float du = (unit_float(random_x) - 0.5f) * edge;
        const Float dv = (unit_float(random_y) - 0.5f) * edge;
        const Float dw = -(pick(on_x, n.y, n.x) * du + pick(on_z, n.y, n.z) * dv) / nw;
        const Vec3 move = vec3(pick(on_x, dw, du), pick(on_x, du, pick(on_y, dw, dv)), pick(on_z, dw, dv));
        p = add(p, move);
        const Vec3 before = sub(q->p, vec3_of(params->camera_origin));
        const Vec3 after = add(before, move);
        const Float ratio = sqrt(dot3(after, after) / max(dot3(before, before), 1e-30f));
        level = cell_level(pick(q->seen, q->width * ratio, q->width), dither) + raise;
    }
    const Float inverse = from_bits(((UInt)(254u) - level) << 23);
    CellPlace place;
    place.x = nearest(p.x * inverse - CELL_SHIFT_X);
    place.y = nearest(p.y * inverse - CELL_SHIFT_Y);
    place.z = nearest(p.z * inverse - CELL_SHIFT_Z);
    place.level = level;
    place.side = pick_u(on_x, (UInt)(0u), pick_u(on_y, (UInt)(1u), (UInt)(2u)))
                 + pick_u(nw < 0.0f, (UInt)(4u), (UInt)(0u));
    return place;
}

/// Entry of a cell in tables without keys, where some cells share one.
static inline UInt entry_of(__global const Params *params, CellPlace place)
{
    const UInt hash = mix_bits(place.x * 0x9e3779b1u + place.y * 0x85ebca77u + place.z * 0xc2b2ae3du
                               + place.level * 0x27d4eb2fu + place.side * 0x165667b1u);
    return hash & (params->cell_slots - 1u);
}

/// Middle of a cube of the grid.
static inline Vec3 cell_middle(CellPlace place)
{
    const Float edge = cell_edge(place.level);
    return vec3((from_bits(place.x) - 0x1.8p23f + CELL_SHIFT_X) * edge,
                (from_bits(place.y) - 0x1.8p23f + CELL_SHIFT_Y) * edge,
                (from_bits(place.z) - 0x1.8p23f + CELL_SHIFT_Z) * edge);
}

/// Return where in the table what is asked for is; `wall` is 0 or tells apart what a wall separates.
///
/// Blocks of 2 x 2 x 2 cells share a bucket, for neighbours are looked up together; each side has its own,
/// for where all of them come together one would not hold them.
static inline CellKey cell_key(__global const Params *params, const CellQuery *q, CellPlace place, UInt wall)
{
    const UInt x = place.x;
    const UInt y = place.y;
    const UInt z = place.z;
    const UInt side = place.side + 8u * q->near + 16u * wall;
    const UInt corner = (x & 1u) | ((y & 1u) << 1) | ((z & 1u) << 2);
    const UInt index = mix_bits((x >> 1) * 0x9e3779b1u + (y >> 1) * 0x85ebca77u + (z >> 1) * 0xc2b2ae3du
                                + place.level * 0x27d4eb2fu + (q->extra * 8u + place.side) * 0x165667b1u
                                + wall * 0xd3a2646du);
    const UInt print = mix_bits_too((x >> 1) * 0x2c1b3c6du + (y >> 1) * 0x297a2d39u + (z >> 1) * 0x9c8f2d35u
                                    + place.level * 0x68e31da5u + q->extra * 0xb5297a4du + side * 0x1b56c4e9u);
    CellKey key;
    key.bucket = bucket_of(index, params->cell_slots);
    // Probing starts at the slot that the last bits name: those of a block are side by side, and what is
    // near on a flat surface has the corners that it leaves free.
    key.key = fingerprint((print & ~63u) | ((index >> 23) & 56u) | (corner ^ (q->near * 7u)));
    return key;
}

/// Radiance behind a gate that let `beyond` through; 0 where next to nothing gets through.
static inline Vec3 demodulated(Vec3 beyond, Vec3 gate)
{
    const Mask r = gate.x > 1e-30f;
    const Mask g = gate.y > 1e-30f;
    const Mask b = gate.z > 1e-30f;
    const Float zero = (Float)(0.0f);
    const Float one = (Float)(1.0f);
    // A 0 may have a sign, which counts where bits are compared: 0 is added.
    return vec3(pick(r, beyond.x / pick(r, gate.x, one), zero) + 0.0f,
                pick(g, beyond.y / pick(g, gate.y, one), zero) + 0.0f,
                pick(b, beyond.z / pick(b, gate.z, one), zero) + 0.0f);
}
