// Particles in a table without keys: of those that meet in a place the one with the least random number
// stays, and a counter knows how many there were.
//
// A cell has PARTICLE_PLACES places side by side; cells may share them, and what is found counts only
// if it came from the cell that is asked for.  Random numbers are a bijection of the particles' numbers:
// 32 bits both order them and tell them apart.
//
// What is asked is a table that is made of the map before the paths start: the words of a cell's places in
// order, so that those of the same cell make a run, and sums of the particles along each run.
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
static inline Float chance_of_news(UInt total, UInt alone)
{
    return (to_float(alone) + 1.0f) / (to_float(total) + 1.0f);
}

// A larger cell is asked where this one's news are as likely as that.
#define STALE_NEWS 0.1f

/// Make the table of a cell's places and of all the cells that share them.
///
/// `kinds`: their words in order; `sums`: particles of the run up to there and with it; `runs`: at the first
/// of a run its length << 8 | how many came alone, else 0; at the first place of all, too, << 16 how many are
/// in use, for a search that reads no more than these.  Where nothing came all stays as it was cleared:
/// kinds all ones, runs 0.
static inline void tabulate_cell(
    __global const Params *params,
    __global const uint *words,
    __global const uint *counts,
    __global uint *kinds,
    __global uint *sums,
    __global uint *runs,
    uint cell)
{
    const uint base = cell * PARTICLE_PLACES;
    const uint node_bits = params->node_bits;
    uint kind[PARTICLE_PLACES];
    uint count[PARTICLE_PLACES];
    uint used = 0;
    for (uint place = base; place < base + PARTICLE_PLACES; ++place) {
        if (counts[place] == 0)
            continue;
        const uint word = words[place];
        uint i = used++;
        for (; i > 0 && kind[i - 1u] > word; --i) {
            kind[i] = kind[i - 1u];
            count[i] = count[i - 1u];
        }
        kind[i] = word;
        count[i] = counts[place];
    }
    uint i = 0;
    while (i < used) {
        const uint first = i;
        uint sum = 0;
        uint alone = 0;
        for (; i < used && kind[i] >> node_bits == kind[first] >> node_bits; ++i) {
            sum += count[i];
            alone += count[i] == 1u;
            kinds[base + i] = kind[i];
            sums[base + i] = sum;
            runs[base + i] = 0;
        }
        runs[base + first] = (i - first) << 8 | alone | (first == 0 ? used << 16 : 0u);
    }
}

/// The particles of a cell in the table, per lane.
typedef struct {
    UInt length; // places of its run; 0 where none came
    UInt total;  // particles
    Float news;  // how likely the next one is of a new kind
} ParticleRun;

/// Return how many of the `length` values from `first` on are less than `limit`; they rise.
static inline UInt count_below(__global const uint *values, UInt first, UInt length, UInt limit)
{
    UInt count = 0;
    for (uint step = PARTICLE_PLACES; step > 0; step >>= 1) {
        const UInt next = count + step;
        const Mask inside = next <= length;
        if (!any_lane(inside))
            continue;
        const UInt value = GATHER_WORD(values, first + pick_u(inside, next - 1u, (UInt)(0u)));
        count = pick_u(inside & (value < limit), next, count);
    }
    return count;
}

/// Return the cell as choose_particle and particle_chance know it: its place is the first of its run.
static inline ParticleCell find_run(
    __global const Params *params, __global const uint *kinds, __global const uint *runs, ParticleCell cell)
{
    const UInt used = GATHER_WORD(runs, cell.place) >> 16;
    const UInt before = count_below(kinds, cell.place, used, cell.print << params->node_bits);
    cell.place += min(before, (UInt)(PARTICLE_PLACES - 1u));
    return cell;
}

/// Return the run of a cell that find_run has returned.
static inline ParticleRun run_of_cell(
    __global const Params *params,
    __global const uint *kinds,
    __global const uint *sums,
    __global const uint *runs,
    ParticleCell cell)
{
    const Mask found = GATHER_WORD(kinds, cell.place) >> params->node_bits == cell.print;
    const UInt both = pick_u(found, GATHER_WORD(runs, cell.place), (UInt)(0u));
    ParticleRun run;
    run.length = both >> 8 & 0xffu;
    const Mask known = run.length != 0u;
    const UInt last = cell.place + pick_u(known, run.length - 1u, (UInt)(0u));
    run.total = pick_u(known, GATHER_WORD(sums, last), (UInt)(0u));
    run.news = chance_of_news(run.total, both & 0xffu);
    return run;
}

