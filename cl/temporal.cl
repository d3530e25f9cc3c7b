// Frames of a sequence share light: each pixel goes on with what it knew of the surface that it sees.
//
// The three rules are those of N. Binder, A. Keller: Ray-Traced Global Illumination for Games: Massively
// Parallel Path Space Filtering, GTC 2019.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/noise.h"
#include "common/pixels.h"
#include "common/probes.h"
#include "common/history.h"
#include "common/view.h"

#if TEMPORAL == 2
/// How much the light has changed of what was seen in a column and a row of the frame before, 0 to 1, and how
/// far frames scatter around there.
static inline Float change_at(
    __global const Params *params, __global const float *changes, Float column, Float row, Float *scatter)
{
    const Float x = clamp(column, (Float)(0.0f), (Float)((float)params->crop_width - 1.0f));
    const Float y = clamp(row, (Float)(0.0f), (Float)((float)params->crop_height - 1.0f));
    const UInt at = to_uint(y * (1.0f / PROBE_TILE)) * probe_columns(params) + to_uint(x * (1.0f / PROBE_TILE));
    *scatter = gather_words(changes, 2u * at + 1u);
    return gather_words(changes, 2u * at);
}
#endif

// Pixels that are missed by less are hit.
#define LEAST_SHIFT 1e-3f

// A history that less of it is there of is none.
#define LEAST_WEIGHT 0.01f

/// A shift in pixels, whole where it is but for rounding: nothing is blurred without need.
static inline Float whole_or(Float shift)
{
    const Float nearest = floor(shift + 0.5f);
    return pick(fabs(shift - nearest) < LEAST_SHIFT, nearest, shift);
}

static inline Vec3 sum_of(__global const FilmSum *film, UInt pixel, Float inverse)
{
    return vec3((GATHER(film, pixel, sum[0]) - GATHER(film, pixel, lost[0])) * inverse,
                (GATHER(film, pixel, sum[1]) - GATHER(film, pixel, lost[1])) * inverse,
                (GATHER(film, pixel, sum[2]) - GATHER(film, pixel, lost[2])) * inverse);
}

/// What a pixel knew of its surface, per lane.
typedef struct {
    Vec3 rgb;
    Vec3 base;
    Float count;
    Float square;
#if CELL_HISTORY
    Vec3 shared; // of that, light from cells
    Vec3 older;  // the same by what cells knew before each frame
#endif
} Known;

/// What a pixel sees, as the tests of its history need it.
typedef struct {
    UInt shape;
    Vec3 before;
    Vec3 ns;
    Float footprint; // in the frame before, m
} Wanted;

#if CELL_HISTORY
#define SHARED_HISTORY_BUFFER , __global const float *shared_history
#define SHARED_HISTORY_ARGUMENT , shared_history
#else
#define SHARED_HISTORY_BUFFER
#define SHARED_HISTORY_ARGUMENT
#endif

