// The screen filter: what the diffuse bases of first surfaces reflect is averaged over a few pixels that see
// the same surface.
//
// After N. Binder, A. Keller: Ray-Traced Global Illumination for Games: Massively Parallel Path Space
// Filtering, GTC 2019.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/noise.h"
#include "common/pixels.h"
#include "common/rng.h"
#include "common/view.h"

// Light is alike if the square of what it differs by is not above so many variances.  Fewer keep shadows sharper
// and leave more noise: from 2 to 9 measured on three scenes.
#define ALIKE_VARIANCES 3.0f

// What others are less sure of by more than this counts as if it were not: else pixels that are sure of their shadow
// take the light of those that see its edge.
#define MORE_NOISE 4.0f

/// Take the light of each pixel from the film.  One work item a pixel.
///
/// reads   film, film_base
/// writes  light
kernel void resolve_light(
    __global const Params *params,
    __global const FilmSum *film,
    __global const FilmSum *film_base,
    __global PixelLight *light)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    const float count = (float)max(film[pixel].count, 1u);
    light[pixel].count = (float)film[pixel].count;
    light[pixel].alpha = 1.0f;
    light[pixel].means = (float)film[pixel].count;
    light[pixel].square = film[pixel].squares / count + film[pixel].mean * film[pixel].mean;
    light[pixel].change = 0.0f;
    light[pixel].noise = count > 1.0f ? NOISE_OF_MEAN(film_base[pixel].squares, count) : NOISE_UNKNOWN;
    for (uint c = 0; c < 3; ++c) {
        light[pixel].rgb[c] = (film[pixel].sum[c] - film[pixel].lost[c]) / count;
        light[pixel].base[c] = (film_base[pixel].sum[c] - film_base[pixel].lost[c]) / count;
    }
}

/// A pixel's first surface, per lane.
typedef struct {
    Vec3 p;
    Vec3 ns;
    Mask there;
} Surroundings;

static inline Surroundings seen_at(__global const SeenMean *surfaces, UInt pixel)
{
    Surroundings s;
    s.p = vec3(GATHER(surfaces, pixel, p[0]), GATHER(surfaces, pixel, p[1]), GATHER(surfaces, pixel, p[2]));
    s.ns = normalize3(vec3(GATHER(surfaces, pixel, ns[0]), GATHER(surfaces, pixel, ns[1]),
                           GATHER(surfaces, pixel, ns[2])));
    s.there = GATHER_U(surfaces, pixel, hits) > 0u;
    return s;
}

/// Whether pixels at `here` and at `there` see one surface: normals agree, and each lies within a pixel's footprint
/// of the plane of the other.
static inline Mask one_surface(Surroundings here, Surroundings there, Vec3 between, Float footprint)
{
    return here.there & there.there & (dot3(here.ns, there.ns) > SAME_SURFACE_COSINE)
           & (fabs(dot3(here.ns, between)) < footprint) & (fabs(dot3(there.ns, between)) < footprint);
}

// Pixels of a surface, of nine, that tell what noise is.
#define FEWEST_PIXELS 4.0f

// So many times the variance that they scatter by: they share cells, and so part of their noise.  One is sharper and
// leaves more noise in five scenes, four blurs the shadows of the sun.
#define SHARED_NOISE 2.0f

static inline Vec3 gate_at(__global const SeenMean *surfaces, UInt pixel)
{
    return vec3(GATHER(surfaces, pixel, gate[0]), GATHER(surfaces, pixel, gate[1]), GATHER(surfaces, pixel, gate[2]));
}

static inline Vec3 base_at(__global const PixelLight *light, UInt pixel)
{
    return vec3(GATHER(light, pixel, base[0]), GATHER(light, pixel, base[1]), GATHER(light, pixel, base[2]));
}

