// The tree of lights: a light is drawn for a point by what each part of the tree might bring there.
//
// Conty Estevez, Kulla: Importance Sampling of Many Lights with Adaptive Tree Splitting, 2018; bounds of
// angles as in Pharr, Jakob, Humphreys: Physically Based Rendering, 4th edition, section 12.6.3.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "rng.h"
#include "unit_vector.h"

/// A light and the chance that it is drawn; 0 in dead lanes.
typedef struct {
    UInt light;
    Float pmf;
#if PHOTON_POINTS
    Mask stored; // whether it is the light of a photon, and lit by the point that this one started from
    UInt point;
#endif
} LightChoice;

// Of two nodes that both may bring light, each is drawn at least this often: the other may be hidden.
#define LEAST_LIGHT_SHARE 0x1p-10f
// Sine of an angle beyond the horizon that still counts: normals and axes are rounded.
#define HORIZON_SLACK 1e-3f
// Of a cluster that is small, by its radius over the distance, and whose lights face one way, by the least cosine
// to their axis, what each light brings is as its power.
#define FAR_RATIO 0x1p-3f
#define ONE_WAY 0.995f

#if LIGHT_SAMPLING
/// Cosine of the angle a - b, of at least 0, and its sine.
static inline Float cosine_of_difference(Float cos_a, Float sin_a, Float cos_b, Float sin_b, Float *sine)
{
    const Mask less = cos_a > cos_b;
    *sine = pick(less, (Float)(0.0f), sin_a * cos_b - cos_a * sin_b);
    return pick(less, (Float)(1.0f), cos_a * cos_b + sin_a * sin_b);
}

// Words of a LightPair before an array of its members.
#define PAIR_WORDS ((uint)(sizeof(LightPair) / 4u))
#define WORDS_BEFORE(member) ((uint)((size_t)(((__global LightPair *)0)->member) / 4u))

/// A member of a node, which is 2 * pair + side; the other node's is `stride` words away.
static inline Float node_word(__global const LightPair *pairs, UInt node, uint word, uint stride)
{
    const UInt at = (node >> 1) * PAIR_WORDS + (node & 1u) * stride + word;
    return gather_words((__global const float *)pairs, at);
}

/// Center of a node, world, m.
static inline Vec3 node_center(__global const LightPair *pairs, UInt node)
{
    const uint at = WORDS_BEFORE(center);
    return vec3(node_word(pairs, node, at, 3u), node_word(pairs, node, at + 1u, 3u), node_word(pairs, node, at + 2u, 3u));
}

/// Power of all lights of a node.
static inline Float node_power(__global const LightPair *pairs, UInt node)
{
    return node_word(pairs, node, WORDS_BEFORE(power), 1u);
}

static inline Float rough_root(Float x) { return x * rough_rsqrt(max(x, 1e-30f)); }

/// Bound of the light that a node of this power brings to a surface at `p` with normal `n`, unoccluded.
static inline Float node_importance(__global const LightPair *pairs, UInt node, Float power, Vec3 p, Vec3 n)
{
    const Float radius = node_word(pairs, node, WORDS_BEFORE(radius), 1u);
    const Vec3 axis = unpack_direction(as_bits(node_word(pairs, node, WORDS_BEFORE(axis), 1u)));
    const Float cos_spread = node_word(pairs, node, WORDS_BEFORE(cos_spread), 1u);
    const Float sin_spread = rough_root(1.0f - cos_spread * cos_spread);

    const Vec3 toward = sub(node_center(pairs, node), p);
    const Float d2 = dot3(toward, toward);
    const Float r2 = radius * radius;
    // From inside of the sphere as from its surface.
    const Float inverse = rough_rsqrt(max(max(d2, r2), 1e-37f));
    const Vec3 wi = scale(toward, inverse);
    // The sphere hides an angle of up to half a turn, or everything from inside.
    const Mask inside = d2 <= r2;
    const Float sin_sphere = pick(inside, (Float)(0.0f), min(radius * inverse, (Float)(1.0f)));
    const Float cos_sphere = pick(inside, (Float)(-1.0f), rough_root(1.0f - sin_sphere * sin_sphere));

    const Float cos_axis = clamp(-dot3(axis, wi) * rough_rsqrt(dot3(axis, axis)), (Float)(-1.0f), (Float)(1.0f));
    const Float sin_axis = rough_root(1.0f - cos_axis * cos_axis);
    Float sine;
    Float cosine = cosine_of_difference(cos_axis, sin_axis, cos_spread, sin_spread, &sine);
    const Float leaves = cosine_of_difference(cosine, sine, cos_sphere, sin_sphere, &sine);

#if TRANSMISSION
    const Float cos_normal = min(fabs(dot3(n, wi)), (Float)(1.0f));
#else
    const Float cos_normal = clamp(dot3(n, wi), (Float)(-1.0f), (Float)(1.0f));
#endif
    const Float sin_normal = rough_root(1.0f - cos_normal * cos_normal);
    const Float falls =
        cosine_of_difference(cos_normal, sin_normal, cos_sphere, sin_sphere, &sine) + HORIZON_SLACK;
    const Float bound = power * max(leaves, 0.0f) * max(falls, 0.0f) * inverse * inverse;
    return pick(radius < INFINITY, min(bound, 1e30f), power);
}

