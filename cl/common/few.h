// Rays of all lanes against a few triangles, corner by corner: slow, and exact at every edge.
//
// Corners are projected along each ray once, into a plane in which the ray is the origin; a triangle
// is hit where its three edge functions agree in sign.  Triangles that share an edge see the same
// rounded corners and the same exact signs, so no ray slips through between them (the argument of
// Woop, Benthin, Wald: Watertight Ray/Triangle Intersection, JCGT 2 (1), 2013, for a rotation in
// place of their shear).
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "geometry.h"
#include "sides.h"

#if FEW // room for so many corners

/// Corners as the rays see them: x and y across the ray, z along it in its lengths.
typedef struct {
    Float x[FEW];
    Float y[FEW];
    Float z[FEW];
} SeenCorners;

static inline void see_corners(
    __global const Params *params, __global const float *corners, Vec3 origin, Vec3 direction, SeenCorners *seen)
{
    const Vec3 n = normalize3(direction);
    Vec3 s;
    Vec3 t;
    make_frame(n, &s, &t);
    const Vec3 along = scale(n, 1.0f / dot3(n, direction));
    const uint count = min(params->corner_count, (uint)FEW);
    for (uint k = 0; k < count; ++k) {
        const Vec3 p = sub(vec3_of(&corners[3 * k]), origin);
        seen->x[k] = dot3(s, p);
        seen->y[k] = dot3(t, p);
        seen->z[k] = dot3(along, p);
    }
}

/// a * d - b * c with the sign of the exact value (short of underflow); see geometry.h.
static inline Float signed_difference_lanes(Float a, Float d, Float b, Float c)
{
#pragma OPENCL FP_CONTRACT OFF
    const Float product = b * c;
    const Float error = fma(-b, c, product);
    const Float difference = fma(a, d, -product);
    return difference + error;
}

/// The edge functions of a triangle, up to a positive factor; which lanes are inside.
typedef struct {
    Float u;
    Float v;
    Float w;
    Float determinant;
    Mask inside;
} Edges;

/// The same where rounding may have decided: exact signs, corners scaled towards 1.
LARGE_FUNCTION Edges careful_edges(Float ax, Float ay, Float bx, Float by, Float cx, Float cy)
{
    const Float largest =
        max(max(max(fabs(ax), fabs(ay)), max(fabs(bx), fabs(by))), max(fabs(cx), fabs(cy)));
    const Float factor = from_bits(0x7f000000u - min(as_bits(largest) & 0x7f800000u, (UInt)(0x7e800000u)));
    ax *= factor;
    ay *= factor;
    bx *= factor;
    by *= factor;
    cx *= factor;
    cy *= factor;
    Edges e;
    e.u = signed_difference_lanes(cx, by, cy, bx);
    e.v = signed_difference_lanes(ax, cy, ay, cx);
    e.w = signed_difference_lanes(bx, ay, by, ax);
    e.inside = (min(e.u, min(e.v, e.w)) >= 0.0f) | (max(e.u, max(e.v, e.w)) <= 0.0f);
    e.determinant = e.u + e.v + e.w;
    return e;
}

// Faces are looked at in runs of so many: first whether some ray is inside of each, without a branch that
// no processor could foresee, then those that are.
#define FACE_RUN 32u

/// Bit k is set where one of the rays may meet the plane of face `first` + k inside of its edges.
static inline uint met_faces(const SeenCorners *seen, __global const uint *faces, uint first, uint count, Mask active)
{
    uint bits = 0;
    for (uint k = 0; k < count; ++k) {
// A contracted a * b - c * d is not the negative of c * d - a * b.
#pragma OPENCL FP_CONTRACT OFF
        const uint4 face = vload4(first + k, faces);
        const Float u = seen->x[face.z] * seen->y[face.y] - seen->y[face.z] * seen->x[face.y];
        const Float v = seen->x[face.x] * seen->y[face.z] - seen->y[face.x] * seen->x[face.z];
        const Float w = seen->x[face.y] * seen->y[face.x] - seen->y[face.y] * seen->x[face.x];
        const Float least = min(u, min(v, w));
        const Float most = max(u, max(v, w));
        // Not the contrary: what overflowed to NaN has to be looked at.
        bits |= (uint)any_lane(active & !((least < 0.0f) & (most > 0.0f))) << k;
    }
    return bits;
}

