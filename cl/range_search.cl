// Path space filtering by range search, the baseline that cells are measured against: the light that paths
// carry beyond a vertex is averaged over all vertices of the pass in a ball around it.
//
// In a place with many vertices each looks at all others: the cost grows with the square of their number.
// They are sorted by the cells of a grid, which only decides what is looked at.
//
// Keller, Dahm, Binder: Path Space Filtering, 2014.

#include "common/features.h"
#include "common/lanes.h"
#include "common/layout.h"
#include "common/cells.h"
#include "common/shared_samples.h"

// Cells of the grid along an axis, and how many of them a ball may meet before it looks at everything.
#define GRID_BITS 21u
#define GRID_HALF 0x1p20f
#define MOST_ROWS 32u

// Behind the last place, for samples that share nothing.
#define NO_PLACE 0xffffffffffffffff

// Planes of what is known of a vertex, in the order of the grid.
#define CLOSE_P 0u     // world, m: 3
#define CLOSE_SIDE 3u  // uint; vertices of different sides share nothing
#define CLOSE_LIGHT 4u // radiance that arrives: 3
#define CLOSE_R2 7u    // square of the ball's radius, m^2
#define CLOSE_PLANES 8u

/// Square of the radius of the ball that blurs as much as a cell of about `width` does.
///
/// A sample is stored at most half an edge e away, anywhere in its cell: from the middle of the cell it is
/// where two uniform numbers add up, each of variance e^2 / 12.  A look-up goes as far again: e^2 / 3 along
/// each axis of the surface, where a disk of radius r has r^2 / 4.  Unmoved, both are uniform in one cell:
/// e^2 / 6.  Edges are the power of two below the width, or with the chance of the rest the next one.
static inline Float ball_radius2(__global const Params *params, Float width)
{
    const UInt bits = as_bits(clamp(width, (Float)(0x1p-60f), (Float)(0x1p60f)));
    const Float low = from_bits(bits & 0x7f800000u);
    const Float rest = from_bits((bits & 0x007fffffu) | 0x3f800000u) - 1.0f;
    const float discs = params->cell_flags & CELL_JITTER ? 4.0f / 3.0f : 2.0f / 3.0f;
    return discs * low * low * (1.0f + 3.0f * rest);
}

/// Coordinate in the grid; what lies outside is in its outermost cells.
static inline uint grid_coordinate(float x, float inverse)
{
    return (uint)(clamp(floor(x * inverse), -GRID_HALF, GRID_HALF - 1.0f) + GRID_HALF);
}

static inline ulong grid_place(uint x, uint y, uint z)
{
    return ((ulong)z << (2u * GRID_BITS)) | ((ulong)y << GRID_BITS) | x;
}

/// Vertex words of W pixels, 0 for those outside.
static inline UInt load_vertex(
    __global const Params *params, __global const Beyond *beyond, UInt wanted, UInt *pixel)
{
    const Mask inside = wanted < params->pixel_count;
    *pixel = pick_u(inside, wanted, (UInt)(0u));
    return pick_u(inside, GATHER_U(beyond, *pixel, vertex), (UInt)(0u));
}

/// Tell which samples of a pass share light, and the exponents of their radii.  One work item W pixels.
///
/// Samples that are too large to be shared get their own light at once.
///
/// reads   beyond, vertices
/// writes  order: 1 for those that share; spare_order: exponents, 0 for others; samples, base;
///         counters.rejected_cells (atomic)
kernel void find_radii(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    volatile __global uint *counters,
    __global uint *order,
    __global uint *spare_order,
#if BASE
    __global const Seen *seen,
    __global float *base,
#endif
    __global float *samples,
    const uint pass)
{
    const uint first = get_global_id(0) * W;
    if (first >= params->pixel_count)
        return;
    const ulong start = (ulong)(pass & (params->ring - 1u)) * params->pixel_count;
    UInt pixel;
    const UInt vertex = load_vertex(params, beyond + start, lanes_before(MASK_ALL) + first, &pixel);
    const Vec3 light = demodulated(load_beyond(beyond + start, pixel), load_gate(vertices + start, pixel));
    const UInt largest = max(as_bits(light.x), max(as_bits(light.y), as_bits(light.z)));
    const Mask there = vertex != 0u;
    const Mask shares = there & (largest < as_uint(params->cell_limit));
    const Float width = GATHER(vertices + start, pixel, length) * cell_width_of(params, pass);
    uint lane_shares[W];
    uint lane_exponent[W];
    store_lanes_u(pick_u(shares, (UInt)(1u), (UInt)(0u)), lane_shares);
    store_lanes_u(pick_u(shares, as_bits(sqrt(ball_radius2(params, width))) >> 23, (UInt)(0u)), lane_exponent);
    for (uint k = 0; k < W && first + k < params->pixel_count; ++k) {
        order[first + k] = lane_shares[k];
        spare_order[first + k] = lane_exponent[k];
    }
    const Mask rejected = there & !shares;
    for (uint left = lane_bits(rejected); left; left &= left - 1u) {
        const uint at = first + lowest_bit(left);
        const float4 own = (float4)(vload3(0, beyond[start + at].radiance), 0.0f);
        vstore4(vload4(start + at, samples) + own, start + at, samples);
#if BASE
        vstore4(vload4(start + at, base) + own * base_share_of(beyond, seen, start + at), start + at, base);
#endif
    }
    if (any_lane(rejected))
        count_up(&counters[COUNTER_REJECTED_CELLS], count_lanes(rejected));
}

