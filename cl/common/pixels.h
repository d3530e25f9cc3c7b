// The order in which pixels are sampled.
#pragma once

#include "lanes.h"
#include "layout.h"

/// x / d for all lanes: the processor divides no vectors of integers.
static inline UInt divide(UInt x, uint d)
{
    // The reciprocal is at most 1 too small, so the quotient is.
    const UInt q = mul_hi(x, (UInt)(0xffffffffu / d));
    return q + pick_u(x - q * d >= d, (UInt)(1u), (UInt)(0u));
}

/// Entry of the queue's order of the pixel in a column and a row of the crop.
static inline UInt pixel_entry(__global const Params *params, UInt column, UInt row)
{
    const UInt top = row - row % STRIP_ROWS;
    const UInt rows = min((UInt)(STRIP_ROWS), params->crop_height - top);
    return top * params->crop_width + column * rows + row - top;
}

/// The same for one pixel.
static inline uint pixel_entry_of(__global const Params *params, uint column, uint row)
{
    const uint top = row - row % STRIP_ROWS;
    return top * params->crop_width + column * min((uint)STRIP_ROWS, params->crop_height - top) + row - top;
}

/// Column and row on the film of entry `i` of the queue's order (tables.pixel_order).
static inline void pixel_place(__global const Params *params, UInt i, UInt *x, UInt *y)
{
    const uint strip_pixels = STRIP_ROWS * params->crop_width;
    const UInt strip = divide(i, strip_pixels);
    const UInt inside = i - strip * strip_pixels;
    const UInt top = strip * STRIP_ROWS;
    const UInt rows = min((UInt)(STRIP_ROWS), params->crop_height - top);
    // Exact: `inside` is below 2^18, and a quotient plus half a row is far from integers.
    const UInt column = to_uint((to_float(inside) + 0.5f) / to_float(rows));
    *x = params->crop_x + column;
    *y = params->crop_y + top + inside - column * rows;
}
