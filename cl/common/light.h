// Emitters: the light table, its sampling and its densities; the environment.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "alpha.h"
#include "light_tree.h"
#include "particle_map.h"
#include "rectangle.h"
#include "rng.h"
#include "sphere.h"
#include "surface.h"

/// Light that arrives at a point from one sampled direction.
typedef struct {
    Vec3 toward;      // from the point to the light, m, not normalised
    Vec3 wi;          // the same, unit
    Vec3 radiance;    // arriving; of a light without extent, irradiance across the ray
    Float pdf;        // per solid angle, times the chance of the light; without extent, the chance
    Mask extended;    // whether a BSDF sample could find this light too
} LightSample;

/// The two numbers in [0, 1), 16 bits each, that a photon's point of its light was drawn with.
static inline void light_point(UInt point, Float *u1, Float *u2)
{
    *u1 = (to_float(point & 0xffffu) + 0.5f) * 0x1p-16f;
    *u2 = (to_float(point >> 16) + 0.5f) * 0x1p-16f;
}

static inline Float power_heuristic(Float a, Float b)
{
    // Divided by the larger first: densities of tiny lights overflow when they are squared.
    const Float largest = max(max(a, b), 1e-30f);
    const Float x = a / largest;
    const Float y = b / largest;
    return x * x / max(x * x + y * y, 1e-30f);
}

#if ENVIRONMENT == 2
/// Texture coordinates of a world direction, and the sine of its angle from the zenith.
static inline void environment_uv(__global const Params *params, Vec3 d, Float *u, Float *v, Float *sine)
{
    __global const float *m = params->environment_rotation;
    const Vec3 l = vec3(m[0] * d.x + m[1] * d.y + m[2] * d.z, m[3] * d.x + m[4] * d.y + m[5] * d.z,
                        m[6] * d.x + m[7] * d.y + m[8] * d.z);
    *sine = sqrt(l.x * l.x + l.z * l.z);
    const Float turns = atan2_lanes(l.x, -l.z) * (0.5f * INV_PI);
    *u = pick(turns < 0.0f, turns + 1.0f, turns);
    *v = atan2_lanes(*sine, l.y) * INV_PI;
}

/// Index of a cell; columns wrap, rows end.
static inline UInt environment_cell(__global const Params *params, Float x, Float y)
{
    const Float width = (Float)((float)params->environment_width);
    const Float height = (Float)((float)params->environment_height);
    const Float column = pick(x < 0.0f, x + width, pick(x >= width, x - width, x));
    const UInt i = min(to_uint(max(column, 0.0f)), (UInt)(params->environment_width - 1u));
    const UInt j = min(to_uint(clamp(y, (Float)(0.0f), height - 1.0f)), (UInt)(params->environment_height - 1u));
    return j * params->environment_width + i;
}

/// Chance per solid angle of the cell at (u, v).
static inline Float environment_density(
    __global const Params *params, __global const EnvironmentCell *cells, UInt cell, Float sine)
{
    const float count = (float)params->environment_width * (float)params->environment_height;
    const Float pdf = GATHER(cells, cell, pmf) * (count * 0.5f * INV_PI * INV_PI) / max(sine, 1e-9f);
    return pick(sine > 1e-7f, pdf, (Float)(0.0f));
}

/// Bilinear radiance at (u, v).
LARGE_FUNCTION Vec3 environment_look_up(
    __global const Params *params, __global const EnvironmentCell *cells, Float u, Float v)
{
    const Float x = u * (float)params->environment_width - 0.5f;
    const Float y = v * (float)params->environment_height - 0.5f;
    const Float x0 = floor(x);
    const Float y0 = floor(y);
    const Float fx = x - x0;
    const Float fy = y - y0;
    Vec3 sum = vec3_all((Float)(0.0f));
    for (uint k = 0; k < 4; ++k) {
        const Float weight = ((k & 1u) ? fx : 1.0f - fx) * ((k & 2u) ? fy : 1.0f - fy);
        const UInt cell = environment_cell(params, x0 + (float)(k & 1u), y0 + (float)(k >> 1));
        const Vec3 c = vec3(GATHER(cells, cell, radiance[0]), GATHER(cells, cell, radiance[1]),
                            GATHER(cells, cell, radiance[2]));
        sum = add_scaled(sum, c, weight);
    }
    return sum;
}
#endif

