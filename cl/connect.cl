// Next event estimation, second half: is the light seen?

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/trace.h"
#include "common/sharing.h"
#include "common/guide.h"
#include "common/cache.h"

/// Trace a shadow ray of each of the W paths of a work item; returns how many there were.
static inline uint connect_paths(
    __global const Params *params,
    __global Float *path,
    uint ray,
#if GUIDE
    volatile __global uint *counters,
    __global GuideSum *guide_sums,
#endif
#if CACHE
    volatile __global uint *cache_counters,
    __global CacheSum *cache_sums,
    __global const CacheCell *cache_cells,
#endif
    GEOMETRY_BUFFERS)
{
    const Vec3 light = get_v(path, RAY_FIELD(ray, LIGHT_R));
    // Not a number must not vanish here: it goes on into the sample, which is rejected and counted.
    const Mask wanted = !(light.x + light.y + light.z <= 0.0f);
    if (!any_lane(wanted))
        return 0;
    DEFINE_RAY_TRAITS(path, (get_u(path, PATH_STATUS) & DEPTH_MASK) * 2u + 1u);
    const Mask blocked = blocked_rays(params, wanted, get_v(path, RAY_FIELD(ray, SHADOW_X)), get_v(path, RAY_FIELD(ray, TOWARD_X)),
                                      GEOMETRY_ARGUMENTS);
    const Vec3 zero = vec3_all((Float)(0.0f));
    const Vec3 arrives = pick_v(wanted & !blocked, light, zero);
#if AOV_DIRECT || BASE || CELLS
    // The vertex that sent the ray: the path has moved on unless it ended.
    const UInt status = get_u(path, PATH_STATUS);
    const UInt depth = (status & DEPTH_MASK)
                       - pick_u((status & STATUS_MASK) == STATUS_ALIVE, (UInt)(1u), (UInt)(0u));
#endif
#if CELLS
    const UInt known = get_u(path, PATH_VERTEX);
    const UInt vertex = known & VERTEX_MASK;
#if CELLS == 2
    const Vec3 share = get_v(path, RAY_FIELD(ray, LIGHT_SHARE_R));
#else
    const Vec3 share = vec3_all((Float)(1.0f));
#endif
    const Mask shared = shares_connection(params, vertex, depth, (known & VERTEX_SKY) != 0u);
    const Vec3 rest = gather_light(path, shared, share, arrives);
    const Mask reflected = !((vertex == 1u) & shared);
#else
    put_v(path, PATH_RADIANCE_R, add(get_v(path, PATH_RADIANCE_R), arrives));
    const Vec3 rest = arrives;
    const Mask reflected = MASK_ALL;
#endif
#if BASE == 2
    keep_base(path, reflected, get_v(path, RAY_FIELD(ray, BASE_LIGHT_R)), rest);
#elif BASE
    keep_base(path, reflected, vec3_all((Float)(1.0f)), rest);
#endif
#if AOV_DIRECT
#if VIRTUAL_LIGHTS
    // The second ray goes to what stands for reflected light.
    const Mask is_direct = (Mask)(ray == 0u ? -1 : 0);
#else
    const Mask is_direct = MASK_ALL;
#endif
    put_v(path, PATH_DIRECT_R, add(get_v(path, PATH_DIRECT_R), pick_v((depth == 0u) & is_direct, arrives, zero)));
#endif
#if CACHE
    const UInt bits = mix_bits(get_u(path, PATH_SEED) + get_u(path, PATH_SAMPLE) * 0x85ebca6bu
                               + get_u(path, PATH_STATUS) * 0x9e3779b9u);
    learn_cached(params, cache_sums, cache_cells, cache_counters, wanted & !blocked, get_u(path, PATH_CACHE),
                 get_v(path, RAY_FIELD(ray, CACHE_LIGHT_R)), bits);
#endif
#if GUIDE
    // What the ray before met reflects this light along it.
    const UInt noise = mix_bits(get_u(path, PATH_SEED) + get_u(path, PATH_SAMPLE) * 0x9e3779b9u
                                + get_u(path, PATH_STATUS) * 0x85ebca6bu);
    learn(params, guide_sums, counters, wanted & !blocked, get_u(path, PATH_GUIDE_FROM),
          FIELD(path, RAY_FIELD(ray, GUIDE_LIGHT)), 0, noise);
#endif
    put_v(path, RAY_FIELD(ray, LIGHT_R), zero);
    return count_lanes(wanted);
}

/// Trace the shadow rays and add what arrives to their paths.
///
/// Also paths that have ended may have a last one.
///
/// reads   pool.{shadow, toward, light, status, vertex}; with GUIDE pool.{guide_from, guide_light, sample, seed};
///         geometry
/// writes  pool.radiance (direct, beyond), pool.light (cleared); counters.pending_shadow; with GUIDE guide_sums;
///         with CACHE cache_sums, counters.cache_rejected
kernel void connect_lights(
    __global const Params *params,
    __global float *pool,
    volatile __global uint *counters,
#if GUIDE
    __global GuideSum *guide_sums,
#endif
#if CACHE
    __global CacheSum *cache_sums,
    __global const CacheCell *cache_cells,
#endif
    GEOMETRY_BUFFERS)
{
    const uint first = get_global_id(0) * RUN;
    const uint end = min(first + RUN, params->slots / W);
    uint wanted = 0;
#if SHADOW_RAYS
    const uint rays = SHADOW_RAYS;
#else
    const uint rays = 1;
#endif
    for (uint item = first; item < end; ++item)
        for (uint ray = 0; ray < rays; ++ray)
            wanted += connect_paths(params, pool_at(pool, item), ray,
#if GUIDE
                                    counters, guide_sums,
#endif
#if CACHE
                                    counters, cache_sums, cache_cells,
#endif
                                    GEOMETRY_BUFFER_ARGUMENTS);
    if (wanted > 0)
        atomic_add(&counters[COUNTER_PENDING_SHADOW], wanted);
}