/// Chance that the left node of a pair is drawn.
///
/// Where the bound of the pair was too high and neither brings any light, their powers decide.
LARGE_FUNCTION Float left_chance(__global const LightPair *pairs, UInt pair, Vec3 p, Vec3 n)
{
    const UInt node = pair << 1;
    const Float left_power = node_power(pairs, node);
    const Float right_power = node_power(pairs, node | 1u);
    Float left = node_importance(pairs, node, left_power, p, n);
    Float right = node_importance(pairs, node | 1u, right_power, p, n);
    const Mask dark = !(left + right > 0.0f);
    left = pick(dark, left_power, left);
    right = pick(dark, right_power, right);
    const Mask both = (left > 0.0f) & (right > 0.0f);
    const Float chance = left / pick(both, left + right, (Float)(1.0f));
    const Float one = pick(right > 0.0f, (Float)(0.0f), (Float)(1.0f));
    return pick(both, clamp(chance, (Float)(LEAST_LIGHT_SHARE), (Float)(1.0f - LEAST_LIGHT_SHARE)), one);
}

/// Word `i` of a part of the clusters: of a light, of a slot of the clusters in order, or of a pair.
static inline UInt cluster_word(__global const uint *clusters, uint light_count, uint part, UInt i)
{
    return GATHER_WORD(clusters, part * light_count + i);
}

/// Return where the power alone decides in a cluster, which is a node.
static inline Mask is_far(__global const LightPair *pairs, Mask asks, UInt node, Vec3 p)
{
    node = pick_u(asks, node, (UInt)(0u));
    const Vec3 toward = sub(node_center(pairs, node), p);
    const Float radius = node_word(pairs, node, WORDS_BEFORE(radius), 1u);
    const Float reach = FAR_RATIO * FAR_RATIO * dot3(toward, toward);
    return asks & (radius * radius <= reach) & (node_word(pairs, node, WORDS_BEFORE(cos_spread), 1u) >= ONE_WAY);
}

/// A light of the tree, and the chances of the two parts of the way to it.
typedef struct {
    UInt light;
    Float above;  // that its group is drawn from the root
    Float inside; // that the light is drawn from its group
} TreeChoice;