#if ENVIRONMENT
/// Radiance from direction `d`, and the density with which sample_light draws it, given the chance that
/// the environment is the light that is chosen.
LARGE_FUNCTION Vec3 eval_environment(
    __global const Params *params,
#if ENVIRONMENT == 2
    __global const EnvironmentCell *cells,
#endif
    Vec3 d,
    Float chance,
    Float *pdf)
{
    const Vec3 factor = vec3_of(params->environment_radiance);
#if ENVIRONMENT == 2
    Float u;
    Float v;
    Float sine;
    environment_uv(params, d, &u, &v, &sine);
    const UInt cell = environment_cell(params, u * (float)params->environment_width,
                                       v * (float)params->environment_height);
    *pdf = chance * environment_density(params, cells, cell, sine);
    return mul(factor, environment_look_up(params, cells, u, v));
#else
    *pdf = chance * (0.25f * INV_PI);
    return factor;
#endif
}
#endif

#if ENVIRONMENT
/// Draw a direction to the sky; `u1` and `u2` say where in a texel, other numbers which.
LARGE_FUNCTION Vec3 sample_environment(
    __global const Params *params,
#if ENVIRONMENT == 2
    __global const EnvironmentCell *cells,
#endif
    Seed seed,
    UInt reversed_index,
    UInt pair,
    Float u1,
    Float u2,
    Vec3 *radiance,
    Float *density)
{
#if ENVIRONMENT == 2
    UInt index_bits;
    UInt alias_bits;
    sample_bits(seed, reversed_index, pair + PAIR_ENVIRONMENT, params->sampler, &index_bits, &alias_bits);
    const uint width = params->environment_width;
    const uint height = params->environment_height;
    Float unused;
    UInt cell = alias_slot(index_bits, (UInt)(width * height), &unused);
    cell = pick_u(unit_float(alias_bits) < GATHER(cells, cell, keep), cell, GATHER_U(cells, cell, other));
    // float division of indices below 2^24 is exact enough to floor: the remainder is corrected.
    UInt row = to_uint(to_float(cell) / (float)width);
    row = pick_u(row * width > cell, row - 1u, row);
    row = pick_u(cell - row * width >= width, row + 1u, row);
    const Float u = (to_float(cell - row * width) + u1) / (float)width;
    const Float v = (to_float(row) + u2) / (float)height;
    Float sine;
    Float cosine;
    Float c;
    Float si;
    cos_sin_turns(v * 0.5f, &cosine, &sine);
    cos_sin_turns(u, &c, &si);
    const Vec3 l = vec3(sine * si, cosine, -sine * c);
    __global const float *m = params->environment_rotation;
    *density = environment_density(params, cells, cell, sine);
    *radiance = mul(vec3_of(params->environment_radiance), environment_look_up(params, cells, u, v));
    return vec3(m[0] * l.x + m[3] * l.y + m[6] * l.z, m[1] * l.x + m[4] * l.y + m[7] * l.z,
                m[2] * l.x + m[5] * l.y + m[8] * l.z);
#else
    const Float z = 1.0f - 2.0f * u1;
    const Float radius = sqrt(max(1.0f - z * z, 0.0f));
    Float c;
    Float si;
    cos_sin_turns(u2, &c, &si);
    *density = (Float)(0.25f * INV_PI);
    *radiance = vec3_of(params->environment_radiance);
    return vec3(radius * c, z, radius * si);
#endif
}
#endif

