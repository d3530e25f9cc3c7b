// Rays through the tree.  Define STACK_SIZE (Bvh.stack_size), and include alpha.h before.
#pragma once

#include "geometry.h"
#include "lanes.h"
#include "sides.h"

#ifndef ALPHA
#define ALPHA 0
#endif
#if !ALPHA && !defined(ALPHA_PARAMETERS)
#define ALPHA_PARAMETERS
#define ALPHA_ARGUMENTS
#endif
#ifndef INSTANCES
#define INSTANCES 0
#endif
#if !FEW

#ifndef STACK_SIZE
#error "STACK_SIZE must be that of the tree: 7 entries a level and one more"
#endif

#ifndef ALPHA_ARGUMENTS_OF
#define ALPHA_ARGUMENTS_OF(lane) ALPHA_ARGUMENTS
#endif
#if ALPHA
#define IS_THERE(id, u, v)                                                                         \
    (((id) & ALPHA_BIT) == 0 || alpha_passes((id) & ~ALPHA_BIT, (u), (v) ALPHA_ARGUMENTS))
#else
#define IS_THERE(id, u, v) true
#endif
#if BACK_FACES
#define IS_SEEN(id, ray)                                                                           \
    (!*camera_rays || !is_looked_through((id) & ~ALPHA_BIT, (ray), surfaces, materials))
#else
#define IS_SEEN(id, ray) true
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

/// Return which of the children that a ray meets is the nearest; the others wait, the nearest on top.
static inline uint descend(
    __global const BvhNode *node, uint met, float8 near, uint *waiting, float *entered, uint *waiting_count)
{
    float entry[8];
    vstore8(near, 0, entry);
    uint k = lowest_bit(met);
    met &= met - 1u;
    uint next = node->child[k];
    float nearest = entry[k];
    uint count = *waiting_count;
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
    *waiting_count = count;
    return next;
}

// Of scenes of two levels an instance's hits are its base plus the index of the triangle.
#if INSTANCES
#define BASE_PARAMETER , uint base
#define TRIANGLE_OF(id) (((id) & ~ALPHA_BIT) + base)
#else
#define BASE_PARAMETER
#define TRIANGLE_OF(id) ((id) & ~ALPHA_BIT)
#endif

