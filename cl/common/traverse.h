// One ray through the tree.  Define STACK_SIZE (Bvh.stack_size), and include alpha.h before.
#pragma once

#include "geometry.h"

#ifndef ALPHA
#define ALPHA 0
#endif
#if !ALPHA && !defined(ALPHA_PARAMETERS)
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif
#ifndef STACK_SIZE
#error "STACK_SIZE must be that of the tree: 7 entries a level and one more"
#endif

#if ALPHA
#define IS_THERE(id, u, v)                                                                         \
    (((id) & ALPHA_BIT) == 0 || alpha_passes((id) & ~ALPHA_BIT, (u), (v) ALPHA_ARGUMENTS))
#else
#define IS_THERE(id, u, v) true
#endif

/// Return the first hit of a ray that is set up; of equally near ones that of the lowest index.
static inline Hit trace_closest_setup(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const RaySetup *ray ALPHA_PARAMETERS)
{
    Hit best;
    best.t = ray->t_max;
    best.u = 0.0f;
    best.v = 0.0f;
    // Index 0 loses every tie, so that t_max itself is out of range.
    best.triangle = 0;
    uint waiting[STACK_SIZE];
    float entered[STACK_SIZE];
    waiting[0] = 0;
    entered[0] = 0.0f;
    uint count = ray->t_max > 0.0f ? 1 : 0;
    while (count > 0) {
        --count;
        // Not where it is equal: of equally near triangles the lowest index wins.
        if (entered[count] > best.t)
            continue;
        const uint next = waiting[count];
        if (next & LEAF_BIT) {
            __global const TriangleBlock *block = &blocks[next & ~LEAF_BIT];
            const BlockHit found = intersect_block(block, ray);
            if (!any(found.hit))
                continue;
            int hit[4];
            float t[4];
            float u[4];
            float v[4];
            vstore4(found.hit, 0, hit);
            vstore4(found.t, 0, t);
            vstore4(found.u, 0, u);
            vstore4(found.v, 0, v);
            for (uint k = 0; k < 4; ++k) {
                const uint id = block->id[k];
                const uint triangle = id & ~ALPHA_BIT;
                if (hit[k] && (t[k] < best.t || (t[k] == best.t && triangle < best.triangle))
                    && IS_THERE(id, u[k], v[k])) {
                    best.t = t[k];
                    best.u = u[k];
                    best.v = v[k];
                    best.triangle = triangle;
                }
            }
            continue;
        }

        __global const BvhNode *node = &nodes[next];
        float8 near;
        const int8 met = intersect_boxes(node, ray, best.t, &near);
        int hit[8];
        float entry[8];
        vstore8(met, 0, hit);
        vstore8(near, 0, entry);
        const uint base = count;
        for (uint k = 0; k < 8; ++k) {
            if (hit[k] && count < STACK_SIZE) {
                // Keep the nearest on top.
                uint place = count++;
                while (place > base && entered[place - 1] < entry[k]) {
                    entered[place] = entered[place - 1];
                    waiting[place] = waiting[place - 1];
                    --place;
                }
                entered[place] = entry[k];
                waiting[place] = node->child[k];
            }
        }
    }
    if (!(best.t < ray->t_max))
        best.triangle = NO_HIT;
    return best;
}

/// Return whether anything lies on the ray before its t_max.
static inline bool trace_any_setup(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const RaySetup *ray ALPHA_PARAMETERS)
{
    uint waiting[STACK_SIZE];
    waiting[0] = 0;
    uint count = ray->t_max > 0.0f ? 1 : 0;
    bool blocked = false;
    while (count > 0 && !blocked) {
        const uint next = waiting[--count];
        if (next & LEAF_BIT) {
            __global const TriangleBlock *block = &blocks[next & ~LEAF_BIT];
            const BlockHit found = intersect_block(block, ray);
            const int4 before = found.hit & (found.t < ray->t_max);
            if (!any(before))
                continue;
#if ALPHA
            int hit[4];
            float u[4];
            float v[4];
            vstore4(before, 0, hit);
            vstore4(found.u, 0, u);
            vstore4(found.v, 0, v);
            for (uint k = 0; k < 4; ++k)
                blocked |= hit[k] && IS_THERE(block->id[k], u[k], v[k]);
#else
            blocked = true;
#endif
            continue;
        }

        __global const BvhNode *node = &nodes[next];
        float8 near;
        const int8 met = intersect_boxes(node, ray, ray->t_max, &near);
        int hit[8];
        vstore8(met, 0, hit);
        for (uint k = 0; k < 8; ++k) {
            if (hit[k] && count < STACK_SIZE)
                waiting[count++] = node->child[k];
        }
    }
    return blocked;
}

/// As trace_closest_setup, for a ray as it is.
static inline Hit trace_closest(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const Ray ray ALPHA_PARAMETERS)
{
    const RaySetup setup = make_ray_setup(ray);
    return trace_closest_setup(nodes, blocks, &setup ALPHA_ARGUMENTS);
}

/// As trace_any_setup, for a ray as it is.
static inline bool trace_any(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const Ray ray ALPHA_PARAMETERS)
{
    const RaySetup setup = make_ray_setup(ray);
    return trace_any_setup(nodes, blocks, &setup ALPHA_ARGUMENTS);
}
