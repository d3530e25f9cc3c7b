// Spheres as lights: points of their surface, named by directions from the center.
//
// A sphere is a mesh of SPHERE_ROWS x SPHERE_COLUMNS flat faces around which another, round sphere lies.  Points of
// the round one are drawn uniformly in the cone that it fills as seen from a point (Shirley, Wang, Zimmerman:
// Monte Carlo Techniques for Direct Lighting Calculations, 1996) and moved towards the center until they are on the
// mesh.  At the edge of what is seen the two differ: a small share of the points is drawn all around, so that
// none is without a chance.
#pragma once

#include "lanes.h"
#include "layout.h"

#if SPHERES

// Of the points, those drawn all around the center.
#define AROUND 0.0625f
// From nearer than this, in distances, and from inside, all are: there round and flat are too different.
#define LEAST_GAP 1e-3f

/// A sphere as it is seen from its center.
typedef struct {
    Vec3 center;
    Float radius;
    Vec3 x;      // unit axes of the mesh
    Vec3 y;
    Vec3 z;
} Sphere;

/// The same from a point.
typedef struct {
    Vec3 axis;      // unit, from the center to the point
    Float ratio;    // radius over distance
    Float cosine;   // of half of the cone's angle
    Mask apart;     // whether there is a cone
} SeenSphere;

static inline Sphere fetch_sphere(__global const Light *lights, UInt light)
{
    Sphere s;
    s.center = vec3(GATHER(lights, light, position[0]), GATHER(lights, light, position[1]),
                    GATHER(lights, light, position[2]));
    const Vec3 x =
        vec3(GATHER(lights, light, e1[0]), GATHER(lights, light, e1[1]), GATHER(lights, light, e1[2]));
    const Vec3 z =
        vec3(GATHER(lights, light, e2[0]), GATHER(lights, light, e2[1]), GATHER(lights, light, e2[2]));
    s.radius = max(sqrt(dot3(x, x)), 1e-30f);
    s.x = scale(x, 1.0f / s.radius);
    s.y = vec3(GATHER(lights, light, direction[0]), GATHER(lights, light, direction[1]),
               GATHER(lights, light, direction[2]));
    s.z = scale(z, 1.0f / s.radius);
    return s;
}

static inline SeenSphere see_sphere(Sphere s, Vec3 from)
{
    SeenSphere seen;
    const Vec3 d = sub(from, s.center);
    const Float length = sqrt(dot3(d, d));
    seen.apart = (s.radius < (1.0f - LEAST_GAP) * length) & (length < INFINITY);
    const Float inverse = 1.0f / pick(seen.apart, length, (Float)(1.0f));
    seen.axis = pick_v(seen.apart, scale(d, inverse), vec3((Float)(0.0f), (Float)(0.0f), (Float)(1.0f)));
    seen.ratio = pick(seen.apart, s.radius * inverse, (Float)(0.0f));
    seen.cosine = sqrt(1.0f - seen.ratio * seen.ratio);
    return seen;
}

/// Draw a direction from the center.
static inline Vec3 draw_around(SeenSphere seen, Float u1, Float u2)
{
    const Float share = pick(seen.apart, (Float)(AROUND), (Float)(1.0f));
    const Mask anywhere = u1 < share;
    const Float u = clamp(pick(anywhere, u1 / share, (u1 - AROUND) / (1.0f - AROUND)), (Float)(0.0f), (Float)(1.0f));
    // In the cone 1 - cos is uniform.  The angle at the center is the one at the surface less the one at the point,
    // whose sines are as distance and radius: no difference of large numbers, however small the cone.
    const Float inside = u / (1.0f + seen.cosine);
    const Float less = seen.ratio * seen.ratio * inside;
    const Float sine2 = inside * (2.0f - less);
    const Float at_surface = sqrt(sine2);
    const Float cos_surface = sqrt(max(1.0f - sine2, 0.0f));
    const Float at_point = seen.ratio * at_surface;
    const Float cos_point = 1.0f - less;
    const Float cosine = pick(anywhere, 1.0f - 2.0f * u, cos_surface * cos_point + at_surface * at_point);
    const Float sine = pick(anywhere, 2.0f * sqrt(u * (1.0f - u)), at_surface * cos_point - cos_surface * at_point);
    Vec3 s;
    Vec3 t;
    Float c;
    Float si;
    make_frame(seen.axis, &s, &t);
    cos_sin_turns(u2, &c, &si);
    return normalize3(add_scaled(add_scaled(scale(seen.axis, cosine), s, sine * c), t, sine * si));
}

/// Density with which draw_around draws `n`, per solid angle at the center.
static inline Float density_around(SeenSphere seen, Vec3 n)
{
    const Vec3 chord = sub(n, seen.axis);
    const Float bend = 0.5f * dot3(chord, chord); // 1 - cos of the angle at the center
    const Float gap = 1.0f - seen.ratio;
    // In distances of the center: that of the point of the surface, squared.
    const Float d2 = gap * gap + 2.0f * seen.ratio * bend;
    const Float cone = (1.0f + seen.cosine) * (0.5f * INV_PI) * max(gap - bend, 0.0f) / max(d2 * sqrt(d2), 1e-30f);
    const Float all_around = (Float)(0.25f * INV_PI);
    return pick(seen.apart, AROUND * all_around + (1.0f - AROUND) * cone, all_around);
}

/// Distance of the mesh from its center along `n`, and the normal of the face.
static inline Float face_along(Sphere s, Vec3 n, Vec3 *ng)
{
    // Half of what a row and a column are wide, as seen from the center.
    const float row_cosine = cos(PI / (2 * SPHERE_ROWS));
    const float column_cosine = cos(PI / SPHERE_COLUMNS);
    const Float up = dot3(n, s.y);
    // Turns around the y axis begin at -z.
    const Float back = -dot3(n, s.z);
    const Float right = -dot3(n, s.x);
    const Float turns = atan2_lanes(right, back) * (0.5f * INV_PI);
    const Float column = floor(pick(turns < 0.0f, turns + 1.0f, turns) * (float)SPHERE_COLUMNS);
    Float middle_cosine;
    Float middle_sine;
    cos_sin_turns((column + 0.5f) / (float)SPHERE_COLUMNS, &middle_cosine, &middle_sine);
    // Edges between rows are straight: across the middle of the column all points of one are at one angle.
    const Float out = back * middle_cosine + right * middle_sine;
    const Float angle = atan2_lanes(out, up * column_cosine);
    const Float row = clamp(floor(angle * (INV_PI * SPHERE_ROWS)), (Float)(0.0f), (Float)(SPHERE_ROWS - 1.0f));
    Float face_cosine;
    Float face_sine;
    cos_sin_turns((row + 0.5f) / (2.0f * SPHERE_ROWS), &face_cosine, &face_sine);
    face_cosine *= column_cosine;
    const Float facing = out * face_sine + up * face_cosine;
    const Vec3 outward = add_scaled(scale(s.z, -middle_cosine), s.x, -middle_sine);
    *ng = normalize3(add_scaled(scale(outward, face_sine), s.y, face_cosine));
    return s.radius * (column_cosine * row_cosine) / max(facing, 0.5f);
}

/// Return the area of the mesh that points drawn along `n` stand for: one over their density.
static inline Float area_along(Float density, Vec3 n, Float r, Vec3 ng)
{
    return r * r / max(density * fabs(dot3(n, ng)), 1e-30f);
}
#endif