/// Add what a pixel of the frame before knew, if it saw the same surface.
static inline void add_history(
    __global const Params *params,
    __global const History *history,
    Wanted wanted,
    Float column,
    Float row,
    Float weight,
    Mask unmoved,
    Mask still,
    Known *known,
    Float *weights SHARED_HISTORY_BUFFER)
{
    const Mask inside = (weight > 0.0f) & (column >= 0.0f) & (row >= 0.0f) & (column < (float)params->crop_width)
                        & (row < (float)params->crop_height);
    if (!any_lane(inside))
        return;
    const UInt at = pixel_entry(params, to_uint(pick(inside, column, (Float)(0.0f))),
                                to_uint(pick(inside, row, (Float)(0.0f))));
    const Float count = GATHER(history, at, count);
    const UInt shape = GATHER_U(history, at, shape);
    const Vec3 ns = vec3(GATHER(history, at, ns[0]), GATHER(history, at, ns[1]), GATHER(history, at, ns[2]));
    const Vec3 between = sub(wanted.before, vec3(GATHER(history, at, p[0]), GATHER(history, at, p[1]),
                                                 GATHER(history, at, p[2])));
    const Mask same_plane = (fabs(dot3(ns, between)) < wanted.footprint)
                            & (fabs(dot3(wanted.ns, between)) < wanted.footprint);
    // What glows itself would be smeared over all that its pixels' edges come by.
    const Mask same = (shape == wanted.shape) & ((shape & SHAPE_SHINES) == 0u)
                      & ((shape == 0u) | (same_plane & (dot3(ns, wanted.ns) > SAME_SURFACE_COSINE)));
    // Where neither moves, the edges that a pixel sees are those that it saw.
    const Mask rests = unmoved & (still | (((shape | wanted.shape) & SHAPE_MOVES) == 0u));
    const Mask taken = inside & (count > 0.0f) & (same | rests);
    const Float part = pick(taken, weight, (Float)(0.0f));
    const Vec3 rgb = vec3(GATHER(history, at, rgb[0]), GATHER(history, at, rgb[1]), GATHER(history, at, rgb[2]));
    const Vec3 base = vec3(GATHER(history, at, base[0]), GATHER(history, at, base[1]), GATHER(history, at, base[2]));
    known->rgb = add_scaled(known->rgb, rgb, part);
    known->base = add_scaled(known->base, base, part);
    known->count += count * part;
    known->square += GATHER(history, at, square) * part;
#if CELL_HISTORY
    const UInt first = at * 8u;
    const Vec3 shared = vec3(gather_words(shared_history, first), gather_words(shared_history, first + 1u),
                             gather_words(shared_history, first + 2u));
    const Vec3 older = vec3(gather_words(shared_history, first + 4u), gather_words(shared_history, first + 5u),
                            gather_words(shared_history, first + 6u));
    known->shared = add_scaled(known->shared, shared, part);
    known->older = add_scaled(known->older, older, part);
#endif
    *weights += part;
}

#if CELL_HISTORY
/// What cells add to the light of pixels that know less of it than they do.
typedef struct {
    Vec3 mean;  // what pixels took of cells, over the frames that they know
    Vec3 older; // the same by what cells knew before each of these frames
    Vec3 added; // to the light of this picture
    Vec3 base;  // of that, what the diffuse base of the first surface reflected
    Float more; // samples that it is worth
} Shared;

/// Return it for pixels whose own history and frame are worth `count` samples.
///
/// A pixel has its own mean of what its samples took from cells; where a cell knows more frames, these are
/// averaged in, for this picture alone.  Nothing is counted twice: in a picture that stands still no cell
/// knows more frames than the pixels that see it.
static inline Shared shared_by_cells(
    __global const SharedLight *sums, UInt pixel, Float fresh, Float alpha, Known known, Float count)
{
    const Float inverse = 1.0f / max(fresh, 1.0f);
    const Vec3 now = scale(vec3(GATHER(sums, pixel, fresh[0]), GATHER(sums, pixel, fresh[1]),
                                GATHER(sums, pixel, fresh[2])), inverse);
    const Vec3 before = scale(vec3(GATHER(sums, pixel, known[0]), GATHER(sums, pixel, known[1]),
                                   GATHER(sums, pixel, known[2])), inverse);
    const Vec3 its_base = scale(vec3(GATHER(sums, pixel, base[0]), GATHER(sums, pixel, base[1]),
                                     GATHER(sums, pixel, base[2])), inverse);
    const Float frames = GATHER(sums, pixel, frames) / max(GATHER(sums, pixel, samples), 1.0f);
    Shared s;
    s.mean = add_scaled(scale(known.shared, 1.0f - alpha), now, alpha);
    // Places in cells are random: several looks are better than one.
    s.older = add_scaled(scale(known.older, 1.0f - alpha), before, alpha);
    s.more = max((frames + 1.0f) * fresh - count, 0.0f);
    s.added = scale(sub(s.older, s.mean), s.more / max(count + s.more, 1.0f));
    const Float zero = (Float)(0.0f);
    s.base = vec3(pick(before.x > 0.0f, s.added.x * its_base.x / before.x, zero),
                  pick(before.y > 0.0f, s.added.y * its_base.y / before.y, zero),
                  pick(before.z > 0.0f, s.added.z * its_base.z / before.z, zero));
    return s;
}
#endif

// Frames from which on their scatter tells the noise.
#define LEAST_FRAMES 3.5f

