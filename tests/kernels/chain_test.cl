// The functions of chain.h and splat.h: chains that sample a known density, and sums of splats.

#include "planes.h"
#include "../../cl/common/chain.h"
#include "../../cl/common/splat.h"

/// Density, up to a factor, at two numbers in [0, 1): a ridge on the diagonal that wraps, black at its side.
static inline Float ridge(Float x, Float y)
{
    const Float across = fabs(x - y);
    const Float distance = min(across, 1.0f - across);
    return pick(distance < 0.25f, (0.26f - distance) * (x + 0.1f), (Float)(0.0f));
}

/// Let every chain go `steps` steps from the numbers in `states` (two planes), which become its last.
kernel void walk(
    global const Params *params,
    global float *chains,
    global uint *numbers,
    global uint *states,
    global uint *accepted,
    const uint steps)
{
    const uint item = get_global_id(0);
    __global Float *chain = chain_at(chains, item);
    __global uint *own = chain_numbers_at(params, numbers, item);
    uint lane_number[2][W];
    store_lanes_u(LOAD_U(states, 0), lane_number[0]);
    store_lanes_u(LOAD_U(states, 1), lane_number[1]);
    for (uint k = 0; k < W; ++k)
        for (uint n = 0; n < 2; ++n)
            own[k * params->chain_numbers + n] = lane_number[n][k];
    put_u(chain, CHAIN_PAIRS, (UInt)(1u));
    Float from = ridge(unit_float(LOAD_U(states, 0)), unit_float(LOAD_U(states, 1)));
    UInt count = (UInt)(0u);
    const UInt index = reverse_bits(lanes_before(MASK_ALL) + item * W);
    for (uint step = 1; step <= steps; ++step) {
        const UInt key = path_key(params, (UInt)(step));
        take_step(chain, MASK_ALL, is_large((UInt)(step), params->seed, params->large_steps));
        const Seed seed = chain_seed(params, key, chain, own);
        UInt a;
        UInt b;
        film_bits(seed, index, params->sampler, &a, &b);
        const Float to = ridge(unit_float(a), unit_float(b));
        const Mask moves = accepts(acceptance(from, to), key, index);
        keep_numbers(chain, own, moves, seed, index, params->sampler, (UInt)(1u));
        from = pick(moves, to, from);
        count += pick_u(moves, (UInt)(1u), (UInt)(0u));
    }
    for (uint k = 0; k < W; ++k)
        for (uint n = 0; n < 2; ++n)
            lane_number[n][k] = own[k * params->chain_numbers + n];
    STORE_U(states, 0, load_lanes_u(lane_number[0]));
    STORE_U(states, 1, load_lanes_u(lane_number[1]));
    STORE_U(accepted, 0, count);
}

/// Splat a colour (three planes of `light`) of each lane.
kernel void splat_all(
    global const Params *params,
    global const uint *pass,
    global const uint *pixel,
    global const float *light,
    global SplatSum *splats,
    global uint *counters)
{
    splat(params, splats, counters, LOAD(light, 0) >= 0.0f, LOAD_U(pass, 0), LOAD_U(pixel, 0), LOAD_V(light, 0),
          mix_bits(LOAD_U(pixel, 0)));
}
