// A vertex of the path: emission found by the ray, next event estimation, the next direction.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/rng.h"
#include "common/alpha.h"
#include "common/surface.h"
#include "common/bsdf.h"
#include "common/material.h"
#include "common/light.h"
#include "common/virtual_light.h"
#include "common/sharing.h"
#include "common/splits.h"
#include "common/roulette.h"
#include "common/chain.h"
#include "common/guide.h"
#include "common/guided.h"
#include "common/cache.h"
#include "common/material_cells.h"
#include "common/motion.h"

// Of the directions, how large a part textures are averaged over.
#define FOOTPRINT_SHARE (1.0f / 256.0f)

/// Weight of emission that a BSDF-sampled ray found, against sampling the light.
static inline Float emission_weight(__global const Params *params, Mask camera_ray, Float pdf_bsdf, Float pdf_light)
{
    Float weight = (Float)(1.0f);
    if (params->direct_sampling == DIRECT_MIS)
        weight = power_heuristic(pdf_bsdf, pdf_light);
    else if (params->direct_sampling == DIRECT_LIGHT)
        weight = pick(pdf_light > 0.0f, (Float)(0.0f), (Float)(1.0f));
    return pick(camera_ray | (pdf_bsdf >= PDF_DELTA), (Float)(1.0f), weight);
}

#if SEEN
/// Hand in the first surface; nothing where `hit` is not set.  `shape` and `before` as in Seen.
LARGE_FUNCTION void store_seen(
    __global const Params *params,
    __global Seen *seen,
    Mask mask,
    Mask hit,
    UInt sample,
    UInt pixel,
    UInt shape,
    Vec3 p,
    Vec3 before,
    Vec3 ns,
    Vec3 gate)
{
    const Vec3 zero = vec3_all((Float)(0.0f));
    const Vec3 place = pick_v(hit, p, zero);
    const Vec3 place_before = pick_v(hit, before, zero);
    const Vec3 factor = pick_v(hit, gate, zero);
    const Float values[12] = {place.x,  place.y,  place.z,  ns.x,           ns.y,           ns.z,
                              factor.x, factor.y, factor.z, place_before.x, place_before.y, place_before.z};
    float lane_value[12][W];
    uint lane_shape[W];
    uint lane_sample[W];
    uint lane_pixel[W];
    for (uint c = 0; c < 12; ++c)
        store_lanes(values[c], lane_value[c]);
    store_lanes_u(pick_u(hit, shape, (UInt)(0u)), lane_shape);
    store_lanes_u(sample & (params->ring - 1u), lane_sample);
    store_lanes_u(pixel, lane_pixel);
    for (uint left = lane_bits(mask); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        const ulong at = (ulong)lane_sample[k] * params->pixel_count + lane_pixel[k];
        __global float *words = (__global float *)(seen + at);
        vstore16((float16)(lane_value[0][k], lane_value[1][k], lane_value[2][k], as_float(lane_shape[k]),
                           lane_value[3][k], lane_value[4][k], lane_value[5][k], lane_value[6][k],
                           lane_value[7][k], lane_value[8][k], 0.0f, 0.0f,
                           0.0f, lane_value[9][k], lane_value[10][k], lane_value[11][k]),
                 0, words);
    }
}
#endif

// Of what a direction reflects, the least part by the base for which its light goes to a cell of that base.
#define LEAST_SHARE 0.5f

// Later surfaces are seen from anywhere: sharper reflections look different from elsewhere.
#define LATER_CELL_ALPHA 0.36f

#if CELLS && BASE == 2
/// Hand in what part of all that comes from beyond the first surface its base reflects.
static inline void store_base_share(
    __global const Params *params, __global Seen *seen, Mask mask, UInt sample, UInt pixel, Vec3 share)
{
    float lane_share[3][W];
    uint lane_sample[W];
    uint lane_pixel[W];
    store_lanes(share.x, lane_share[0]);
    store_lanes(share.y, lane_share[1]);
    store_lanes(share.z, lane_share[2]);
    store_lanes_u(sample & (params->ring - 1u), lane_sample);
    store_lanes_u(pixel, lane_pixel);
    for (uint left = lane_bits(mask); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        const ulong at = (ulong)lane_sample[k] * params->pixel_count + lane_pixel[k];
        vstore3((float3)(lane_share[0][k], lane_share[1][k], lane_share[2][k]), 0, seen[at].share);
    }
}
#endif

