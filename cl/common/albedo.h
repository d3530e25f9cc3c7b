// What lobes leave of white light from one direction, so that bsdf.h can give back what light between
// facets loses, and layers take what they reflect from what is under them.
#pragma once

#include "lanes.h"

#include "albedo_tables.h"

#if GLOSSY

static inline Float fifth_power_of_one_minus(Float x)
{
    const Float y = max(1.0f - x, 0.0f);
    const Float y2 = y * y;
    return y2 * y2 * y;
}

// Albedos by the fits of albedo_tables.h: polynomials in x = 2 q - 1, q = cos (1 + alpha) / (cos + alpha), because
// a lobe near the horizon looks the same for all alpha in it.  They are never too small by more than 3e-4,
// for light must not be gained, and too large by less than 0.006 of a mirror and 0.004 of an edge.

/// Sum of c[k] x^k for the `terms` coefficients of a fit.
static inline Float polynomial(__constant const float *c, uint terms, Float x)
{
    Float sum = (Float)(c[terms - 1]);
    for (uint k = terms - 1; k > 0; --k)
        sum = sum * x + c[k - 1];
    return sum;
}

/// The same of coefficients that have been set up.
static inline Float set_up_polynomial(const Float *c, uint terms, Float x)
{
    Float sum = c[terms - 1];
    for (uint k = terms - 1; k > 0; --k)
        sum = sum * x + c[k - 1];
    return sum;
}

/// Where the fits of an edge have a width, in [-1, 1].
static inline Float place_of_edge(Float alpha)
{
    const float least = 1.0f / (1.0f + EDGE_SCALE);
    return 2.0f / (1.0f - least) * (1.0f / (1.0f + EDGE_SCALE * alpha) - least) - 1.0f;
}

/// Fits of GGX for one width.
typedef struct {
    Float alpha;
    Float mirror[MIRROR_TERMS];
    Float edge[EDGE_TERMS];
} Facets;

/// What facets reflect of white light from one direction.
typedef struct {
    Float white; // all of them white mirrors, without scattering between facets
    Float edge;  // with a reflectance of (1 - cos)^5
} Reflected;

static inline Facets facets_of(Float alpha)
{
    Facets f;
    f.alpha = alpha;
    for (uint k = 0; k < MIRROR_TERMS; ++k)
        f.mirror[k] = polynomial(MIRROR_FIT[k], MIRROR_WIDTHS, 2.0f * alpha - 1.0f);
    const Float place = place_of_edge(alpha);
    for (uint k = 0; k < EDGE_TERMS; ++k)
        f.edge[k] = polynomial(EDGE_FIT[k], EDGE_WIDTHS, place);
    return f;
}

static inline Reflected reflected_by(Facets f, Float cosine)
{
    const Float inverse = 1.0f / (cosine + f.alpha);
    const Float x = 2.0f * (1.0f + f.alpha) * cosine * inverse - 1.0f;
    const Float lost = f.alpha * inverse * set_up_polynomial(f.mirror, MIRROR_TERMS, x);
    Reflected r;
    r.white = clamp((1.0f - lost) * (1.0f + MIRROR_RAISED), (Float)(0.25f), (Float)(1.0f));
    r.edge = fifth_power_of_one_minus(cosine) * set_up_polynomial(f.edge, EDGE_TERMS, x) + EDGE_RAISED;
    return r;
}

#if LAYERS
/// What white sheen is scaled by, so that it nowhere reflects more than all: 1 from roughness 0.46 on.
static inline Float sheen_scale(Float roughness) { return 1.0f / max(2.2f - 2.6f * roughness, (Float)(1.0f)); }

/// Part of the light that white sheen reflects, too large by less than 0.003.
static inline Float sheen_albedo(Float roughness, Float cosine)
{
    const Float x = 2.0f * (1.0f + SHEEN_SCALE) * cosine / (cosine + SHEEN_SCALE) - 1.0f;
    const Float y = 2.0f / (1.0f / SHEEN_ROUGHNESS_MIN - 1.0f) * (1.0f / roughness - 1.0f) - 1.0f;
    Float sum = (Float)(0.0f);
    for (uint k = SHEEN_TERMS; k > 0; --k)
        sum = sum * x + polynomial(SHEEN_FIT[k - 1], SHEEN_ROUGHNESSES, y);
    return clamp(sum * sheen_scale(roughness) + SHEEN_RAISED, (Float)(0.0f), (Float)(1.0f));
}
#endif

#if LAYERS
#define TABLE_AXES 4
#define TABLE_CORNERS (1 << TABLE_AXES)

