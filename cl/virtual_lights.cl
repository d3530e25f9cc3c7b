// Photons go on: what surfaces reflect of them becomes virtual lights.
//
// Of the path's fields shadow is where a photon left a light, light its power, pdf (as bits) the normal there,
// toward_y its random number and toward_z its slot of the table.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pool.h"
#include "common/photons.h"
#include "common/roulette.h"
#include "common/rng.h"
#include "common/alpha.h"
#include "common/surface.h"
#include "common/bsdf.h"
#include "common/material.h"
#include "common/light.h"
#include "common/virtual_light.h"

/// Let every photon that hit something leave a virtual light there, and send it on or end it.
///
/// With `most_bounces` surfaces behind it at most.  Surfaces are without their normal maps.
///
/// reads   photons, scene tables
/// writes  photons; virtual_keys, virtual_counts, photon_counters (atomic)
kernel void scatter_photons(
    __global const Params *params,
    __global float *photons,
    volatile __global uint *photon_counters,
    __global const Surface *surfaces,
#if SMOOTH
    __global const Normals *normals,
#endif
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS INSTANCE_PARAMETERS,
    volatile __global uint *virtual_keys,
    volatile __global uint *virtual_counts,
    const uint most_bounces)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(photons, item);
    const UInt status = get_u(path, PATH_STATUS);
    const Mask alive = (status & STATUS_MASK) == STATUS_ALIVE;
    put_u(path, PATH_TOWARD_Z, (UInt)(NO_PLACE));
    if (!any_lane(alive))
        return;
    const UInt hit_triangle = get_u(path, PATH_HIT_TRIANGLE);
    const Mask hit = alive & (hit_triangle != NO_HIT);
    count_photons(photon_counters, PHOTONS_ESCAPED, alive & !hit);
    // How many surfaces it has left so far: photons leave their light with a depth of 1.
    const UInt bounce = (status & DEPTH_MASK) - 1u;
    const UInt triangle = pick_u(hit, hit_triangle, (UInt)(0u));
    const Float u = FIELD(path, PATH_HIT_U);
    const Float v = FIELD(path, PATH_HIT_V);
    const Vec3 wo = scale(get_v(path, PATH_DIRECTION_X), (Float)(-1.0f));
    SurfacePoint s = surface_point(triangle, u, v, wo, surfaces
#if SMOOTH
                                         , normals
#endif
                                         INSTANCE_ARGUMENTS);
    Vec3 beta = get_v(path, PATH_BETA_R);
#if TRANSMISSION
    beta = mul(beta, attenuation(hit, s, FIELD(path, PATH_HIT_T), materials));
#endif
    const Bsdf b = fetch_bsdf(hit, s, u, v, (Float)(0.0f), materials TEXTURE_ARGUMENTS COLOR_ARGUMENTS);

    Float matt = (Float)(1.0f);
#if GLOSSY
    matt *= 1.0f - b.metallic;
#endif
#if TRANSMISSION
    matt *= 1.0f - b.transmission;
#endif
    const Vec3 reflected = scale(mul(beta, b.base_color), matt);
    const Mask leaves = hit & (max3(reflected) > 0.0f) & (max3(reflected) < INFINITY);
    const UInt number = get_u(path, PATH_SAMPLE);
    const UInt key = mix_bits(((number << 4) | (bounce & 15u)) ^ params->seed);
    const UInt slot = virtual_slot(mix_bits(key ^ 0x7669u));
    put_v(path, PATH_SHADOW_X, ray_origin(s, s.ng));
    put_v(path, PATH_LIGHT_R, reflected);
    FIELD(path, PATH_PDF) = from_bits(pack_unit(s.ng));
    put_u(path, PATH_TOWARD_Y, key);
    put_u(path, PATH_TOWARD_Z, pick_u(leaves, slot, (UInt)(NO_PLACE)));
    uint lane_key[W];
    uint lane_slot[W];
    uint lane_bounce[W];
    store_lanes_u(key, lane_key);
    store_lanes_u(slot, lane_slot);
    store_lanes_u(bounce, lane_bounce);
    for (uint left = lane_bits(leaves); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        atomic_min(&virtual_keys[lane_slot[k]], lane_key[k]);
        atomic_inc(&virtual_counts[lane_slot[k]]);
    }

#if TRANSMISSION
    s.ns = normal_of_glass(s, b, wo);