#if AREA_LIGHTS
/// Density per solid angle with which sample_light draws a point at distance `t` on an emitter that is
/// chosen with `chance`.
static inline Float area_light_density(
    __global const Light *lights, UInt light, Float chance, Float t, Float cosine)
{
    const Float area = GATHER(lights, light, area);
    const Float pdf = chance * t * t / max(cosine * area, 1e-30f);
    return pick((cosine > 0.0f) & (area > 0.0f), pdf, (Float)(0.0f));
}

#if RECTANGLES
/// The same as seen from `from`, of which `by_area` is the density of triangles.
static inline Float rectangle_density(
    __global const Light *lights, Mask active, UInt light, Float chance, Vec3 from, Float by_area)
{
    active &= (GATHER_U(lights, light, flags) & LIGHT_RECTANGLE) != 0u;
    if (!any_lane(active))
        return by_area;
    const Vec3 corner = vec3(GATHER(lights, light, position[0]), GATHER(lights, light, position[1]),
                             GATHER(lights, light, position[2]));
    const Vec3 e1 =
        vec3(GATHER(lights, light, e1[0]), GATHER(lights, light, e1[1]), GATHER(lights, light, e1[2]));
    const Vec3 e2 =
        vec3(GATHER(lights, light, e2[0]), GATHER(lights, light, e2[1]), GATHER(lights, light, e2[2]));
    active &= is_close(corner, e1, e2, from);
    if (!any_lane(active))
        return by_area;
    const SeenRectangle seen = see_rectangle(corner, e1, e2, from);
    return pick(active & is_wide(seen) & (by_area > 0.0f), chance / seen.solid, by_area);
}
#endif

#if SPHERES
/// The same for the point `p` of a sphere, where its normal is `ng`.
static inline Float sphere_density(
    __global const Light *lights, Mask active, UInt light, Vec3 from, Vec3 p, Vec3 ng, Float by_area)
{
    active &= (GATHER_U(lights, light, flags) & LIGHT_SPHERE) != 0u;
    if (!any_lane(active))
        return by_area;
    const Sphere sphere = fetch_sphere(lights, light);
    const Vec3 outward = sub(p, sphere.center);
    const Float r = max(sqrt(dot3(outward, outward)), 1e-30f);
    const Vec3 n = scale(outward, 1.0f / r);
    const Float density = density_around(see_sphere(sphere, from), n);
    return pick(active, by_area * (GATHER(lights, light, area) / area_along(density, n, r, ng)), by_area);
}
#endif
#endif

// What choosing a light takes beside the table.
#if LIGHT_SAMPLING
#define TREE_PARAMETERS \
    , __global const LightPair *light_pairs, __global const uint *light_places, __global const uint *light_clusters
#define TREE_ARGUMENTS , light_pairs, light_places, light_clusters
#else
#define TREE_PARAMETERS
#define TREE_ARGUMENTS
#endif
#if LIGHT_PHOTONS
#define CHOICE_PARAMETERS \
    TREE_PARAMETERS, __global const LightGroup *light_groups, __global const uint *particle_table
#define CHOICE_ARGUMENTS TREE_ARGUMENTS, light_groups, particle_table
#else
#define CHOICE_PARAMETERS TREE_PARAMETERS
#define CHOICE_ARGUMENTS TREE_ARGUMENTS
#endif

/// What a light is chosen for.  What the choice depends on is the same when a ray that left the vertex
/// finds a light by chance.
typedef struct {
    Vec3 p;
    Vec3 n;
#if LIGHT_PHOTONS
    UInt row; // of the table of photons
#endif
} LightQuery;

/// Draw a light by the chances of the table.
static inline LightChoice choose_in_table(__global const Light *lights, uint light_count, UInt bits)
{
    LightChoice choice;
    Float alias_u;
    const UInt slot = alias_slot(bits, (UInt)(light_count), &alias_u);
    choice.light = pick_u(alias_u < GATHER(lights, slot, keep), slot, GATHER_U(lights, slot, other));
    choice.pmf = GATHER(lights, choice.light, pmf);
    return choice;
}