static inline Edges edges_of(const SeenCorners *seen, uint a, uint b, uint c, Mask active)
{
#pragma OPENCL FP_CONTRACT OFF
    const Float ax = seen->x[a];
    const Float bx = seen->x[b];
    const Float cx = seen->x[c];
    const Float ay = seen->y[a];
    const Float by = seen->y[b];
    const Float cy = seen->y[c];
    Edges e;
    e.u = cx * by - cy * bx;
    e.v = ax * cy - ay * cx;
    e.w = bx * ay - by * ax;
    const Float least = min(e.u, min(e.v, e.w));
    const Float most = max(e.u, max(e.v, e.w));
    e.inside = active & !((least < 0.0f) & (most > 0.0f));
    e.determinant = e.u + e.v + e.w;
    const Float size = fabs(e.determinant);
    const Mask doubtful =
        e.inside & ((least == 0.0f) | (most == 0.0f) | !((size > 0x1p-40f) & (size < 0x1p40f)));
    if (any_lane(doubtful)) {
        const Edges exact = careful_edges(ax, ay, bx, by, cx, cy);
        e.u = pick(doubtful, exact.u, e.u);
        e.v = pick(doubtful, exact.v, e.v);
        e.w = pick(doubtful, exact.w, e.w);
        e.determinant = pick(doubtful, exact.determinant, e.determinant);
        e.inside &= !doubtful | exact.inside;
    }
    return e;
}

/// First hits of the rays; of equally near triangles that of the lowest index.
LARGE_FUNCTION Hits trace_closest_corners(
    __global const Params *params,
    Mask active,
    Vec3 origin,
    Vec3 direction,
    __global const float *corners,
    __global const uint *faces ALPHA_PARAMETERS)
{
    SeenCorners seen;
    see_corners(params, corners, origin, direction, &seen);
    // Distances stay fractions until the end: far / size is t.
    Float far = (Float)(INFINITY);
    Float size = (Float)(1.0f);
    Hits best;
    best.u = (Float)(0.0f);
    best.v = (Float)(0.0f);
    best.triangle = (UInt)(NO_HIT);
#if BACK_FACES
    const Mask camera = active & (load_lanes_u(camera_rays) != 0u);
    const bool some_camera = any_lane(camera);
#endif
    for (uint first = 0; first < params->face_count; first += FACE_RUN) {
        uint met = met_faces(&seen, faces, first, min(params->face_count - first, FACE_RUN), active);
        for (; met; met &= met - 1u) {
            const uint4 face = vload4(first + lowest_bit(met), faces);
            const Edges e = edges_of(&seen, face.x, face.y, face.z, active);
            const UInt minus = as_bits(e.determinant) & 0x80000000u;
            const Float determinant = from_bits(as_bits(e.determinant) ^ minus);
            const Float distance = from_bits(
                as_bits(e.u * seen.z[face.x] + e.v * seen.z[face.y] + e.w * seen.z[face.z]) ^ minus);
            Mask nearer = e.inside & (distance > 0.0f) & (distance * size < far * determinant);
#if BACK_FACES
            if (some_camera)
                nearer &= !looked_through_lanes(camera, face.w & ~ALPHA_BIT, direction, surfaces, materials);
#endif
#if ALPHA
            if (face.w & ALPHA_BIT) {
                const Float inverse = 1.0f / e.determinant;
                nearer &= alpha_passes_lanes(nearer, (UInt)(face.w & ~ALPHA_BIT), e.v * inverse, e.w * inverse
                                             ALPHA_ARGUMENTS);
            }
#endif
            far = pick(nearer, distance, far);
            size = pick(nearer, determinant, size);
            best.u = pick(nearer, from_bits(as_bits(e.v) ^ minus), best.u);
            best.v = pick(nearer, from_bits(as_bits(e.w) ^ minus), best.v);
            best.triangle = pick_u(nearer, (UInt)(face.w & ~ALPHA_BIT), best.triangle);
        }
    }
    const Float inverse = 1.0f / size;
    best.t = far * inverse;
    best.u *= inverse;
    best.v *= inverse;
    return best;
}

/// Whether anything lies on the rays between their origins and `t` = 1.
LARGE_FUNCTION Mask trace_any_corners(
    __global const Params *params,
    Mask active,
    Vec3 origin,
    Vec3 toward,
    __global const float *corners,
    __global const uint *faces ALPHA_PARAMETERS)
{
    SeenCorners seen;
    see_corners(params, corners, origin, toward, &seen);
    Mask waiting = active;
    for (uint first = 0; first < params->face_count; first += FACE_RUN) {
        uint met = met_faces(&seen, faces, first, min(params->face_count - first, FACE_RUN), waiting);
        for (; met; met &= met - 1u) {
            const uint4 face = vload4(first + lowest_bit(met), faces);
            const Edges e = edges_of(&seen, face.x, face.y, face.z, waiting);
            const UInt minus = as_bits(e.determinant) & 0x80000000u;
            const Float determinant = from_bits(as_bits(e.determinant) ^ minus);
            const Float distance = from_bits(
                as_bits(e.u * seen.z[face.x] + e.v * seen.z[face.y] + e.w * seen.z[face.z]) ^ minus);
            Mask there = e.inside & (distance > 0.0f) & (distance < determinant);
#if ALPHA
            if (face.w & ALPHA_BIT) {
                const Float inverse = 1.0f / e.determinant;
                there &= alpha_passes_lanes(there, (UInt)(face.w & ~ALPHA_BIT), e.v * inverse, e.w * inverse
                                          ALPHA_ARGUMENTS);
            }
#endif
            waiting &= !there;
        }
        if (!any_lane(waiting))
            break;
    }
    return active & !waiting;
}

#endif
