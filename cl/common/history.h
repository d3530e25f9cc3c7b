// What a frame adds to what is known from those before it: the three rules, for pixels and for cells.
//
// N. Binder, A. Keller: Ray-Traced Global Illumination for Games: Massively Parallel Path Space Filtering,
// GTC 2019.
#pragma once

#include "lanes.h"
#include "layout.h"

// A change from which on the frame has more than its part.
#define CERTAIN 0.5f

// Before frames have shown it, their standard deviation is taken for half of the light, as two frames would say.
#define PRIOR_VARIANCE 0.25f
#define PRIOR_FRAMES 2.0f

/// How often the square of the light of a history exceeds the variance of its frames, which is `scatter` times
/// that square as far as frames have shown.
static inline Float clearness_of(Float scatter, Float frames)
{
    return (frames + PRIOR_FRAMES) / max(frames * scatter + PRIOR_FRAMES * PRIOR_VARIANCE, 1e-30f);
}

/// Samples that a history is worth of which a part has changed: with N of variance v and a bias b, it errs as
/// N / (1 + N b^2 / v) without bias.  All of them if nothing has changed.
static inline Float worth_of(Float scatter, Float count, Float change, Float fresh)
{
    // A change of c of the brighter of both leaves at least 1 - c of it.
    const Float bias = change / (1.0f - min(change, CERTAIN));
    const Float frames = count / max(fresh, 1.0f);
    const Float ratio = frames * bias * bias * clearness_of(scatter, frames);
    return pick(change > 0.0f, count / (1.0f + ratio), count);
}

/// The variance of frames relative to the square of their mean.
static inline Float scatter_of(Float level, Float mean_square)
{
    return max(mean_square - level * level, 0.0f) / max(level * level, 1e-30f);
}

/// What a frame adds.
typedef struct {
    Float alpha; // its weight
    Float count; // samples that both are worth from then on
    Float kept;  // samples that what was known is worth in this frame
} Share;

/// The share of a frame of `fresh` samples in what was known: its samples, and how far frames scatter.
static inline Share share_of_frame(
    __global const Params *params, Float known, Float scatter, Float change, Float fresh)
{
    const Mask is_known = known > 0.0f;
    Float kept = pick(is_known, worth_of(scatter, known, change, fresh), (Float)(0.0f));
    Float alpha = fresh / max(kept + fresh, 1.0f);
    Float count = kept + fresh;
    if (params->temporal_rule == RULE_EXPONENTIAL) {
        alpha = pick(is_known, (Float)(params->temporal_alpha), (Float)(1.0f));
        count = min(count, fresh / max(alpha, 1e-6f));
        kept = min(kept, fresh / max(alpha, 1e-6f) - fresh);
    }
    const Mask changed = is_known & (change > 0.0f);
    const Float part = max(change - CERTAIN, 0.0f) * (1.0f / (1.0f - CERTAIN));
    alpha = pick(changed, alpha + part * part * (1.0f - alpha), alpha);
    // The bias of what is kept stays, while noise goes: in the frames to come it counts for less, by the part
    // of it that was worth keeping.
    const Float left = fresh / max(alpha, 1e-6f) - fresh;
    Share share;
    share.count = pick(changed, fresh + left * left / max(known, 1.0f), count);
    share.kept = pick(changed, left, kept);
    share.alpha = pick(is_known, alpha, (Float)(1.0f));
    return share;
}
