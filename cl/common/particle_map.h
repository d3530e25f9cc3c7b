// Particles in a table without keys: of those that meet in a place the one with the least random number
// stays, and a counter knows how many there were.
//
// A cell has PARTICLE_PLACES places side by side; cells may share them, and what is found counts only
// if it came from the cell that is asked for.  Random numbers are a bijection of the particles' numbers:
// 32 bits both order them and tell them apart.
//
// Binder, Keller: Ray-Traced Global Illumination for Games, GTC 2019 ("stochastically hashed particle
// maps"); Hachisuka, Jensen: Parallel Progressive Photon Mapping on GPUs, SIGGRAPH Asia Sketches 2010.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "cells.h"
#include "light_tree.h"
#include "unit_vector.h"

/// A cell of the map, per lane.
typedef struct {
    UInt place; // index of its first place
    UInt print; // tells its particles from others
} ParticleCell;

/// Return the cell of a hash of all that tells cells apart.
static inline ParticleCell cell_of_hash(__global const Params *params, UInt hash)
{
    ParticleCell cell;
    cell.place = (hash & (params->particle_cells - 1u)) * PARTICLE_PLACES;
    cell.print = mix_bits_too(hash) >> params->node_bits;
    return cell;
}

/// Count a particle in its place; the least `key` that ever came stays there.
static inline void insert_particle(
    volatile __global uint *keys, volatile __global uint *counts, uint place, uint key)
{
    atomic_min(&keys[place], key);
    atomic_inc(&counts[place]);
}

/// Return a point that is moved in its tangent plane by up to half a cell.
static inline Vec3 jittered(__global const Params *params, Vec3 p, Vec3 ng, UInt random_x, UInt random_y)
{
    const Vec3 d = sub(p, vec3_of(params->camera_origin));
    const Float edge = params->particle_cell * sqrt(dot3(d, d));
    Vec3 s;
    Vec3 t;
    make_frame(ng, &s, &t);
    return add_scaled(add_scaled(p, s, (unit_float(random_x) - 0.5f) * edge), t, (unit_float(random_y) - 0.5f) * edge);
}

/// Return the cell of a point; `size` 0 for the smallest, each larger one is four times as wide.
///
/// Edges follow the distance from the camera.
static inline ParticleCell particle_cell(__global const Params *params, Vec3 p, Vec3 ng, uint size)
{
    const Vec3 d = sub(p, vec3_of(params->camera_origin));
    const UInt level = cell_level(params->particle_cell * sqrt(dot3(d, d)), (Float)(1.0f)) + 2u * size;
    // Walls lie on planes of round numbers: the grid is shifted off these.  Adding 0 takes a zero's sign.
    const Float inverse = 1.0f / cell_edge(level);
    const UInt x = as_bits(floor(p.x * inverse + 0.37f) + 0.0f);
    const UInt y = as_bits(floor(p.y * inverse + 0.61f) + 0.0f);
    const UInt z = as_bits(floor(p.z * inverse + 0.83f) + 0.0f);
    UInt index = mix_bits(level * 32u + cube_face(ng) * 4u + size);
    index = mix_bits(index + x);
    index = mix_bits(index + y);
    return cell_of_hash(params, mix_bits(index + z));
}

/// What a particle from the lights below a node of the tree leaves in a place of the cell.
static inline UInt particle_word(__global const Params *params, ParticleCell cell, UInt node)
{
    return cell.print << params->node_bits | node;
}

/// Place of the cell that the particles of a node come to: other ones share it in other cells.
static inline UInt particle_place(ParticleCell cell, UInt node)
{
    return cell.place + (mix_bits(node ^ rotate(cell.print, (UInt)(7u))) & (PARTICLE_PLACES - 1u));
}

/// What a cell is worth: how many particles it has seen, and how likely the next one is of a new kind.
///
/// Good: The Population Frequencies of Species and the Estimation of Population Parameters, Biometrika
/// 40, 1953: as likely as particles were the only ones of their kind.
static inline float chance_of_news(uint total, uint alone) { return (alone + 1.0f) / (total + 1.0f); }

// A larger cell is asked where this one's news are as likely as that.
#define STALE_NEWS 0.1f

