// Rays of all lanes against a few triangles: every plate of the list, no tree.
//
// A plate is met where the ray crosses its plane within its edges, by its own matrix.  That is twice as
// quick as going by corners, but two plates that share an edge round it differently.  So each plate
// knows how far rounding may reach: rays that pass an edge closer than that are looked at again corner
// by corner (few.h), where triangles agree on every edge.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "few.h"
#include "geometry.h"
#include "sides.h"

#if FEW

#define LIST_BUFFERS \
    __global const float *corners, __global const uint *faces, __global const Plate *plates
#define LIST_ARGUMENTS corners, faces, plates

// Of `first` or `second`: the triangle alone.
#define PLATE_TRIANGLE(word) ((word) & ((1u << PLATE_TURN) - 1u))

/// Rays, their directions of about length 1 so that no product leaves the range of float.
typedef struct {
    Vec3 origin;
    Vec3 direction;
    Float inverse; // the direction's own length is 1 / inverse
    Float reach; // at least the distance of the origin from that of the world
} PlateRays;

static inline PlateRays plate_rays(Vec3 origin, Vec3 direction)
{
    PlateRays rays;
    rays.inverse = 1.0f / (fabs(direction.x) + fabs(direction.y) + fabs(direction.z));
    rays.origin = origin;
    rays.direction = scale(direction, rays.inverse);
    rays.reach = fabs(origin.x) + fabs(origin.y) + fabs(origin.z);
    return rays;
}

static inline Float along_row(__global const float *row, Vec3 d) { return row[0] * d.x + row[1] * d.y + row[2] * d.z; }

/// Where rays cross the plane of a plate: distance, u and v, all times `size`, which is positive.
typedef struct {
    Float far;
    Float u;
    Float v;
    Float size;
    Mask inside;
    Mask outside; // lanes that are neither are in doubt
} Crossing;

static inline Crossing cross_plate(__global const Plate *plate, bool pair, const PlateRays *rays)
{
    Crossing c;
    const Float down = along_row(plate->n, rays->direction);
    const UInt minus = as_bits(down) & 0x80000000u;
    c.size = from_bits(as_bits(down) ^ minus);
    c.far = from_bits(as_bits(-plate->n[3] - along_row(plate->n, rays->origin)) ^ minus);
    c.u = (along_row(plate->u, rays->origin) + plate->u[3]) * c.size + along_row(plate->u, rays->direction) * c.far;
    c.v = (along_row(plate->v, rays->origin) + plate->v[3]) * c.size + along_row(plate->v, rays->direction) * c.far;
    const Float from_edge = min(min(c.u, c.v), c.size - (pair ? max(c.u, c.v) : c.u + c.v));
    const Float slack = plate->slack * rays->reach + plate->slack_here;
    c.inside = from_edge > slack;
    c.outside = from_edge < -slack;
    return c;
}

