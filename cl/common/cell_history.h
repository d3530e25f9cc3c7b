// What cells know from the frames before.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "cells.h"
#include "cell_samples.h"
#include "hash_map.h"
#include "history.h"

#if CELL_HISTORY == 2
#define CHANGE_BUFFER , __global const uint *cell_changes
#define CHANGE_ARGUMENT , cell_changes

/// Change of the light where points are, 0 to 1: that of their cell, of the coarser one where no probe was in
/// it, and the largest of all where none was there either.
static inline Float change_in_cell(
    __global const Params *params, const CellQuery *query, CellPlace at, UInt a, UInt b, uint jitter CHANGE_BUFFER)
{
    if (!(params->history_flags & HISTORY_CHANGED) || params->temporal_rule != RULE_ADAPTIVE)
        return (Float)(0.0f);
    const CellPlace coarser = cell_place(params, query, a, b, jitter, (UInt)(1u));
    const UInt own = GATHER_WORD(cell_changes, entry_of(params, at));
    const UInt around = GATHER_WORD(cell_changes, entry_of(params, coarser));
    const UInt found = pick_u(own != 0u, own, pick_u(around != 0u, around, (UInt)(cell_changes[params->cell_slots])));
    return max(from_bits(found) - 1.0f, 0.0f);
}
#else
#define CHANGE_BUFFER
#define CHANGE_ARGUMENT
#define change_in_cell(params, query, at, a, b, jitter) ((Float)(0.0f))
#endif

#if CELL_HISTORY
#define KNOWN_BUFFERS                                                                              \
    , __global const uint *kept_keys, __global const CellHistory *kept_cells CHANGE_BUFFER
#define KNOWN_ARGUMENTS , kept_keys, kept_cells CHANGE_ARGUMENT

// Frames from which on a cell knows enough not to ask those of other levels.
#define ENOUGH_FRAMES 8.0f

// What a coarser cell knows is blurred; a finer one has a quarter of the samples.
#define COARSER_WORTH 0.5f
#define FINER_WORTH 0.25f

/// What was known of a place, per lane.
typedef struct {
    Vec3 mean;
    Float frames; // that it is worth; 0 for nothing
} CellKnown;

/// Put what a cell knew in place of `known` where it is worth more, times `factor`.
static inline void take_known(
    __global const Params *params,
    Mask mask,
    const CellQuery *query,
    CellPlace place,
    UInt wall,
    Float change,
    float factor,
    CellKnown *known KNOWN_BUFFERS)
{
    const CellKey key = cell_key(params, query, place, wall);
    const uint size = bucket_size(params->cell_slots);
    // Also in buckets that a pass of this frame has filled: whether one has depends on which passes are done.
    const UInt slot = find_in_buckets(kept_keys, mask, key.bucket, size, key.key);
    const Mask found = mask & (slot != NO_SLOT);
    if (!any_lane(found))
        return;
    const UInt at = pick_u(found, slot, (UInt)(0u));
    const Vec3 mean = vec3(GATHER(kept_cells, at, mean[0]), GATHER(kept_cells, at, mean[1]),
                           GATHER(kept_cells, at, mean[2]));
    const Float count = GATHER(kept_cells, at, count);
    const Float frames = GATHER(kept_cells, at, frames);
    const Float square = GATHER(kept_cells, at, square);
    const Mask there = found & (count > 0.0f);
    const Float fresh = max(count / max(frames, 1e-6f), 1.0f);
    const Share share = share_of_frame(params, count, scatter_of(luminance(mean), square), change, fresh);
    // Pixels have weighed their own histories against the change; on top of that comes only what is certain.
    const Float certain = 1.0f - min(change * (1.0f / CERTAIN), 1.0f);
    const Float part = certain * (share.kept / pick(there, count, (Float)(1.0f)));
    const Float has = pick(there, factor * frames * part, (Float)(0.0f));
    const Mask better = has > known->frames;
    known->mean = pick_v(better, mean, known->mean);
    known->frames = pick(better, has, known->frames);
}

/// What was known where samples look: of their cell, or of a coarser or finer one, for levels change with the
/// distance.
static inline CellKnown known_of(
    __global const Params *params,
    Mask mask,
    const CellQuery *query,
    CellPlace at,
    UInt wall,
    UInt pixel,
    uint pass KNOWN_BUFFERS)
{
    CellKnown known;
    known.mean = vec3_all((Float)(0.0f));
    known.frames = (Float)(0.0f);
    if (!(params->history_flags & HISTORY_THERE) || params->temporal_rule == RULE_OFF)
        return known;
    UInt a;
    UInt b;
    cell_random(params, pixel, pass, CELL_LOOK_UP, &a, &b);
    const uint jitter = params->cell_flags & CELL_JITTER;
    const Float change = change_in_cell(params, query, at, a, b, jitter CHANGE_ARGUMENT);
    take_known(params, mask, query, at, wall, change, 1.0f, &known KNOWN_ARGUMENTS);
    const Mask asks = mask & (known.frames < ENOUGH_FRAMES);
    if (!any_lane(asks))
        return known;
    const CellPlace coarser = cell_place(params, query, a, b, jitter, (UInt)(1u));
    take_known(params, asks, query, coarser, wall, change, COARSER_WORTH, &known KNOWN_ARGUMENTS);
    const CellPlace finer = cell_place(params, query, a, b, jitter, (UInt)(0xffffffffu));
    take_known(params, asks, query, finer, wall, change, FINER_WORTH, &known KNOWN_ARGUMENTS);
    return known;
}
#else
#define KNOWN_BUFFERS
#define KNOWN_ARGUMENTS
#endif