/// Draw a light for a surface at `p` with normal `n`, below `node`, which has the word `child` in its pair.
///
/// The random number goes from node to node: what is left of it is uniform in the node that was drawn.
/// Digits that it runs out of are made up.
LARGE_FUNCTION TreeChoice descend_tree(
    __global const LightPair *pairs,
    __global const uint *clusters,
    uint light_count,
    Mask active,
    UInt node,
    UInt child,
    Vec3 p,
    Vec3 n,
    UInt bits)
{
    TreeChoice choice;
    choice.light = child & NODE_MASK;
    choice.above = (Float)(1.0f);
    choice.inside = (Float)(1.0f);
    Float u = unit_float(bits);
    Mask inner = active & (child < LEAF_BIT);
    // No tree is deeper than it has leaves.
    for (uint level = 0; level <= light_count && any_lane(inner); ++level) {
        const UInt pair = pick_u(inner, child & NODE_MASK, (UInt)(0u));
        const Mask small = inner & ((child & CLUSTER_BIT) != 0u);
        if (any_lane(small)) {
            const Mask far = is_far(pairs, small, node, p);
            const UInt first = cluster_word(clusters, light_count, CLUSTER_FIRST, pair);
            const UInt length =
                pick_u(far, cluster_word(clusters, light_count, CLUSTER_LENGTH, pair), (UInt)(0u));
            const Mask drawn = length > 0u;
            Float alias_u;
            const UInt digits = digits_left(u, (Float)(1.0f), mix_bits(bits + 0x9e3779b9u));
            const UInt slot = alias_slot(digits, length, &alias_u) + pick_u(drawn, first, (UInt)(0u));
            const Mask keeps = alias_u < from_bits(cluster_word(clusters, light_count, CLUSTER_KEEP, slot));
            const UInt light = pick_u(keeps, cluster_word(clusters, light_count, CLUSTER_LIGHT, slot),
                                      cluster_word(clusters, light_count, CLUSTER_OTHER, slot));
            choice.light = pick_u(drawn, light, choice.light);
            const UInt known = pick_u(drawn, light, (UInt)(0u));
            const Float share = from_bits(cluster_word(clusters, light_count, CLUSTER_CHANCE, known));
            choice.inside = pick(drawn, choice.inside * share, choice.inside);
            inner &= !drawn;
            if (!any_lane(inner))
                break;
        }
        const Float chance = left_chance(pairs, pair, p, n);
        const Mask left = u < chance;
        const Float share = pick(left, chance, 1.0f - chance);
        const Float scale = 1.0f / max(share, 0x1p-30f);
        bits = mix_bits(bits + 0x9e3779b9u);
        const Float rest = (pick(left, u, u - chance) + 0x1p-24f * unit_float(bits)) * scale;
        u = clamp(rest, (Float)(0.0f), (Float)(0x1.fffffep-1f));
        node = pair << 1 | pick_u(left, (UInt)(0u), (UInt)(1u));
        child = pick_u(left, GATHER_U(pairs, pair, child[0]), GATHER_U(pairs, pair, child[1]));
        // Where no light was fit for the tree, its only pair leads nowhere.
        const Mask there = child != NO_LIGHT;
        const Float so_far = pick(there, choice.inside * share, (Float)(0.0f));
        const Mask group = inner & ((child & GROUP_BIT) != 0u);
        choice.above = pick(group, so_far, choice.above);
        choice.inside = pick(group, (Float)(1.0f), pick(inner, so_far, choice.inside));
        const Mask leaf = child >= LEAF_BIT;
        choice.light = pick_u(inner & leaf & there, child & NODE_MASK, choice.light);
        inner &= !leaf;
    }
    return choice;
}

/// Chances of a light from its group and from the root.
///
/// `places`: that of every light, as 2 * pair + side, then of every pair; NO_LIGHT for those that have none,
/// which are never drawn.  Where `whole` is not set, only what is inside of the group matters.
LARGE_FUNCTION TreeChoice climb_tree(
    __global const LightPair *pairs,
    __global const uint *places,
    __global const uint *clusters,
    uint light_count,
    Mask whole,
    Mask active,
    UInt light,
    Vec3 p,
    Vec3 n)
{
    TreeChoice choice;
    UInt place = GATHER_WORD(places, light);
    Mask climbs = active & (place != NO_LIGHT);
    choice.light = light;
    choice.above = pick(climbs, (Float)(1.0f), (Float)(0.0f));
    choice.inside = choice.above;
    const UInt cluster = cluster_word(clusters, light_count, CLUSTER_PLACE, light);
    const Mask small = climbs & (cluster != NO_LIGHT);
    if (any_lane(small)) {
        const Mask far = is_far(pairs, small, cluster, p);
        place = pick_u(far, cluster, place);
        choice.inside =
            pick(far, from_bits(cluster_word(clusters, light_count, CLUSTER_CHANCE, light)), choice.inside);
    }
    Mask inside = climbs;
    for (uint level = 0; level <= light_count; ++level) {
        const UInt pair = pick_u(climbs, place >> 1, (UInt)(0u));
        const Mask left = (place & 1u) == 0u;
        const UInt child = pick_u(left, GATHER_U(pairs, pair, child[0]), GATHER_U(pairs, pair, child[1]));
        inside &= (child & GROUP_BIT) == 0u;
        climbs &= inside | whole;
        if (!any_lane(climbs))
            break;
        const Float chance = left_chance(pairs, pair, p, n);
        const Float share = pick(left, chance, 1.0f - chance);
        choice.inside = pick(climbs & inside, choice.inside * share, choice.inside);
        choice.above = pick(climbs & !inside, choice.above * share, choice.above);
        place = GATHER_WORD(places, light_count + pair);
        climbs &= place != NO_LIGHT;
    }
    return choice;
}
#endif