/// Find the light that falls on the base of what pixels see, and the variance that it has by noise.  One work item W
/// pixels.
///
/// Where samples do not tell the noise, for there is one, it is the mean of the pixel and of those around it that
/// see the same surface, and they scatter by its noise.  Without that all light would be alike there: that of the
/// sun would be blurred over its shadows.
///
/// reads   light, surfaces_seen
/// writes  arriving (light and variance)
kernel void find_arriving(
    __global const Params *params,
    __global const PixelLight *light,
    __global const SeenMean *surfaces_seen,
    __global float *arriving)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = min(wanted, (UInt)(params->pixel_count - 1u));
    const Float zero = (Float)(0.0f);
    const Float gate = luminance(gate_at(surfaces_seen, pixel));
    const Float noise = GATHER(light, pixel, noise);
    const Mask known = noise < NOISE_UNKNOWN;
    Float mean = luminance(base_at(light, pixel)) / max(gate, 1e-37f);
    Float variance = pick(known, noise / max(gate * gate, 1e-37f), (Float)(NOISE_UNKNOWN));
    if (any_lane(!known)) {
        UInt x;
        UInt y;
        pixel_place(params, pixel, &x, &y);
        x -= params->crop_x;
        y -= params->crop_y;
        const Surroundings here = seen_at(surfaces_seen, pixel);
        const Float footprint = footprint_at(params, view_of(params), here.p);
        Float count = zero;
        Float sum = zero;
        Float squares = zero;
        for (uint k = 0; k < 9u; ++k) {
            // To the left of the first pixel this wraps around, to beyond the last.
            const UInt column = x + (k % 3u) - 1u;
            const UInt row = y + (k / 3u) - 1u;
            const Mask inside = (column < params->crop_width) & (row < params->crop_height);
            const UInt other = pixel_entry(params, pick_u(inside, column, x), pick_u(inside, row, y));
            const Surroundings there = seen_at(surfaces_seen, other);
            const Float reflects = luminance(gate_at(surfaces_seen, other));
            const Mask agrees = inside & (reflects > 0.0f)
                                & one_surface(here, there, sub(there.p, here.p), footprint);
            const Float arrives = pick(agrees, luminance(base_at(light, other)) / max(reflects, 1e-37f), zero);
            count += pick(agrees, (Float)(1.0f), zero);
            sum += arrives;
            squares += arrives * arrives;
        }
        const Mask told = !known & (count >= FEWEST_PIXELS);
        const Float n = max(count, FEWEST_PIXELS);
        mean = pick(told, sum / n, mean);
        variance = pick(told, SHARED_NOISE * NOISE_OF_MEAN(max(squares - sum * sum / n, zero), n), variance);
    }
    float lane[2][W];
    store_lanes(mean, lane[0]);
    store_lanes(variance, lane[1]);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k)
        vstore2((float2)(lane[0][k], lane[1][k]), first + k, arriving);
}