/// First hits of the rays; of equally near triangles that of the lowest index.
static inline Hits trace_closest_few(
    __global const Params *params, Mask active, Vec3 origin, Vec3 direction, LIST_BUFFERS ALPHA_PARAMETERS)
{
    const uint count = params->plate_count;
    if (count == 0u)
        return trace_closest_corners(params, active, origin, direction, corners, faces ALPHA_ARGUMENTS);
    const PlateRays rays = plate_rays(origin, direction);
#if BACK_FACES
    const Mask camera = active & (load_lanes_u(camera_rays) != 0u);
    const bool some_camera = any_lane(camera);
#endif
    // Distances stay fractions until the end.
    Float far = (Float)(INFINITY);
    Float size = (Float)(1.0f);
    Float u = (Float)(0.0f);
    Float v = (Float)(0.0f);
    UInt met = (UInt)(NO_HIT);
    Mask doubtful = (Mask)(0);
    for (uint k = 0; k < count; ++k) {
        __global const Plate *plate = &plates[k];
        const Crossing c = cross_plate(plate, k < params->pair_count, &rays);
        // The contrary of what is too far: what overflowed to NaN has to be looked at.
        const Mask there = !(c.outside | (c.far <= 0.0f) | (c.far * size >= far * c.size));
        Mask nearer = there & c.inside;
        doubtful |= there & !c.inside;
#if BACK_FACES
        if (some_camera)
            nearer &= !looked_through_lanes(camera, PLATE_TRIANGLE(plate->first), direction, surfaces, materials);
#endif
#if ALPHA
        if (plate->first & ALPHA_BIT) {
            const Float inverse = 1.0f / c.size;
            nearer &= alpha_passes_lanes(nearer, (UInt)(PLATE_TRIANGLE(plate->first)), c.u * inverse, c.v * inverse
                                         ALPHA_ARGUMENTS);
        }
#endif
        far = pick(nearer, c.far, far);
        size = pick(nearer, c.size, size);
        u = pick(nearer, c.u, u);
        v = pick(nearer, c.v, v);
        met = pick_u(nearer, (UInt)(k), met);
    }
    Hits best;
    const Mask hit = active & (met != NO_HIT);
    const Float inverse = 1.0f / size;
    best.t = pick(hit, far * inverse * rays.inverse, (Float)(INFINITY));
    u *= inverse;
    v *= inverse;
    const UInt plate = pick_u(hit, met, (UInt)(0u));
    const Mask second = (plate < params->pair_count) & (u + v > 1.0f);
    const UInt word = pick_u(second, GATHER_U(plates, plate, second), GATHER_U(plates, plate, first));
    // Weights of the corners after the plate's own; the triangle's record may begin at another one.
    const Float b = pick(second, 1.0f - u, u);
    const Float c = pick(second, 1.0f - v, v);
    const Float a = 1.0f - b - c;
    const UInt turn = (word >> PLATE_TURN) & 3u;
    best.u = pick(turn == 0u, b, pick(turn == 1u, a, c));
    best.v = pick(turn == 0u, c, pick(turn == 1u, b, a));
    best.triangle = pick_u(hit, PLATE_TRIANGLE(word), (UInt)(NO_HIT));
    doubtful &= active;
    if (any_lane(doubtful)) {
        const Hits exact =
            trace_closest_corners(params, doubtful, origin, direction, corners, faces ALPHA_ARGUMENTS);
        best.t = pick(doubtful, exact.t, best.t);
        best.u = pick(doubtful, exact.u, best.u);
        best.v = pick(doubtful, exact.v, best.v);
        best.triangle = pick_u(doubtful, exact.triangle, best.triangle);
    }
    return best;
}

// Plates that shadow rays try before they look whether all have met one.
#define PLATE_RUN 6u

/// Whether anything lies on the rays between their origins and `t` = 1.
static inline Mask trace_any_few(
    __global const Params *params, Mask active, Vec3 origin, Vec3 toward, LIST_BUFFERS ALPHA_PARAMETERS)
{
    const uint count = params->plate_count;
    if (count == 0u)
        return trace_any_corners(params, active, origin, toward, corners, faces ALPHA_ARGUMENTS);
    const PlateRays rays = plate_rays(origin, toward);
    Mask waiting = active;
    Mask doubtful = (Mask)(0);
    for (uint first = 0; first < count && any_lane(waiting); first += PLATE_RUN) {
        const uint end = min(first + PLATE_RUN, count);
        for (uint k = first; k < end; ++k) {
            __global const Plate *plate = &plates[k];
            const Crossing c = cross_plate(plate, k < params->pair_count, &rays);
            const Mask there = !(c.outside | (c.far <= 0.0f) | (c.far * rays.inverse >= c.size));
            Mask blocked = there & c.inside;
            doubtful |= there & !c.inside;
#if ALPHA
            if (plate->first & ALPHA_BIT) {
                const Float inverse = 1.0f / c.size;
                blocked &= waiting;
                blocked &= alpha_passes_lanes(blocked, (UInt)(PLATE_TRIANGLE(plate->first)), c.u * inverse,
                                              c.v * inverse ALPHA_ARGUMENTS);
            }
#endif
            waiting &= !blocked;
        }
    }
    doubtful &= waiting;
    if (any_lane(doubtful))
        waiting &= !trace_any_corners(params, doubtful, origin, toward, corners, faces ALPHA_ARGUMENTS);
    return active & !waiting;
}

#endif
