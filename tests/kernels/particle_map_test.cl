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

/// The table of the places: one work item W rows of them.
kernel void tabulate(
    global const Params *params,
    global const uint *words,
    global const uint *counts,
    global uint *table,
    global const uint *rows)
{
    for (uint k = 0; k < W; ++k)
        tabulate_row(params, words, counts, table, rows[get_global_id(0) * W + k]);
}

/// Row of a cell, if that is what the row tells of.
static UInt row_of(global const Params *params, global const uint *table, UInt number)
{
    const ParticleCell cell = cell_of_hash(params, mix_bits(number));
    const UInt row = cell.place / PARTICLE_PLACES;
    const Mask own = (record_word(table, row, RECORD_PRINT) == cell.print)
                     & (record_word(table, row, RECORD_LENGTH) > 0u);
    return pick_u(own, row, (UInt)(NO_PLACE));
}

/// Chance of a node among those of a cell, and of any light.
kernel void list_shares(
    global const Params *params,
    global const uint *table,
    global const uint *cells,
    global const uint *nodes,
    global float *shares,
    global float *kept)
{
    const UInt row = row_of(params, table, LOAD_U(cells, 0));
    STORE(shares, 0, node_chance(table, MASK_ALL, row, LOAD_U(nodes, 0)));
    STORE(kept, 0, row_keeps(table, row != NO_PLACE, row));
}

/// A draw by a number, what is left of it, and the chance of the node.
kernel void draw_particles(
    global const Params *params,
    global const uint *table,
    global const uint *cells,
    global const float *numbers,
    global uint *nodes,
    global float *left,
    global float *chances)
{
    const UInt row = row_of(params, table, LOAD_U(cells, 0));
    Float u = LOAD(numbers, 0);
    Float part;
    const UInt node = choose_node(table, row != NO_PLACE, row, &u, &part);
    STORE_U(nodes, 0, node);
    STORE(left, 0, u);
    STORE(chances, 0, pick(part == node_chance(table, MASK_ALL, row, node), part, (Float)(NAN)));
}

/// What is left of random bits below `part`.
kernel void go_on(
    global const Params *params, global const uint *bits, global const float *parts, global uint *left)
{
    const Float part = LOAD(parts, 0);
    const UInt drawn = LOAD_U(bits, 0);
    STORE_U(left, 0, digits_left(unit_float(drawn) / part, part, mix_bits(drawn + 0x9e3779b9u)));
}

/// The first place of each cell, and what tells its particles from others.
kernel void list_cells(
    global const Params *params, global const uint *cells, global uint *places, global uint *prints)
{
    const ParticleCell cell = cell_of_hash(params, mix_bits(LOAD_U(cells, 0)));
    STORE_U(places, 0, cell.place);
    STORE_U(prints, 0, cell.print);
}