#if LIGHT_PHOTONS
/// Chance that choose_light draws the group of a light.
static inline Float group_chance(
    __global const uint *table, __global const LightGroup *groups, Mask active, UInt row, UInt light)
{
    const Float kept = row_keeps(table, active & (row != NO_PLACE), row);
    const Float share = node_chance(table, active, row, GATHER_U(groups, light, node));
    return (1.0f - kept) * share + kept * GATHER(groups, light, chance);
}
#endif

/// Draw a light for a surface.
///
/// Of photons: a group of lights by how much of what it might bring came to the cell, but with a chance that
/// is kept for what no photon saw, by its power; then one of the group by what each might bring.  With
/// PHOTON_POINTS groups are single lights, and the point on it is that of the photon.
static inline LightChoice choose_light(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    Mask active,
    LightQuery q,
    UInt bits)
{
    const uint count = params->light_count;
#if LIGHT_PHOTONS
    const Mask known = active & (q.row != NO_PLACE);
    const Float kept = row_keeps(particle_table, known, q.row);
    Float u = unit_float(bits);
    const Mask blind = active & (u < kept);
    // What is left of the number is uniform either way; digits that it has run out of are made up.
    u = pick(blind, u / kept, (u - kept) / (1.0f - kept));
    Float part;
    UInt group = choose_node(particle_table, known & !blind, q.row, &u, &part);
    bits = mix_bits(bits + 0x9e3779b9u);
    if (any_lane(blind)) {
        const LightChoice any = choose_in_table(lights, count, digits_left(u, kept, bits));
        group = pick_u(blind, GATHER_U(light_groups, any.light, node), group);
    }
    bits = pick_u(blind, mix_bits(bits), digits_left(u, part * (1.0f - kept), bits));
    const Mask there = active & (group != NO_LIGHT);
    const UInt pair = pick_u(there, group >> 1, (UInt)(0u));
    const UInt child = pick_u((group & 1u) == 0u, GATHER_U(light_pairs, pair, child[0]),
                              GATHER_U(light_pairs, pair, child[1]));
    const TreeChoice drawn =
        descend_tree(light_pairs, light_clusters, count, there, group, child, q.p, q.n, bits);
    LightChoice choice;
    choice.light = pick_u(there, drawn.light, (UInt)(0u));
    const Float chance = group_chance(particle_table, light_groups, there, q.row, choice.light);
    choice.pmf = pick(there, chance * drawn.inside, (Float)(0.0f));
#if PHOTON_POINTS
    choice.stored = known & !blind;
    choice.point = node_point(particle_table, choice.stored, q.row, group);
#endif
    return choice;
#elif LIGHT_SAMPLING
    const TreeChoice drawn = descend_tree(
        light_pairs, light_clusters, count, active, (UInt)(0u), (UInt)(0u), q.p, q.n, bits);
    LightChoice choice;
    choice.light = drawn.light;
    choice.pmf = pick(active, drawn.above * drawn.inside, (Float)(0.0f));
    return choice;
#else
    return choose_in_table(lights, count, bits);
#endif
}

/// Chance with which choose_light draws `light`.
static inline Float light_chance(
    __global const Params *params,
    __global const Light *lights CHOICE_PARAMETERS,
    Mask active,
    UInt light,
    LightQuery q)
{
#if LIGHT_SAMPLING
    const UInt wanted = pick_u(active, light, (UInt)(0u));
    const TreeChoice drawn = climb_tree(light_pairs, light_places, light_clusters, params->light_count,
                                        LIGHT_PHOTONS ? (Mask)(0) : MASK_ALL, active, wanted, q.p, q.n);
#if LIGHT_PHOTONS
    return drawn.inside * group_chance(particle_table, light_groups, active, q.row, wanted);
#else
    return drawn.above * drawn.inside;
#endif
#else
    return GATHER(lights, light, pmf);
#endif
}

