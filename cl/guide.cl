// The guide between passes: what was learned becomes what paths are drawn by.

#include "common/features.h"
#include "common/layout.h"
#include "common/hash_map.h"
#include "common/guide.h"

// Visits that what is known of the square around is worth.
#define TRUST 8.0f

static inline float sum_of(__global const GuideSum *sums, uint k)
{
    return (float)sums->high[k] * 0x1p32f + (float)sums->low[k];
}

/// Begin parts of the table anew that have run over: what came late had no place there.  One work item a
/// bucket, while no path is on its way.
///
/// reads   guide_full
/// writes  guide_keys, guide_full, guide_sums, guide_cells
kernel void renew_guide(
    __global const Params *params,
    __global uint *guide_keys,
    __global uint *guide_full,
    __global GuideSum *guide_sums,
    __global GuideCell *guide_cells)
{
    const uint size = bucket_size(params->guide_slots);
    const uint bucket = get_global_id(0);
    if (bucket >= params->guide_slots / max(size, 1u) || guide_full[bucket] == 0u)
        return;
    guide_full[bucket] = 0u;
    for (uint slot = bucket * size; slot < (bucket + 1u) * size; ++slot) {
        guide_keys[slot] = 0u;
        guide_cells[slot].mean = 0.0f;
        guide_cells[slot].visits = 0.0f;
        for (uint k = 0; k < GUIDE_BINS; ++k) {
            guide_sums[slot].low[k] = 0u;
            guide_sums[slot].high[k] = 0u;
            guide_sums[slot].count[k] = 0u;
        }
    }
}

/// Make the densities of all cells anew from their sums.  One work item a slot, while no path is on its
/// way.
///
/// A part's value is the mean of its visits, with the mean of the cell as one more; the density is a mix
/// of that and of the cosine.  Cells in buckets that overflowed are given up, for which of them are there
/// depends on the order in which they came.
///
/// reads   guide_keys, guide_full, guide_sums
/// writes  guide_cells
kernel void freeze_guide(
    __global const Params *params,
    __global const uint *guide_keys,
    __global const uint *guide_full,
    __global GuideSum *guide_sums,
    __global GuideCell *guide_cells,
    const uint fades)
{
    const uint slot = get_global_id(0);
    const uint slots = params->guide_slots;
    if (slot >= slots || guide_keys[slot] == 0u)
        return;
    __global GuideSum *sums = &guide_sums[slot];
    __global GuideCell *cell = &guide_cells[slot];
    float total = 0.0f;
    float visits = 0.0f;
    for (uint k = 0; k < GUIDE_BINS; ++k) {
        total += sum_of(sums, k);
        visits += (float)sums->count[k];
    }
    const float inverse = 1.0f / params->guide_steps;
    // From the whole square to ever smaller ones: each begins with what the one around it knows.
    float value[GUIDE_BINS];
    value[0] = total * inverse / max(visits, 1.0f);
    for (uint side = 2; side <= GUIDE_SIDE; side *= 2) {
        const uint edge = GUIDE_SIDE / side;
        // The last first: a square takes the place of one whose own squares are done.
        for (uint square = side * side; square-- > 0;) {
            const uint i = square / side;
            const uint j = square % side;
            const float around = value[(i / 2) * (side / 2) + j / 2];
            float seen = 0.0f;
            float n = 0.0f;
            for (uint a = i * edge; a < (i + 1) * edge; ++a)
                for (uint b = j * edge; b < (j + 1) * edge; ++b) {
                    seen += sum_of(sums, a * GUIDE_SIDE + b);
                    n += (float)sums->count[a * GUIDE_SIDE + b];
                }
            value[square] = (seen * inverse + TRUST * around) / (n + TRUST);
        }
    }
    float sum = 0.0f;
    for (uint k = 0; k < GUIDE_BINS; ++k)
        sum += value[k];
    const int given_up = guide_full[slot / bucket_size(slots)] != 0u;
    const int knows = visits >= (float)GUIDE_BINS && sum > 0.0f && sum < INFINITY && !given_up;
    const float by_guide = knows ? params->guide_share : 0.0f;
    const float norm = knows ? GUIDE_BINS / sum : 0.0f;
    float below = 0.0f;
    for (uint i = 0; i < GUIDE_SIDE; ++i) {
        for (uint j = 0; j < GUIDE_SIDE; ++j) {
            const uint k = i * GUIDE_SIDE + j;
            const float density = 1.0f - by_guide + by_guide * value[k] * norm;
            cell->density[k] = density;
            below += density;
        }
        cell->rows[i] = below;
    }
    for (uint i = 0; i < GUIDE_SIDE; ++i)
        cell->rows[i] /= below;
    cell->mean = given_up ? 0.0f : sum / GUIDE_BINS;
    cell->visits = given_up ? 0.0f : visits;
    if (fades)
        for (uint k = 0; k < GUIDE_BINS; ++k) {
            sums->low[k] = (sums->low[k] >> 1) | (sums->high[k] << 31);
            sums->high[k] >>= 1;
            sums->count[k] >>= 1;
        }
}