/// Blend the light of this frame with what is known from the frames before.  One work item W pixels.
///
/// A pixel looks where its surface was, between four pixels, and takes those that saw the same: the same
/// shape, nothing of it glowing, normals that agree, each within a pixel's footprint of the plane of the other.  One that moved by
/// whole pixels, or not at all, takes one of them as it is.
///
/// reads   film, film_base, surfaces_seen, motion, history, changes; shared_light, shared_history
/// writes  light; shared_pixels
kernel void blend_history(
    __global const Params *params,
    __global const FilmSum *film,
#if BASE
    __global const FilmSum *film_base,
#endif
    __global const SeenMean *surfaces_seen,
    __global const float *motion,
    __global const History *history,
#if TEMPORAL == 2
    __global const float *changes,
#endif
#if CELL_HISTORY
    __global const SharedLight *shared_light,
    __global const float *shared_history,
    __global SharedPixel *shared_pixels,
#endif
    __global PixelLight *light)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt pixel = min(lanes_before(MASK_ALL) + first, (UInt)(params->pixel_count - 1u));
    const Float fresh = to_float(GATHER_U(film, pixel, count));
    const Float inverse = 1.0f / max(fresh, 1.0f);
    const Vec3 zero = vec3_all((Float)(0.0f));
    const Vec3 rgb = sum_of(film, pixel, inverse);
#if BASE
    const Vec3 base = sum_of(film_base, pixel, inverse);
#else
    const Vec3 base = zero;
#endif

    Known known;
    known.rgb = zero;
    known.base = zero;
    known.count = (Float)(0.0f);
    known.square = (Float)(0.0f);
#if CELL_HISTORY
    known.shared = zero;
    known.older = zero;
#endif
    Float weights = (Float)(0.0f);
    Float change = (Float)(0.0f);
    Float scatter = (Float)(0.0f);
    if ((params->history_flags & HISTORY_THERE) && params->temporal_rule != RULE_OFF) {
        UInt x;
        UInt y;
        pixel_place(params, pixel, &x, &y);
        Wanted wanted;
        wanted.shape = GATHER_U(surfaces_seen, pixel, shape);
        wanted.before = vec3(GATHER(surfaces_seen, pixel, before[0]), GATHER(surfaces_seen, pixel, before[1]),
                             GATHER(surfaces_seen, pixel, before[2]));
        wanted.ns = normalize3(vec3(GATHER(surfaces_seen, pixel, ns[0]), GATHER(surfaces_seen, pixel, ns[1]),
                                    GATHER(surfaces_seen, pixel, ns[2])));
        wanted.footprint = footprint_at(params, previous_view_of(params), wanted.before);
        const Float right = gather_words(motion, pixel * 2u);
        const Float down = gather_words(motion, pixel * 2u + 1u);
        const Float column = to_float(x - params->crop_x) - whole_or(right);
        const Float row = to_float(y - params->crop_y) - whole_or(down);
        const Float left = floor(column);
        const Float top = floor(row);
        const Float aside = column - left;
        const Float below = row - top;
        const Mask none = !MASK_ALL;
        const Mask still = params->history_flags & HISTORY_STILL ? MASK_ALL : none;
        const Mask same_view = params->history_flags & HISTORY_SAME_VIEW ? MASK_ALL : none;
#if TEMPORAL == 2
        if (params->temporal_rule == RULE_ADAPTIVE)
            change = change_at(params, changes, left, top, &scatter);
#endif
        const Mask unmoved = same_view & (right == 0.0f) & (down == 0.0f);
        for (uint k = 0; k < 4; ++k) {
            const Float share = ((k & 1u) ? aside : 1.0f - aside) * ((k & 2u) ? below : 1.0f - below);
            add_history(params, history, wanted, left + (float)(k & 1u), top + (float)(k >> 1), share, unmoved,
                        still, &known, &weights SHARED_HISTORY_ARGUMENT);
        }
        const Float whole = pick(weights > LEAST_WEIGHT, 1.0f / max(weights, LEAST_WEIGHT), (Float)(0.0f));
        known.rgb = scale(known.rgb, whole);
        known.base = scale(known.base, whole);
        known.count = known.count * whole;
        known.square = known.square * whole;
#if CELL_HISTORY
        known.shared = scale(known.shared, whole);
        known.older = scale(known.older, whole);
#endif
    }

    const Share share = share_of_frame(params, known.count, scatter, change, fresh);
    const Float alpha = share.alpha;
    Float count = share.count;
    Vec3 mean = add_scaled(scale(known.rgb, 1.0f - alpha), rgb, alpha);
    const Float brightness = luminance(rgb);
    const Float square = (1.0f - alpha) * known.square + alpha * brightness * brightness;
    Vec3 base_mean = add_scaled(scale(known.base, 1.0f - alpha), base, alpha);