#if SHADOW_RAYS
// What the number of shadow rays depends on.
#if LIGHT_PHOTONS
#define RAYS_PARAMETERS , __global const uint *particle_table
#define RAYS_ARGUMENTS , particle_table
#else
#define RAYS_PARAMETERS
#define RAYS_ARGUMENTS
#endif

/// Return how many shadow rays a vertex sends: of `auto` the first one as many as its cell knows groups of
/// lights, and the others one.
static inline UInt rays_asked(__global const Params *params RAYS_PARAMETERS, Mask active, Mask is_first, LightQuery q)
{
#if LIGHT_PHOTONS
    if (params->shadow_rays == 0u) {
        const Mask known = active & (q.row != NO_PLACE);
        const UInt length = record_word(particle_table, pick_u(known, q.row, (UInt)(0u)), RECORD_LENGTH);
        const UInt most = pick_u(is_first, (UInt)(SHADOW_RAYS), (UInt)(1u));
        return pick_u(known, clamp(length, (UInt)(1u), most), most);
    }
#endif
    return (UInt)(params->shadow_rays);
}
#endif

/// Draw a point of a flat light, uniformly by area, as parts of its two edges; `flags` are the light's.
static inline void sample_flat(Mask wanted, UInt flags, Float u1, Float u2, Float *part1, Float *part2)
{
    // On a triangle without folding, so that strata stay connected.
    const Float root = sqrt(u1);
    *part1 = root * (1.0f - u2);
    *part2 = root * u2;
#if RECTANGLES
    const Mask whole = wanted & ((flags & LIGHT_RECTANGLE) != 0u);
    *part1 = pick(whole, u1, *part1);
    *part2 = pick(whole, u2, *part2);
    const Mask disk = whole & ((flags & LIGHT_DISK) != 0u);
    if (any_lane(disk)) {
        Float disk1;
        Float disk2;
        sample_disk(u1, u2, &disk1, &disk2);
        *part1 = pick(disk, disk1, *part1);
        *part2 = pick(disk, disk2, *part2);
    }
#endif
}

