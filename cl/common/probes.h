// Where probes are: one in each tile of the film.
#pragma once

#include "layout.h"

static inline uint probe_columns(__global const Params *params)
{
    return (params->crop_width + PROBE_TILE - 1u) / PROBE_TILE;
}

static inline uint probe_rows(__global const Params *params)
{
    return (params->crop_height + PROBE_TILE - 1u) / PROBE_TILE;
}