#if AOV_FEATURES
/// Hand in what the first surface looks like: albedo, normal, depth (planes of weighted values).
static inline void store_features(
    __global const Params *params,
    __global float *features,
    Mask mask,
    Mask hit,
    UInt sample,
    UInt pixel,
    Vec3 albedo,
    Vec3 ns,
    Float depth)
{
    const Vec3 values[3] = {pick_v(hit, albedo, vec3_all((Float)(0.0f))), ns, vec3(depth, depth, depth)};
    const Float weights[3] = {(Float)(1.0f), pick(hit, (Float)(1.0f), (Float)(0.0f)),
                              pick(hit, (Float)(1.0f), (Float)(0.0f))};
    float lane_mask[W];
    uint lane_sample[W];
    uint lane_pixel[W];
    store_lanes(pick(mask, (Float)(1.0f), (Float)(0.0f)), lane_mask);
    store_lanes_u(sample, lane_sample);
    store_lanes_u(pixel, lane_pixel);
    for (uint plane = 0; plane < 3; ++plane) {
        float x[W];
        float y[W];
        float z[W];
        float w[W];
        const Mask known = weights[plane] > 0.0f;
        const Vec3 value = pick_v(known, values[plane], vec3_all((Float)(0.0f)));
        store_lanes(value.x, x);
        store_lanes(value.y, y);
        store_lanes(value.z, z);
        store_lanes(weights[plane], w);
        for (uint k = 0; k < W; ++k)
            if (lane_mask[k] > 0.0f) {
                const ulong pass = lane_sample[k] & (params->ring - 1u);
                const ulong at = (plane * params->ring + pass) * params->pixel_count + lane_pixel[k];
                vstore4((float4)(x[k], y[k], z[k], w[k]), at, features);
            }
    }
}
#endif

#if AOV_LIGHTS
/// Hand in how a light was chosen: photons and groups of lights of the cell, chance of the light.
static inline void store_choice(
    __global const Params *params,
#if AOV_LIGHTS == 2
    __global const uint *particle_words,
    __global const uint *particle_counts,
    UInt row,
#endif
    __global float *choices,
    Mask mask,
    Mask chosen,
    UInt sample,
    UInt pixel,
    Float pmf)
{
    float lane_pmf[W];
    uint lane_sample[W];
    uint lane_pixel[W];
    store_lanes(pmf, lane_pmf);
    store_lanes_u(sample & (params->ring - 1u), lane_sample);
    store_lanes_u(pixel, lane_pixel);
    const uint chosen_bits = lane_bits(chosen);
#if AOV_LIGHTS == 2
    uint lane_row[W];
    store_lanes_u(row, lane_row);
#endif
    for (uint left = lane_bits(mask); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        uint photons = 0;
        uint groups = 0;
        const uint is_chosen = chosen_bits >> k & 1u;
#if AOV_LIGHTS == 2
        if (is_chosen && lane_row[k] != NO_PLACE)
            photons = count_in_row(params, particle_words, particle_counts, lane_row[k], &groups);
#endif
        const ulong at = (ulong)lane_sample[k] * params->pixel_count + lane_pixel[k];
        const float4 values = (float4)((float)photons, (float)groups, lane_pmf[k], 1.0f);
        vstore4(is_chosen ? values : (float4)(0.0f), at, choices);
    }
}
#endif

/// Shade what the rays hit, prepare a shadow ray, and send the paths on or end them.
///
/// reads   pool, scene tables
/// writes  pool.{status, origin, direction, beta, radiance, direct, pdf, shadow, toward, light}; features, choices;
///         with LIGHT_SAMPLING pool.{light_normal, particle_row};
///         with CELLS pool.{vertex, length, beyond, share, light_share}, vertices; with GUIDE
///         pool.{guide, guide_from, guide_light, expected}, guide_keys, guide_full, guide_sums,
///         counters.{guide_failed, guide_rejected} (atomic); with CACHE pool.{cache, cache_gate, cache_light},
///         cache_keys, cache_full, cache_sums, counters.{cache_failed, cache_rejected, cache_ends} (atomic); with
///         MATERIAL_CELLS material_keys, material_full, material_sums, counters.material_failed (atomic)
kernel void shade_paths(
    __global const Params *params,
    __global const Surface *surfaces,
#if SMOOTH
    __global const Normals *normals,
#endif
#if TANGENTS
    __global const Tangents *tangents,
#endif
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS INSTANCE_PARAMETERS,
#if CONNECT
    __global const Light *lights CHOICE_PARAMETERS,
#endif
#if ENVIRONMENT == 2
    __global const EnvironmentCell *environment,
#endif
#if AOV_FEATURES
    __global float *features,
#endif
#if AOV_LIGHTS
    __global float *choices,
#endif
#if AOV_LIGHTS == 2
    __global const uint *particle_words,
    __global const uint *particle_counts,
#endif
#if VIRTUAL_LIGHTS
    __global const VirtualLight *virtual_lights,
    __global const uint *virtual_counts,
    __global const uint *photon_counters,
#endif
#if SEEN
    __global Seen *seen,
#endif
#if SEEN == 2 && MOTION
    __global const Corners *previous,
#endif
#if CELLS
    __global CellVertex *vertices,
#endif
#if METROPOLIS
    __global float *chains,
    __global uint *chain_numbers,
#endif
#if GUIDE || CACHE || MATERIAL_CELLS
    volatile __global uint *counters,
#endif
#if MATERIAL_CELLS
    volatile __global uint *material_keys,
    __global uint *material_full,
    __global MaterialSum *material_sums,
    __global const MaterialCell *material_cells,
#endif
#if CACHE
    volatile __global uint *cache_keys,
    __global uint *cache_full,
    __global CacheSum *cache_sums,
    __global const CacheCell *cache_cells,
#endif
#if GUIDE
    volatile __global uint *guide_keys,
    __global uint *guide_full,
    __global GuideSum *guide_sums,
    __global const GuideCell *guide_cells,
#endif
    __global float *pool)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(pool, item);
    const UInt status = get_u(path, PATH_STATUS);
    const Mask alive = (status & STATUS_MASK) == STATUS_ALIVE;
    if (!any_lane(alive))
        return;

    const Vec3 zero = vec3_all((Float)(0.0f));
    const UInt depth = status & DEPTH_MASK;
    const Mask camera_ray = depth == 0u;
    const UInt hit_triangle = get_u(path, PATH_HIT_TRIANGLE);
    const Mask hit = alive & (hit_triangle != NO_HIT);
    const Vec3 direction = get_v(path, PATH_DIRECTION_X);
    const Vec3 wo = scale(direction, (Float)(-1.0f));
    const Float pdf_bsdf = FIELD(path, PATH_PDF);
    Vec3 beta = get_v(path, PATH_BETA_R);
    Vec3 emitted = zero;

