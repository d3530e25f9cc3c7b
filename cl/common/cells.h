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
    Vec3 ng;
    Float width;      // wanted edge of the cell, m
    Mask seen;        // the camera sees the point: the edge follows its distance
    UInt near;        // 1: its light comes from near
    UInt extra;       // told apart in addition; 0 for nothing
} CellQuery;

/// Where to look in the table.
typedef struct {
    UInt bucket;
    UInt key;
} CellKey;

/// Side of the cube that a unit vector points to: axis and sign, 0 to 5.
static inline UInt cube_face(Vec3 n)
{
    const Float ax = fabs(n.x);
    const Float ay = fabs(n.y);
    const Float az = fabs(n.z);
    const Mask on_x = (ax >= ay) & (ax >= az);
    const Mask on_y = ay >= az;
    const UInt axis = pick_u(on_x, (UInt)(0u), pick_u(on_y, (UInt)(1u), (UInt)(2u)));
    const Float along = pick(on_x, n.x, pick(on_y, n.y, n.z));
    return axis * 2u + pick_u(along < 0.0f, (UInt)(1u), (UInt)(0u));
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

/// Return the cell of a point that is moved in its tangent plane by up to half a cell.
///
/// The level is chosen again after the move, or there would be cells of levels that no point that
/// stays has.  Walls lie on planes of round numbers: the grid is shifted off these.  Blocks of 2 x 2 x 2
/// cells share a bucket, for neighbours are looked up together.
static inline CellKey cell_of(__global const Params *params, CellQuery q, UInt random_x, UInt random_y)
{
    const Float dither = unit_float(mix_bits(random_x ^ rotate(random_y, (UInt)(16u))));
    UInt level = cell_level(q.width, dither);
    Vec3 p = q.p;
    if (params->cell_flags & CELL_JITTER) {
        const Float edge = cell_edge(level);
        Vec3 s;
        Vec3 t;
        make_frame(q.ng, &s, &t);
        p = add_scaled(p, s, (unit_float(random_x) - 0.5f) * edge);
        p = add_scaled(p, t, (unit_float(random_y) - 0.5f) * edge);
        const Vec3 eye = vec3_of(params->camera_origin);
        const Vec3 before = sub(q.p, eye);
        const Vec3 after = sub(p, eye);
        const Float ratio = sqrt(dot3(after, after) / max(dot3(before, before), 1e-30f));
        level = cell_level(pick(q.seen, q.width * ratio, q.width), dither);
    }
    const Float inverse = 1.0f / cell_edge(level);
    const Vec3 cell = vec3(floor(p.x * inverse + 0.37f), floor(p.y * inverse + 0.61f), floor(p.z * inverse + 0.83f));
    const Vec3 block = vec3(floor(cell.x * 0.5f), floor(cell.y * 0.5f), floor(cell.z * 0.5f));
    const UInt corner = to_uint(cell.x - 2.0f * block.x) + 2u * to_uint(cell.y - 2.0f * block.y)
                        + 4u * to_uint(cell.z - 2.0f * block.z);
    // A zero of its own sign would be another number: 0 is added.
    const UInt x = as_bits(block.x + 0.0f);
    const UInt y = as_bits(block.y + 0.0f);
    const UInt z = as_bits(block.z + 0.0f);

    UInt index = mix_bits(level + q.extra * 0x9e3779b9u);
    index = mix_bits(index + x);
    index = mix_bits(index + y);
    index = mix_bits(index + z);
    UInt print = mix_bits_too(level + (cube_face(q.ng) + 8u * q.near) * 0x01000193u + q.extra * 0x85ebca6bu);
    print = mix_bits_too(print ^ x);
    print = mix_bits_too(print ^ y);
    print = mix_bits_too(print ^ z);
    CellKey key;
    key.bucket = bucket_of(index, params->cell_slots);
    // Probing starts at the slot that the last bits name: those of a block are side by side.
    key.key = fingerprint((print & ~63u) | ((index >> 23) & 56u) | corner);
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