/// Let what the film holds count for less: samples become fewer, and their mean stays.  One work item W sums, while
/// no path is on its way.
///
/// Not where cells share light, which is summed elsewhere, too.  Squares are those of parts of the sum: the variance
/// of the mean, which is told from them, stays what it is.
///
/// reads, writes  film
kernel void fade_film(__global const Params *params, __global FilmSum *film, const uint planes, const uint halvings)
{
    const uint first = get_global_id(0) * W;
    const uint end = min(first + W, params->pixel_count * planes);
    for (uint i = first; i < end; ++i) {
        FilmSum sum = film[i];
        if (sum.count == 0u)
            continue;
        const uint count = max(sum.count >> halvings, 1u);
        const float part = (float)count / (float)sum.count;
        for (uint c = 0; c < 3; ++c) {
            sum.sum[c] *= part;
            sum.lost[c] *= part;
        }
        sum.squares *= part * part;
        sum.lost_squares *= part * part;
        sum.count = count;
        film[i] = sum;
    }
}

#if AOV_GUIDE
// Look-ups around what a pixel sees, whose mean is shown.
#define VIEW_LOOKS 8u

/// Tell what the guide knows where the pixels look, on average over the cells that look-ups may find there.
/// One work item W pixels.
///
/// reads   surfaces_seen, guide_keys, guide_full, guide_cells
/// writes  guide_views
kernel void view_guide(
    __global const Params *params,
    __global const SeenMean *surfaces_seen,
    __global const uint *guide_keys,
    __global const uint *guide_full,
    __global const GuideCell *guide_cells,
    __global GuideView *guide_views)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const UInt pixel = min(lanes_before(MASK_ALL) + first, (UInt)(params->pixel_count - 1u));
    const Vec3 p = vec3(GATHER(surfaces_seen, pixel, p[0]), GATHER(surfaces_seen, pixel, p[1]),
                        GATHER(surfaces_seen, pixel, p[2]));
    const Vec3 sum = vec3(GATHER(surfaces_seen, pixel, ns[0]), GATHER(surfaces_seen, pixel, ns[1]),
                          GATHER(surfaces_seen, pixel, ns[2]));
    const Mask seen = (GATHER_U(surfaces_seen, pixel, hits) > 0u) & (dot3(sum, sum) > 0.0f);
    const Vec3 n = normalize3(pick_v(seen, sum, vec3((Float)(0.0f), (Float)(0.0f), (Float)(1.0f))));
    const Vec3 away = sub(p, vec3_of(params->camera_origin));
    const Float width = params->guide_width * sqrt(dot3(away, away));
    const uint size = bucket_size(params->guide_slots);
    const Float zero = (Float)(0.0f);
    Float known = zero;
    Float visits = zero;
    Float entropy = zero;
    Vec3 drawn = vec3_all(zero);
    for (uint look = 0; look < VIEW_LOOKS; ++look) {
        const UInt random = mix_bits(pixel * VIEW_LOOKS + look + 1u);
        const CellKey key = coarse_cell_of(params, p, n, random, width, params->guide_slots);
        const UInt found = find_lanes(guide_keys, guide_full, seen, key.bucket, size, key.key);
        const UInt at = pick_u(found != NO_SLOT, found, (UInt)(0u));
        const Float made_from = pick(found != NO_SLOT, GATHER(guide_cells, at, visits), zero);
        const UInt slot = pick_u(made_from > 0.0f, found, (UInt)(NO_SLOT));
        const Float one = pick(made_from > 0.0f, (Float)(1.0f), zero);
        known += one;
        visits += made_from;
        for (uint k = 0; k < GUIDE_BINS; ++k) {
            Float x;
            Float y;
            disk_of_square((Float)(((float)(k / GUIDE_SIDE) + 0.5f) / GUIDE_SIDE),
                           (Float)(((float)(k % GUIDE_SIDE) + 0.5f) / GUIDE_SIDE), &x, &y);
            const Float share = one * guide_density(guide_cells, slot, (UInt)(k)) * (1.0f / GUIDE_BINS);
            entropy -= share * log2(max(share, (Float)(1e-30f)));
            drawn = add_scaled(drawn, vec3(x, y, sqrt(1.0f - x * x - y * y)), share);
        }
    }
    Vec3 s;
    Vec3 t;
    guide_frame(n, &s, &t);
    const Float inverse = 1.0f / max(known, (Float)(1.0f));
    const Vec3 direction =
        scale(add_scaled(add_scaled(scale(s, drawn.x), t, drawn.y), n, drawn.z), inverse);
    float lane_view[5][W];
    store_lanes(direction.x, lane_view[0]);
    store_lanes(direction.y, lane_view[1]);
    store_lanes(direction.z, lane_view[2]);
    store_lanes(entropy * inverse, lane_view[3]);
    store_lanes(visits * inverse, lane_view[4]);
    const uint lanes = min(params->pixel_count - first, (uint)W);
    for (uint k = 0; k < lanes; ++k) {
        __global GuideView *view = &guide_views[first + k];
        for (uint c = 0; c < 3; ++c)
            view->direction[c] = lane_view[c][k];
        view->entropy = lane_view[3][k];
        view->visits = lane_view[4][k];
    }
}
#endif
