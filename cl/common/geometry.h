// A ray against four triangles and against eight boxes, so that no ray slips through a closed mesh.
//
// Watertight means: the sign of an edge function is that of its exact value for the rounded,
// sheared corners, so two triangles that share an edge agree on which side of it the ray passes.
// Rounding moves those corners by at most 6 u times their distance from the ray's origin, with
// u = 2^-24 and the distance by the largest component: at most the corner's plus the origin's from 0.
// Boxes must allow for it: BOX_SLACK times the corner's part is added around them where the tree is
// built, BOX_SLACK times the origin's part where the ray is set up.
//
// Woop, Benthin, Wald: Watertight Ray/Triangle Intersection, JCGT 2 (1), 2013.
#pragma once

#include "lanes.h"
#include "layout.h"

#define BOX_SLACK 0x1.4p-21f // 10 u: 6 for the corners, 2 for the rounding of slack and sum, 1 for `shift`

// At least 1 + 2 gamma(3): the far distance of a box must not be rounded below its near distance.
// Ize: Robust BVH Ray Traversal, JCGT 2 (2), 2013.
#define BOX_FAR_FACTOR 0x1.000008p0f

/// What a ray hits first.
typedef struct {
    float t; // the ray's t_max if there is no hit
    float u; // barycentric coordinate of the second corner
    float v; // barycentric coordinate of the third corner
    uint triangle; // index without ALPHA_BIT, or NO_HIT
} Hit;

/// Hits of all lanes; `triangle` is NO_HIT where there is none.
typedef struct {
    Float t;
    Float u; // barycentric coordinate of the second corner
    Float v; // barycentric coordinate of the third corner
    UInt triangle;
} Hits;

/// What depends on the ray alone: boxes' rows and planes, and the shear that turns the ray into z.
typedef struct {
    float inverse[3]; // 1 / direction; large for 0
    float far_inverse[3]; // the same times BOX_FAR_FACTOR
    float near_shift[3]; // minus the origin, moved back by its slack, times inverse
    float far_shift[3]; // minus the origin, moved on, times far_inverse
    uint near_row[3]; // row of BvhNode.bounds that the ray meets first; the other is near_row ^ 1
    uint axis[3]; // kx, ky, kz: kz is where the direction is longest
    float origin[3]; // along kx, ky, kz
    float shear[3]; // direction x / z, y / z and 1 / z along those axes
    float t_max; // 0 if the ray is beyond 2^120, not finite or has no direction: no hits
} RaySetup;

/// The same of all lanes.
typedef struct {
    float inverse[3][W];
    float far_inverse[3][W];
    float near_shift[3][W];
    float far_shift[3][W];
    uint axis[W]; // kz
    float origin[3][W];
    float shear[3][W];
    float t_max[W];
} RaySetups;

/// Four triangles' answers; lane k holds only where hit[k] is -1.
typedef struct {
    int4 hit;
    float4 t;
    float4 u;
    float4 v;
} BlockHit;

/// Set up the rays of the lanes in `active`; the others' t_max is 0.
static inline void set_up_rays(RaySetups *rays, Mask active, Vec3 origin, Vec3 direction, Float t_max)
{
    const Float x = fabs(direction.x);
    const Float y = fabs(direction.y);
    const Float z = fabs(direction.z);
    const Float longest = max(x, max(y, z));
    const Float reach = max(fabs(origin.x), max(fabs(origin.y), fabs(origin.z)));
    // Sums, because max() may drop a NaN; the limits keep every inverse away from 0.
    const Mask usable = active & (x + y + z < 0x1p120f) & (longest > 0x1p-120f)
                        & (fabs(origin.x) + fabs(origin.y) + fabs(origin.z) < 0x1p120f);
    store_lanes(pick(usable, t_max, (Float)(0.0f)), rays->t_max);

    const Float slack = BOX_SLACK * reach;
    // Along an axis that the ray does not follow boxes must still be told apart: infinities would not.  What
    // the ray moves too far this way is less than the slack.
    const Float least = longest * 0x1p-60f;
    const Vec3 inverse = vec3(1.0f / pick(x < least, least, direction.x), 1.0f / pick(y < least, least, direction.y),
                              1.0f / pick(z < least, least, direction.z));
    const Float slack_x = pick(inverse.x < 0.0f, -slack, slack);
    const Float slack_y = pick(inverse.y < 0.0f, -slack, slack);
    const Float slack_z = pick(inverse.z < 0.0f, -slack, slack);
    const Vec3 far_inverse = scale(inverse, (Float)(BOX_FAR_FACTOR));
    store_lanes(inverse.x, rays->inverse[0]);
    store_lanes(inverse.y, rays->inverse[1]);
    store_lanes(inverse.z, rays->inverse[2]);
    store_lanes(far_inverse.x, rays->far_inverse[0]);
    store_lanes(far_inverse.y, rays->far_inverse[1]);
    store_lanes(far_inverse.z, rays->far_inverse[2]);
    store_lanes(-(origin.x + slack_x) * inverse.x, rays->near_shift[0]);
    store_lanes(-(origin.y + slack_y) * inverse.y, rays->near_shift[1]);
    store_lanes(-(origin.z + slack_z) * inverse.z, rays->near_shift[2]);
    store_lanes(-(origin.x - slack_x) * far_inverse.x, rays->far_shift[0]);
    store_lanes(-(origin.y - slack_y) * far_inverse.y, rays->far_shift[1]);
    store_lanes(-(origin.z - slack_z) * far_inverse.z, rays->far_shift[2]);

    // The winding that Woop et al. keep by swapping kx and ky does not matter without culling.
    const Mask along_x = (x > y) & (x > z);
    const Mask along_y = !along_x & (y > z) & (x <= y);
    const Vec3 o = pick_v(along_x, vec3(origin.y, origin.z, origin.x),
                          pick_v(along_y, vec3(origin.z, origin.x, origin.y), origin));
    const Vec3 d = pick_v(along_x, vec3(direction.y, direction.z, direction.x),
                          pick_v(along_y, vec3(direction.z, direction.x, direction.y), direction));
    store_lanes_u(pick_u(along_x, (UInt)(0u), pick_u(along_y, (UInt)(1u), (UInt)(2u))), rays->axis);
    store_lanes(o.x, rays->origin[0]);
    store_lanes(o.y, rays->origin[1]);
    store_lanes(o.z, rays->origin[2]);
    store_lanes(d.x / d.z, rays->shear[0]);
    store_lanes(d.y / d.z, rays->shear[1]);
    store_lanes(1.0f / d.z, rays->shear[2]);
}

