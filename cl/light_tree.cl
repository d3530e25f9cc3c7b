// Bounds of the tree of lights, level by level from the leaves up.

#include "common/lanes.h"
#include "common/layout.h"
#include "common/unit_vector.h"

/// Box, cone and power of one light.
static inline LightBounds bounds_of_light(__global const Light *light, float power_unit)
{
    LightBounds b;
    const int sphere = (light->flags & LIGHT_SPHERE) != 0u;
    const int triangle = light->kind == LIGHT_TRIANGLE && !sphere;
    const float radius = sphere ? length(vload3(0, light->e1)) : 0.0f;
    const int around = sphere || light->kind == LIGHT_POINT
                       || (triangle && (light->flags & MATERIAL_TWO_SIDED_EMISSION) != 0u);
    for (uint i = 0; i < 3; ++i) {
        const float p = light->position[i];
        const float q = triangle ? p + light->e1[i] : p;
        const float r = triangle ? p + light->e2[i] : p;
        const float s = light->flags & LIGHT_RECTANGLE ? q + (r - p) : p;
        b.low[i] = min(min(p, s), min(q, r)) - radius;
        b.high[i] = max(max(p, s), max(q, r)) + radius;
        b.axis[i] = light->direction[i];
    }
    b.power = clamp(light->power * power_unit, 0.0f, 1e36f);
    b.spread = around ? PI : light->kind == LIGHT_SPOT ? acos(clamp(light->cos_outer, -1.0f, 1.0f)) : 0.0f;
    b.far = light->kind == LIGHT_ENVIRONMENT || light->kind == LIGHT_DIRECTIONAL;
    return b;
}

/// Widen a cone so that it has another one in it.
///
/// Conty Estevez, Kulla 2018: the union of two bounding cones.
static inline void join_cones(LightBounds *a, const LightBounds *b)
{
    const float3 wide = vload3(0, a->spread >= b->spread ? a->axis : b->axis);
    const float3 narrow = vload3(0, a->spread >= b->spread ? b->axis : a->axis);
    const float most = max(a->spread, b->spread);
    const float least = min(a->spread, b->spread);
    const float apart = acos(clamp(dot(wide, narrow), -1.0f, 1.0f));
    float3 axis = wide;
    float spread = most;
    if (apart + least > most) {
        spread = 0.5f * (most + apart + least);
        const float3 across = narrow - wide * dot(wide, narrow);
        const float length2 = dot(across, across);
        // Opposite directions lie on no one great circle: all around.
        if (spread >= PI || length2 < 1e-12f)
            spread = PI;
        else
            axis = wide * cos(spread - most) + across * (sin(spread - most) / sqrt(length2));
    }
    vstore3(axis, 0, a->axis);
    a->spread = spread;
}

/// Fit the pairs of a level to their children, which are fitted.  One work item a pair.
///
/// `power_unit` times the power of a light is its power in the tree.  The pair above all near and all far lights draws by constant shares: `near_share`, and the rest.
///
/// reads   places[level_start ..], pairs[].child, bounds of the pairs below, lights
/// writes  pairs[], bounds[]
kernel void fit_light_pairs(
    __global const Light *lights,
    __global const uint *order,
    __global LightPair *pairs,
    __global LightBounds *bounds,
    const float power_unit,
    const float near_share,
    const uint level_start,
    const uint level_count)
{
    const uint i = get_global_id(0);
    if (i >= level_count)
        return;
    const uint pair = order[level_start + i];
    LightBounds side[2];
    for (uint k = 0; k < 2; ++k) {
        const uint child = pairs[pair].child[k];
        if (child == NO_LIGHT) {
            side[k] = side[0];
            side[k].power = 0.0f;
        } else {
            const uint index = child & NODE_MASK;
            side[k] = child >= LEAF_BIT ? bounds_of_light(&lights[index], power_unit) : bounds[index];
        }
    }
    const int split = side[0].far != side[1].far;
    for (uint k = 0; k < 2; ++k) {
        const float3 low = vload3(0, side[k].low);
        const float3 high = vload3(0, side[k].high);
        const float3 center = 0.5f * low + 0.5f * high;
        vstore3(center, 0, pairs[pair].center[k]);
        // Rounded up: the center is rounded.
        const float radius = length(0.5f * high - 0.5f * low) * 1.000001f;
        pairs[pair].radius[k] = split || side[k].far ? INFINITY : radius;
        pairs[pair].power[k] = split ? (side[k].far ? 1.0f - near_share : near_share) : side[k].power;
        pairs[pair].cos_spread[k] = side[k].spread >= PI ? -1.0f : cos(min(side[k].spread + 1e-3f, PI));
        pairs[pair].axis[k] = pack_unit(vec3(side[k].axis[0], side[k].axis[1], side[k].axis[2]));
    }
    LightBounds both = side[0];
    for (uint a = 0; a < 3; ++a) {
        both.low[a] = min(side[0].low[a], side[1].low[a]);
        both.high[a] = max(side[0].high[a], side[1].high[a]);
    }
    both.power = side[0].power + side[1].power;
    join_cones(&both, &side[1]);
    bounds[pair] = both;
}