/// Chance of `node` among the particles of the cell; `*kept` that of drawing a light whatever they say.
LARGE_FUNCTION Float particle_chance(
    __global const Params *params,
    __global const uint *words,
    __global const uint *counts,
    Mask active,
    ParticleCell cell,
    UInt node,
    Float *kept)
{
    uint lane_place[W];
    uint lane_print[W];
    uint lane_node[W];
    float lane_chance[W];
    float lane_kept[W];
    store_lanes_u(cell.place, lane_place);
    store_lanes_u(cell.print, lane_print);
    store_lanes_u(node, lane_node);
    store_lanes((Float)(0.0f), lane_chance);
    store_lanes((Float)(1.0f), lane_kept);
    const uint node_bits = params->node_bits;
    for (uint left = lane_bits(active); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        uint total = 0;
        uint alone = 0;
        uint own = 0;
        const uint wanted = lane_print[k] << node_bits | lane_node[k];
        for (uint i = 0; i < PARTICLE_PLACES; ++i) {
            const uint word = words[lane_place[k] + i];
            const uint count = word >> node_bits == lane_print[k] ? counts[lane_place[k] + i] : 0u;
            total += count;
            alone += count == 1u;
            own += word == wanted ? count : 0u;
        }
        if (total == 0)
            continue;
        lane_chance[k] = (float)own / (float)total;
        lane_kept[k] = max(chance_of_news(total, alone), params->photon_floor);
    }
    *kept = load_lanes(lane_kept);
    return load_lanes(lane_chance);
}

/// Draw the node of one of the particles by their counts, and of 32 random bits whether to draw one.
///
/// `cells`: those of all sizes; the smallest that knows enough answers, and is left in cells[0].
/// `*kept` as particle_chance has it; `*blind` where a light is to be drawn whatever particles say; `*bits`
/// is uniform again.
LARGE_FUNCTION Float choose_particle(
    __global const Params *params,
    __global const uint *words,
    __global const uint *counts,
    Mask active,
    ParticleCell *cells,
    UInt *bits,
    UInt *node,
    Float *kept,
    Mask *blind)
{
    uint lane_place[PARTICLE_SIZES][W];
    uint lane_print[PARTICLE_SIZES][W];
    uint lane_bits_of[W];
    uint lane_node[W];
    uint lane_blind[W];
    float lane_chance[W];
    float lane_kept[W];
    for (uint size = 0; size < PARTICLE_SIZES; ++size) {
        store_lanes_u(cells[size].place, lane_place[size]);
        store_lanes_u(cells[size].print, lane_print[size]);
    }
    store_lanes_u(*bits, lane_bits_of);
    store_lanes_u((UInt)(0u), lane_node);
    store_lanes_u((UInt)(1u), lane_blind);
    store_lanes((Float)(0.0f), lane_chance);
    store_lanes((Float)(1.0f), lane_kept);
    const uint node_bits = params->node_bits;
    for (uint left = lane_bits(active); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        uint weight[PARTICLE_PLACES];
        uint total = 0;
        float news = 1.0f;
        __global const uint *word = words;
        for (uint size = 0; size < PARTICLE_SIZES; ++size) {
            const uint print = lane_print[size][k];
            word = words + lane_place[size][k];
            __global const uint *count = counts + lane_place[size][k];
            uint alone = 0;
            total = 0;
            for (uint i = 0; i < PARTICLE_PLACES; ++i) {
                weight[i] = word[i] >> node_bits == print ? count[i] : 0u;
                total += weight[i];
                alone += weight[i] == 1u;
            }
            lane_place[0][k] = lane_place[size][k];
            lane_print[0][k] = print;
            news = chance_of_news(total, alone);
            if (news < STALE_NEWS)
                break;
        }
        if (total == 0)
            continue;
        const float blindly = max(news, params->photon_floor);
        lane_kept[k] = blindly;
        // What is left of the number is uniform either way; digits that it has run out of are made up.
        const float u = (float)(lane_bits_of[k] >> 8) * 0x1p-24f;
        lane_blind[k] = u < blindly;
        const float rest = u < blindly ? u / blindly : (u - blindly) / (1.0f - blindly);
        const uint fresh = (uint)(clamp(rest, 0.0f, 0x1.fffffep-1f) * 0x1p32f) ^ (lane_bits_of[k] & 0xffu);
        lane_bits_of[k] = fresh;
        if (u < blindly)
            continue;
        uint above = mul_hi(fresh, total);
        uint i = 0;
        while (i + 1u < PARTICLE_PLACES && above >= weight[i]) {
            above -= weight[i];
            ++i;
        }
        // Particles of a node all come to one place of a cell.
        lane_chance[k] = (float)weight[i] / (float)total;
        lane_node[k] = word[i] & ((1u << node_bits) - 1u);
        lane_bits_of[k] = (fresh ^ (fresh >> 15)) * 0x2c1b3c6du;
    }
    cells[0].place = load_lanes_u(lane_place[0]);
    cells[0].print = load_lanes_u(lane_print[0]);
    *bits = load_lanes_u(lane_bits_of);
    *node = load_lanes_u(lane_node);
    *blind = active & (load_lanes_u(lane_blind) != 0u);
    *kept = load_lanes(lane_kept);
    return load_lanes(lane_chance);
}