// Loops over axes are written out in what every ray runs: PoCL keeps short loops, and their arrays in
// memory.

/// The setup of lane `k`.
static inline RaySetup ray_setup(const RaySetups *rays, uint k)
{
    RaySetup ray;
    ray.far_inverse[0] = rays->far_inverse[0][k];
    ray.far_inverse[1] = rays->far_inverse[1][k];
    ray.far_inverse[2] = rays->far_inverse[2][k];
    ray.near_shift[0] = rays->near_shift[0][k];
    ray.near_shift[1] = rays->near_shift[1][k];
    ray.near_shift[2] = rays->near_shift[2][k];
    ray.far_shift[0] = rays->far_shift[0][k];
    ray.far_shift[1] = rays->far_shift[1][k];
    ray.far_shift[2] = rays->far_shift[2][k];
    ray.inverse[0] = rays->inverse[0][k];
    ray.inverse[1] = rays->inverse[1][k];
    ray.inverse[2] = rays->inverse[2][k];
    ray.near_row[0] = ray.inverse[0] < 0.0f ? 1u : 0u;
    ray.near_row[1] = ray.inverse[1] < 0.0f ? 3u : 2u;
    ray.near_row[2] = ray.inverse[2] < 0.0f ? 5u : 4u;
    const uint kz = rays->axis[k];
    const uint kx = kz == 2u ? 0u : kz + 1u;
    ray.axis[0] = kx;
    ray.axis[1] = kx == 2u ? 0u : kx + 1u;
    ray.axis[2] = kz;
    ray.origin[0] = rays->origin[0][k];
    ray.origin[1] = rays->origin[1][k];
    ray.origin[2] = rays->origin[2][k];
    ray.shear[0] = rays->shear[0][k];
    ray.shear[1] = rays->shear[1][k];
    ray.shear[2] = rays->shear[2][k];
    ray.t_max = rays->t_max[k];
    return ray;
}

/// a * d - b * c with the sign of the exact value (short of underflow).
///
/// Jeannerod, Louvet, Muller: Further Analysis of Kahan's Algorithm for the Accurate Computation of
/// 2x2 Determinants, Mathematics of Computation 82, 2013: the relative error is at most 2 u.
static inline float4 signed_difference(float4 a, float4 d, float4 b, float4 c)
{
#pragma OPENCL FP_CONTRACT OFF
    const float4 product = b * c;
    const float4 error = fma(-b, c, product);
    const float4 difference = fma(a, d, -product);
    return difference + error;
}

/// A power of two that brings the largest of the lane's numbers between 1 and 4.
static inline float4 power_of_two_scale(float4 a, float4 b, float4 c, float4 d, float4 e, float4 f)
{
    const float4 largest =
        max(max(max(fabs(a), fabs(b)), max(fabs(c), fabs(d))), max(fabs(e), fabs(f)));
    const int4 exponent = min(as_int4(largest) & 0x7F800000, 0x7E800000);
    return as_float4(0x7F000000 - exponent);
}

static inline int4 signs_differ(float4 u, float4 v, float4 w)
{
    return ((u < 0.0f) | (v < 0.0f) | (w < 0.0f)) & ((u > 0.0f) | (v > 0.0f) | (w > 0.0f));
}

