// One ray through the tree.  Define STACK_SIZE (Bvh.stack_size), and include alpha.h before.
#pragma once

#include "geometry.h"
#include "lanes.h"

#ifndef ALPHA
#define ALPHA 0
#endif
#if !ALPHA && !defined(ALPHA_PARAMETERS)
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif
#if !FEW

#ifndef STACK_SIZE
#error "STACK_SIZE must be that of the tree: 7 entries a level and one more"
#endif

#if ALPHA
#define IS_THERE(id, u, v)                                                                         \
    (((id) & ALPHA_BIT) == 0 || alpha_passes((id) & ~ALPHA_BIT, (u), (v) ALPHA_ARGUMENTS))
#else
#define IS_THERE(id, u, v) true
#endif

/// Bit k of the result is set where lane k of `mask` is -1.
static inline uint bits_of_4(int4 mask)
{
#ifdef __SSE__
    // Measured: one instruction in place of four tests saves up to a tenth of a traversal.
    return (uint)__builtin_ia32_movmskps(as_float4(mask));
#else
    const int4 bits = mask & (int4)(1, 2, 4, 8);
    return (uint)(bits.x | bits.y | bits.z | bits.w);
#endif
}

static inline uint bits_of_8(int8 mask)
{
#ifdef __AVX__
    return (uint)__builtin_ia32_movmskps256(as_float8(mask));
#else
    return bits_of_4(mask.lo) | bits_of_4(mask.hi) << 4;
#endif
}

/// Return the first hit of a ray; of equally near ones that of the lowest index.
static inline Hit trace_closest(
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
    uint count = 0;
    uint next = 0;
    bool more = ray->t_max > 0.0f;
    while (more) {
        uint met;
        if (next & LEAF_BIT) {
            met = 0;
            __global const TriangleBlock *block = &blocks[next & ~LEAF_BIT];
            const BlockHit found = intersect_block(block, ray);
            uint nearer = bits_of_4(found.hit & (found.t <= best.t));
            if (nearer) {
                float t[4];
                float u[4];
                float v[4];
                vstore4(found.t, 0, t);
                vstore4(found.u, 0, u);
                vstore4(found.v, 0, v);
                do {
                    const uint k = lowest_bit(nearer);
                    nearer &= nearer - 1u;
                    const uint id = block->id[k];
                    const uint triangle = id & ~ALPHA_BIT;
                    if ((t[k] < best.t || (t[k] == best.t && triangle < best.triangle))
                        && IS_THERE(id, u[k], v[k])) {
                        best.t = t[k];
                        best.u = u[k];
                        best.v = v[k];
                        best.triangle = triangle;
                    }
                } while (nearer);
            }
        } else {
            __global const BvhNode *node = &nodes[next];
            float8 near;
            met = bits_of_8(intersect_boxes(node, ray, best.t, &near));
            if (met) {
                // The nearest child is next; the others wait, the nearest of them on top.
                float entry[8];
                vstore8(near, 0, entry);
                uint k = lowest_bit(met);
                met &= met - 1u;
                next = node->child[k];
                float nearest = entry[k];
                const uint base = count;
                while (met && count < STACK_SIZE) {
                    k = lowest_bit(met);
                    met &= met - 1u;
                    uint child = node->child[k];
                    float at = entry[k];
                    if (at < nearest) {
                        const uint other = next;
                        const float farther = nearest;
                        next = child;
                        nearest = at;
                        child = other;
                        at = farther;
                    }
                    uint place = count++;
                    while (place > base && entered[place - 1] < at) {
                        entered[place] = entered[place - 1];
                        waiting[place] = waiting[place - 1];
                        --place;
                    }
                    entered[place] = at;
                    waiting[place] = child;
                }
                continue;
            }
        }
        // Not where it is equal: of equally near triangles the lowest index wins.
        more = false;
        while (count > 0 && !more) {
            --count;
            more = entered[count] <= best.t;
            next = waiting[count];
        }
    }
    if (!(best.t < ray->t_max))
        best.triangle = NO_HIT;
    return best;
}

/// Return whether anything lies on the ray before its t_max.
static inline bool trace_any(
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
            uint before = bits_of_4(found.hit & (found.t < ray->t_max));
#if ALPHA
            if (!before)
                continue;
            float u[4];
            float v[4];
            vstore4(found.u, 0, u);
            vstore4(found.v, 0, v);
            while (before && !blocked) {
                const uint k = lowest_bit(before);
                before &= before - 1u;
                blocked = IS_THERE(block->id[k], u[k], v[k]);
            }
#else
            blocked = before != 0;
#endif
            continue;
        }

        __global const BvhNode *node = &nodes[next];
        float8 near;
        uint met = bits_of_8(intersect_boxes(node, ray, ray->t_max, &near));
        while (met && count < STACK_SIZE) {
            const uint k = lowest_bit(met);
            met &= met - 1u;
            waiting[count++] = node->child[k];
        }
    }
    return blocked;
}

#endif
