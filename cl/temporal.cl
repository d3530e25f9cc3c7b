// Frames of a sequence share light: each pixel goes on with what it knew of the surface that it sees.
//
// The three rules are those of N. Binder, A. Keller: Ray-Traced Global Illumination for Games: Massively
// Parallel Path Space Filtering, GTC 2019.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/pixels.h"
#include "common/probes.h"
#include "common/view.h"

#if TEMPORAL == 2
/// How much the light has changed of what was seen in a column and a row of the frame before: 0 to 1.
static inline Float change_at(__global const Params *params, __global const float *changes, Float column, Float row)
{
    const Float x = clamp(column, (Float)(0.0f), (Float)((float)params->crop_width - 1.0f));
    const Float y = clamp(row, (Float)(0.0f), (Float)((float)params->crop_height - 1.0f));
    const UInt at = to_uint(y * (1.0f / PROBE_TILE)) * probe_columns(params) + to_uint(x * (1.0f / PROBE_TILE));
    return gather_words(changes, at);
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
} Known;

// A change from which on the frame has more than its part.
#define CERTAIN 0.5f

// Before frames have shown it, their standard deviation is taken for half of the light, as two frames would say.
#define PRIOR_VARIANCE 0.25f
#define PRIOR_FRAMES 2.0f

/// Samples that a history is worth of which a part has changed: with N of variance v and a bias b, it errs as
/// N / (1 + N b^2 / v) without bias.  All of them if nothing has changed.
static inline Float worth_of(Known known, Float change, Float fresh)
{
    const Float level = luminance(known.rgb);
    // A change of c of the brighter of both leaves at least 1 - c of it.
    const Float bias = change * level / (1.0f - min(change, CERTAIN));
    const Float frames = known.count / max(fresh, 1.0f);
    const Float spread = max(known.square - level * level, 0.0f);
    const Float variance =
        (frames * spread + PRIOR_FRAMES * PRIOR_VARIANCE * level * level) / (frames + PRIOR_FRAMES);
    const Float ratio = frames * bias * bias / max(variance, 1e-30f);
    return pick(change > 0.0f, known.count / (1.0f + ratio), known.count);
}

/// What a pixel sees, as the tests of its history need it.
typedef struct {
    UInt shape;
    Vec3 before;
    Vec3 ns;
    Float footprint; // in the frame before, m
} Wanted;

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
    Float *weights)
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
    const Mask same = (shape == wanted.shape)
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
    *weights += part;
}

/// Blend the light of this frame with what is known from the frames before.  One work item W pixels.
///
/// A pixel looks where its surface was, between four pixels, and takes those that saw the same: the same
/// shape, normals that agree, each within a pixel's footprint of the plane of the other.  One that moved by
/// whole pixels, or not at all, takes one of them as it is.
///
/// reads   film, film_base, surfaces_seen, motion, history, changes
/// writes  light
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
    Float weights = (Float)(0.0f);
    Float change = (Float)(0.0f);
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
            change = change_at(params, changes, left, top);
#endif
        const Mask unmoved = same_view & (right == 0.0f) & (down == 0.0f);
        for (uint k = 0; k < 4; ++k) {
            const Float share = ((k & 1u) ? aside : 1.0f - aside) * ((k & 2u) ? below : 1.0f - below);
            add_history(params, history, wanted, left + (float)(k & 1u), top + (float)(k >> 1), share, unmoved,
                        still, &known, &weights);
        }
        const Float whole = pick(weights > LEAST_WEIGHT, 1.0f / max(weights, LEAST_WEIGHT), (Float)(0.0f));
        known.rgb = scale(known.rgb, whole);
        known.base = scale(known.base, whole);
        known.count = known.count * whole;
        known.square = known.square * whole;
    }

    const Mask is_known = known.count > 0.0f;
    const Float kept = pick(is_known, worth_of(known, change, fresh), (Float)(0.0f));
    Float alpha = fresh / max(kept + fresh, 1.0f);
    Float count = kept + fresh;
    if (params->temporal_rule == RULE_EXPONENTIAL) {
        alpha = pick(is_known, (Float)(params->temporal_alpha), (Float)(1.0f));
        count = min(count, fresh / max(alpha, 1e-6f));
    }
    const Mask changed = is_known & (change > 0.0f);
    const Float part = max(change - CERTAIN, 0.0f) * (1.0f / (1.0f - CERTAIN));
    alpha = pick(changed, alpha + part * part * (1.0f - alpha), alpha);
    // The bias of what is kept stays, while noise goes: in the frames to come it counts for less, by the part
    // of it that was worth keeping.
    const Float left = fresh / max(alpha, 1e-6f) - fresh;
    count = pick(changed, fresh + left * left / max(known.count, 1.0f), count);
    alpha = pick(is_known, alpha, (Float)(1.0f));
    const Vec3 mean = add_scaled(scale(known.rgb, 1.0f - alpha), rgb, alpha);
    const Float brightness = luminance(rgb);
    const Float square = (1.0f - alpha) * known.square + alpha * brightness * brightness;
    const Vec3 base_mean = add_scaled(scale(known.base, 1.0f - alpha), base, alpha);

    const Float values[10] = {mean.x,      mean.y,      mean.z, count,  base_mean.x,
                              base_mean.y, base_mean.z, alpha,  square, change};
    float lane[10][W];
    for (uint c = 0; c < 10; ++c)
        store_lanes(values[c], lane[c]);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k) {
        __global float *words = (__global float *)(light + first + k);
        vstore8((float8)(lane[0][k], lane[1][k], lane[2][k], lane[3][k], lane[4][k], lane[5][k], lane[6][k],
                         lane[7][k]),
                0, words);
        vstore4((float4)(lane[8][k], lane[9][k], 0.0f, 0.0f), 2, words);
    }
}

/// Keep the light of this frame, and what it sees, for the next.  One work item a pixel, after
/// blend_history.
///
/// reads   light, surfaces_seen
/// writes  history
kernel void keep_history(
    __global const Params *params,
    __global const PixelLight *light,
    __global const SeenMean *surfaces_seen,
    __global History *history)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    __global const SeenMean *seen = &surfaces_seen[pixel];
    __global History *to = &history[pixel];
    to->count = light[pixel].count;
    to->shape = seen->shape;
    to->square = light[pixel].square;
    const float3 ns = vload3(0, seen->ns);
    const float length2 = dot(ns, ns);
    vstore3(vload3(0, light[pixel].rgb), 0, to->rgb);
    vstore3(vload3(0, light[pixel].base), 0, to->base);
    vstore3(vload3(0, seen->p), 0, to->p);
    vstore3(length2 > 1e-12f ? ns / sqrt(length2) : (float3)(0.0f, 0.0f, 1.0f), 0, to->ns);
}
