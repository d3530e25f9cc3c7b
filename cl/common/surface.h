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
} SurfacePoint;

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
)
{
    SurfacePoint s;
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

    const Vec3 ng = vec3(GATHER(surfaces, triangle, ng[0]), GATHER(surfaces, triangle, ng[1]),
                         GATHER(surfaces, triangle, ng[2]));
    s.offset = GATHER(surfaces, triangle, offset);
    s.front = dot3(ng, wo) >= 0.0f;
    const Float side = pick(s.front, (Float)(1.0f), (Float)(-1.0f));
    s.ng = scale(ng, side);
    s.ns = s.ng;
#if SMOOTH
    const Float w = 1.0f - u - v;
    const Vec3 n0 = vec3(GATHER(normals, triangle, n0[0]), GATHER(normals, triangle, n0[1]),
                         GATHER(normals, triangle, n0[2]));
    const Vec3 n1 = vec3(GATHER(normals, triangle, n1[0]), GATHER(normals, triangle, n1[1]),
                         GATHER(normals, triangle, n1[2]));
    const Vec3 n2 = vec3(GATHER(normals, triangle, n2[0]), GATHER(normals, triangle, n2[1]),
                         GATHER(normals, triangle, n2[2]));
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

/// Origin for a ray that leaves `s` along `wi`: off the surface, on the side that wi is on.
static inline Vec3 ray_origin(SurfacePoint s, Vec3 wi)
{
    const Float side = pick(dot3(s.ng, wi) >= 0.0f, s.offset, -s.offset);
    return add_scaled(s.p, s.ng, side);
}
