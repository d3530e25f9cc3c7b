// What averages per cell took from the picture is added back as far as it stands out of the noise.
//
// Each pixel knows the mean of what its own samples had more than the averages that they used: the bias of
// the filter, with the noise of plain path tracing.  Averaged over a window that noise is less; what is then
// left above it is bias, and goes back into the picture: first over large windows, then over smaller ones,
// at last pixel by pixel.  With ever more samples all of it goes back: the picture becomes that of plain
// path tracing.
//
// Where a rare bright sample is missing all looks darker than its cell, and sure: without care its light
// would be taken from there, and not be given to where it is, for there is noise.  So no pixel counts as surer
// than what is around, relative to the light that it shares, and nothing becomes negative.
//
// James, Stein: Estimation with Quadratic Loss, 1961 (shrinking by the part that is noise).

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pixels.h"

static inline Vec3 gather_lost(__global const Lost *lost, UInt pixel)
{
    return vec3(GATHER(lost, pixel, rgb[0]), GATHER(lost, pixel, rgb[1]), GATHER(lost, pixel, rgb[2]));
}

/// Part of a mean that is not noise, of the square of its luminance and what of it counts as noise.
static inline Float sure_part(Float square, Float noise)
{
    // Of what is infinite nothing is sure: it must not make anything that is no number.
    const Mask sure = (noise < square) & (square < (Float)(INFINITY));
    return pick(sure, square - noise, (Float)(0.0f)) / max(square, (Float)(1e-37f));
}

// What pixels show beside the light that they share, as lamps do, tells nothing of its noise: so many times that
// light they have at most.
#define MOST_LIGHT 4.0f

// The part of the pixels that noise comes from up to which it passes for that of all around; where more of them
// have a share in it, it is known well, and pixels are believed to have less: ever less, down to LEAST_LIFT of it.
#define FEW_NOISY 0.1f
#define LEAST_LIFT 0.2f

// Of the mean noise of the first window, the part that is the least of each pixel.
#define LEAST_NOISE 0.5f

// Tiles to each side whose noise is looked at.
#define TILES_AROUND 2u

static inline uint tiles_along(uint extent) { return (extent + RESTORE_TILE - 1u) / RESTORE_TILE; }

/// `back`, but no more of it than leaves a pixel that is not negative so.
static inline float kept_positive(float back, float restored) { return max(back, -max(restored, 0.0f)); }

/// Column and row of W pixels in the crop.
static inline void place_in_crop(__global const Params *params, UInt pixel, UInt *column, UInt *row)
{
    pixel_place(params, pixel, column, row);
    *column -= params->crop_x;
    *row -= params->crop_y;
}

/// Turn sums into means, with what counts as noise of their squares in `difference`, and take the picture from the
/// film, with the light of which that is the noise: what was shared, and some more.  One work item a pixel.
///
/// The noise shows in the difference between two halves of the samples; `tilt` is what one half has more of
/// all, and 1 where nothing can be told.  Of few samples the halves often look too much alike, for bright ones
/// are rare: their noise is taken for larger.  `caution` variances count as noise.
///
/// reads   film, film_lost, film_shared; kept
/// writes  unrestored, restored, mean_light
kernel void take_lost(
    __global const Params *params,
    __global const FilmSum *film,
    __global const Lost *film_lost,
    __global const float *film_shared,
#if FIREFLIES
    __global const float *kept,
#endif
    __global Lost *unrestored,
    __global float *restored,
    __global float *mean_light,
    const float tilt,
    const float caution)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    const float count = (float)max(film[pixel].count, 1u);
#if FIREFLIES
    const float part = kept[pixel];
#else
    const float part = 1.0f;
#endif
    float mean = 0.0f;
    const float weights[3] = {LUMINANCE_RED, LUMINANCE_GREEN, LUMINANCE_BLUE};
    for (uint c = 0; c < 3; ++c) {
        restored[4 * pixel + c] = part * ((film[pixel].sum[c] - film[pixel].lost[c]) / count);
        const float sum = film_lost[pixel].rgb[c] - film_lost[params->pixel_count + pixel].rgb[c];
        const float lost = fabs(tilt) < 1.0f ? sum / count : 0.0f;
        unrestored[pixel].rgb[c] = lost;
        mean += weights[c] * lost;
    }
    const float apart = film_lost[pixel].difference - film_lost[params->pixel_count + pixel].difference;
    const float difference = apart / count - tilt * mean;
    const float variance = difference * difference / max(1.0f - tilt * tilt, 1e-6f);
    unrestored[pixel].difference = caution * variance * (1.0f + 4.0f / max(count - 1.0f, 1.0f));
    const float shown = max(weights[0] * restored[4 * pixel] + weights[1] * restored[4 * pixel + 1]
                                + weights[2] * restored[4 * pixel + 2], 0.0f);
    mean_light[pixel] = min(shown, MOST_LIGHT * film_shared[pixel] / count);
}

