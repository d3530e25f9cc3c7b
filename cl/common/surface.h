// A hit becomes a point: position, normals, sides, material parameters.
#pragma once

#include "lanes.h"
#include "layout.h"
#include "texture.h"

/// A point of a surface, as the BSDF and the lights need it.
///
/// ng and ns are on the side of wo (they are flipped for a ray that comes from behind).
typedef struct {
    Vec3 p;
    Vec3 ng;          // unit geometric normal
    Vec3 ns;          // unit shading normal
    Float offset;     // m along ng that clears the rounding error of p
    Mask front;       // wo is on the side from which the corners go counter-clockwise
    UInt triangle;
    UInt material;
    UInt light;       // NO_LIGHT if it does not emit
#if TEXTURE_LEVELS
    Float footprint;  // m^2 that textures are averaged over; 0 for none
#endif
#if INSTANCES
    UInt instance;
#endif
} SurfacePoint;

// Where meshes are placed several times, functions and kernels need their places.
#if INSTANCES
#define INSTANCE_PARAMETERS , __global const Instance *instances
#define INSTANCE_ARGUMENTS , instances

#define GATHER_VECTOR(array, index, member)                                                        \
    vec3(GATHER(array, index, member[0]), GATHER(array, index, member[1]), GATHER(array, index, member[2]))

/// The direction `v` of a mesh in the world, not normalised.
static inline Vec3 placed_direction(__global const Instance *instances, UInt instance, Vec3 v)
{
    return vec3(dot3(GATHER_VECTOR(instances, instance, x_row), v),
                dot3(GATHER_VECTOR(instances, instance, y_row), v),
                dot3(GATHER_VECTOR(instances, instance, z_row), v));
}

/// The normal `n` of a mesh in the world; none stays none.
static inline Vec3 placed_normal(__global const Instance *instances, UInt instance, Vec3 n)
{
    // The inverse transposed: rows become columns.
    const Vec3 x = vec3(GATHER(instances, instance, inverse[0]), GATHER(instances, instance, inverse[3]),
                        GATHER(instances, instance, inverse[6]));
    const Vec3 y = vec3(GATHER(instances, instance, inverse[1]), GATHER(instances, instance, inverse[4]),
                        GATHER(instances, instance, inverse[7]));
    const Vec3 z = vec3(GATHER(instances, instance, inverse[2]), GATHER(instances, instance, inverse[5]),
                        GATHER(instances, instance, inverse[8]));
    const Vec3 placed = normalize3(vec3(dot3(x, n), dot3(y, n), dot3(z, n)));
    return pick_v(dot3(n, n) > 0.0f, placed, n);
}
#else
#define INSTANCE_PARAMETERS
#define INSTANCE_ARGUMENTS
#endif

/// Parameters of the BSDF at a point; textures are already in.
typedef struct {
    Vec3 base_color;
#if GLOSSY
    Float metallic;
    Float alpha;      // GGX; along the tangent, if anisotropic
    Float f0;         // dielectric reflectance at normal incidence
    Float specular;   // dielectric F90
#endif
#if TRANSMISSION
    Float transmission;
    Float eta;        // index of the side of wi over that of wo, for a ray that goes through
    Mask thin;        // a sheet: what goes through is not bent
#endif
#if LAYERS
    Float alpha_y;    // along the bitangent
    Vec3 tint;        // of the dielectric reflection at normal incidence
    Float coat;
    Float coat_alpha;
    Vec3 sheen;
    Float sheen_roughness;
#endif
} Bsdf;