/// Intersect the four triangles of a block with the line of a ray.
///
/// Both sides count; degenerate and unused triangles are never hit.  Edges belong to both
/// triangles.  Coordinates of any size do: where products leave the range of float, corners are
/// scaled first.
static inline BlockHit intersect_block(__global const TriangleBlock *block, const RaySetup *ray)
{
// A contracted a * b - c * d is not the negative of c * d - a * b.
#pragma OPENCL FP_CONTRACT OFF
    const uint kx = ray->axis[0];
    const uint ky = ray->axis[1];
    const uint kz = ray->axis[2];
    const float4 az = vload4(0, block->v[kz]) - ray->origin[2];
    const float4 bz = vload4(0, block->v[3 + kz]) - ray->origin[2];
    const float4 cz = vload4(0, block->v[6 + kz]) - ray->origin[2];
    float4 ax = (vload4(0, block->v[kx]) - ray->origin[0]) - ray->shear[0] * az;
    float4 bx = (vload4(0, block->v[3 + kx]) - ray->origin[0]) - ray->shear[0] * bz;
    float4 cx = (vload4(0, block->v[6 + kx]) - ray->origin[0]) - ray->shear[0] * cz;
    float4 ay = (vload4(0, block->v[ky]) - ray->origin[1]) - ray->shear[1] * az;
    float4 by = (vload4(0, block->v[3 + ky]) - ray->origin[1]) - ray->shear[1] * bz;
    float4 cy = (vload4(0, block->v[6 + ky]) - ray->origin[1]) - ray->shear[1] * cz;

    float4 u = cx * by - cy * bx;
    float4 v = ax * cy - ay * cx;
    float4 w = bx * ay - by * ax;
    const int4 used = vload4(0, block->id) != (uint4)(NO_HIT);
    BlockHit found;
    found.hit = used & ~signs_differ(u, v, w);
    if (!ANY(found.hit))
        return found;

    float4 determinant = u + v + w;
    const int4 doubtful = (u == 0.0f) | (v == 0.0f) | (w == 0.0f)
        | ~((fabs(determinant) > 0x1p-100f) & (fabs(determinant) < 0x1p100f));
    if (ANY(found.hit & doubtful)) {
        const float4 scale = power_of_two_scale(ax, bx, cx, ay, by, cy);
        ax *= scale;
        bx *= scale;
        cx *= scale;
        ay *= scale;
        by *= scale;
        cy *= scale;
        u = signed_difference(cx, by, cy, bx);
        v = signed_difference(ax, cy, ay, cx);
        w = signed_difference(bx, ay, by, ax);
        found.hit &= ~signs_differ(u, v, w);
        determinant = u + v + w;
    }
    const float4 inverse = 1.0f / determinant;
    found.u = v * inverse;
    found.v = w * inverse;
    // Weighting the corners' distances keeps t between them, however small the determinant.
    found.t = (u * inverse) * (az * ray->shear[2]) + found.u * (bz * ray->shear[2])
        + found.v * (cz * ray->shear[2]);
    // A determinant of 0 makes t NaN or infinite, and that is not in front.
    found.hit &= (found.t > 0.0f) & (found.t < INFINITY);
    return found;
}

/// Return which of a node's eight children the ray may meet up to `limit`, and where it enters.
///
/// Conservative.  Minima and maxima drop NaN or what it stands against (an infinite inverse times what
/// it is infinitely far from: the ray slides along the face), and empty children are entered at
/// infinity.  The distances hang on few operations after one another: a ray waits for them.
static inline int8 intersect_boxes(
    __global const BvhNode *node, const RaySetup *ray, float limit, float8 *entry)
{
    const uint x = ray->near_row[0];
    const uint y = ray->near_row[1];
    const uint z = ray->near_row[2];
    const float8 x0 = fma(vload8(0, node->bounds[x]), (float8)(ray->inverse[0]), (float8)(ray->near_shift[0]));
    const float8 y0 = fma(vload8(0, node->bounds[y]), (float8)(ray->inverse[1]), (float8)(ray->near_shift[1]));
    const float8 z0 = fma(vload8(0, node->bounds[z]), (float8)(ray->inverse[2]), (float8)(ray->near_shift[2]));
    const float8 x1 =
        fma(vload8(0, node->bounds[x ^ 1u]), (float8)(ray->far_inverse[0]), (float8)(ray->far_shift[0]));
    const float8 y1 =
        fma(vload8(0, node->bounds[y ^ 1u]), (float8)(ray->far_inverse[1]), (float8)(ray->far_shift[1]));
    const float8 z1 =
        fma(vload8(0, node->bounds[z ^ 1u]), (float8)(ray->far_inverse[2]), (float8)(ray->far_shift[2]));
    const float8 start = x0 > 0.0f ? x0 : (float8)(0.0f);
    const float8 end = x1 < limit * BOX_FAR_FACTOR ? x1 : (float8)(limit * BOX_FAR_FACTOR);
    const float8 enter = y0 > z0 ? y0 : z0;
    const float8 leave = y1 < z1 ? y1 : z1;
    const float8 near = enter > start ? enter : start;
    const float8 far = leave < end ? leave : end;
    *entry = near;
    return near <= far;
}