#endif
    Vec3 tangent;
    Vec3 bitangent;
    make_frame(s.ns, &tangent, &bitangent);
    const Vec3 wo_local = vec3(dot3(tangent, wo), dot3(bitangent, wo), max(dot3(s.ns, wo), (Float)(1e-6f)));
    const LobeChances chances = lobe_chances(b, wo_local);
    const UInt pair = PAIR_VERTEX + (bounce + 1u) * VERTEX_PAIRS;
    const UInt index = reverse_bits(number);
    const Seed seed = get_u(path, PATH_SEED);
    UInt lobe_bits;
    UInt unused;
    Float u1;
    Float u2;
    sample_bits(seed, index, pair + PAIR_CHOICE, params->sampler, &lobe_bits, &unused);
    sample_pair(seed, index, pair + PAIR_BSDF, params->sampler, &u1, &u2);
    const Float u_lobe = unit_float(lobe_bits);
    const Vec3 drawn = sample_bsdf(b, chances, wo_local, u_lobe, u1, u2);
    const Vec3 wi = renormalize3(
        add_scaled(add_scaled(scale(tangent, drawn.x), bitangent, drawn.y), s.ns, drawn.z));
    Float pdf;
    Vec3 f = eval_bsdf(b, chances, wo_local, drawn, dot3(s.ng, wi), &pdf);
#if TRANSMISSION
    // Radiance is denser in glass, power is not.
    const Mask crosses = (drawn.z < 0.0f) & (b.transmission > 0.0f) & !b.thin;
    f = scale(f, pick(crosses, b.eta * b.eta, (Float)(1.0f)));
#endif
    f = scale(f, 1.0f / pick(pdf > 0.0f, pdf, (Float)(1.0f)));
    const Float carried = f.x + f.y + f.z;
    const Vec3 after = mul(beta, f);
    const Mask broken = hit & !(after.x + after.y + after.z < INFINITY);
    const Float chance = min(max3(f), (Float)(MAX_SURVIVAL));
    const Mask survives =
        hit & !broken & (pdf > 0.0f) & (carried > 0.0f) & (left_of_choice(chances, u_lobe) < chance);
    const Mask goes_on = survives & (bounce < most_bounces);
    count_photons(photon_counters, PHOTONS_REJECTED, broken);
    count_photons(photon_counters, PHOTONS_ABSORBED, hit & !broken & !survives);
    count_photons(photon_counters, PHOTONS_CUT, survives & !goes_on);
    put_v(path, PATH_BETA_R, scale(after, 1.0f / pick(survives, chance, (Float)(1.0f))));
    put_v(path, PATH_ORIGIN_X, ray_origin(s, wi));
    put_v(path, PATH_DIRECTION_X, wi);
    put_u(path, PATH_STATUS, pick_u(goes_on, status + 1u, pick_u(alive, (UInt)(STATUS_DONE), status)));
}

/// Write down those that have won their slots so far.  After scatter_photons, before the next of them.
///
/// reads   photons.{shadow, light, pdf, toward}, virtual_keys
/// writes  virtual_lights
kernel void settle_virtual_lights(
    __global const Params *params,
    __global float *photons,
    __global const uint *virtual_keys,
    __global VirtualLight *virtual_lights)
{
    const uint item = get_global_id(0);
    if (item >= params->slots / W)
        return;
    __global Float *path = pool_at(photons, item);
    uint slot[W];
    uint key[W];
    uint ng[W];
    float value[6][W];
    const Vec3 p = get_v(path, PATH_SHADOW_X);
    const Vec3 power = get_v(path, PATH_LIGHT_R);
    const Float values[6] = {p.x, p.y, p.z, power.x, power.y, power.z};
    store_lanes_u(get_u(path, PATH_TOWARD_Z), slot);
    store_lanes_u(get_u(path, PATH_TOWARD_Y), key);
    store_lanes_u(get_u(path, PATH_PDF), ng);
    for (uint c = 0; c < 6; ++c)
        store_lanes(values[c], value[c]);
    for (uint k = 0; k < W; ++k)
        if (slot[k] != NO_PLACE && virtual_keys[slot[k]] == key[k])
            vstore8((float8)(value[0][k], value[1][k], value[2][k], as_float(ng[k]), value[3][k], value[4][k],
                             value[5][k], 0.0f),
                    slot[k], (__global float *)virtual_lights);
}