/// Average what the bases reflect of the light that falls on them.  One work item W pixels.
///
/// A neighbour counts if both see one surface, they are no farther apart than the filter is wide on a surface
/// that is seen at 60 degrees, and the light that they get is alike but for noise: edges of shadows stay.  Neighbours
/// are a fixed random set in a disk, stratified in radius and angle; the disk shrinks with the samples, count^(-1/4):
/// its bias falls as fast as the noise.  Reflectances are weights, so that nothing is divided by what is next to none.
///
/// reads   light, surfaces_seen, arriving
/// writes  filtered (RGB and a word)
kernel void filter_screen(
    __global const Params *params,
    __global const PixelLight *light,
    __global const SeenMean *surfaces_seen,
    __global const float *arriving,
    __global float *filtered)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = min(wanted, (UInt)(params->pixel_count - 1u));
    UInt x;
    UInt y;
    pixel_place(params, pixel, &x, &y);
    const Surroundings here = seen_at(surfaces_seen, pixel);
    const Float footprint = footprint_at(params, view_of(params), here.p);
    const Float own = GATHER(light, pixel, count);
    const Float radius = params->screen_radius * exp2(-0.25f * log2(max(own, 1.0f)));
    const Float reach = 2.0f * radius * footprint;

    const Vec3 rgb = vec3(GATHER(light, pixel, rgb[0]), GATHER(light, pixel, rgb[1]), GATHER(light, pixel, rgb[2]));
    const Vec3 base = base_at(light, pixel);
    const Vec3 gate = gate_at(surfaces_seen, pixel);
    const Float own_light = gather_words(arriving, 2u * pixel);
    const Float own_noise = gather_words(arriving, 2u * pixel + 1u);
    Vec3 light_sum = scale(base, own);
    Vec3 gate_sum = scale(gate, own);
    Mask shared = !MASK_ALL;
    UInt random = mix_bits(y * params->width + x + 0x5bd1e995u);
    const Float turned = unit_float(random);
    const float count = (float)params->screen_neighbours;
    for (uint k = 0; k < params->screen_neighbours; ++k) {
        random = mix_bits(random + 0x9e3779b9u);
        const Float r = radius * sqrt(((float)k + unit_float(random)) / count);
        random = mix_bits(random + 0x9e3779b9u);
        // The golden ratio spreads the angles of successive radii.
        const Float turns = turned + (float)k * 0.61803399f + unit_float(random) / count;
        Float c;
        Float s;
        cos_sin_turns(turns - floor(turns), &c, &s);
        const Float column = floor(r * c + 0.5f) + to_float(x - params->crop_x);
        const Float row = floor(r * s + 0.5f) + to_float(y - params->crop_y);
        const Mask inside = (column >= 0.0f) & (row >= 0.0f) & (column < (float)params->crop_width)
                            & (row < (float)params->crop_height);
        const UInt other = pixel_entry(params, to_uint(pick(inside, column, (Float)(0.0f))),
                                       to_uint(pick(inside, row, (Float)(0.0f))));
        const Surroundings there = seen_at(surfaces_seen, other);
        const Vec3 between = sub(there.p, here.p);
        const Vec3 its_base = base_at(light, other);
        const Vec3 its_gate = gate_at(surfaces_seen, other);
        const Float apart = own_light - gather_words(arriving, 2u * other);
        const Float its_noise = gather_words(arriving, 2u * other + 1u);
        const Float noise = own_noise + min(its_noise, MORE_NOISE * own_noise);
        const Mask alike = !(apart * apart > ALIKE_VARIANCES * noise);
        const Mask agrees = alike & inside & (other != pixel) & one_surface(here, there, between, footprint)
                            & (dot3(between, between) < reach * reach);
        const Float weight = pick(agrees, GATHER(light, other, count), (Float)(0.0f));
        light_sum = add_scaled(light_sum, its_base, weight);
        gate_sum = add_scaled(gate_sum, its_gate, weight);
        shared |= agrees;
    }
    const Vec3 one = vec3_all((Float)(1.0f));
    const Vec3 whole = vec3(pick(gate_sum.x > 0.0f, gate_sum.x, one.x), pick(gate_sum.y > 0.0f, gate_sum.y, one.y),
                            pick(gate_sum.z > 0.0f, gate_sum.z, one.z));
    const Vec3 arrives = vec3(light_sum.x / whole.x, light_sum.y / whole.y, light_sum.z / whole.z);
    // Sums that were rounded apart: the rest may be a little below 0.
    const Vec3 rest = vec3(max(rgb.x - base.x, 0.0f), max(rgb.y - base.y, 0.0f), max(rgb.z - base.z, 0.0f));
    const Vec3 result = add(rest, mul(gate, arrives));
    const Vec3 mean = pick_v(shared, result, rgb);
    float lane[3][W];
    store_lanes(mean.x, lane[0]);
    store_lanes(mean.y, lane[1]);
    store_lanes(mean.z, lane[2]);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k)
        vstore4((float4)(lane[0][k], lane[1][k], lane[2][k], 0.0f), first + k, filtered);
}