/// Add up the noise of a tile of the crop; the square of its mean light, for each pixel; and the roots of its noise.
/// One work item a tile.
///
/// reads   unrestored, mean_light
/// writes  tiles
kernel void sum_tiles(
    __global const Params *params,
    __global const Lost *unrestored,
    __global const float *mean_light,
    __global float *tiles)
{
    const uint tile = get_global_id(0);
    const uint across = tiles_along(params->crop_width);
    const uint down = tiles_along(params->crop_height);
    if (tile >= across * down)
        return;
    const uint left = tile % across * RESTORE_TILE;
    const uint top = tile / across * RESTORE_TILE;
    const uint right = min(left + RESTORE_TILE, params->crop_width);
    const uint bottom = min(top + RESTORE_TILE, params->crop_height);
    float noise = 0.0f;
    float roots = 0.0f;
    float sum = 0.0f;
    for (uint y = top; y < bottom; ++y)
        for (uint x = left; x < right; ++x) {
            const uint pixel = pixel_entry_of(params, x, y);
            noise += unrestored[pixel].difference;
            roots += sqrt(unrestored[pixel].difference);
            sum += mean_light[pixel];
        }
    tiles[3u * tile] = noise;
    tiles[3u * tile + 1u] = sum / (float)((right - left) * (bottom - top)) * sum;
    tiles[3u * tile + 2u] = roots;
}

/// Lift the noise of pixels that look surer, for their light, than the tiles around, the more the fewer pixels
/// that noise comes from: by the squared mean root of noise over its mean.  One work item a tile.
///
/// reads   tiles, mean_light
/// writes  unrestored
kernel void lift_noise(
    __global const Params *params,
    __global const float *tiles,
    __global const float *mean_light,
    __global Lost *unrestored)
{
    const uint tile = get_global_id(0);
    const uint across = tiles_along(params->crop_width);
    const uint down = tiles_along(params->crop_height);
    if (tile >= across * down)
        return;
    const uint column = tile % across;
    const uint row = tile / across;
    float noise = 0.0f;
    float squares = 0.0f;
    float roots = 0.0f;
    uint count = 0;
    for (uint y = row - min(row, TILES_AROUND); y <= min(row + TILES_AROUND, down - 1u); ++y)
        for (uint x = column - min(column, TILES_AROUND); x <= min(column + TILES_AROUND, across - 1u); ++x) {
            noise += tiles[3u * (y * across + x)];
            squares += tiles[3u * (y * across + x) + 1u];
            roots += tiles[3u * (y * across + x) + 2u];
            count += min(RESTORE_TILE, params->crop_width - x * RESTORE_TILE)
                     * min(RESTORE_TILE, params->crop_height - y * RESTORE_TILE);
        }
    // Where squares leave the range of numbers nothing is known: what is infinite passes for all noise.
    const float part = roots * roots / max(noise * (float)count, 1e-37f);
    const float lift = clamp(FEW_NOISY / max(part, 1e-37f), LEAST_LIFT, 1.0f);
    const float relative = isfinite(noise) && isfinite(squares) ? lift * noise / max(squares, 1e-37f) : FLT_MAX;
    const uint right = min((column + 1u) * RESTORE_TILE, params->crop_width);
    const uint bottom = min((row + 1u) * RESTORE_TILE, params->crop_height);
    for (uint y = row * RESTORE_TILE; y < bottom; ++y)
        for (uint x = column * RESTORE_TILE; x < right; ++x) {
            const uint pixel = pixel_entry_of(params, x, y);
            const float its_light = mean_light[pixel];
            __global Lost *left = &unrestored[pixel];
            // No number where nothing around has any light: fmax leaves that out.
            left->difference = fmax(left->difference, relative * its_light * its_light);
        }
}

/// Sum over the pixels of a row, or `down` a column, at most `radius` away; return the sum of variances.
static inline Float sum_line(
    __global const Params *params,
    __global const Lost *lost,
    UInt column,
    UInt row,
    const uint radius,
    const bool down,
    Vec3 *sum)
{
    const UInt here = down ? row : column;
    const uint extent = down ? params->crop_height : params->crop_width;
    *sum = vec3_all((Float)(0.0f));
    Float variance = (Float)(0.0f);
    for (uint k = 0; k <= 2u * radius; ++k) {
        // Before the first pixel this wraps around, to beyond the last.
        const Mask inside = here + k - radius < extent;
        const UInt there = pick_u(inside, here + k - radius, here);
        const UInt at = down ? pixel_entry(params, column, there) : pixel_entry(params, there, row);
        *sum = add(*sum, pick_v(inside, gather_lost(lost, at), vec3_all((Float)(0.0f))));
        variance += pick(inside, GATHER(lost, at, difference), (Float)(0.0f));
    }
    return variance;
}