/// Look for hits of a ray below `next` (a child[]) that are nearer than `hit`; of equally near ones that
/// of the lowest index counts.
static inline void trace_closest_from(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const RaySetup *ray,
    uint next,
    Hit *hit BASE_PARAMETER ALPHA_PARAMETERS)
{
    Hit best = *hit;
    uint waiting[STACK_SIZE];
    float entered[STACK_SIZE];
    uint count = 0;
    bool more = true;
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
                    const uint triangle = TRIANGLE_OF(id);
                    if ((t[k] < best.t || (t[k] == best.t && triangle < best.triangle))
                        && IS_SEEN(id, ray) && IS_THERE(id, u[k], v[k])) {
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
                next = descend(node, met, near, waiting, entered, &count);
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
    *hit = best;
}

/// Return whether anything below `first` (a child[]) lies on the ray before its t_max.
static inline bool trace_any_from(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    const RaySetup *ray,
    uint first ALPHA_PARAMETERS)
{
    uint waiting[STACK_SIZE];
    waiting[0] = first;
    uint count = 1;
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

#if INSTANCES
// instances.h has the rest.
#elif W == 1
/// Return the first hit of a ray; of equally near ones that of the lowest index.
static inline Hits trace_closest(
    __global const BvhNode *nodes, __global const TriangleBlock *blocks, const RaySetups *rays ALPHA_PARAMETERS)
{
    const RaySetup ray = ray_setup(rays, 0);
    Hit best;
    best.t = ray.t_max;
    best.u = 0.0f;
    best.v = 0.0f;
    // Index 0 loses every tie, so that t_max itself is out of range.
    best.triangle = 0;
    if (ray.t_max > 0.0f)
        trace_closest_from(nodes, blocks, &ray, 0, &best ALPHA_ARGUMENTS);
    Hits hits;
    hits.t = best.t;
    hits.u = best.u;
    hits.v = best.v;
    hits.triangle = best.t < ray.t_max ? best.triangle : NO_HIT;
    return hits;
}

/// Return whether anything lies on the ray before its t_max.
static inline Mask trace_any(
    __global const BvhNode *nodes, __global const TriangleBlock *blocks, const RaySetups *rays ALPHA_PARAMETERS)
{
    const RaySetup ray = ray_setup(rays, 0);
    return ray.t_max > 0.0f && trace_any_from(nodes, blocks, &ray, 0 ALPHA_ARGUMENTS);
}

#else
// Neighbours' rays share the upper part of their way: all lanes go down together as long as more than
// these meet a box, then each on its own.  Where a ray is tested does not change what it hits.
#ifndef LANES_APART
#define LANES_APART 4
#endif

/// The boxes' part of the rays' setups, in lanes.
typedef struct {
    Vec3 inverse;
    Vec3 far_inverse;
    Vec3 near_shift;
    Vec3 far_shift;
    Mask backward_x;
    Mask backward_y;
    Mask backward_z;
} Bundle;

static inline Bundle bundle_of(const RaySetups *rays)
{
    Bundle b;
    b.inverse = vec3(load_lanes(rays->inverse[0]), load_lanes(rays->inverse[1]), load_lanes(rays->inverse[2]));
    b.far_inverse = vec3(load_lanes(rays->far_inverse[0]), load_lanes(rays->far_inverse[1]),
                         load_lanes(rays->far_inverse[2]));
    b.near_shift = vec3(load_lanes(rays->near_shift[0]), load_lanes(rays->near_shift[1]),
                        load_lanes(rays->near_shift[2]));
    b.far_shift = vec3(load_lanes(rays->far_shift[0]), load_lanes(rays->far_shift[1]),
                       load_lanes(rays->far_shift[2]));
    b.backward_x = b.inverse.x < 0.0f;
    b.backward_y = b.inverse.y < 0.0f;
    b.backward_z = b.inverse.z < 0.0f;
    return b;
}

/// As intersect_boxes: which rays may meet child `c` up to `limit`.
static inline Mask intersect_box(__global const BvhNode *node, uint c, const Bundle *rays, Float limit)
{
    const Float x_low = (Float)(node->bounds[0][c]);
    const Float x_high = (Float)(node->bounds[1][c]);
    const Float y_low = (Float)(node->bounds[2][c]);
    const Float y_high = (Float)(node->bounds[3][c]);
    const Float z_low = (Float)(node->bounds[4][c]);
    const Float z_high = (Float)(node->bounds[5][c]);
    const Float x0 = fma(pick(rays->backward_x, x_high, x_low), rays->inverse.x, rays->near_shift.x);
    const Float y0 = fma(pick(rays->backward_y, y_high, y_low), rays->inverse.y, rays->near_shift.y);
    const Float z0 = fma(pick(rays->backward_z, z_high, z_low), rays->inverse.z, rays->near_shift.z);
    const Float x1 = fma(pick(rays->backward_x, x_low, x_high), rays->far_inverse.x, rays->far_shift.x);
    const Float y1 = fma(pick(rays->backward_y, y_low, y_high), rays->far_inverse.y, rays->far_shift.y);
    const Float z1 = fma(pick(rays->backward_z, z_low, z_high), rays->far_inverse.z, rays->far_shift.z);
    Float near = x0 > 0.0f ? x0 : (Float)(0.0f);
    Float far = x1 < limit * BOX_FAR_FACTOR ? x1 : limit * BOX_FAR_FACTOR;
    near = y0 > near ? y0 : near;
    near = z0 > near ? z0 : near;
    far = y1 < far ? y1 : far;
    far = z1 < far ? z1 : far;
    return near <= far;
}

/// Return the first hits of the rays; of equally near ones that of the lowest index.
///
/// Each on its own: after a bounce rays of neighbours part too early for a common way to pay.
static inline Hits trace_closest(
    __global const BvhNode *nodes, __global const TriangleBlock *blocks, const RaySetups *rays ALPHA_PARAMETERS)
{
    float t[W];
    float u[W];
    float v[W];
    uint triangle[W];
    for (uint k = 0; k < W; ++k) {
        const RaySetup ray = ray_setup(rays, k);
        Hit best;
        best.t = ray.t_max;
        best.u = 0.0f;
        best.v = 0.0f;
        // Index 0 loses every tie, so that t_max itself is out of range.
        best.triangle = 0;
        if (ray.t_max > 0.0f)
            trace_closest_from(nodes, blocks, &ray, 0, &best ALPHA_ARGUMENTS_OF(k));
        t[k] = best.t;
        u[k] = best.u;
        v[k] = best.v;
        triangle[k] = best.t < ray.t_max ? best.triangle : NO_HIT;
    }
    Hits hits;
    hits.t = load_lanes(t);
    hits.u = load_lanes(u);
    hits.v = load_lanes(v);
    hits.triangle = load_lanes_u(triangle);
    return hits;
}

/// Return whether anything lies on the rays before their t_max.
static inline Mask trace_any(
    __global const BvhNode *nodes, __global const TriangleBlock *blocks, const RaySetups *rays ALPHA_PARAMETERS)
{
    const Bundle bundle = bundle_of(rays);
    const Float t_max = load_lanes(rays->t_max);
    uint left = lane_bits(t_max > 0.0f);
    uint blocked = 0;
    uint entered[STACK_SIZE];
    uint waiting[STACK_SIZE];
    entered[0] = left;
    waiting[0] = 0;
    uint count = 1;
    while (count > 0 && left) {
        --count;
        const uint next = waiting[count];
        uint lanes = entered[count] & left;
        if (!lanes)
            continue;
        if ((next & LEAF_BIT) || popcount(lanes) <= LANES_APART) {
            do {
                const uint k = lowest_bit(lanes);
                lanes &= lanes - 1u;
                const RaySetup ray = ray_setup(rays, k);
                if (trace_any_from(nodes, blocks, &ray, next ALPHA_ARGUMENTS_OF(k))) {
                    blocked |= 1u << k;
                    left &= ~(1u << k);
                }
            } while (lanes);
            continue;
        }
        __global const BvhNode *node = &nodes[next];
        for (uint c = 0; c < 8 && count < STACK_SIZE; ++c) {
            const uint met = lanes & lane_bits(intersect_box(node, c, &bundle, t_max));
            if (met) {
                entered[count] = met;
                waiting[count++] = node->child[c];
            }
        }
    }
    return lanes_of(blocked);
}
#endif

#endif