/// Particles of the place `i` of the run that starts at `first`.
static inline UInt particles_at(__global const uint *sums, UInt first, UInt i)
{
    const UInt before = GATHER_WORD(sums, first + pick_u(i > 0u, i - 1u, (UInt)(0u)));
    return GATHER_WORD(sums, first + i) - pick_u(i > 0u, before, (UInt)(0u));
}

/// Chance of `node` among the particles of a cell that find_run has returned; `*kept` that of drawing a light
/// whatever they say.
LARGE_FUNCTION Float particle_chance(
    __global const Params *params,
    __global const uint *kinds,
    __global const uint *sums,
    __global const uint *runs,
    Mask active,
    ParticleCell cell,
    UInt node,
    Float *kept)
{
    cell.place = pick_u(active, cell.place, (UInt)(0u));
    const ParticleRun run = run_of_cell(params, kinds, sums, runs, cell);
    const Mask known = active & (run.length != 0u);
    const UInt word = particle_word(params, cell, node);
    const UInt before = count_below(kinds, cell.place, run.length, word);
    const UInt i = pick_u(known & (before < run.length), before, (UInt)(0u));
    const Mask own = known & (GATHER_WORD(kinds, cell.place + i) == word);
    *kept = pick(known, max(run.news, params->photon_floor), (Float)(1.0f));
    return pick(own, to_float(particles_at(sums, cell.place, i)) / to_float(run.total), (Float)(0.0f));
}

/// Draw the node of one of the particles by their counts, and of 32 random bits whether to draw one.
///
/// `cells`: those of all sizes; the smallest that knows enough answers, and is left in cells[0] as find_run
/// returns it.  `*kept` as particle_chance has it; `*blind` where a light is to be drawn whatever particles
/// say; `*bits` is uniform again.
LARGE_FUNCTION Float choose_particle(
    __global const Params *params,
    __global const uint *kinds,
    __global const uint *sums,
    __global const uint *runs,
    Mask active,
    ParticleCell *cells,
    UInt *bits,
    UInt *node,
    Float *kept,
    Mask *blind)
{
    ParticleCell cell = cells[0];
    ParticleRun run;
    run.length = (UInt)(0u);
    run.total = (UInt)(0u);
    run.news = (Float)(1.0f);
    Mask asks = active;
    for (uint size = 0; size < PARTICLE_SIZES && any_lane(asks); ++size) {
        const ParticleCell wider = find_run(params, kinds, runs, cells[size]);
        const ParticleRun found = run_of_cell(params, kinds, sums, runs, wider);
        cell.place = pick_u(asks, wider.place, cell.place);
        cell.print = pick_u(asks, wider.print, cell.print);
        run.length = pick_u(asks, found.length, run.length);
        run.total = pick_u(asks, found.total, run.total);
        run.news = pick(asks, found.news, run.news);
        asks = asks & (found.news >= STALE_NEWS);
    }
    cells[0] = cell;
    const Mask known = active & (run.length != 0u);
    const Float blindly = max(run.news, params->photon_floor);
    *kept = pick(known, blindly, (Float)(1.0f));
    // What is left of the number is uniform either way; digits that it has run out of are made up.
    const Float u = to_float(*bits >> 8) * 0x1p-24f;
    const Mask low = u < blindly;
    const Mask seen = known & !low;
    *blind = active & !seen;
    const Float rest = pick(low, u / blindly, (u - blindly) / (1.0f - blindly));
    const UInt fresh =
        to_uint(clamp(rest, (Float)(0.0f), (Float)(0x1.fffffep-1f)) * 0x1p32f) ^ (*bits & 0xffu);
    *bits = pick_u(known, fresh, *bits);
    *node = (UInt)(0u);
    if (!any_lane(seen))
        return (Float)(0.0f);
    const UInt first = pick_u(seen, cell.place, (UInt)(0u));
    const UInt above = mul_hi(fresh, run.total);
    const UInt i = pick_u(seen, count_below(sums, first, run.length, above + 1u), (UInt)(0u));
    *bits = pick_u(seen, (fresh ^ (fresh >> 15)) * 0x2c1b3c6du, *bits);
    *node = pick_u(seen, GATHER_WORD(kinds, first + i) & ((1u << params->node_bits) - 1u), (UInt)(0u));
    return pick(seen, to_float(particles_at(sums, first, i)) / to_float(run.total), (Float)(0.0f));
}