/// Sum what is left over windows of a row, `radius` pixels to either side.  One work item W pixels.
///
/// reads   unrestored
/// writes  rows
kernel void sum_rows(
    __global const Params *params, __global const Lost *unrestored, __global Lost *rows, const uint radius)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = min(wanted, (UInt)(params->pixel_count - 1u));
    UInt column;
    UInt row;
    place_in_crop(params, pixel, &column, &row);
    Vec3 sum;
    const Float variance = sum_line(params, unrestored, column, row, radius, false, &sum);
    float lane[4][W];
    store_lanes(sum.x, lane[0]);
    store_lanes(sum.y, lane[1]);
    store_lanes(sum.z, lane[2]);
    store_lanes(variance, lane[3]);
    for (uint k = 0; k < min((uint)W, params->pixel_count - first); ++k)
        vstore4((float4)(lane[0][k], lane[1][k], lane[2][k], lane[3][k]), first + k, (__global float *)rows);
}

/// Add back what stands out in windows of the picture, `radius` pixels to each side, and if they are the first
/// ones lift the noise of each pixel.  One work item W pixels, after sum_rows.
///
/// reads   rows
/// writes  unrestored, restored
kernel void restore_windows(
    __global const Params *params,
    __global const Lost *rows,
    __global Lost *unrestored,
    __global float *restored,
    const uint radius,
    const uint is_first)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = min(wanted, (UInt)(params->pixel_count - 1u));
    UInt column;
    UInt row;
    place_in_crop(params, pixel, &column, &row);
    Vec3 sum;
    const Float variance = sum_line(params, rows, column, row, radius, true, &sum);
    const UInt wide = min(column + radius, (UInt)(params->crop_width - 1u)) - (column - min(column, (UInt)(radius)));
    const UInt high = min(row + radius, (UInt)(params->crop_height - 1u)) - (row - min(row, (UInt)(radius)));
    const Float inverse = 1.0f / to_float((wide + 1u) * (high + 1u));
    const Vec3 mean = scale(sum, inverse);
    const Float y = luminance(mean);
    const Vec3 back = scale(mean, sure_part(y * y, variance * inverse * inverse));
    float lane[4][W];
    store_lanes(back.x, lane[0]);
    store_lanes(back.y, lane[1]);
    store_lanes(back.z, lane[2]);
    store_lanes(variance * inverse * LEAST_NOISE, lane[3]);
    for (uint k = 0; k < min((uint)W, params->pixel_count - first); ++k) {
        __global Lost *left = &unrestored[first + k];
        for (uint c = 0; c < 3; ++c) {
            __global float *value = &restored[4 * (first + k) + c];
            const float moved = kept_positive(lane[c][k], *value);
            left->rgb[c] -= moved;
            *value += moved;
        }
        if (is_first)
            left->difference = max(left->difference, lane[3][k]);
    }
}

/// Add back what stands out in a pixel, judged by it and its neighbours.  One work item W pixels.
///
/// reads   unrestored
/// writes  restored
kernel void restore_pixels(__global const Params *params, __global const Lost *unrestored, __global float *restored)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = min(wanted, (UInt)(params->pixel_count - 1u));
    UInt column;
    UInt row;
    place_in_crop(params, pixel, &column, &row);
    Float square = (Float)(0.0f);
    Float variance = (Float)(0.0f);
    for (uint k = 0; k < 9u; ++k) {
        const UInt x = min(max(column + k % 3u, (UInt)(1u)) - 1u, (UInt)(params->crop_width - 1u));
        const UInt y = min(max(row + k / 3u, (UInt)(1u)) - 1u, (UInt)(params->crop_height - 1u));
        const UInt at = pixel_entry(params, x, y);
        const Float value = luminance(gather_lost(unrestored, at));
        square += value * value;
        variance += GATHER(unrestored, at, difference);
    }
    const Vec3 back = scale(gather_lost(unrestored, pixel), sure_part(square, variance));
    float lane[3][W];
    store_lanes(back.x, lane[0]);
    store_lanes(back.y, lane[1]);
    store_lanes(back.z, lane[2]);
    for (uint k = 0; k < min((uint)W, params->pixel_count - first); ++k)
        for (uint c = 0; c < 3; ++c) {
            __global float *value = &restored[4 * (first + k) + c];
            *value += kept_positive(lane[c][k], *value);
        }
}