/// Write the places of the vertices of a pass in the grid.  One work item a pixel, after find_radii.
///
/// `inverse` is one over the edge of the grid's cells.
///
/// reads   order, vertices
/// writes  places; order: the indices of the pixels
kernel void find_places(
    __global const Params *params,
    __global const CellVertex *vertices,
    __global ulong *places,
    __global uint *order,
    const uint pass,
    const float inverse)
{
    const uint pixel = get_global_id(0);
    if (pixel >= params->pixel_count)
        return;
    const ulong at = (ulong)(pass & (params->ring - 1u)) * params->pixel_count + pixel;
    uint cell[3];
    for (uint c = 0; c < 3; ++c)
        cell[c] = grid_coordinate(vertices[at].p[c], inverse);
    places[pixel] = order[pixel] ? grid_place(cell[0], cell[1], cell[2]) : NO_PLACE;
    order[pixel] = pixel;
}

/// Copy what the search asks of vertices into planes, in the order of the grid.  One work item W vertices,
/// `count` of them.
///
/// reads   order, beyond, vertices
/// writes  close
kernel void lay_out_close(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    __global const uint *order,
    __global float *close,
    const uint pass,
    const uint count)
{
    const uint first = get_global_id(0) * W;
    if (first >= count)
        return;
    const ulong start = (ulong)(pass & (params->ring - 1u)) * params->pixel_count;
    const UInt wanted = lanes_before(MASK_ALL) + first;
    const UInt pixel = GATHER_WORD(order, pick_u(wanted < count, wanted, (UInt)(0u)));
    const UInt vertex = GATHER_U(beyond + start, pixel, vertex);
    const Vec3 light = demodulated(load_beyond(beyond + start, pixel), load_gate(vertices + start, pixel));
    const UInt near = params->cell_flags & CELL_NEAR ? vertex >> 31 : (UInt)(0u);
    const UInt side = cube_face(unpack_direction(GATHER_U(vertices + start, pixel, ng))) + 8u * near;
    const Float width = GATHER(vertices + start, pixel, length) * cell_width_of(params, pass);
    const Float values[CLOSE_PLANES] = {
        GATHER(vertices + start, pixel, p[0]),
        GATHER(vertices + start, pixel, p[1]),
        GATHER(vertices + start, pixel, p[2]),
        from_bits(side),
        light.x,
        light.y,
        light.z,
        ball_radius2(params, width),
    };
    for (uint c = 0; c < CLOSE_PLANES; ++c) {
        float lane[W];
        store_lanes(values[c], lane);
        for (uint k = 0; k < W && first + k < count; ++k)
            close[(ulong)c * params->pixel_count + first + k] = lane[k];
    }
}

/// First of the places `[from, end)`, which are in order, that is not below `place`.
static inline uint first_from(__global const ulong *places, uint from, uint end, ulong place)
{
    while (from < end) {
        const uint middle = from + (end - from) / 2u;
        if (places[middle] < place)
            from = middle + 1u;
        else
            end = middle;
    }
    return from;
}

/// What the vertices in a ball sum up to, per lane.
typedef struct {
    Vec3 light;
    UInt count;
} CloseSum;

static inline Float load_run(__global const float *words)
{
#if W == 1
    return words[0];
#else
    return JOIN(vload, W)(0, words);
#endif
}

