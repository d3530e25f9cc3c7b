// Rays through a scene of two levels: a tree over placings of meshes, and each mesh's own tree.
//
// The ray goes into a mesh's space without being normalised, so that its `t` is the same in both, and is
// exact there as far as the mesh's triangles are concerned: they stay watertight.  What is placed once
// lies in a tree in world space, that of instance 0, which rays visit first; node 0 is the root of the
// tree over all other instances.  A hit's index is an instance's `base` plus that of the triangle.
#pragma once

#include "traverse.h"

#if INSTANCES

/// Set up one ray, as set_up_rays does for lanes.
static inline RaySetup set_up_ray(float3 origin, float3 direction, float t_max)
{
    RaySetup ray;
    const float3 size = fabs(direction);
    const float3 place = fabs(origin);
    const bool usable = size.x + size.y + size.z < 0x1p120f
                        && max(size.x, max(size.y, size.z)) > 0x1p-120f
                        && place.x + place.y + place.z < 0x1p120f;
    ray.t_max = usable ? t_max : 0.0f;

    const float slack = BOX_SLACK * max(place.x, max(place.y, place.z));
    const float3 inverse = 1.0f / direction;
    const float3 far_inverse = inverse * BOX_FAR_FACTOR;
    const float3 back = select((float3)(slack), (float3)(-slack), inverse < 0.0f);
    const float3 near_shift = -(origin + back) * inverse;
    const float3 far_shift = -(origin - back) * far_inverse;
    vstore3(inverse, 0, ray.inverse);
    vstore3(far_inverse, 0, ray.far_inverse);
    vstore3(near_shift, 0, ray.near_shift);
    vstore3(far_shift, 0, ray.far_shift);
    ray.near_row[0] = inverse.x < 0.0f ? 1u : 0u;
    ray.near_row[1] = inverse.y < 0.0f ? 3u : 2u;
    ray.near_row[2] = inverse.z < 0.0f ? 5u : 4u;

    const bool along_x = size.x > size.y && size.x > size.z;
    const bool along_y = !along_x && size.y > size.z;
    const float3 o = along_x ? origin.yzx : along_y ? origin.zxy : origin;
    const float3 d = along_x ? direction.yzx : along_y ? direction.zxy : direction;
    ray.axis[2] = along_x ? 0u : along_y ? 1u : 2u;
    ray.axis[0] = along_x ? 1u : along_y ? 2u : 0u;
    ray.axis[1] = along_x ? 2u : along_y ? 0u : 1u;
    vstore3(o, 0, ray.origin);
    ray.shear[0] = d.x / d.z;
    ray.shear[1] = d.y / d.z;
    ray.shear[2] = 1.0f / d.z;
    return ray;
}

static inline float3 times_rows(__global const float *m, float3 v)
{
    return (float3)(m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z,
                    m[6] * v.x + m[7] * v.y + m[8] * v.z);
}

/// The ray in the space of an instance's mesh.
static inline RaySetup ray_in_instance(
    __global const Instance *instance, float3 origin, float3 direction, float t_max)
{
    const float3 from = origin - vload3(0, instance->position);
    return set_up_ray(times_rows(instance->inverse, from), times_rows(instance->inverse, direction), t_max);
}