/// What a table of albedo_tables.h has at `places`, in [0, 1] along each axis, between entries linearly;
/// 1 in lanes that are not wanted.
static inline Float look_up(
    Mask wanted, __constant const ushort *table, __constant const uint *shape, const Float *places)
{
    Float part[TABLE_AXES];
    uint offset[TABLE_CORNERS];
    UInt first = (UInt)(0u);
    uint stride = 1;
    offset[0] = 0;
    for (uint axis = TABLE_AXES; axis-- > 0;) {
        const uint most = shape[axis] - 1u;
        // Not a number becomes 0 here: no index leaves the table.
        const Float place = pick(places[axis] > 0.0f, min(places[axis], (Float)(1.0f)), (Float)(0.0f));
        const Float at = place * (float)most;
        const UInt whole = min(to_uint(at), (UInt)(most - 1u));
        part[axis] = at - to_float(whole);
        first += whole * stride;
        const uint known = TABLE_CORNERS >> (axis + 1u);
        for (uint corner = 0; corner < known; ++corner)
            offset[known + corner] = offset[corner] + stride;
        stride *= shape[axis];
    }
    uint lane_first[W];
    float lane_entry[TABLE_CORNERS][W];
    store_lanes_u(first, lane_first);
    for (uint corner = 0; corner < TABLE_CORNERS; ++corner)
        store_lanes((Float)(65535.0f), lane_entry[corner]);
    for (uint left = lane_bits(wanted); left; left &= left - 1u) {
        const uint k = lowest_bit(left);
        for (uint corner = 0; corner < TABLE_CORNERS; ++corner)
            lane_entry[corner][k] = (float)table[lane_first[k] + offset[corner]];
    }
    // Corners on the far side of the first axis are the second half, and so on.
    Float entry[TABLE_CORNERS];
    for (uint corner = 0; corner < TABLE_CORNERS; ++corner)
        entry[corner] = load_lanes(lane_entry[corner]);
    for (uint axis = 0; axis < TABLE_AXES; ++axis) {
        const uint half_of_them = TABLE_CORNERS >> (axis + 1u);
        for (uint corner = 0; corner < half_of_them; ++corner)
            entry[corner] += (entry[half_of_them + corner] - entry[corner]) * part[axis];
    }
    return entry[0] * (1.0f / 65535.0f);
}
#endif

#if LAYERS
/// What facets of two widths reflect of white light from `wo`, in lanes in which these differ.
static inline Reflected reflected_by_stretched(Mask stretched, Float alpha_x, Float alpha_y, Vec3 wo, Reflected round)
{
    const Float low = min(alpha_x, alpha_y);
    const Float high = max(alpha_x, alpha_y);
    // The width that is seen along wo.
    const Float x = alpha_x * wo.x;
    const Float y = alpha_y * wo.y;
    const Float width = clamp(sqrt((x * x + y * y) / max(wo.x * wo.x + wo.y * wo.y, 1e-12f)), low, high);
    // place_of_whites and place_of_edges in tools/make_albedo_tables.py.
    const Float ratio = low / high;
    const Float along = pick(alpha_x >= alpha_y, x * x, y * y) / max(x * x + y * y, 1e-30f);
    const Float turned = sqrt(x * x + y * y) / max(wo.z, 1e-12f);
    const Float whites[4] = {
        native_exp2(-0.75f * native_log2(1.0f + turned)),
        native_exp2(0.8f * native_log2(max(along, 1e-12f))),
        high,
        ratio,
    };
    const Float least = sqrt(sqrt(low));
    const Float edges[4] = {
        native_exp2(0.75f * native_log2(max(wo.z * (1.0f + width) / (wo.z + width), 1e-12f))),
        (sqrt(sqrt(width)) - least) / (sqrt(sqrt(high)) - least),
        sqrt(high),
        sqrt(ratio),
    };
    Reflected r;
    const Float white = STRETCHED_MOST * look_up(stretched, STRETCHED_TABLE, STRETCHED_SHAPE, whites);
    r.white = clamp(white, (Float)(0.25f), (Float)(1.0f));
    // Of the edge the table has the cosine at which all facets together seem to be met.
    const Float met = 1.0f - look_up(stretched, STRETCHED_EDGE_TABLE, STRETCHED_EDGE_SHAPE, edges);
    r.edge = r.white * fifth_power_of_one_minus(met * STRETCHED_MET * (wo.z + width));
    r.white = pick(stretched, r.white, round.white);
    r.edge = pick(stretched, r.edge, round.edge);
    return r;
}
#endif

#endif