/// Add those of the vertices `[from, end)` that are in the ball and on the same side.
static inline void add_close(
    __global const float *close, ulong stride, uint from, uint end, Vec3 p, UInt side, float r2, CloseSum *sum)
{
    for (uint i = from; i < end; i += W) {
        __global const float *at = close + i;
        const Float x = load_run(at) - p.x;
        const Float y = load_run(at + stride) - p.y;
        const Float z = load_run(at + 2 * stride) - p.z;
        const Mask near = (lanes_before(MASK_ALL) + i < end) & (x * x + y * y + z * z <= r2)
                          & (as_bits(load_run(at + CLOSE_SIDE * stride)) == side);
        const Vec3 light = vec3(load_run(at + CLOSE_LIGHT * stride), load_run(at + (CLOSE_LIGHT + 1u) * stride),
                                load_run(at + (CLOSE_LIGHT + 2u) * stride));
        sum->light = add(sum->light, pick_v(near, light, vec3_all((Float)(0.0f))));
        sum->count += pick_u(near, (UInt)(1u), (UInt)(0u));
    }
}

/// Add to samples what the vertices around theirs have on average.  One work item a vertex, `count` of
/// `total` from `first` on in the order of the grid.
///
/// reads   places, order, close, beyond, vertices, seen
/// writes  samples, base
kernel void average_close(
    __global const Params *params,
    __global const Beyond *beyond,
    __global const CellVertex *vertices,
    __global const ulong *places,
    __global const uint *order,
    __global const float *close,
#if BASE
    __global const Seen *seen,
    __global float *base,
#endif
    __global float *samples,
    const uint pass,
    const float inverse,
    const uint first,
    const uint count,
    const uint total)
{
    if (get_global_id(0) >= count || first + get_global_id(0) >= total)
        return;
    const uint own = first + get_global_id(0);
    const ulong stride = params->pixel_count;
    const float p[3] = {close[own], close[stride + own], close[2 * stride + own]};
    const float r2 = close[CLOSE_R2 * stride + own];
    const float radius = sqrt(r2);
    const Vec3 center = vec3((Float)(p[0]), (Float)(p[1]), (Float)(p[2]));
    const UInt side = (UInt)(as_uint(close[CLOSE_SIDE * stride + own]));
    uint low[3];
    uint high[3];
    for (uint c = 0; c < 3; ++c) {
        // A little more, so that rounding leaves nothing out.
        const float reach = radius * 1.0001f + fabs(p[c]) * 1e-6f;
        low[c] = grid_coordinate(p[c] - reach, inverse);
        high[c] = grid_coordinate(p[c] + reach, inverse);
    }
    CloseSum sum;
    sum.light = vec3_all((Float)(0.0f));
    sum.count = (UInt)(0u);
    if (high[1] - low[1] > MOST_ROWS || high[2] - low[2] > MOST_ROWS) {
        add_close(close, stride, 0, total, center, side, r2, &sum);
    } else {
        // Cells along x follow one another.
        for (uint z = low[2]; z <= high[2]; ++z)
            for (uint y = low[1]; y <= high[1]; ++y) {
                const uint from = first_from(places, 0, total, grid_place(low[0], y, z));
                const uint end = first_from(places, from, total, grid_place(high[0], y, z) + 1u);
                add_close(close, stride, from, end, center, side, r2, &sum);
            }
    }
    const Float sums[3] = {sum.light.x, sum.light.y, sum.light.z};
    float light[3] = {0.0f, 0.0f, 0.0f};
    uint lane_count[W];
    uint found = 0;
    store_lanes_u(sum.count, lane_count);
    for (uint k = 0; k < W; ++k)
        found += lane_count[k];
    for (uint c = 0; c < 3; ++c) {
        float lane[W];
        store_lanes(sums[c], lane);
        for (uint k = 0; k < W; ++k)
            light[c] += lane[k];
    }
    const ulong at = (ulong)(pass & (params->ring - 1u)) * params->pixel_count + order[own];
    // The vertex itself is among them.
    const float3 mean = vload3(0, vertices[at].gate) * (float3)(light[0], light[1], light[2]) / (float)found;
    const float4 more = (float4)(mean, 0.0f);
    vstore4(vload4(at, samples) + more, at, samples);
#if BASE
    vstore4(vload4(at, base) + more * base_share_of(beyond, seen, at), at, base);
#endif
}

/// Add what the samples of an interrupted first pass gathered behind their vertices, as it is.  One work
/// item a pixel, after add_samples.
///
/// reads   samples, beyond
/// writes  film
kernel void add_unfiltered(
    __global const Params *params, __global const float *samples, __global const Beyond *beyond, __global FilmSum *film)
{
    const uint pixel = get_global_id(0);
    if (pixel < params->pixel_count)
        add_as_it_is(params, samples, beyond, film, pixel);
}