/// As intersect_boxes for a leaf of the upper tree: each lane's first two corners are those of a box.
static inline uint intersect_instances(
    __global const TriangleBlock *block, const RaySetup *ray, float limit, float4 *entry)
{
    const uint x = 3u * (ray->near_row[0] & 1u);
    const uint y = 3u * (ray->near_row[1] & 1u) + 1u;
    const uint z = 3u * (ray->near_row[2] & 1u) + 2u;
    const float4 x0 = fma(vload4(0, block->v[x]), (float4)(ray->inverse[0]), (float4)(ray->near_shift[0]));
    const float4 y0 = fma(vload4(0, block->v[y]), (float4)(ray->inverse[1]), (float4)(ray->near_shift[1]));
    const float4 z0 = fma(vload4(0, block->v[z]), (float4)(ray->inverse[2]), (float4)(ray->near_shift[2]));
    const float4 x1 =
        fma(vload4(0, block->v[3u - x]), (float4)(ray->far_inverse[0]), (float4)(ray->far_shift[0]));
    const float4 y1 =
        fma(vload4(0, block->v[5u - y]), (float4)(ray->far_inverse[1]), (float4)(ray->far_shift[1]));
    const float4 z1 =
        fma(vload4(0, block->v[7u - z]), (float4)(ray->far_inverse[2]), (float4)(ray->far_shift[2]));
    const float4 start = x0 > 0.0f ? x0 : (float4)(0.0f);
    const float4 end = x1 < limit * BOX_FAR_FACTOR ? x1 : (float4)(limit * BOX_FAR_FACTOR);
    const float4 enter = y0 > z0 ? y0 : z0;
    const float4 leave = y1 < z1 ? y1 : z1;
    const float4 near = enter > start ? enter : start;
    const float4 far = leave < end ? leave : end;
    *entry = near;
    return bits_of_4((near <= far) & (vload4(0, block->id) != (uint4)(NO_HIT)));
}

// Whether what blends is there is drawn anew for each instance.
#if ALPHA == 2
#define DEFINE_INSTANCE_SEED(number) const uint instance_seed = *ray_seeds ^ (number)*0x85ebca6bu
#if BACK_FACES
#define ALPHA_ARGUMENTS_INSIDE ALPHA_BUFFER_ARGUMENTS, &instance_seed, camera_rays
#else
#define ALPHA_ARGUMENTS_INSIDE ALPHA_BUFFER_ARGUMENTS, &instance_seed
#endif
#else
#define DEFINE_INSTANCE_SEED(number)
#define ALPHA_ARGUMENTS_INSIDE ALPHA_ARGUMENTS
#endif

/// As trace_closest_from, below the root of the tree over the instances.
static inline void trace_closest_instances(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    __global const Instance *instances,
    const RaySetup *ray,
    float3 origin,
    float3 direction,
    Hit *hit ALPHA_PARAMETERS)
{
    uint waiting[STACK_SIZE];
    float entered[STACK_SIZE];
    uint count = 0;
    uint next = 0;
    bool more = true;
    while (more) {
        if (next & LEAF_BIT) {
            __global const TriangleBlock *block = &blocks[next & ~LEAF_BIT];
            float4 near;
            uint met = intersect_instances(block, ray, hit->t, &near);
            float entry[4];
            vstore4(near, 0, entry);
            while (met) {
                uint nearest = lowest_bit(met);
                for (uint rest = met & (met - 1u); rest; rest &= rest - 1u) {
                    const uint k = lowest_bit(rest);
                    nearest = entry[k] < entry[nearest] ? k : nearest;
                }
                met &= ~(1u << nearest);
                // Not where it is equal: of equally near triangles the lowest index wins.
                if (entry[nearest] > hit->t)
                    break;
                const uint number = block->id[nearest];
                __global const Instance *instance = &instances[number];
                const RaySetup inside = ray_in_instance(instance, origin, direction, ray->t_max);
                DEFINE_INSTANCE_SEED(number);
                if (inside.t_max > 0.0f)
                    trace_closest_from(nodes, blocks, &inside, instance->root, hit,
                                       instance->base ALPHA_ARGUMENTS_INSIDE);
            }
        } else {
            __global const BvhNode *node = &nodes[next];
            float8 near;
            const uint met = bits_of_8(intersect_boxes(node, ray, hit->t, &near));
            if (met) {
                next = descend(node, met, near, waiting, entered, &count);
                continue;
            }
        }
        more = false;
        while (count > 0 && !more) {
            --count;
            more = entered[count] <= hit->t;
            next = waiting[count];
        }
    }
}

