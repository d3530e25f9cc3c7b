// Directions drawn by the guide: it takes the place of the cosine in the diffuse lobe.
#pragma once

#include "lanes.h"
#include "bsdf.h"
#include "guide.h"

#if TANGENTS
// The guide has a frame of its own: the turn from it to the tangents.
typedef struct {
    Float xs;
    Float xt;
    Float ys;
    Float yt;
} GuideTurn;
#define GUIDE_TURN_PARAMETERS , GuideTurn turn
#define GUIDE_TURN , turn
#else
#define GUIDE_TURN_PARAMETERS
#define GUIDE_TURN
#endif

/// Replace the cosine density of the diffuse lobe in `pdf` by that of the guide; returns the part of the
/// hemisphere that `wi` (local) is in, if somebody `learns` or is guided.
static inline UInt guide_pdf(
    __global const GuideCell *cells, UInt slot, LobeChances chances, int learns, Vec3 wi GUIDE_TURN_PARAMETERS, Float *pdf)
{
    if (!any_lane(slot != NO_SLOT) && !learns)
        return (UInt)(0u);
#if TANGENTS
    const UInt part = guide_bin(wi.x * turn.xs + wi.y * turn.ys, wi.x * turn.xt + wi.y * turn.yt);
#else
    const UInt part = guide_bin(wi.x, wi.y);
#endif
    const Float more = chances.diffuse * wi.z * INV_PI * (guide_density(cells, slot, part) - 1.0f);
    *pdf = pick((wi.z > 0.0f) & (*pdf > 0.0f), *pdf + more, *pdf);
    return part;
}

/// Draw wi (local) as sample_bsdf does, the diffuse lobe by the guide.
static inline Vec3 sample_guided(
    __global const GuideCell *cells,
    UInt slot,
    Bsdf b,
    LobeChances chances,
    Vec3 wo GUIDE_TURN_PARAMETERS,
    Float u_lobe,
    Float u1,
    Float u2)
{
    Float x;
    Float y;
    Float v1 = u1;
    Float v2 = u2;
    warp_by_guide(cells, slot, &v1, &v2);
    disk_of_square(v1, v2, &x, &y);
    const Float z = sqrt(max(1.0f - x * x - y * y, (Float)(1e-12f)));
#if TANGENTS
    const Vec3 guided = vec3(x * turn.xs + y * turn.xt, x * turn.ys + y * turn.yt, z);
#else
    const Vec3 guided = vec3(x, y, z);
#endif
    const Mask diffuse = u_lobe < chances.diffuse;
    if (!any_lane(!diffuse))
        return guided;
    return pick_v(diffuse, guided, sample_bsdf(b, chances, wo, u_lobe, u1, u2));
}

/// Chance to go on where the guide knows what is still to come; `otherwise` where it does not.
///
/// It sends rays of a small throughput to where the light is: what a path is worth is not what is behind
/// it.  Paths that bring a fifth of what their first vertex was expected to, or more, go on.
/// Vorba, Krivanek: Adjoint-Driven Russian Roulette and Splitting, 2016.
static inline Float informed_chance(Float to_come, Float expected, Float otherwise)
{
    const Mask known = (to_come > 0.0f) & (expected > 0.0f) & (expected < INFINITY);
    const Float chance = 5.0f * to_come / pick(known, expected, (Float)(1.0f));
    return pick(known, clamp(chance, (Float)(0.05f), (Float)(1.0f)), otherwise);
}
