// Probes: a small share of the paths of a frame, traced again in the next one, to find where light changes.
//
// A probe is a path, not the random numbers that led to it, for what is learned or emitted between frames
// changes what numbers lead to.  It stores its vertex on a triangle, the direction that goes on from there,
// and for both surfaces a light and the seed of the point on it, and it is compared with itself: traced in
// the frame that it was made in, and as what is there now moves and shines.
//
// After Schied, Peters, Dachsbacher: Gradient Estimation for Real-Time Adaptive Temporal Filtering, 2018.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pixels.h"
#include "common/probes.h"
#include "common/rng.h"
#include "common/camera_ray.h"
#include "common/surface.h"
#include "common/trace.h"
#include "common/light.h"
#include "common/cell_history.h"
#include "common/history.h"

// What both kernels that trace need of the scene.
#if SMOOTH
#define NORMAL_PARAMETERS , __global const Normals *normals
#define NORMAL_ARGUMENTS , normals
#else
#define NORMAL_PARAMETERS
#define NORMAL_ARGUMENTS
#endif
#if ENVIRONMENT == 2
#define SKY_PARAMETERS , __global const EnvironmentCell *environment
#define SKY_ARGUMENTS environment,
#define LAST_SKY , environment
#else
#define SKY_PARAMETERS
#define SKY_ARGUMENTS
#define LAST_SKY
#endif
#if ALPHA == 2
#define DEFINE_PROBE_SEEDS(seed)                                                                   \
    uint ray_seeds[W];                                                                             \
    store_lanes_u(seed, ray_seeds);
#else
#define DEFINE_PROBE_SEEDS(seed)
#endif
// `whose`: 1 for the camera's rays, 0 for all others.
#if BACK_FACES
#define DEFINE_PROBE_RAYS(seed, whose)                                                             \
    DEFINE_PROBE_SEEDS(seed)                                                                       \
    uint camera_rays[W];                                                                           \
    SET_PROBE_RAYS(whose)
#define SET_PROBE_RAYS(whose) store_lanes_u((UInt)(whose), camera_rays)
#else
#define DEFINE_PROBE_RAYS(seed, whose) DEFINE_PROBE_SEEDS(seed)
#define SET_PROBE_RAYS(whose)
#endif
#define SCENE_PARAMETERS                                                                           \
    __global const Params *params, TRIANGLE_BUFFERS, __global const Surface *surfaces NORMAL_PARAMETERS, \
        __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS,                    \
        __global const Light *lights SKY_PARAMETERS

/// Light of the chosen light that a white surface at `s` reflects, as luminance; 0 outside of `mask`.
LARGE_FUNCTION Float reflected_light(
    SCENE_PARAMETERS RAY_PARAMETERS, Mask mask, SurfacePoint s, LightChoice choice, UInt seed)
{
    const Vec3 above = add_scaled(s.p, s.ng, s.offset);
    Float u1;
    Float u2;
    sample_pair(seed, (UInt)(0u), (UInt)(PAIR_LIGHT), params->sampler, &u1, &u2);
    const LightSample light = sample_light(params, lights, surfaces, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS,
                                           SKY_ARGUMENTS mask, above, u1, u2, seed, (UInt)(0u), (UInt)(0u), choice);
    const Float cosine = dot3(s.ns, light.wi);
    const Mask lit = mask & (light.pdf > 0.0f) & (cosine > 0.0f) & (dot3(s.ng, light.wi) > 0.0f);
    if (!any_lane(lit))
        return (Float)(0.0f);
    const Mask blocked = blocked_rays(params, lit, above, light.toward, GEOMETRY_ARGUMENTS);
    const Float arrives = luminance(light.radiance) * cosine * INV_PI / pick(lit, light.pdf, (Float)(1.0f));
    return pick(lit & !blocked, arrives, (Float)(0.0f));
}

