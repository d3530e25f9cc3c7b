// The functions of particle_map.h: particles of given cells, one a lane.

#include "planes.h"
#include "../../cl/common/particle_map.h"

/// cells: a number of the cell of each particle; nodes: below which its light is; numbers: its own.
kernel void insert_particles(
    global const Params *params,
    volatile global uint *keys,
    volatile global uint *counts,
    global const uint *cells,
    global const uint *nodes,
    global const uint *numbers)
{
    const UInt place = particle_place(cell_of_hash(params, mix_bits(LOAD_U(cells, 0))), LOAD_U(nodes, 0));
    uint lane_place[W];
    uint lane_key[W];
    store_lanes_u(place, lane_place);
    store_lanes_u(mix_bits(LOAD_U(numbers, 0) ^ params->seed), lane_key);
    for (uint k = 0; k < W; ++k)
        insert_particle(keys, counts, lane_place[k], lane_key[k]);
}

/// After all are in: what those leave that have won.
kernel void settle_particles(
    global const Params *params,
    global const uint *keys,
    global uint *words,
    global const uint *cells,
    global const uint *nodes,
    global const uint *numbers)
{
    const ParticleCell cell = cell_of_hash(params, mix_bits(LOAD_U(cells, 0)));
    uint lane_place[W];
    uint lane_key[W];
    uint lane_word[W];
    store_lanes_u(particle_place(cell, LOAD_U(nodes, 0)), lane_place);
    store_lanes_u(mix_bits(LOAD_U(numbers, 0) ^ params->seed), lane_key);
    store_lanes_u(particle_word(params, cell, LOAD_U(nodes, 0)), lane_word);
    for (uint k = 0; k < W; ++k)
        if (keys[lane_place[k]] == lane_key[k])
            words[lane_place[k]] = lane_word[k];
}

/// The table of each cell's places: one work item W of those in `rows`.
kernel void tabulate(
    global const Params *params,
    global const uint *words,
    global const uint *counts,
    global uint *kinds,
    global uint *sums,
    global uint *runs,
    global const uint *rows)
{
    for (uint k = 0; k < W; ++k)
        tabulate_cell(params, words, counts, kinds, sums, runs, rows[get_global_id(0) * W + k]);
}

/// Share of the particles of a cell that are from below a node.
kernel void list_shares(
    global const Params *params,
    global const uint *kinds,
    global const uint *sums,
    global const uint *runs,
    global const uint *cells,
    global const uint *nodes,
    global float *shares,
    global float *kept)
{
    Float rest;
    const ParticleCell cell = find_run(params, kinds, runs, cell_of_hash(params, mix_bits(LOAD_U(cells, 0))));
    STORE(shares, 0, particle_chance(params, kinds, sums, runs, MASK_ALL, cell, LOAD_U(nodes, 0), &rest));
    STORE(kept, 0, rest);
}

/// A draw of `bits`: what is kept, whether it is blind, and of the others the node and its chance.
kernel void draw_particles(
    global const Params *params,
    global const uint *kinds,
    global const uint *sums,
    global const uint *runs,
    global const uint *cells,
    global const uint *bits,
    global uint *nodes,
    global uint *blinds,
    global float *chances,
    global float *kept,
    global float *again)
{
    const ParticleCell cell = cell_of_hash(params, mix_bits(LOAD_U(cells, 0)));
    ParticleCell sizes[PARTICLE_SIZES];
    for (uint size = 0; size < PARTICLE_SIZES; ++size)
        sizes[size] = cell;
    UInt random = LOAD_U(bits, 0);
    UInt node;
    Float rest;
    Mask blind;
    STORE(chances, 0, choose_particle(params, kinds, sums, runs, MASK_ALL, sizes, &random, &node, &rest, &blind));
    STORE(kept, 0, rest);
    STORE_U(nodes, 0, node);
    STORE_U(blinds, 0, pick_u(blind, (UInt)(1u), (UInt)(0u)));
    STORE(again, 0, particle_chance(params, kinds, sums, runs, MASK_ALL, sizes[0], node, &rest));
}

/// The first place of each cell, and what tells its particles from others.
kernel void list_cells(
    global const Params *params, global const uint *cells, global uint *places, global uint *prints)
{
    const ParticleCell cell = cell_of_hash(params, mix_bits(LOAD_U(cells, 0)));
    STORE_U(places, 0, cell.place);
    STORE_U(prints, 0, cell.print);
}
