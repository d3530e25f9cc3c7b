// The path pool: BLOCK paths a block, each block a structure of arrays, W paths a work item.
#pragma once

#include "lanes.h"
#include "layout.h"

#define ITEMS_PER_BLOCK (BLOCK / W)

/// Address of the first field of the W paths of work item `item`.
static inline __global Float *pool_at(__global float *pool, uint item)
{
    return (__global Float *)pool + (item / ITEMS_PER_BLOCK) * (PATH_FIELD_COUNT * ITEMS_PER_BLOCK)
           + item % ITEMS_PER_BLOCK;
}

// One field of these paths: readable and writable.
#define FIELD(path, field) (path)[(field) * ITEMS_PER_BLOCK]

// A field of a shadow ray, the first of which has number 0.
#if SHADOW_RAYS
#define RAY_FIELD(ray, field) ((ray) == 0u ? PATH_##field : PATH_RAY2_##field + ((ray) - 1u) * RAY_WORDS)
#else
#define RAY_FIELD(ray, field) PATH_##field
#endif

static inline UInt get_u(__global Float *path, uint field) { return as_bits(FIELD(path, field)); }
static inline void put_u(__global Float *path, uint field, UInt value) { FIELD(path, field) = from_bits(value); }
static inline Vec3 get_v(__global Float *path, uint field)
{
    return vec3(FIELD(path, field), FIELD(path, field + 1), FIELD(path, field + 2));
}
static inline void put_v(__global Float *path, uint field, Vec3 value)
{
    FIELD(path, field) = value.x;
    FIELD(path, field + 1) = value.y;
    FIELD(path, field + 2) = value.z;
}