/// Trace every probe as the scene is now; what it brought before comes to the first place.  One work item W probes.
///
/// It brings what reaches its vertex from its light, and what reaches the surface that its direction leads
/// to; both are taken for matt, and the first for white.
///
/// reads   probes
/// writes  probes.{reflected, emitted}
kernel void measure_probes(SCENE_PARAMETERS, __global Probe *probes)
{
    const uint first = get_global_id(0) * W;
    const uint count = probe_columns(params) * probe_rows(params);
    if (first >= count)
        return;
    const UInt at = min(lanes_before(MASK_ALL) + first, (UInt)(count - 1u));
    const UInt triangle = GATHER_U(probes, at, triangle);
    const Mask there = triangle != NO_HIT;
    const UInt seed = GATHER_U(probes, at, seed);
    DEFINE_PROBE_RAYS(seed, 0u);
    const Vec3 wo = vec3(GATHER(probes, at, wo[0]), GATHER(probes, at, wo[1]), GATHER(probes, at, wo[2]));
    const SurfacePoint s = surface_point(pick_u(there, triangle, (UInt)(0u)), GATHER(probes, at, u),
                                         GATHER(probes, at, v), wo, surfaces NORMAL_ARGUMENTS INSTANCE_ARGUMENTS);
    LightChoice choice;
    choice.light = GATHER_U(probes, at, light);
    choice.pmf = GATHER(probes, at, pmf);
    Float value = reflected_light(params, TRIANGLE_ARGUMENTS, surfaces NORMAL_ARGUMENTS,
                                  materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS, lights LAST_SKY RAY_ARGUMENTS,
                                  there, s, choice, seed);
    const Mask shines = there & (s.front | ((GATHER_U(materials, s.material, flags) & MATERIAL_TWO_SIDED_EMISSION) != 0u));
    const Vec3 emission = vec3(GATHER(materials, s.material, emission[0]), GATHER(materials, s.material, emission[1]),
                               GATHER(materials, s.material, emission[2]));
    const Float emitted = pick(shines, luminance(emission), (Float)(0.0f));

    const Vec3 direction = vec3(GATHER(probes, at, direction[0]), GATHER(probes, at, direction[1]),
                                GATHER(probes, at, direction[2]));
    const Hits hits = closest_hits(params, there, ray_origin(s, direction), direction, GEOMETRY_ARGUMENTS);
    const Mask hit = there & (hits.triangle != NO_HIT);
    const SurfacePoint beyond = surface_point(pick_u(hit, hits.triangle, (UInt)(0u)), hits.u, hits.v,
                                              scale(direction, (Float)(-1.0f)), surfaces NORMAL_ARGUMENTS INSTANCE_ARGUMENTS);
    choice.light = GATHER_U(probes, at, next_light);
    choice.pmf = GATHER(probes, at, next_pmf);
    const Vec3 color = vec3(GATHER(materials, beyond.material, base_color[0]),
                            GATHER(materials, beyond.material, base_color[1]),
                            GATHER(materials, beyond.material, base_color[2]));
    value += luminance(color)
             * reflected_light(params, TRIANGLE_ARGUMENTS, surfaces NORMAL_ARGUMENTS,
                               materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS, lights LAST_SKY RAY_ARGUMENTS,
                               hit, beyond, choice, mix_bits(seed + 1u));

    float lane[2][W];
    store_lanes(value, lane[0]);
    store_lanes(emitted, lane[1]);
    const uint lanes = min(count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k) {
        __global Probe *probe = &probes[first + k];
        const float4 both = (float4)(probe->reflected[1], lane[0][k], probe->emitted[1], lane[1][k]);
        vstore4(both, 0, probe->reflected);
    }
}

/// A light for a surface: where `usual` as paths choose theirs, else any, for one that is off may be on in the
/// next frame.
static inline LightChoice light_for_probe(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    Mask mask,
    SurfacePoint s,
    UInt random,
    Mask usual)
{
    const Vec3 above = add_scaled(s.p, s.ng, s.offset);
    LightQuery query;
    query.p = above;
    query.n = s.ng;
#if LIGHT_PHOTONS
    query.row = find_row(params, particle_table, mask, s.p, s.ng);
#endif
    LightChoice choice = choose_light(params, lights CHOICE_ARGUMENTS, mask, query, random);
    const UInt any = mul_hi(random, (UInt)(params->light_count));
    choice.light = pick_u(usual, choice.light, any);
    const Float chance = light_chance(params, lights CHOICE_ARGUMENTS, mask, choice.light, query);
    choice.pmf = 0.5f * chance + 0.5f / (float)params->light_count;
#if PHOTON_POINTS
    choice.stored = (Mask)(0);
#endif
    return choice;
}