/// As trace_any_from, below the root of the tree over the instances.
static inline bool trace_any_instances(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    __global const Instance *instances,
    const RaySetup *ray,
    float3 origin,
    float3 direction ALPHA_PARAMETERS)
{
    uint waiting[STACK_SIZE];
    waiting[0] = 0;
    uint count = 1;
    bool blocked = false;
    while (count > 0 && !blocked) {
        const uint next = waiting[--count];
        float8 near;
        if (next & LEAF_BIT) {
            __global const TriangleBlock *block = &blocks[next & ~LEAF_BIT];
            float4 entry;
            uint met = intersect_instances(block, ray, ray->t_max, &entry);
            for (; met && !blocked; met &= met - 1u) {
                const uint number = block->id[lowest_bit(met)];
                __global const Instance *instance = &instances[number];
                const RaySetup inside = ray_in_instance(instance, origin, direction, ray->t_max);
                DEFINE_INSTANCE_SEED(number);
                blocked = inside.t_max > 0.0f
                          && trace_any_from(nodes, blocks, &inside, instance->root ALPHA_ARGUMENTS_INSIDE);
            }
            continue;
        }
        __global const BvhNode *node = &nodes[next];
        uint met = bits_of_8(intersect_boxes(node, ray, ray->t_max, &near));
        while (met && count < STACK_SIZE) {
            const uint k = lowest_bit(met);
            met &= met - 1u;
            waiting[count++] = node->child[k];
        }
    }
    return blocked;
}

/// Origins and directions of rays, lane by lane.
typedef struct {
    float origin[3][W];
    float direction[3][W];
} RayLanes;

static inline void store_rays(RayLanes *rays, Vec3 origin, Vec3 direction)
{
    store_lanes(origin.x, rays->origin[0]);
    store_lanes(origin.y, rays->origin[1]);
    store_lanes(origin.z, rays->origin[2]);
    store_lanes(direction.x, rays->direction[0]);
    store_lanes(direction.y, rays->direction[1]);
    store_lanes(direction.z, rays->direction[2]);
}

static inline float3 lane_of(float (*const rows)[W], uint k)
{
    return (float3)(rows[0][k], rows[1][k], rows[2][k]);
}

/// Return the first hits of the rays; of equally near ones that of the lowest index.
static inline Hits trace_closest_levels(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    __global const Instance *instances,
    const RaySetups *setups,
    Vec3 origin,
    Vec3 direction ALPHA_PARAMETERS)
{
    RayLanes rays;
    store_rays(&rays, origin, direction);
    float t[W];
    float u[W];
    float v[W];
    uint triangle[W];
    for (uint k = 0; k < W; ++k) {
        const RaySetup ray = ray_setup(setups, k);
        Hit best;
        best.t = ray.t_max;
        best.u = 0.0f;
        best.v = 0.0f;
        // Index 0 loses every tie, so that t_max itself is out of range.
        best.triangle = 0;
        if (ray.t_max > 0.0f) {
            trace_closest_from(nodes, blocks, &ray, instances->root, &best, 0u ALPHA_ARGUMENTS_OF(k));
            trace_closest_instances(nodes, blocks, instances, &ray, lane_of(rays.origin, k),
                                    lane_of(rays.direction, k), &best ALPHA_ARGUMENTS_OF(k));
        }
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
static inline Mask trace_any_levels(
    __global const BvhNode *nodes,
    __global const TriangleBlock *blocks,
    __global const Instance *instances,
    const RaySetups *setups,
    Vec3 origin,
    Vec3 direction ALPHA_PARAMETERS)
{
    RayLanes rays;
    store_rays(&rays, origin, direction);
    float blocked[W];
    for (uint k = 0; k < W; ++k) {
        const RaySetup ray = ray_setup(setups, k);
        const bool met =
            ray.t_max > 0.0f
            && (trace_any_from(nodes, blocks, &ray, instances->root ALPHA_ARGUMENTS_OF(k))
                || trace_any_instances(nodes, blocks, instances, &ray, lane_of(rays.origin, k),
                                       lane_of(rays.direction, k) ALPHA_ARGUMENTS_OF(k)));
        blocked[k] = met ? 1.0f : 0.0f;
    }
    return load_lanes(blocked) != 0.0f;
}

#endif
