// Fireflies: pixels far brighter than what their samples and those of their neighbours speak for are dimmed.
//
// A mean of which one sample has nearly all says little: whether such a sample is rare or common shows only where
// there are others like it.  With `bright`, the mean of the samples' luminance weighted by itself, the sum over a
// pixel and its neighbours divided by `bright` counts the samples as bright as the pixel's own; without that one
// sample itself they are those that speak for it.  Ever more do with more samples: consistent, and darker until then.
//
// After T. Zirr, J. Hanika, C. Dachsbacher: Re-Weighting Firefly Samples for Improved Finite-Sample Monte Carlo
// Estimates, CGF 37(6), 2018, which counts in layers of brightness what two moments of each pixel say here.

#include "common/features.h"
#include "common/layout.h"
#include "common/pixels.h"

// Samples as bright as a pixel's own that it takes for it to be believed in full, out of the eight that its neighbours
// have of each pass where they are like it.  From four to eight measured on five scenes: fewer leave fireflies, more
// darken what is merely noisy.
#define ENOUGH_ALIKE 6.0f

/// The neighbour `k` - 1 away along a line of `extent` pixels; beyond the first and the last, that of the other side:
/// then no pixel but one that has no neighbours speaks for itself more than once.
static inline uint neighbour(uint here, uint k, uint extent)
{
    if (extent < 2u)
        return 0u;
    if (here == 0u)
        return k == 1u ? 0u : 1u;
    return here + k > extent ? extent - 2u : here + k - 1u;
}

/// Part of the light of a pixel that it keeps: of `count` samples of luminance `mean`, `bright` as above; the
/// samples of its neighbours add up to `others`.
static inline float part_kept(float mean, float count, float bright, float others)
{
    const float alike = (others + max(mean * count - bright, 0.0f)) / bright;
    // What is no number, for sums beyond its range, is left as it is.
    return mean > 0.0f && alike < ENOUGH_ALIKE ? max(alike / ENOUGH_ALIKE, 0.0f) : 1.0f;
}

/// Find the entry of the pixel with this index in the crop, and those of the eight around it.
static inline uint pixels_around(__global const Params *params, uint index, uint others[8])
{
    const uint column = index % params->crop_width;
    const uint row = index / params->crop_width;
    for (uint k = 0; k < 8u; ++k) {
        const uint place = k < 4u ? k : k + 1u; // not the one in the middle
        others[k] = pixel_entry_of(params, neighbour(column, place % 3u, params->crop_width),
                                   neighbour(row, place / 3u, params->crop_height));
    }
    return pixel_entry_of(params, column, row);
}

static inline float luminance_of(__global const float *rgb)
{
    return LUMINANCE_RED * rgb[0] + LUMINANCE_GREEN * rgb[1] + LUMINANCE_BLUE * rgb[2];
}

/// Find what pixels of the film keep.  One work item a pixel.
///
/// reads   film
/// writes  kept
kernel void weigh_film(__global const Params *params, __global const FilmSum *film, __global float *kept)
{
    const uint index = get_global_id(0);
    if (index >= params->pixel_count)
        return;
    uint around[8];
    const uint pixel = pixels_around(params, index, around);
    float others = 0.0f;
    for (uint k = 0; k < 8u; ++k)
        others += max(film[around[k]].mean, 0.0f) * (float)film[around[k]].count;
    const float mean = film[pixel].mean;
    const float count = (float)film[pixel].count;
    kept[pixel] = part_kept(mean, count, mean + film[pixel].squares / (mean * count), others);
}

/// The same for pixels with the light of other frames: what is alike are samples of this frame, or frames.
///
/// reads   light
/// writes  kept
kernel void weigh_light(__global const Params *params, __global const PixelLight *light, __global float *kept)
{
    const uint index = get_global_id(0);
    if (index >= params->pixel_count)
        return;
    uint around[8];
    const uint pixel = pixels_around(params, index, around);
    float others = 0.0f;
    for (uint k = 0; k < 8u; ++k)
        others += max(luminance_of(light[around[k]].rgb), 0.0f) * light[around[k]].means;
    const float mean = luminance_of(light[pixel].rgb);
    kept[pixel] = part_kept(mean, light[pixel].means, max(light[pixel].square / mean, mean), others);
}

/// Hold the rest back.  One work item a pixel.
///
/// reads   kept
/// writes  light
kernel void hold_light(__global const Params *params, __global const float *kept, __global PixelLight *light)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    const float part = kept[pixel];
    for (uint c = 0; c < 3; ++c) {
        light[pixel].rgb[c] *= part;
        light[pixel].base[c] *= part;
    }
    if (light[pixel].noise < NOISE_UNKNOWN)
        light[pixel].noise *= part * part;
}
