// The functions of light.h, one point a lane.

#include "planes.h"
#include "../../cl/common/light.h"

/// Everything that sample_light returns; `active` of 0 is a dead lane.
kernel void sample_lights(
    global const Params *params,
    global const Light *lights,
    global const Surface *surfaces,
    global const Material *materials,
#if TEXTURES
    global const Uvs *uvs,
    global const TextureInfo *textures,
    global const uchar4 *texels,
    global const float *srgb_to_linear,
#endif
#if ENVIRONMENT == 2
    global const EnvironmentCell *cells,
#endif
    global const uint *active,
    global const float *origin,
    global const uint *pixel,
    global const uint *sample,
    global float *toward,
    global float *wi,
    global float *radiance,
    global float *pdfs,
    global uint *extended)
{
    const UInt seed = pixel_seed(LOAD_U(pixel, 0), params->seed);
    const UInt index = reverse_bits(LOAD_U(sample, 0));
    const UInt pair = (UInt)(PAIR_VERTEX);
    const VertexBits numbers = vertex_bits(seed, index, pair, params->sampler);
    LightQuery query;
    query.p = LOAD_V(origin, 0);
    query.n = query.p;
    const LightChoice light = choose_light(params, lights, LOAD_U(active, 0) != 0u, query, numbers.choice.second);
    const LightSample s = sample_light(params, lights, surfaces, materials,
#if TEXTURES
                                       uvs, textures, texels, srgb_to_linear,
#endif
#if ENVIRONMENT == 2
                                       cells,
#endif
                                       LOAD_U(active, 0) != 0u, LOAD_V(origin, 0), unit_float(numbers.light.first),
                                       unit_float(numbers.light.second), seed, index, pair, light);
    store_vec3(toward, 0, s.toward);
    store_vec3(wi, 0, s.wi);
    store_vec3(radiance, 0, s.radiance);
    STORE(pdfs, 0, s.pdf);
    STORE_U(extended, 0, pick_u(s.extended, (UInt)(1u), (UInt)(0u)));
}

/// hits: distance and cosine at points of the emitters `light`.
kernel void list_densities(
    global const Light *lights, global const uint *light, global const float *hits, global float *pdfs)
{
#if AREA_LIGHTS
    const Float chance = GATHER(lights, LOAD_U(light, 0), pmf);
    STORE(pdfs, 0, area_light_density(lights, LOAD_U(light, 0), chance, LOAD(hits, 0), LOAD(hits, 1)));
#endif
}

/// What alias_slot makes of bits.
kernel void list_slots(global const uint *bits, global uint *slots, global float *left, const uint count)
{
    Float rest;
    STORE_U(slots, 0, alias_slot(LOAD_U(bits, 0), (UInt)(count), &rest));
    STORE(left, 0, rest);
}

kernel void look_up_sky(
    global const Params *params,
    global const Light *lights,
#if ENVIRONMENT == 2
    global const EnvironmentCell *cells,
#endif
    global const float *directions,
    global float *radiance,
    global float *pdfs)
{
#if ENVIRONMENT
    Float pdf;
    const Vec3 value = eval_environment(params,
#if ENVIRONMENT == 2
                                        cells,
#endif
                                        LOAD_V(directions, 0),
                                        (Float)(lights[params->environment_light].pmf), &pdf);
    store_vec3(radiance, 0, value);
    STORE(pdfs, 0, pdf);
#endif
}

kernel void weigh_densities(global const float *a, global const float *b, global float *weights)
{
    STORE(weights, 0, power_heuristic(LOAD(a, 0), LOAD(b, 0)));
}