/// Start a probe in each tile of the film.  One work item W probes.
///
/// reads   nothing of the frames before
/// writes  probes
kernel void place_probes(SCENE_PARAMETERS CHOICE_PARAMETERS, __global Probe *probes)
{
    const uint first = get_global_id(0) * W;
    const uint columns = probe_columns(params);
    const uint count = columns * probe_rows(params);
    if (first >= count)
        return;
    const UInt at = min(lanes_before(MASK_ALL) + first, (UInt)(count - 1u));
    const UInt row = divide(at, columns);
    const UInt column = at - row * columns;
    const UInt seed = mix_bits(at + mix_bits((UInt)(params->seed + params->first_pass * 0x9e3779b9u)));
    DEFINE_PROBE_RAYS(seed, 1u);
    UInt random[4];
    for (uint k = 0; k < 4; ++k)
        random[k] = mix_bits(seed + (k + 2u) * 0x9e3779b9u);
    const Float x = min((to_float(column) + unit_float(random[0])) * (float)PROBE_TILE, (float)params->crop_width - 0.01f);
    const Float y = min((to_float(row) + unit_float(random[1])) * (float)PROBE_TILE, (float)params->crop_height - 0.01f);
    Vec3 eye;
    // Through the middle of a lens.
    const Vec3 away = camera_ray(params, x + (float)params->crop_x, y + (float)params->crop_y, (Float)(0.0f),
                                 (Float)(0.0f), &eye);
    const Hits seen = closest_hits(params, MASK_ALL, eye, away, GEOMETRY_ARGUMENTS);
    SET_PROBE_RAYS(0u);
    const Mask there = seen.triangle != NO_HIT;
    const Vec3 wo = scale(away, (Float)(-1.0f));
    const SurfacePoint s = surface_point(pick_u(there, seen.triangle, (UInt)(0u)), seen.u, seen.v, wo,
                                         surfaces NORMAL_ARGUMENTS INSTANCE_ARGUMENTS);
    Vec3 tangent;
    Vec3 bitangent;
    make_frame(s.ng, &tangent, &bitangent);
    const Float square = unit_float(random[2]);
    const Float radius = sqrt(square);
    Float c;
    Float si;
    cos_sin_turns(unit_float(random[3]), &c, &si);
    const Vec3 direction = renormalize3(add_scaled(
        add_scaled(scale(tangent, radius * c), bitangent, radius * si), s.ng, sqrt(max(1.0f - square, 0.0f))));
    const Hits hits = closest_hits(params, there, ray_origin(s, direction), direction, GEOMETRY_ARGUMENTS);
    const Mask hit = there & (hits.triangle != NO_HIT);
    const SurfacePoint beyond = surface_point(pick_u(hit, hits.triangle, (UInt)(0u)), hits.u, hits.v,
                                              scale(direction, (Float)(-1.0f)), surfaces NORMAL_ARGUMENTS INSTANCE_ARGUMENTS);
    // Tiles that are pooled share out the lights: a lattice in the plane.  Roberts: The Unreasonable
    // Effectiveness of Quasirandom Sequences, 2018.
    const UInt lattice = column * 0xc13fa9a9u + row * 0x91e10da5u;
    const uint shift = params->first_pass * 0x9e3779b9u;
    const Mask usual = ((column + row) & 1u) != 0u;
    const LightChoice here = light_for_probe(params, lights CHOICE_ARGUMENTS, there, s, lattice + shift, usual);
    const LightChoice later =
        light_for_probe(params, lights CHOICE_ARGUMENTS, hit, beyond, lattice - shift, !usual);

    const Float values[14] = {from_bits(pick_u(there, seen.triangle, (UInt)(NO_HIT))),
                              seen.u,
                              seen.v,
                              from_bits(seed),
                              direction.x,
                              direction.y,
                              direction.z,
                              from_bits(here.light),
                              wo.x,
                              wo.y,
                              wo.z,
                              from_bits(later.light),
                              here.pmf,
                              later.pmf};
    float lane[14][W];
    for (uint k = 0; k < 14; ++k)
        store_lanes(values[k], lane[k]);
    const uint lanes = min(count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k)
        vstore16((float16)(lane[0][k], lane[1][k], lane[2][k], lane[3][k], lane[4][k], lane[5][k], lane[6][k],
                           lane[7][k], lane[8][k], lane[9][k], lane[10][k], lane[11][k], lane[12][k],
                           lane[13][k], 0.0f, 0.0f),
                 0, (__global float *)(probes + first + k));
}

