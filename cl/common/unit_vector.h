// Unit vectors in a word.
#pragma once

#include "lanes.h"

/// Pack a unit vector: 16 bits for each coordinate of the octahedron unfolded to a square.
///
/// Cigolle et al.: A Survey of Efficient Representations for Independent Unit Vectors, JCGT 3 (2), 2014.
static inline UInt pack_unit(Vec3 n)
{
    const Float inverse = 1.0f / max(fabs(n.x) + fabs(n.y) + fabs(n.z), 1e-20f);
    Float x = n.x * inverse;
    Float y = n.y * inverse;
    const Float fold_x = (1.0f - fabs(y)) * pick(x >= 0.0f, (Float)(1.0f), (Float)(-1.0f));
    const Float fold_y = (1.0f - fabs(x)) * pick(y >= 0.0f, (Float)(1.0f), (Float)(-1.0f));
    const Mask below = n.z < 0.0f;
    x = pick(below, fold_x, x);
    y = pick(below, fold_y, y);
    const Float most = (Float)(65534.0f);
    const UInt a = to_uint(clamp(x * 32767.0f + 32767.5f, (Float)(0.0f), most));
    const UInt b = to_uint(clamp(y * 32767.0f + 32767.5f, (Float)(0.0f), most));
    return a | (b << 16);
}

/// Direction of a packed vector, not of unit length.
static inline Vec3 unpack_direction(UInt packed)
{
    const Float x = to_float(packed & 0xffffu) * (1.0f / 32767.0f) - 1.0f;
    const Float y = to_float(packed >> 16) * (1.0f / 32767.0f) - 1.0f;
    const Float z = 1.0f - fabs(x) - fabs(y);
    const Float fold = max(-z, 0.0f);
    return vec3(x + pick(x >= 0.0f, -fold, fold), y + pick(y >= 0.0f, -fold, fold), z);
}

static inline Vec3 unpack_unit(UInt packed) { return normalize3(unpack_direction(packed)); }

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