#if CONNECT
    // What a light was chosen for at the last vertex.
    LightQuery last;
    last.p = zero;
    last.n = zero;
#if LIGHT_SAMPLING
    last.p = get_v(path, PATH_ORIGIN_X);
    last.n = unpack_unit(get_u(path, PATH_LIGHT_NORMAL));
#endif
#if LIGHT_PHOTONS
    last.row = get_u(path, PATH_PARTICLE_ROW);
#endif
#if SHADOW_RAYS
    const Float last_rays = to_float(rays_asked(params RAYS_ARGUMENTS, alive & !camera_ray, depth == 1u, last));
#endif
#endif

#if CELLS
    Mask even_sky = (Mask)(0);
#endif
#if ENVIRONMENT
    const Mask missed = alive & !hit;
    if (any_lane(missed)) {
        Float pdf_light;
#if CONNECT
        Float chance = light_chance(params, lights CHOICE_ARGUMENTS, missed & !camera_ray,
                                    (UInt)(params->environment_light), last);
#if SHADOW_RAYS
        chance *= last_rays;
#endif
#else
        const Float chance = (Float)(0.0f);
#endif
#if ENVIRONMENT == 2
        const Vec3 radiance = eval_environment(params, environment, direction, chance, &pdf_light);
#else
        const Vec3 radiance = eval_environment(params, direction, chance, &pdf_light);
#endif
        const Float weight = emission_weight(params, camera_ray, pdf_bsdf, pdf_light);
        emitted = pick_v(missed, scale(radiance, weight), emitted);
#if CELLS
        even_sky = missed & is_even_sky(params, radiance);
#endif
    }
#endif

    const UInt triangle = pick_u(hit, hit_triangle, (UInt)(0u));
    const Float u = FIELD(path, PATH_HIT_U);
    const Float v = FIELD(path, PATH_HIT_V);
    SurfacePoint s = surface_point(triangle, u, v, wo, surfaces
#if SMOOTH
                                   , normals
#endif
                                   INSTANCE_ARGUMENTS);
#if TEXTURE_LEVELS
    // A path stands for all directions near its own: the more, the less densely they are drawn.  Footprints:
    // Suykens, Willems: Path Differentials and Applications, 2000; here by the density.
    const Float reach = FIELD(path, PATH_HIT_T);
    const Float spread = reach * reach / (max(pdf_bsdf, 1e-6f) * max(fabs(dot3(s.ng, wo)), 0.1f));
    s.footprint = pick(camera_ray | !hit, (Float)(0.0f), FOOTPRINT_SHARE * spread * density_scale(s INSTANCE_ARGUMENTS));
#endif
#if TRANSMISSION
    beta = mul(beta, attenuation(hit, s, FIELD(path, PATH_HIT_T), materials));
#endif

#if AREA_LIGHTS
    const UInt flags = GATHER_U(materials, s.material, flags);
    const Mask gives = (s.light != NO_LIGHT) | ((flags & MATERIAL_UNLIT) != 0u);
    const Mask emits = hit & gives & (s.front | ((flags & MATERIAL_TWO_SIDED_EMISSION) != 0u));
    if (any_lane(emits)) {
        const Vec3 emission =
            fetch_emission(emits, s, u, v, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS);
#if CONNECT
        const Mask sampled = emits & (s.light != NO_LIGHT);
        const UInt light = pick_u(sampled, s.light, (UInt)(0u));
        Float chance =
            light_chance(params, lights CHOICE_ARGUMENTS, sampled & !camera_ray, light, last);
#if SHADOW_RAYS
        chance *= last_rays;
#endif
        Float pdf_light =
            area_light_density(lights, light, chance, FIELD(path, PATH_HIT_T), fabs(dot3(s.ng, wo)));
#if RECTANGLES
        pdf_light = rectangle_density(lights, sampled & !camera_ray, light, chance,
                                      get_v(path, PATH_ORIGIN_X), pdf_light);
#endif
#if SPHERES
        pdf_light = sphere_density(lights, sampled & !camera_ray, light, get_v(path, PATH_ORIGIN_X), s.p, s.ng, pdf_light);
#endif
        pdf_light = pick(sampled, pdf_light, (Float)(0.0f));
#else
        const Float pdf_light = (Float)(0.0f);
#endif
        const Float weight = emission_weight(params, camera_ray, pdf_bsdf, pdf_light);
        emitted = pick_v(emits, scale(emission, weight), emitted);
    }
#endif

    const Vec3 brought = pick_v(alive, mul(beta, emitted), zero);