#if CELL_HISTORY
    const Shared shared = shared_by_cells(shared_light, pixel, fresh, alpha, known, count);
    mean = add(mean, shared.added);
    base_mean = add(base_mean, shared.base);
    const Float parts[13] = {shared.mean.x,  shared.mean.y,  shared.mean.z,  count,
                             shared.older.x, shared.older.y, shared.older.z, shared.added.x,
                             shared.added.y, shared.added.z, shared.base.x,  shared.base.y,
                             shared.base.z};
    count += shared.more;
    float lane_parts[13][W];
    for (uint c = 0; c < 13; ++c)
        store_lanes(parts[c], lane_parts[c]);
#endif

    // Of the samples of one frame, or of the means of several.
    Float noise = (Float)(NOISE_UNKNOWN);
#if BASE
    noise = pick(fresh > 1.0f, NOISE_OF_MEAN(GATHER(film_base, pixel, squares), max(fresh, 2.0f)), noise);
#endif
    const Float mean_luminance = luminance(mean);
    noise = pick(count > LEAST_FRAMES * fresh,
                 max(square - mean_luminance * mean_luminance, 0.0f) * fresh / max(count, 1.0f), noise);

    const Float values[12] = {mean.x,      mean.y, mean.z, count,  base_mean.x, base_mean.y,
                              base_mean.z, alpha,  square, change, noise,       count * inverse};
    float lane[12][W];
    for (uint c = 0; c < 12; ++c)
        store_lanes(values[c], lane[c]);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k) {
        __global float *words = (__global float *)(light + first + k);
        vstore8((float8)(lane[0][k], lane[1][k], lane[2][k], lane[3][k], lane[4][k], lane[5][k], lane[6][k],
                         lane[7][k]),
                0, words);
        vstore4((float4)(lane[8][k], lane[9][k], lane[10][k], lane[11][k]), 2, words);
#if CELL_HISTORY
        __global float *its = (__global float *)(shared_pixels + first + k);
        vstore4((float4)(lane_parts[0][k], lane_parts[1][k], lane_parts[2][k], lane_parts[3][k]), 0, its);
        vstore4((float4)(lane_parts[4][k], lane_parts[5][k], lane_parts[6][k], 0.0f), 1, its);
        vstore4((float4)(lane_parts[7][k], lane_parts[8][k], lane_parts[9][k], 0.0f), 2, its);
        vstore4((float4)(lane_parts[10][k], lane_parts[11][k], lane_parts[12][k], 0.0f), 3, its);
#endif
    }
}

/// Keep the light of this frame, and what it sees, for the next, without what cells added.  One work item a
/// pixel, after blend_history.
///
/// reads   light, surfaces_seen; shared_pixels
/// writes  history; shared_history
kernel void keep_history(
    __global const Params *params,
    __global const PixelLight *light,
    __global const SeenMean *surfaces_seen,
#if CELL_HISTORY
    __global const SharedPixel *shared_pixels,
    __global float *shared_history,
#endif
    __global History *history)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    __global const SeenMean *seen = &surfaces_seen[pixel];
    __global History *to = &history[pixel];
    float count = light[pixel].count;
    float3 rgb = vload3(0, light[pixel].rgb);
    float3 base = vload3(0, light[pixel].base);
#if CELL_HISTORY
    __global const SharedPixel *shared = &shared_pixels[pixel];
    count = shared->count;
    rgb -= vload3(0, shared->added);
    base -= vload3(0, shared->base);
    vstore4((float4)(vload3(0, shared->mean), 0.0f), 2 * pixel, shared_history);
    vstore4((float4)(vload3(0, shared->older), 0.0f), 2 * pixel + 1, shared_history);
#endif
    to->count = count;
    to->shape = seen->shape;
    to->square = light[pixel].square;
    const float3 ns = vload3(0, seen->ns);
    const float length2 = dot(ns, ns);
    vstore3(rgb, 0, to->rgb);
    vstore3(base, 0, to->base);
    vstore3(vload3(0, seen->p), 0, to->p);
    vstore3(length2 > 1e-12f ? ns / sqrt(length2) : (float3)(0.0f, 0.0f, 1.0f), 0, to->ns);
}