// Tiles around a tile, in each direction, whose probes decide with its own.
#define POOLED 3

// A change counts by what it is larger than the standard error of the sums, squared, so many times.
#define DOUBT 2.0f

// A change of all light of which so much is left beyond doubt is one.
#define CLEAR 0.75f

// A relative difference that may be rounding.
#define DEAD_BAND 0.02f

/// The relative difference beyond the dead band, 0 to 1.
static inline float part_of(float difference, float larger)
{
    const float part = larger > 0.0f && larger < FLT_MAX ? difference / larger : 0.0f;
    return clamp((part - DEAD_BAND) / (1.0f - DEAD_BAND), 0.0f, 1.0f);
}

/// Sums over the probes of a square of tiles.
typedef struct {
    float difference; // with its sign: what some paths gain and others lose has not changed
    float square;     // of the same
    float larger;     // of what was and what is
} Pool;

/// How much of the light of a pool has changed, beyond what the paths that were chosen may make of it; 1 where
/// hardly a doubt is left that all of it came or went.
static inline float change_of(Pool pool)
{
    const float square = pool.difference * pool.difference - DOUBT * pool.square;
    const float change = part_of(sqrt(max(square, 0.0f)), pool.larger);
    return fabs(pool.difference) == pool.larger && change > CLEAR ? 1.0f : change;
}

/// How far frames scatter around a tile: their variance, relative to the square of the light.
///
/// Of pixels by themselves it would be too small wherever rare bright paths have not been found yet, and
/// those would forget first.
static inline float scatter_around(__global const Params *params, __global const History *history, int column, int row)
{
    const int edge = PROBE_TILE;
    float variance = 0.0f;
    float square = 0.0f;
    for (int y = max((row - 1) * edge, 0); y < min((row + 2) * edge, (int)params->crop_height); ++y)
        for (int x = max((column - 1) * edge, 0); x < min((column + 2) * edge, (int)params->crop_width); ++x) {
            __global const History *pixel = &history[pixel_entry_of(params, (uint)x, (uint)y)];
            const float level = 0.2126f * pixel->rgb[0] + 0.7152f * pixel->rgb[1] + 0.0722f * pixel->rgb[2];
            if (pixel->count > 0.0f && level < 1e18f) {
                variance += max(pixel->square - level * level, 0.0f);
                square += level * level;
            }
        }
    return variance / max(square, 1e-30f);
}