#if CELLS
    const UInt known = pick_u(camera_ray, (UInt)(0u), get_u(path, PATH_VERTEX) & ~(uint)VERTEX_SKY);
    const UInt vertex = known & VERTEX_MASK;
    const Float length = pick(camera_ray, (Float)(0.0f), FIELD(path, PATH_LENGTH)) + FIELD(path, PATH_HIT_T);
    FIELD(path, PATH_LENGTH) = length;
    put_v(path, PATH_BEYOND_R, pick_v(camera_ray, zero, get_v(path, PATH_BEYOND_R)));
    put_u(path, PATH_VERTEX, known | near_bit(params, hit, vertex, depth, length, FIELD(path, PATH_HIT_T), s.ng));
#if CELLS == 2
    Vec3 share = get_v(path, PATH_SHARE_R);
#else
    const Vec3 share = vec3_all((Float)(1.0f));
#endif
    const Mask shared = shares_emission(params, vertex, depth, even_sky);
    const Vec3 rest = gather_light(path, shared, share, brought);
    // What the first surface did not share is none of its base's.
    const Mask reflected = !camera_ray & !((vertex == 1u) & shared);
#else
    put_v(path, PATH_RADIANCE_R, add(get_v(path, PATH_RADIANCE_R), brought));
    const Vec3 rest = brought;
    const Mask reflected = !camera_ray;
#endif
#if BASE == 2
    Vec3 base_part = get_v(path, PATH_BASE_SHARE_R);
    keep_base(path, reflected, base_part, rest);
#elif BASE
    keep_base(path, reflected, vec3_all((Float)(1.0f)), rest);
#endif
#if AOV_DIRECT
    put_v(path, PATH_DIRECT_R, add(get_v(path, PATH_DIRECT_R), pick_v(depth <= 1u, brought, zero)));
#endif

#if TANGENTS
    Vec3 tangent;
    Vec3 bitangent;
    const Float anisotropy =
        map_normal(hit, &s, u, v, wo, materials, tangents TEXTURE_ARGUMENTS INSTANCE_ARGUMENTS, &tangent, &bitangent);
#else
    const Float anisotropy = (Float)(0.0f);
#endif
    const UInt sample = get_u(path, PATH_SAMPLE);
    const UInt pixel = get_u(path, PATH_PIXEL);
#if MATERIAL_CELLS
    const UInt move = mix_bits(mix_bits(get_u(path, PATH_SEED) + depth * 0x85ebca77u) + sample);
    const Factors factors = shared_factors(params, counters, hit, !camera_ray, s, u, v, move,
                                        materials TEXTURE_ARGUMENTS MATERIAL_CELL_ARGUMENTS);
    const Bsdf b = bsdf_of(hit, s, u, v, anisotropy, factors, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS);
#else
    const Bsdf b = fetch_bsdf(hit, s, u, v, anisotropy, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS);
#endif

#if AOV_FEATURES
    const Mask first = alive & camera_ray;
    if (any_lane(first)) {
        // What a denoiser calls albedo: a metal's reflectance, a dielectric's base colour.
        store_features(params, features, first, hit, sample, pixel, b.base_color, s.ns, FIELD(path, PATH_HIT_T));
    }
#endif
#if TRANSMISSION
    s.ns = normal_of_glass(s, b, wo);
#if TANGENTS
    tangent = tangent_across(s.ns, tangent);
    bitangent = cross3(s.ns, tangent);
#endif
#endif

#if AOV_LIGHTS
    if (any_lane(alive & camera_ray))
        store_choice(params,
#if AOV_LIGHTS == 2
                     particle_words, particle_counts, (UInt)(NO_PLACE),
#endif
                     choices, alive & camera_ray, (Mask)(0), sample, pixel, (Float)(0.0f));
#endif

    Mask goes_on = hit & (depth < params->max_depth);
#if VIRTUAL_LIGHTS
    // Beyond the first surface of no mirror there are only lights to be found.
    goes_on &= camera_ray | (pdf_bsdf >= PDF_DELTA);
#endif
    const Mask delta = is_delta(b);
#if SEEN
#if INSTANCES
    UInt shape = 1u + ((s.instance * 0x9e3779b1u + GATHER_U(surfaces, s.triangle, shape)) >> 3);
#elif MOTION
    UInt shape = (1u + GATHER_U(surfaces, triangle, shape))
                       | pick_u(triangle >= params->first_moving, (UInt)(SHAPE_MOVES), (UInt)(0u));
#else
    UInt shape = 1u + GATHER_U(surfaces, triangle, shape);
#endif
    shape |= pick_u(luminance(emitted) > 0.0f, (UInt)(SHAPE_SHINES), (UInt)(0u));
#if SEEN == 2 && MOTION
    const Vec3 before = previous_point(params, previous, triangle, u, v, s.p);
#else
    const Vec3 before = s.p;
#endif
#if BASE
    // The others wait for the reflectance of their base.
    const Mask sees = alive & camera_ray & !goes_on;
#else
    const Mask sees = alive & camera_ray;
#endif
    if (any_lane(sees))
        store_seen(params, seen, sees, hit, sample, pixel, shape, s.p, before, s.ns, zero);
