// Paths in the order of the kinds of material that they meet.

#include "../cl/common/lanes.h"
#include "../cl/common/layout.h"
#include "../cl/common/pool.h"

/// Word of a field of a path in a pool.
static inline uint word_of(uint slot, uint field)
{
    return slot / BLOCK * (PATH_FIELD_COUNT * BLOCK) + field * BLOCK + slot % BLOCK;
}

/// Say what kind of kernel each path needs.
///
/// reads   pool.{status, hit_triangle}, surfaces, kinds
/// writes  keys, values[0, slots); no path and no hit are kind 0
kernel void make_keys(
    global const float *pool,
    global const Surface *surfaces,
    global const uint *kinds,
    global uint *keys,
    global uint *values,
    const uint slots)
{
    const uint slot = get_global_id(0);
    if (slot >= slots)
        return;
    const uint status = as_uint(pool[word_of(slot, PATH_STATUS)]);
    const uint triangle = as_uint(pool[word_of(slot, PATH_HIT_TRIANGLE)]);
    const bool hits = (status & STATUS_MASK) == STATUS_ALIVE && triangle != NO_HIT;
    keys[slot] = hits ? kinds[surfaces[triangle].material] : 0u;
    values[slot] = slot;
}

/// Move paths to their places; a work item fills a block.
///
/// reads   pool, values
/// writes  moved
kernel void move_paths(
    global const float *pool, global const uint *values, global float *moved, const uint slots)
{
    const uint first = get_global_id(0) * BLOCK;
    if (first >= slots)
        return;
    uint from[BLOCK];
    for (uint k = 0; k < BLOCK; ++k)
        from[k] = word_of(values[first + k], 0);
    for (uint field = 0; field < PATH_FIELD_COUNT; ++field)
        for (uint k = 0; k < BLOCK; ++k)
            moved[word_of(first, field) + k] = pool[from[k] + field * BLOCK];
}