/// Draw a direction to the light that was chosen, for rays that start at `origin`.
///
/// pdf is 0 where nothing arrives.  `u1` and `u2` are PAIR_LIGHT of the vertex whose first pair is `pair`;
/// `seed` and `reversed_index` name what a textured sky takes beside them.
LARGE_FUNCTION LightSample sample_light(
    __global const Params *params,
    __global const Light *lights,
    __global const Surface *surfaces,
    __global const Material *materials TEXTURE_PARAMETERS COLOR_PARAMETERS,
#if ENVIRONMENT == 2
    __global const EnvironmentCell *cells,
#endif
    Mask active,
    Vec3 origin,
    Float u1,
    Float u2,
    Seed seed,
    UInt reversed_index,
    UInt pair,
    LightChoice choice)
{
    const UInt light = choice.light;
    const Float pmf = choice.pmf;
    const UInt kind = GATHER_U(lights, light, kind);
#if PHOTON_POINTS
    // Of a ball other numbers stand for other points from each place that sees it.
    const Mask stored = choice.stored & (kind == LIGHT_TRIANGLE)
                        & ((GATHER_U(lights, light, flags) & LIGHT_SPHERE) == 0u);
    Float stored1;
    Float stored2;
    light_point(choice.point, &stored1, &stored2);
    u1 = pick(stored, stored1, u1);
    u2 = pick(stored, stored2, u2);
#endif

    LightSample s;
    s.toward = vec3((Float)(0.0f), (Float)(0.0f), (Float)(1.0f));
    s.radiance = vec3_all((Float)(0.0f));
    s.pdf = (Float)(0.0f);
    s.extended = MASK_ALL;
    s.wi = s.toward;

#if AREA_LIGHTS
    const Mask on_triangle = active & (kind == LIGHT_TRIANGLE);
    if (any_lane(on_triangle)) {
        const UInt triangle = pick_u(on_triangle, GATHER_U(lights, light, triangle), (UInt)(0u));
        const Vec3 p0 = vec3(GATHER(lights, light, position[0]), GATHER(lights, light, position[1]),
                             GATHER(lights, light, position[2]));
        const Vec3 e1 = vec3(GATHER(lights, light, e1[0]), GATHER(lights, light, e1[1]),
                             GATHER(lights, light, e1[2]));
        const Vec3 e2 = vec3(GATHER(lights, light, e2[0]), GATHER(lights, light, e2[1]),
                             GATHER(lights, light, e2[2]));
        Vec3 ng = vec3(GATHER(lights, light, direction[0]), GATHER(lights, light, direction[1]),
                       GATHER(lights, light, direction[2]));
        Float area = GATHER(lights, light, area);
        // Not even the boxes of the light and of its neighbours: to go down to one of 2^17 takes twice the time
        // of a sample.  21 u of both ends' coordinates for these (`geometry.h`), 4 u for the point.
        const Float reach = max(fabs(origin.x), max(fabs(origin.y), fabs(origin.z)));
        const Float away = 2.0f * GATHER(lights, light, offset) + 0x1.8p-20f * reach;
        const UInt flags = GATHER_U(lights, light, flags);
        Float b1;
        Float b2;
        sample_flat(on_triangle, flags, u1, u2, &b1, &b2);
#if RECTANGLES
        const Mask whole = on_triangle & ((flags & LIGHT_RECTANGLE) != 0u);
        const Mask disk = whole & ((flags & LIGHT_DISK) != 0u);
        Mask near = whole & is_close(p0, e1, e2, origin);
        Float solid = (Float)(1.0f);
        if (any_lane(near)) {
            const SeenRectangle seen = see_rectangle(p0, e1, e2, origin);
            near &= is_wide(seen);
            solid = pick(near, seen.solid, solid);
            Float part1;
            Float part2;
            sample_rectangle(seen, u1, u2, &part1, &part2);
            b1 = pick(near, part1, b1);
            b2 = pick(near, part2, b2);
        }
        Mask there = MASK_ALL;
        if (any_lane(disk & near))
            there = !(disk & near) | on_disk(b1, b2);
#endif
        Vec3 q = add_scaled(add_scaled(p0, e1, b1), e2, b2);
#if SPHERES
        const Mask round = on_triangle & ((flags & LIGHT_SPHERE) != 0u);
        if (any_lane(round)) {
            const Sphere sphere = fetch_sphere(lights, light);
            const SeenSphere seen = see_sphere(sphere, origin);
            const Vec3 n = draw_around(seen, u1, u2);
            Vec3 face;
            const Float r = face_along(sphere, n, &face);
            q = pick_v(round, add_scaled(sphere.center, n, r), q);
            ng = pick_v(round, face, ng);
            area = pick(round, area_along(density_around(seen, n), n, r, face), area);
        }
#endif
        q = add_scaled(q, ng, pick(dot3(ng, sub(origin, q)) >= 0.0f, away, -away));
        const Vec3 toward = sub(q, origin);
        const Vec3 wi = normalize3(toward);
        const Mask two_sided = (flags & MATERIAL_TWO_SIDED_EMISSION) != 0u;
        const Float cosine = -dot3(ng, wi);
        Mask lit = on_triangle & ((cosine > 0.0f) | two_sided) & (area > 0.0f);
#if RECTANGLES
        lit &= there;
#endif
        Vec3 emission = vec3(GATHER(lights, light, intensity[0]), GATHER(lights, light, intensity[1]),
                             GATHER(lights, light, intensity[2]));
#if TEXTURES
        emission = textured(lit, emission, GATHER_U(lights, light, emission_texture), triangle, b1,
                            b2 TEXTURE_ARGUMENTS);
#endif
#if ALPHA
        // Holes of an emitter give no light; the shadow ray ends before it could find that out.
        emission = scale(emission, alpha_share(lit, triangle, b1, b2 ALPHA_BUFFER_ARGUMENTS));
#endif
        Float pdf = pmf * dot3(toward, toward) / max(fabs(cosine) * area, 1e-30f);
#if RECTANGLES
        pdf = pick(near, pmf / solid, pdf);
#endif
        s.toward = pick_v(lit, toward, s.toward);
        s.wi = pick_v(lit, wi, s.wi);
        s.radiance = pick_v(lit, emission, s.radiance);
        s.pdf = pick(lit & (cosine != 0.0f), pdf, s.pdf);
    }
#endif

#if ENVIRONMENT
    const Mask in_sky = active & (kind == LIGHT_ENVIRONMENT);
    if (any_lane(in_sky)) {
        Float density;
        Vec3 radiance;
        const Vec3 wi = sample_environment(params,
#if ENVIRONMENT == 2
                                           cells,
#endif
                                           seed, reversed_index, pair, u1, u2, &radiance, &density);
        s.wi = pick_v(in_sky, wi, s.wi);
        // Far enough to leave the scene from any point of it.
        s.toward = pick_v(in_sky, scale(wi, (Float)(4.0f * params->scene_radius)), s.toward);
        s.radiance = pick_v(in_sky, radiance, s.radiance);
        s.pdf = pick(in_sky, pmf * density, s.pdf);
    }
#endif

#if PUNCTUAL_LIGHTS
    const Mask without_extent = active & (kind >= LIGHT_POINT);
    if (any_lane(without_extent)) {
        const Vec3 axis = vec3(GATHER(lights, light, direction[0]), GATHER(lights, light, direction[1]),
                               GATHER(lights, light, direction[2]));
        const Mask far = kind == LIGHT_DIRECTIONAL;
        const Vec3 position = vec3(GATHER(lights, light, position[0]), GATHER(lights, light, position[1]),
                                   GATHER(lights, light, position[2]));
        const Vec3 near_toward = sub(position, origin);
        const Vec3 far_toward = scale(axis, (Float)(-4.0f * params->scene_radius));
        const Vec3 toward = pick_v(far, far_toward, near_toward);
        const Vec3 wi = normalize3(toward);
        const Float d2 = dot3(near_toward, near_toward);
        // KHR_lights_punctual: the window that fades a light out at its range, and the cone's ramp.
        const Float ratio2 = d2 / (GATHER(lights, light, range) * GATHER(lights, light, range));
        const Float window = clamp(1.0f - ratio2 * ratio2, (Float)(0.0f), (Float)(1.0f));
        const Float ramp = clamp((-dot3(axis, wi) - GATHER(lights, light, cos_outer))
                                     * GATHER(lights, light, spot_scale),
                                 (Float)(0.0f), (Float)(1.0f));
        Float fall_off = window / max(d2, 1e-30f);
        fall_off = pick(kind == LIGHT_SPOT, fall_off * ramp * ramp, fall_off);
        fall_off = pick(far, (Float)(1.0f), fall_off);
        const Vec3 intensity = vec3(GATHER(lights, light, intensity[0]), GATHER(lights, light, intensity[1]),
                                    GATHER(lights, light, intensity[2]));
        s.toward = pick_v(without_extent, toward, s.toward);
        s.wi = pick_v(without_extent, wi, s.wi);
        s.radiance = pick_v(without_extent, scale(intensity, fall_off), s.radiance);
        s.pdf = pick(without_extent & (far | (d2 > 0.0f)), pmf, s.pdf);
        s.extended &= !without_extent;
    }
#endif
    return s;
}