#endif
#if GUIDE || CACHE
    const UInt noise = mix_bits(mix_bits(get_u(path, PATH_SEED) + depth * 0x9e3779b9u) + sample);
    const Mask learning = alive & (sample < counters[COUNTER_LEARN_LIMIT]);
#endif
#if CACHE
    const UInt cache_noise = mix_bits(noise + 0x6a09e667u);
    UInt cache = pick_u(learning & !camera_ray, get_u(path, PATH_CACHE), (UInt)(NO_SLOT));
    Vec3 cache_gate = get_v(path, PATH_CACHE_GATE_R);
    learn_cached(params, cache_sums, cache_cells, counters, learning, cache, mul(cache_gate, emitted), cache_noise);
#endif
#if GUIDE
    const Mask guided = goes_on & !delta & (Mask)(counters[COUNTER_GUIDE_OFF] ? 0 : -1);
    Guide guide =
        find_guide(params, guide_keys, guide_cells, guide_full, counters, guided, learning, s.p, s.ns, noise);
    guide.known = pick_u(depth < GUIDED_BOUNCES, guide.known, (UInt)(NO_SLOT));
    // What the last ray brought: what this surface emits, and reflects of what its own cell knows of.  What
    // it reflects of a light that a shadow ray finds is added when that is known.
    const UInt guide_from = pick_u(learning & !camera_ray, get_u(path, PATH_GUIDE), (UInt)(NO_PART));
    learn(params, guide_sums, counters, learning, guide_from,
          luminance(emitted) + luminance(b.base_color) * guide.mean, 1, mix_bits(noise));
#endif
    if (!any_lane(goes_on)) {
        put_u(path, PATH_STATUS, pick_u(alive, STATUS_DONE | depth, status));
        return;
    }

#if !TANGENTS
    Vec3 tangent;
    Vec3 bitangent;
#if GUIDE
    guide_frame(s.ns, &tangent, &bitangent);
#else
    make_frame(s.ns, &tangent, &bitangent);
#endif
#elif GUIDE
    Vec3 guide_s;
    Vec3 guide_t;
    guide_frame(s.ns, &guide_s, &guide_t);
    GuideTurn turn;
    turn.xs = dot3(tangent, guide_s);
    turn.xt = dot3(tangent, guide_t);
    turn.ys = dot3(bitangent, guide_s);
    turn.yt = dot3(bitangent, guide_t);
#endif
    const Vec3 wo_local = vec3(dot3(tangent, wo), dot3(bitangent, wo), max(dot3(s.ns, wo), (Float)(1e-6f)));
    const LobeChances chances = lobe_chances(b, wo_local);

#if CELLS || BASE
    // Light is divided by the reflectance of what shares it: textures stay sharp.
#if CELLS == 2 || BASE == 2
    const Float base = base_gate(chances);
    const Vec3 gate = mul(beta, scale(b.base_color, base));
#else
    const Vec3 gate = mul(beta, b.base_color);
#endif
#endif
#if BASE
    const Mask reflects = goes_on & camera_ray;
    if (any_lane(reflects))
        store_seen(params, seen, reflects, reflects, sample, pixel, shape, s.p, before, s.ns, gate);
#endif
#if CELLS
    Vec3 cell_gate = gate;
    UInt ng = pack_unit(s.ng);
    UInt mark = depth + 1u;
#if CELL_LAYERS
    // Where reflections are as wide as a cell looks from the camera, all that the surface reflects is shared.
    const Float alpha = least_alpha(b);
    Mask wide = !delta & (alpha >= pick(camera_ray, (Float)(params->cell_alpha), (Float)(LATER_CELL_ALPHA)));
#if TRANSMISSION
    wide &= b.transmission == 0.0f;
#endif
    if (any_lane(wide)) {
        const UInt turn = mix_bits(mix_bits(get_u(path, PATH_SEED) + depth * 0xc2b2ae35u) + sample);
        const UInt tagged = with_gloss(with_direction(ng, params->cell_directions, wo, turn), b.metallic >= 0.5f, alpha);
        cell_gate = pick_v(wide, mul(beta, reflectance(b, chances)), gate);
        ng = pick_u(wide, tagged, ng);
        mark |= pick_u(wide, (UInt)(VERTEX_GLOSSY), (UInt)(0u));
    }
#endif
    const Mask chosen = goes_on & (vertex == 0u) & (max3(cell_gate) > 0.0f)
                        & wants_cell(params, depth, length, FIELD(path, PATH_HIT_T), pdf_bsdf);
    if (any_lane(chosen)) {
        store_cell_vertices(params, vertices, chosen, sample, pixel, s.p, ng, cell_gate, length);
        put_u(path, PATH_VERTEX, pick_u(chosen, mark, get_u(path, PATH_VERTEX)));
    }
#endif

#if CACHE
    const Mask matt = goes_on & (chances.diffuse >= 1.0f) & (max3(b.base_color) > CACHE_LEAST_REFLECTANCE);
    const Cached cached = find_cached(params, cache_keys, cache_cells, cache_full, counters, matt, learning,
                                      s.p, s.ns, cache_noise);
    const Vec3 reflected_here = mul(b.base_color, cached.mean);
    learn_cached(params, cache_sums, cache_cells, counters, learning & cached.known, cache,
                 mul(cache_gate, reflected_here), mix_bits(cache_noise));
    // Next to the last vertex a cell is too coarse: in corners paths go on.  Some go on everywhere and teach;
    // were all those of corners to teach, cells would learn what corners see.
    const Mask teaches = learning & ((noise & 15u) == 0u);
    Mask may_end = cached.known & !camera_ray & !teaches & (FIELD(path, PATH_HIT_T) > 0.5f * cached.edge);