/// Set up the point that barycentrics (u, v) of `triangle` name, seen along wo.
LARGE_FUNCTION SurfacePoint surface_point(
    UInt triangle,
    Float u,
    Float v,
    Vec3 wo,
    __global const Surface *surfaces
#if SMOOTH
    , __global const Normals *normals
#endif
    INSTANCE_PARAMETERS)
{
    SurfacePoint s;
#if TEXTURE_LEVELS
    s.footprint = (Float)(0.0f);
#endif
#if INSTANCES
    s.instance = triangle >> (uint)INSTANCES;
    triangle -= GATHER_U(instances, s.instance, base);
#endif
    const Vec3 p0 = vec3(GATHER(surfaces, triangle, p0[0]), GATHER(surfaces, triangle, p0[1]),
                         GATHER(surfaces, triangle, p0[2]));
    const Vec3 e1 = vec3(GATHER(surfaces, triangle, e1[0]), GATHER(surfaces, triangle, e1[1]),
                         GATHER(surfaces, triangle, e1[2]));
    const Vec3 e2 = vec3(GATHER(surfaces, triangle, e2[0]), GATHER(surfaces, triangle, e2[1]),
                         GATHER(surfaces, triangle, e2[2]));
    s.triangle = triangle;
    s.material = GATHER_U(surfaces, triangle, material);
    s.light = GATHER_U(surfaces, triangle, light);
    s.p = add_scaled(add_scaled(p0, e1, u), e2, v);

#if INSTANCES
    const Vec3 ng = placed_normal(instances, s.instance, GATHER_VECTOR(surfaces, triangle, ng));
    s.p = add(GATHER_VECTOR(instances, s.instance, position), placed_direction(instances, s.instance, s.p));
    const UInt material = GATHER_U(instances, s.instance, material);
    s.material = pick_u(material == OWN_MATERIAL, s.material, material);
    const Float offset = GATHER(instances, s.instance, offset);
    s.offset = pick(offset > 0.0f, offset, GATHER(surfaces, triangle, offset));
#else
    const Vec3 ng = vec3(GATHER(surfaces, triangle, ng[0]), GATHER(surfaces, triangle, ng[1]),
                         GATHER(surfaces, triangle, ng[2]));
    s.offset = GATHER(surfaces, triangle, offset);
#endif
    s.front = dot3(ng, wo) >= 0.0f;
    const Float side = pick(s.front, (Float)(1.0f), (Float)(-1.0f));
    s.ng = scale(ng, side);
    s.ns = s.ng;
#if SMOOTH
    const Float w = 1.0f - u - v;
    Vec3 n0 = vec3(GATHER(normals, triangle, n0[0]), GATHER(normals, triangle, n0[1]),
                   GATHER(normals, triangle, n0[2]));
    Vec3 n1 = vec3(GATHER(normals, triangle, n1[0]), GATHER(normals, triangle, n1[1]),
                   GATHER(normals, triangle, n1[2]));
    Vec3 n2 = vec3(GATHER(normals, triangle, n2[0]), GATHER(normals, triangle, n2[1]),
                   GATHER(normals, triangle, n2[2]));
#if INSTANCES
    n0 = placed_normal(instances, s.instance, n0);
    n1 = placed_normal(instances, s.instance, n1);
    n2 = placed_normal(instances, s.instance, n2);
#endif
    const Vec3 sum = add_scaled(add_scaled(scale(n0, w), n1, u), n2, v);
    const Float length2 = dot3(sum, sum);
    Vec3 ns = normalize3(sum);
    const Float agree = dot3(ns, s.ng);
    ns = scale(ns, pick(agree < 0.0f, (Float)(-1.0f), (Float)(1.0f)));
    // A shading normal that wo sees from behind would make the point black: the real one serves there.
    s.ns = pick_v((length2 > 0.0f) & (dot3(ns, wo) > 1e-4f), ns, s.ng);
#endif
    return s;
}

#if TEXTURE_LEVELS
/// Area on a mesh over that in the world.
static inline Float density_scale(SurfacePoint s INSTANCE_PARAMETERS)
{
#if INSTANCES
    const Vec3 x = GATHER_VECTOR(instances, s.instance, x_row);
    const Vec3 y = GATHER_VECTOR(instances, s.instance, y_row);
    const Vec3 z = GATHER_VECTOR(instances, s.instance, z_row);
    return 3.0f / max(dot3(x, x) + dot3(y, y) + dot3(z, z), 1e-30f);
#else
    return (Float)(1.0f);
#endif
}
#endif

/// Origin for a ray that leaves `s` along `wi`: off the surface, on the side that wi is on.
static inline Vec3 ray_origin(SurfacePoint s, Vec3 wi)
{
    const Float side = pick(dot3(s.ng, wi) >= 0.0f, s.offset, -s.offset);
    return add_scaled(s.p, s.ng, side);
}
