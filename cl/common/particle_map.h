// Particles in a table without keys: of those that meet in a place the one with the least random number
// stays, and a counter knows how many there were.
//
// A cell has PARTICLE_PLACES places side by side; cells may share them, and what is found counts only
// if it came from the cell that is asked for.  Random numbers are a bijection of the particles' numbers:
// 32 bits both order them and tell them apart.
//
// What is asked is a table that is made of the map before the paths start: a record for each row of places,
// of the cell that most of its particles came to.
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

#define NO_PLACE 0xffffffffu // of the map, or row of the table

// A larger cell is asked where this one's news are as likely as that.
#define STALE_NEWS 0.1f

// Words of a record of the table: nodes in order, then the shares of each and all before it.
#define RECORD_PRINT 0u
#define RECORD_LENGTH 1u // how many nodes
#define RECORD_KEPT 2u   // chance of drawing a light whatever they say, float
#define RECORD_NEWS 3u   // how likely the next particle is of a new kind, float
#define RECORD_NODES 4u
#define RECORD_SHARES (RECORD_NODES + PARTICLE_KINDS)
#if PHOTON_POINTS
#define RECORD_POINTS (RECORD_SHARES + PARTICLE_KINDS) // where on the light the particle started
#define RECORD_WORDS (RECORD_POINTS + PARTICLE_KINDS)
#define POINT_PARAMETERS , __global const uint *points
#define POINT_ARGUMENTS , particle_points
#else
#define RECORD_WORDS (RECORD_SHARES + PARTICLE_KINDS)
#define POINT_PARAMETERS
#define POINT_ARGUMENTS
#endif

/// Return the print of the cell that most particles of a row of places came from; `*most`: how many.
static inline uint main_cell(
    __global const Params *params, __global const uint *words, __global const uint *counts, uint base, uint *most)
{
    uint best = 0;
    *most = 0;
    for (uint i = base; i < base + PARTICLE_PLACES; ++i) {
        const uint print = words[i] >> params->node_bits;
        if (counts[i] == 0 || (*most > 0 && print == best))
            continue;
        uint total = 0;
        for (uint j = i; j < base + PARTICLE_PLACES; ++j)
            total += counts[j] > 0 && words[j] >> params->node_bits == print ? counts[j] : 0u;
        if (total > *most) {
            *most = total;
            best = print;
        }
    }
    return best;
}

/// Return how many particles came to the main cell of a row of places; `*kinds`: to how many places of it.
static inline uint count_in_row(
    __global const Params *params, __global const uint *words, __global const uint *counts, uint row, uint *kinds)
{
    uint total;
    const uint base = row * PARTICLE_PLACES;
    const uint print = main_cell(params, words, counts, base, &total);
    *kinds = 0;
    for (uint i = base; i < base + PARTICLE_PLACES; ++i)
        *kinds += counts[i] > 0 && words[i] >> params->node_bits == print;
    return total;
}

/// Make the record of a row of places: of the cell in it that most particles came to.
///
/// Of its nodes those stay that most came from; what the others had is kept for any light.  How likely news
/// are is Good's estimate (The Population Frequencies of Species, Biometrika 40, 1953): as likely as
/// particles were the only ones of their kind.
static inline void tabulate_row(
    __global const Params *params,
    __global const uint *words,
    __global const uint *counts POINT_PARAMETERS,
    __global uint *table,
    uint row)
{
    const uint node_mask = (1u << params->node_bits) - 1u;
    const uint base = row * PARTICLE_PLACES;
    uint total;
    const uint print = main_cell(params, words, counts, base, &total);
    uint count[PARTICLE_KINDS];
    uint at_place[PARTICLE_KINDS];
    uint length = 0;
    uint alone = 0;
    for (uint place = base; place < base + PARTICLE_PLACES; ++place) {
        const uint own = counts[place];
        if (own == 0 || words[place] >> params->node_bits != print)
            continue;
        alone += own == 1u;
        // Most first; the last one gives way.
        if (length == PARTICLE_KINDS && own <= count[PARTICLE_KINDS - 1u])
            continue;
        uint at = length < PARTICLE_KINDS ? length++ : PARTICLE_KINDS - 1u;
        for (; at > 0 && count[at - 1u] < own; --at) {
            count[at] = count[at - 1u];
            at_place[at] = at_place[at - 1u];
        }
        count[at] = own;
        at_place[at] = place;
    }
    for (uint i = 1; i < length; ++i) {
        const uint own = count[i];
        const uint place = at_place[i];
        uint at = i;
        // Of one cell: what tells the words apart is the node.
        for (; at > 0 && words[at_place[at - 1u]] > words[place]; --at) {
            count[at] = count[at - 1u];
            at_place[at] = at_place[at - 1u];
        }
        count[at] = own;
        at_place[at] = place;
    }
    uint kept_of = 0;
    for (uint i = 0; i < length; ++i)
        kept_of += count[i];
    __global uint *record = table + row * RECORD_WORDS;
    uint up_to = 0;
    for (uint i = 0; i < length; ++i) {
        up_to += count[i];
        record[RECORD_NODES + i] = words[at_place[i]] & node_mask;
#if PHOTON_POINTS
        record[RECORD_POINTS + i] = points[at_place[i]];
#endif
        record[RECORD_SHARES + i] = as_uint((float)up_to / (float)kept_of);
    }
    const float news = ((float)alone + 1.0f) / ((float)total + 1.0f);
    const float lost = (float)(total - kept_of) / (float)max(total, 1u);
    record[RECORD_PRINT] = print;
    record[RECORD_LENGTH] = length;
    record[RECORD_KEPT] = as_uint(min(max(news, params->photon_floor) + lost, 1.0f));
    record[RECORD_NEWS] = as_uint(news);
}