#if CELLS
    may_end &= vertex != 0u;
#endif
    const Float ends = pick(may_end, cached.ends, (Float)(0.0f));
    const Mask ended = unit_float(mix_bits(cache_noise ^ 0x3c6ef372u)) < ends;
    if (any_lane(ends > 0.0f)) {
        const Float on = 1.0f / pick(ended, (Float)(1.0f), 1.0f - ends);
        const Vec3 taken = pick_v(ends > 0.0f, scale(mul(beta, reflected_here), pick(ended, (Float)(1.0f), 1.0f - on)), zero);
        beta = scale(beta, on);
#if CELLS == 2
        const Vec3 left = gather_light(path, shares_connection(params, vertex, depth, (Mask)(0)), share, taken);
#elif CELLS
        const Vec3 left =
            gather_light(path, shares_connection(params, vertex, depth, (Mask)(0)), vec3_all((Float)(1.0f)), taken);
#else
        put_v(path, PATH_RADIANCE_R, add(get_v(path, PATH_RADIANCE_R), taken));
        const Vec3 left = taken;
#endif
#if BASE == 2
        keep_base(path, ends > 0.0f, base_part, left);
#elif BASE
        keep_base(path, ends > 0.0f, vec3_all((Float)(1.0f)), left);
#endif
#if GUIDE
        // Of this the guide knows only what no shadow ray finds.
        const Float more = max(luminance(reflected_here) - luminance(b.base_color) * guide.mean, (Float)(0.0f));
        learn(params, guide_sums, counters, learning & ended, guide_from, more, 0, cache_noise);
#endif
        goes_on &= !ended;
        count_up(&counters[COUNTER_CACHE_ENDS], count_lanes(ended));
    }
    // Few records are opened where much is known, and not all elsewhere: a path has one at a time, and what
    // the camera does not see is learned too.
    const Mask opens = learning & matt & goes_on & (cached.slot != NO_SLOT)
                       & ((cached.known & ((camera_ray & ((noise & 48u) == 0u)) | teaches))
                          | (!cached.known & (cache == NO_SLOT) & ((noise & 16u) != 0u)));
    cache = pick_u(cached.known & !opens, (UInt)(NO_SLOT), pick_u(opens, cached.slot, cache));
    cache_gate = pick_v(opens, vec3(inverse_reflectance(b.base_color.x), inverse_reflectance(b.base_color.y),
                                    inverse_reflectance(b.base_color.z)), cache_gate);
    visit_cached(cache_sums, opens, !camera_ray & (FIELD(path, PATH_HIT_T) < cached.edge), cache);
    put_u(path, PATH_CACHE, cache);
#endif

    // The seed names the pixel by its place on the film; it travels with the path.
#if METROPOLIS
    const Seed seed = path_seed(params, path, chains, chain_numbers, item);
#else
    const Seed seed = get_u(path, PATH_SEED);
#endif
    const UInt pair = PAIR_VERTEX + depth * VERTEX_PAIRS;
    const UInt index = reversed_index(params, sample, depth + 1u);
    const VertexBits numbers = vertex_bits(seed, index, pair, params->sampler);
    const Float u_lobe = unit_float(numbers.choice.first);

