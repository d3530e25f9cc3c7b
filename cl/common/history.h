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

/// Samples that a history is worth of which a part has changed: with N of variance v and a bias b, it errs as
/// N / (1 + N b^2 / v) without bias.  All of them if nothing has changed.
static inline Float worth_of(Float level, Float count, Float mean_square, Float change, Float fresh)
{
    // A change of c of the brighter of both leaves at least 1 - c of it.
    const Float bias = change * level / (1.0f - min(change, CERTAIN));
    const Float frames = count / max(fresh, 1.0f);
    const Float spread = max(mean_square - level * level, 0.0f);
    const Float variance =
        (frames * spread + PRIOR_FRAMES * PRIOR_VARIANCE * level * level) / (frames + PRIOR_FRAMES);
    const Float ratio = frames * bias * bias / max(variance, 1e-30f);
    return pick(change > 0.0f, count / (1.0f + ratio), count);
}

/// What a frame adds.
typedef struct {
    Float alpha; // its weight
    Float count; // samples that both are worth from then on
    Float kept;  // samples that what was known is worth in this frame
} Share;

/// The share of a frame of `fresh` samples in what was known: its luminance, samples, and mean square of the
/// luminance of frames.
static inline Share share_of_frame(
    __global const Params *params, Float level, Float known, Float mean_square, Float change, Float fresh)
{
    const Mask is_known = known > 0.0f;
    Float kept = pick(is_known, worth_of(level, known, mean_square, change, fresh), (Float)(0.0f));
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