static inline UInt record_word(__global const uint *table, UInt row, uint word)
{
    return GATHER_WORD(table, row * RECORD_WORDS + word);
}

static inline Float record_float(__global const uint *table, UInt row, uint word)
{
    return from_bits(record_word(table, row, word));
}

/// Return the row of the smallest cell of all sizes around `p` that knows enough; NO_PLACE where none knows
/// anything.
static inline UInt find_row(
    __global const Params *params, __global const uint *table, Mask active, Vec3 p, Vec3 ng)
{
    UInt row = (UInt)(NO_PLACE);
    Mask asks = active;
    for (uint size = 0; size < PARTICLE_SIZES && any_lane(asks); ++size) {
        const ParticleCell cell = particle_cell(params, p, ng, size);
        const UInt asked = cell.place / PARTICLE_PLACES;
        const Mask found = asks & (record_word(table, asked, RECORD_PRINT) == cell.print)
                           & (record_word(table, asked, RECORD_LENGTH) > 0u);
        row = pick_u(found, asked, row);
        asks &= !(found & (record_float(table, asked, RECORD_NEWS) < STALE_NEWS));
    }
    return row;
}

/// Chance of drawing any light, whatever the particles of a row say.
static inline Float row_keeps(__global const uint *table, Mask known, UInt row)
{
    return pick(known, record_float(table, pick_u(known, row, (UInt)(0u)), RECORD_KEPT), (Float)(1.0f));
}

/// Share of the node `i` of a row.
static inline Float node_share(__global const uint *table, UInt row, UInt i)
{
    const UInt at = row * RECORD_WORDS + RECORD_SHARES + i;
    const Float before = from_bits(GATHER_WORD(table, pick_u(i > 0u, at - 1u, at)));
    return from_bits(GATHER_WORD(table, at)) - pick(i > 0u, before, (Float)(0.0f));
}

/// Return how many of the `length` words from `first` on are less than `limit`; they rise.
///
/// Of floats that are not negative the bits rise too.
static inline UInt count_below(__global const uint *words, UInt first, UInt length, UInt limit)
{
    UInt count = (UInt)(0u);
    for (uint step = 16u; step > 0; step >>= 1) {
        const UInt next = count + step;
        const Mask inside = next <= length;
        if (!any_lane(inside))
            continue;
        const UInt word = GATHER_WORD(words, first + pick_u(inside, next - 1u, (UInt)(0u)));
        count = pick_u(inside & (word < limit), next, count);
    }
    return count;
}

/// Return which of the nodes of a row `node` is; `*own`: whether it is one of them.
static inline UInt node_index(__global const uint *table, Mask known, UInt row, UInt node, Mask *own)
{
    const UInt length = pick_u(known, record_word(table, row, RECORD_LENGTH), (UInt)(0u));
    const UInt first = row * RECORD_WORDS + RECORD_NODES;
    const UInt before = count_below(table, first, length, node);
    const UInt i = pick_u(before < length, before, (UInt)(0u));
    *own = (before < length) & (GATHER_WORD(table, first + i) == node);
    return i;
}

/// Chance of `node` where one of a row is drawn.
static inline Float node_chance(__global const uint *table, Mask active, UInt row, UInt node)
{
    const Mask known = active & (row != NO_PLACE);
    row = pick_u(known, row, (UInt)(0u));
    Mask own;
    const UInt i = node_index(table, known, row, node, &own);
    return pick(own, node_share(table, row, i), (Float)(0.0f));
}

#if PHOTON_POINTS
/// Where on the light of `node` the particle started that a row has of it.
static inline UInt node_point(__global const uint *table, Mask active, UInt row, UInt node)
{
    row = pick_u(active, row, (UInt)(0u));
    Mask own;
    const UInt i = node_index(table, active, row, node, &own);
    return GATHER_WORD(table, row * RECORD_WORDS + RECORD_POINTS + pick_u(own, i, (UInt)(0u)));
}
#endif

/// Draw a node of a row by `*u` in [0, 1), of which is left what is uniform in the node; `*part` is its chance,
/// as node_chance says.
static inline UInt choose_node(__global const uint *table, Mask active, UInt row, Float *u, Float *part)
{
    row = pick_u(active, row, (UInt)(0u));
    const UInt length = pick_u(active, record_word(table, row, RECORD_LENGTH), (UInt)(0u));
    const UInt first = row * RECORD_WORDS;
    // Above 0: a node without a share is not drawn.
    const UInt below = count_below(table, first + RECORD_SHARES, length, as_bits(*u + 0x1p-25f));
    const UInt i = min(below, pick_u(length > 0u, length - 1u, (UInt)(0u)));
    const UInt at = first + RECORD_SHARES + i;
    const Float before =
        pick(i > 0u, from_bits(GATHER_WORD(table, pick_u(i > 0u, at - 1u, at))), (Float)(0.0f));
    *part = node_share(table, row, i);
    *u = pick(active, (*u - before) / max(*part, 1e-9f), *u);
    return GATHER_WORD(table, first + RECORD_NODES + i);
}