#if CONNECT
    if (params->light_count > 0u) {
        const Mask asks = goes_on & !delta;
        const Float away = s.offset;
        const Vec3 above = add_scaled(s.p, s.ng, away);
        LightQuery query;
        query.p = above;
        query.n = s.ng;
#if LIGHT_SAMPLING
        // As the next vertex will know it.
        const UInt normal = pack_unit(s.ng);
        put_u(path, PATH_LIGHT_NORMAL, normal);
        query.n = unpack_unit(normal);
#endif
#if LIGHT_PHOTONS
        UInt random_x;
        UInt random_y;
        sample_bits(seed, index, PAIR_PARTICLES + depth, params->sampler, &random_x, &random_y);
        const Vec3 near = jittered(params, s.p, s.ng, random_x, random_y);
        query.row = find_row(params, particle_table, asks, near, s.ng);
        put_u(path, PATH_PARTICLE_ROW, query.row);
#endif
#if GUIDE
        put_u(path, PATH_GUIDE_FROM, guide_from);
#endif
#if SHADOW_RAYS
        const UInt rays = rays_asked(params RAYS_ARGUMENTS, asks, camera_ray, query);
        // Rays of a vertex take their lights from as many equal parts of the chances.
        const UInt part = to_uint(0x1p32f / to_float(max(rays, 2u)));
        const uint most_rays = SHADOW_RAYS;
#else
        const uint most_rays = 1;
#endif
        for (uint ray = 0; ray < most_rays; ++ray) {
#if SHADOW_RAYS
            const Mask sends = asks & (rays > ray);
            if (!any_lane(sends))
                continue;
            const UInt ray_bits = numbers.choice.second + part * ray;
            const UInt ray_pair =
                ray == 0u ? pair : PAIR_RAYS + (depth * SHADOW_RAYS + ray) * VERTEX_PAIRS;
            BitPair place = numbers.light;
            if (ray > 0u)
                sample_bits(seed, index, ray_pair + PAIR_LIGHT, params->sampler, &place.first, &place.second);
#else
            const Mask sends = asks;
            const UInt ray_bits = numbers.choice.second;
            const UInt ray_pair = pair;
            const BitPair place = numbers.light;
#endif
            const LightChoice choice = choose_light(params, lights CHOICE_ARGUMENTS, sends, query, ray_bits);
#if AOV_LIGHTS
            const Mask shows = sends & camera_ray & (Mask)(ray == 0u ? -1 : 0);
            if (any_lane(shows))
                store_choice(params,
#if AOV_LIGHTS == 2
                             particle_words, particle_counts, query.row,
#endif
                             choices, shows, shows, sample, pixel, choice.pmf);
#endif
            LightSample light = sample_light(params, lights, surfaces,
                                                   materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS,
#if ENVIRONMENT == 2
                                                   environment,
#endif
                                                   sends, above, unit_float(place.first), unit_float(place.second),
                                                   seed, index, ray_pair, choice);
#if CELLS && ENVIRONMENT && !SHADOW_RAYS
            // Of several rays one bit could not tell.
            const UInt its_vertex = get_u(path, PATH_VERTEX);
            const Mask even = sends & (choice.light == params->environment_light) & is_even_sky(params, light.radiance)
                              & ((its_vertex & VERTEX_MASK) == depth + 1u);
            put_u(path, PATH_VERTEX, its_vertex | pick_u(even, (UInt)(VERTEX_SKY), (UInt)(0u)));
#endif
            const Vec3 wi_local = vec3(dot3(tangent, light.wi), dot3(bitangent, light.wi), dot3(s.ns, light.wi));
            Float pdf;
            const Vec3 f = eval_bsdf(b, chances, wo_local, wi_local, dot3(s.ng, light.wi), &pdf);
#if GUIDE
            guide_pdf(guide_cells, guide.known, chances, 0, wi_local GUIDE_TURN, &pdf);
#endif
#if SHADOW_RAYS
            light.pdf *= to_float(rays);
#endif
            Float weight = (Float)(1.0f);
            if (params->direct_sampling == DIRECT_MIS)
                weight = pick(light.extended, power_heuristic(light.pdf, pdf), weight);
            else if (params->direct_sampling == DIRECT_BSDF)
                weight = pick(light.extended, (Float)(0.0f), weight);
            const Mask lit = sends & (light.pdf > 0.0f);
            const Vec3 arrives =
                mul(mul(beta, f), scale(light.radiance, weight / pick(lit, light.pdf, (Float)(1.0f))));
            put_v(path, RAY_FIELD(ray, LIGHT_R), pick_v(lit, arrives, zero));
#if GUIDE
            FIELD(path, RAY_FIELD(ray, GUIDE_LIGHT)) = luminance(
                mul(f, scale(light.radiance, weight / pick(lit, light.pdf, (Float)(1.0f)))));
#endif
#if CACHE
            put_v(path, RAY_FIELD(ray, CACHE_LIGHT_R),
                  mul(mul(cache_gate, f), scale(light.radiance, weight / pick(lit, light.pdf, (Float)(1.0f)))));
#endif
#if CELLS == 2
            Vec3 light_share = base_share(b, chances, base, wi_local, f);
#if CELL_LAYERS
            light_share = pick_v(wide, vec3_all((Float)(1.0f)), light_share);
#endif
            put_v(path, RAY_FIELD(ray, LIGHT_SHARE_R), pick_v(chosen, light_share, share));
#endif
#if BASE == 2
            put_v(path, RAY_FIELD(ray, BASE_LIGHT_R), pick_v(camera_ray, base_share(b, chances, base, wi_local, f), base_part));
#endif
            // On the far side (glass) the ray starts below; the light stays where it is.
            const Vec3 origin = ray_origin(s, light.wi);
            put_v(path, RAY_FIELD(ray, SHADOW_X), origin);
            put_v(path, RAY_FIELD(ray, TOWARD_X), add(light.toward, sub(above, origin)));
        }
#if VIRTUAL_LIGHTS
        {
            UInt slot_bits;
            UInt unused;
            sample_bits(seed, index, PAIR_RAYS + depth * VERTEX_PAIRS, params->sampler, &slot_bits, &unused);
            const VirtualSample light =
                sample_virtual_light(params, virtual_lights, virtual_counts, photon_counters, asks,
                                     virtual_slot(slot_bits), above);
            const Vec3 wi_local =
                vec3(dot3(tangent, light.wi), dot3(bitangent, light.wi), dot3(s.ns, light.wi));
            Float pdf;
            const Vec3 f = eval_bsdf(b, chances, wo_local, wi_local, dot3(s.ng, light.wi), &pdf);
            put_v(path, RAY_FIELD(1u, LIGHT_R), pick_v(asks, mul(mul(beta, f), light.radiance), zero));
#if BASE == 2
            put_v(path, RAY_FIELD(1u, BASE_LIGHT_R),
                  pick_v(camera_ray, base_share(b, chances, base, wi_local, f), base_part));
#endif
            const Vec3 origin = ray_origin(s, light.wi);
            put_v(path, RAY_FIELD(1u, SHADOW_X), origin);
            put_v(path, RAY_FIELD(1u, TOWARD_X), add(light.toward, sub(above, origin)));
        }
#endif
    }