/// Find how much light has changed around each probe, 0 not at all, 1 altogether, and how far frames scatter
/// there.  One work item a probe.
///
/// The largest square of tiles has the least doubt, but shadows that move take away on one side of it what
/// they give on the other: the largest change of those around a tile counts.
///
/// reads   probes, history
/// writes  changes
kernel void pool_probes(
    __global const Params *params,
    __global const Probe *probes,
    __global const History *history,
    __global float *changes)
{
    const int columns = (int)probe_columns(params);
    const int rows = (int)probe_rows(params);
    const int at = (int)get_global_id(0);
    if (at >= columns * rows)
        return;
    const int row = at / columns;
    const int column = at - row * columns;
    Pool rings[POOLED + 1];
    for (uint ring = 0; ring <= POOLED; ++ring)
        rings[ring] = (Pool){0.0f, 0.0f, 0.0f};
    float2 shining = (float2)(0.0f);
    for (int y = max(row - POOLED, 0); y <= min(row + POOLED, rows - 1); ++y)
        for (int x = max(column - POOLED, 0); x <= min(column + POOLED, columns - 1); ++x) {
            const float4 value = vload4(0, probes[y * columns + x].reflected);
            const uint ring = max(abs(x - column), abs(y - row));
            const float difference = value.y - value.x;
            rings[ring].difference += difference;
            rings[ring].square += difference * difference;
            rings[ring].larger += max(value.x, value.y);
            // Lights that are seen outshine what they light: they only speak for themselves.
            if (ring <= 1u)
                shining += (float2)(fabs(value.w - value.z), max(value.z, value.w));
        }
    float change = part_of(shining.x, shining.y);
    int brighter = 0;
    Pool pool = rings[0];
    for (uint ring = 1; ring <= POOLED; ++ring) {
        pool.difference += rings[ring].difference;
        pool.square += rings[ring].square;
        pool.larger += rings[ring].larger;
        const float its = change_of(pool);
        brighter = its > change ? pool.difference > 0.0f : brighter;
        change = max(change, its);
    }
    float scatter = 0.0f;
    if (change > 0.0f) {
        scatter = scatter_around(params, history, column, row);
        // Light that came scatters as much as what was there: the frames to come are less worth than those before.
        const float before = 1.0f - min(change, CERTAIN);
        scatter = brighter ? scatter / (before * before) : scatter;
    }
    vstore2((float2)(change, scatter), at, changes);
}

#if CELL_HISTORY == 2
/// Tell the cells around the vertices of probes how much the light has changed there, and all of them the
/// largest change.  One work item W probes, after pool_probes.
///
/// A cell stores 1 + the change, and 0 where no probe is: three levels around that of paths, with the
/// camera's view of this frame.
///
/// reads   probes, changes
/// writes  cell_changes (atomic)
kernel void spread_changes(
    __global const Params *params,
    __global const Surface *surfaces NORMAL_PARAMETERS INSTANCE_PARAMETERS,
    __global const Probe *probes,
    __global const float *changes,
    volatile __global uint *cell_changes)
{
    const uint first = get_global_id(0) * W;
    const uint count = probe_columns(params) * probe_rows(params);
    if (first >= count)
        return;
    const UInt at = min(lanes_before(MASK_ALL) + first, (UInt)(count - 1u));
    const UInt triangle = GATHER_U(probes, at, triangle);
    const Mask there = triangle != NO_HIT;
    const Vec3 wo = vec3(GATHER(probes, at, wo[0]), GATHER(probes, at, wo[1]), GATHER(probes, at, wo[2]));
    const SurfacePoint s = surface_point(pick_u(there, triangle, (UInt)(0u)), GATHER(probes, at, u),
                                         GATHER(probes, at, v), wo, surfaces NORMAL_ARGUMENTS INSTANCE_ARGUMENTS);
    const Vec3 away = sub(s.p, vec3_of(params->camera_origin));
#if LENS == 2
    const Float length = dot3(away, vec3_of(params->camera_forward));
#else
    const Float length = sqrt(dot3(away, away));
#endif
    CellQuery query;
    query.p = s.p;
    query.ng = s.ng;
    query.width = length * cell_width_of(params, params->first_pass);
    query.seen = MASK_ALL;
    query.near = (UInt)(0u);
    query.extra = (UInt)(0u);
    const Float change = 1.0f + gather_words(changes, 2u * at);
    float lane_change[W];
    store_lanes(change, lane_change);
    for (uint level = 0; level < 3; ++level) {
        const UInt entry = entry_of(params, cell_place(params, &query, (UInt)(0u), (UInt)(0u), 0, (UInt)(level - 1u)));
        uint lane_entry[W];
        store_lanes_u(entry, lane_entry);
        for (uint bits = lane_bits(there); bits; bits &= bits - 1u) {
            const uint k = lowest_bit(bits);
            atomic_max(&cell_changes[lane_entry[k]], as_uint(lane_change[k]));
        }
    }
    for (uint bits = lane_bits(there); bits; bits &= bits - 1u)
        atomic_max(&cell_changes[params->cell_slots], as_uint(lane_change[lowest_bit(bits)]));
}
#endif
