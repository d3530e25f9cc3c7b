// Photons: emitted by all lights, traced as paths are, kept in a map by the surfaces that they light.
//
// A photon in flight lies in a pool of the same shape as the paths' and is traced by the same kernel.  Of
// the path's fields beta is its power, sample its number, pixel its light and shadow_z its random number;
// from PLACE_FIELD on are, for each size of cells, its place in the map and what it leaves there.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/photons.h"
#include "common/rng.h"
#include "common/alpha.h"
#include "common/surface.h"
#include "common/light.h"
#include "common/emission.h"
#include "common/particle_map.h"

#define PLACE_FIELD PATH_RADIANCE_R // and the five behind it

/// Fill the pool with photons `first` .. `first` + `count` of the light table; the rest of it is dead.
///
/// reads   lights, scene tables
/// writes  photons, photon_counters
kernel void emit_photons(
    __global const Params *params,
    __global float *photons,
    volatile __global uint *photon_counters,
    __global const Light *lights,
    __global const Surface *surfaces,
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS,
#if ENVIRONMENT == 2
    __global const EnvironmentCell *environment,
#endif
    const uint first,
    const uint count)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(photons, item);
    const UInt slot = lanes_before(MASK_ALL) + item * W;
    const Mask wanted = slot < count;
    put_u(path, PATH_STATUS, (UInt)(STATUS_DONE));
    if (!any_lane(wanted))
        return;
    const UInt number = slot + first;
    const UInt seed = mix_bits((UInt)(params->seed ^ 0x70686f74u));
    const Emission e = emit(params, lights, surfaces, materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS,
#if ENVIRONMENT == 2
                            environment,
#endif
                            wanted, seed, reverse_bits(number));
    const Float carried = e.power.x + e.power.y + e.power.z;
    const Mask broken = wanted & !(carried < INFINITY);
    const Mask dark = wanted & (carried <= 0.0f);
    const Mask starts = wanted & !broken & !dark;
    put_v(path, PATH_ORIGIN_X, e.origin);
    put_v(path, PATH_DIRECTION_X, e.direction);
    put_v(path, PATH_BETA_R, e.power);
    put_u(path, PATH_SEED, seed);
    put_u(path, PATH_SAMPLE, number);
    put_u(path, PATH_PIXEL, e.light);
    put_u(path, PATH_TOWARD_X, e.point);
    put_u(path, PATH_STATUS, pick_u(starts, (UInt)(STATUS_ALIVE | 1u), (UInt)(STATUS_DONE)));
    count_photons(photon_counters, PHOTONS_EMITTED, starts | broken);
    count_photons(photon_counters, PHOTONS_DARK, dark);
    count_photons(photon_counters, PHOTONS_REJECTED, broken);
}

#if LIGHT_PHOTONS
/// Let every photon that hit something try for its place of the map: the least random number wins.
///
/// reads   photons, surfaces
/// writes  photons.shadow; particle_keys, particle_counts, photon_counters (atomic)
kernel void store_photons(
    __global const Params *params,
    __global float *photons,
    volatile __global uint *photon_counters,
    __global const LightGroup *light_groups,
    __global const Surface *surfaces INSTANCE_PARAMETERS,
    volatile __global uint *particle_keys,
    volatile __global uint *particle_counts)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(photons, item);
    const UInt status = get_u(path, PATH_STATUS);
    const Mask alive = (status & STATUS_MASK) == STATUS_ALIVE;
    for (uint size = 0; size < PARTICLE_SIZES; ++size)
        put_u(path, PLACE_FIELD + 2u * size, (UInt)(NO_PLACE));
    if (!any_lane(alive))
        return;
    const UInt triangle = get_u(path, PATH_HIT_TRIANGLE);
    const Mask hit = alive & (triangle != NO_HIT);
    count_photons(photon_counters, PHOTONS_STORED, hit);
    const Vec3 wo = scale(get_v(path, PATH_DIRECTION_X), (Float)(-1.0f));
    const SurfacePoint s = surface_point(pick_u(hit, triangle, (UInt)(0u)), FIELD(path, PATH_HIT_U),
                                         FIELD(path, PATH_HIT_V), wo, surfaces INSTANCE_ARGUMENTS);
    const UInt node = GATHER_U(light_groups, pick_u(hit, get_u(path, PATH_PIXEL), (UInt)(0u)), node);
    const UInt key = mix_bits(get_u(path, PATH_SAMPLE) ^ params->seed);
#if !VIRTUAL_LIGHTS
    count_photons(photon_counters, PHOTONS_ESCAPED, alive & !hit);
    put_u(path, PATH_STATUS, pick_u(alive, (UInt)(STATUS_DONE), status));
#endif
    put_u(path, PATH_SHADOW_Z, key);
    uint lane_key[W];
    store_lanes_u(key, lane_key);
    for (uint size = 0; size < PARTICLE_SIZES; ++size) {
        const ParticleCell cell = particle_cell(params, s.p, s.ng, size);
        const UInt place = particle_place(cell, node);
        put_u(path, PLACE_FIELD + 2u * size, pick_u(hit, place, (UInt)(NO_PLACE)));
        put_u(path, PLACE_FIELD + 2u * size + 1u, particle_word(params, cell, node));
        uint lane_place[W];
        store_lanes_u(place, lane_place);
        for (uint left = lane_bits(hit); left; left &= left - 1u) {
            const uint k = lowest_bit(left);
            insert_particle(particle_keys, particle_counts, lane_place[k], lane_key[k]);
        }
    }
}

/// Write down those that have won their places so far.  After store_photons, before the pool is used again.
///
/// reads   photons.{shadow, toward}, particle_keys
/// writes  particle_words, particle_points
kernel void settle_photons(
    __global const Params *params,
    __global float *photons,
    __global const uint *particle_keys,
#if PHOTON_POINTS
    __global uint *particle_points,
#endif
    __global uint *particle_words)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(photons, item);
    uint key[W];
    store_lanes_u(get_u(path, PATH_SHADOW_Z), key);
#if PHOTON_POINTS
    uint point[W];
    store_lanes_u(get_u(path, PATH_TOWARD_X), point);
#endif
    for (uint size = 0; size < PARTICLE_SIZES; ++size) {
        uint place[W];
        uint word[W];
        store_lanes_u(get_u(path, PLACE_FIELD + 2u * size), place);
        store_lanes_u(get_u(path, PLACE_FIELD + 2u * size + 1u), word);
        for (uint k = 0; k < W; ++k)
            if (place[k] != NO_PLACE && particle_keys[place[k]] == key[k]) {
                particle_words[place[k]] = word[k];
#if PHOTON_POINTS
                particle_points[place[k]] = point[k];
#endif
            }
    }
}

/// Make the table that paths ask of the places of the map.  One work item a row of them.
///
/// reads   particle_words, particle_counts, particle_points
/// writes  particle_table
kernel void tabulate_photons(
    __global const Params *params,
    __global const uint *particle_words,
    __global const uint *particle_counts,
#if PHOTON_POINTS
    __global const uint *particle_points,
#endif
    __global uint *particle_table)
{
    const uint row = get_global_id(0);
    if (row >= params->particle_cells)
        return;
    tabulate_row(params, particle_words, particle_counts POINT_ARGUMENTS, particle_table, row);
}
#endif