#endif

    const Float u1 = unit_float(numbers.bsdf.first);
    const Float u2 = unit_float(numbers.bsdf.second);
#if GUIDE
    const Vec3 drawn = sample_guided(guide_cells, guide.known, b, chances, wo_local GUIDE_TURN, u_lobe, u1, u2);
#else
    const Vec3 drawn = sample_bsdf(b, chances, wo_local, u_lobe, u1, u2);
#endif
    const Vec3 wi = renormalize3(
        add_scaled(add_scaled(scale(tangent, drawn.x), bitangent, drawn.y), s.ns, drawn.z));
    Float pdf;
    const Vec3 f = eval_bsdf(b, chances, wo_local, drawn, dot3(s.ng, wi), &pdf);
#if GUIDE
    const UInt part = guide_pdf(guide_cells, guide.known, chances, any_lane(guide.slot != NO_SLOT), drawn GUIDE_TURN, &pdf);
    put_u(path, PATH_GUIDE, guide_part(guide, part, u_lobe < chances.diffuse));
#endif
#if CELLS == 2
    const Vec3 by_base = base_share(b, chances, base, drawn, f);
    share = pick_v(chosen, by_base, share);
    // Of a path that goes on by a coat the base's cell would get little: a later vertex may share its light.
    Mask gives_up = chosen & (max3(by_base) < LEAST_SHARE) & (Mask)(params->filter_direct ? 0 : -1)
                    & ((get_u(path, PATH_VERTEX) & VERTEX_SKY) == 0u);
#if CELL_LAYERS
    share = pick_v(chosen & wide, vec3_all((Float)(1.0f)), share);
    gives_up &= !wide;
#endif
    put_v(path, PATH_SHARE_R, share);
    put_u(path, PATH_VERTEX, pick_u(gives_up, (UInt)(0u), get_u(path, PATH_VERTEX)));
#endif
#if BASE == 2
    base_part = pick_v(camera_ray, base_share(b, chances, base, drawn, f), base_part);
    put_v(path, PATH_BASE_SHARE_R, base_part);
#if CELLS
    if (any_lane(reflects)) {
        Vec3 in_all = base_part;
#if CELL_LAYERS
        // Of all that a cell brings.
        in_all = pick_v(chosen & wide, demodulated(gate, cell_gate), base_part);
#endif
        store_base_share(params, seen, reflects, sample, pixel, in_all);
    }
#endif
#endif
#if GUIDE
    const Vec3 beta_here = beta;
#endif
    beta = mul(beta, scale(f, 1.0f / pick(pdf > 0.0f, pdf, (Float)(1.0f))));
    const Float carried = beta.x + beta.y + beta.z;
    const Mask broken = goes_on & !(carried < INFINITY);
    // The film rejects and counts the sample.
    FIELD(path, PATH_RADIANCE_R) = pick(broken, (Float)(NAN), FIELD(path, PATH_RADIANCE_R));
    Mask survives = goes_on & (pdf > 0.0f) & (carried > 0.0f) & !broken;

    const Mask roulette = (depth + 1u) > params->roulette_depth;
    Float worth = max3(beta);
#if TRANSMISSION
    // Inside of glass beta is smaller by eta^2 and will be larger again, in glass within glass more than once: that
    // is no reason to end.
    const Mask crosses = (drawn.z < 0.0f) & (b.transmission > 0.0f) & !b.thin;
    Float denser = pick(camera_ray, (Float)(1.0f), FIELD(path, PATH_DENSER));
    denser *= pick(crosses, b.eta * b.eta, (Float)(1.0f));
    FIELD(path, PATH_DENSER) = denser;
    worth *= denser;
#endif
    Float chance = pick(roulette, min(worth, (Float)(MAX_SURVIVAL)), (Float)(1.0f));
#if GUIDE
    const Float to_come = luminance(mul(beta_here, b.base_color)) * guide.mean;
    const Float expected = pick(camera_ray, to_come, FIELD(path, PATH_EXPECTED));
    FIELD(path, PATH_EXPECTED) = expected;
    chance = pick(roulette, min(informed_chance(to_come, expected, chance), (Float)(MAX_SURVIVAL)), chance);
#endif
    survives &= left_of_choice(chances, u_lobe) < chance;
    beta = scale(beta, 1.0f / pick(survives, chance, (Float)(1.0f)));
#if CACHE
    const Float step = 1.0f / pick(survives, pdf * chance, (Float)(1.0f));
    put_v(path, PATH_CACHE_GATE_R, mul(cache_gate, scale(f, step)));
#endif

    put_v(path, PATH_BETA_R, beta);
    put_v(path, PATH_ORIGIN_X, ray_origin(s, wi));
    put_v(path, PATH_DIRECTION_X, wi);
    FIELD(path, PATH_PDF) = pick(delta, (Float)(PDF_DELTA), pdf);
    const UInt next = pick_u(survives, STATUS_ALIVE | (depth + 1u), STATUS_DONE | depth);
    put_u(path, PATH_STATUS, pick_u(alive, next, status));
}
