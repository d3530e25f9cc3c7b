// Rectangles as lights: the solid angle that one fills as seen from a point, and uniform directions in it.  And disks,
// polygons of DISK_SEGMENTS corners in such rectangles: near ones are drawn with what is beside them, where
// there is no light.
//
// Urena, Fajardo, King: An Area-Preserving Parametrization for Spherical Rectangles, 2013.  Its angles are
// taken as arc tangents and its squares as differences that do not cancel where the view is grazing.
#pragma once

#include "lanes.h"
#include "layout.h"

#if RECTANGLES

// Below this solid angle floats would show.
#define LEAST_SOLID_ANGLE 1e-2f
// Above the plane, in sides.
#define LEAST_HEIGHT 1e-4f

/// A rectangle from a point at the origin: its sides at `x0`, `x1` and `y0`, `y1` of its plane at `z` >= 0.
typedef struct {
    Float x0;
    Float x1;
    Float y0;
    Float y1;
    Float z;
    Float first; // angle at which the corners x0 begin
    Float solid; // solid angle
} SeenRectangle;

/// Solid angle between the foot of the perpendicular and the corner (x, y), with a sign.
static inline Float corner_angle(Float x, Float y, Float z)
{
    return atan2_lanes(x * y, z * sqrt(x * x + y * y + z * z));
}

/// Whether a rectangle is nearer than it is large: from farther away uniform points are as good, and
/// cost less.
static inline Mask is_close(Vec3 corner, Vec3 e1, Vec3 e2, Vec3 from)
{
    const Vec3 d = sub(add_scaled(corner, add(e1, e2), (Float)(0.5f)), from);
    return dot3(d, d) < dot3(e1, e1) + dot3(e2, e2);
}

/// See the rectangle of a corner and the edges from it.
static inline SeenRectangle see_rectangle(Vec3 corner, Vec3 e1, Vec3 e2, Vec3 from)
{
    SeenRectangle r;
    const Float width = sqrt(dot3(e1, e1));
    const Float height = sqrt(dot3(e2, e2));
    const Vec3 x = scale(e1, 1.0f / max(width, 1e-30f));
    const Vec3 y = scale(e2, 1.0f / max(height, 1e-30f));
    const Vec3 d = sub(corner, from);
    r.x0 = dot3(d, x);
    r.y0 = dot3(d, y);
    r.x1 = r.x0 + width;
    r.y1 = r.y0 + height;
    r.z = fabs(dot3(d, cross3(x, y)));
    r.first = corner_angle(r.x0, r.y1, r.z) - corner_angle(r.x0, r.y0, r.z);
    r.solid = corner_angle(r.x1, r.y1, r.z) - corner_angle(r.x1, r.y0, r.z) - r.first;
    return r;
}

/// Whether it is large enough for directions to be drawn uniformly, and far enough from its plane for points on
/// it to be told apart; no solid angle that is no number is.
static inline Mask is_wide(SeenRectangle r)
{
    const Mask apart = r.z > LEAST_HEIGHT * max(r.x1 - r.x0, r.y1 - r.y0);
    return apart & (r.solid > LEAST_SOLID_ANGLE) & (r.solid < INFINITY);
}

/// Draw a point, as parts of the edges, so that directions are uniform.
static inline void sample_rectangle(SeenRectangle r, Float u1, Float u2, Float *part1, Float *part2)
{
    const Float z2 = r.z * r.z;
    const Float low = z2 + r.y0 * r.y0;
    const Float high = z2 + r.y1 * r.y1;
    Float c;
    Float s;
    const Float angle = r.first + u1 * r.solid;
    cos_sin_turns(fabs(angle) * (0.5f * INV_PI), &c, &s);
    s = pick(angle < 0.0f, -s, s);
    s = pick(fabs(s) < 1e-12f, (Float)(1e-12f), s);
    const Float f = (r.y1 / sqrt(max(high, 1e-30f)) - c * r.y0 / sqrt(max(low, 1e-30f))) / s;
    const Float x = r.z / sqrt(max(f * f - z2 / max(low, 1e-30f), 1e-30f));
    const Float along = clamp(pick(f < 0.0f, -x, x), r.x0, r.x1);
    const Float d2 = along * along + z2;
    const Float from = r.y0 / sqrt(max(d2 + r.y0 * r.y0, 1e-30f));
    const Float to = r.y1 / sqrt(max(d2 + r.y1 * r.y1, 1e-30f));
    const Float h = from + u2 * (to - from);
    const Float across = clamp(h * sqrt(d2 / max(1.0f - h * h, 1e-12f)), r.y0, r.y1);
    *part1 = (along - r.x0) / max(r.x1 - r.x0, 1e-30f);
    *part2 = (across - r.y0) / max(r.y1 - r.y0, 1e-30f);
}

/// Whether the point at parts of the edges of its rectangle is on the disk.
static inline Mask on_disk(Float part1, Float part2)
{
    const Float x = 2.0f * part1 - 1.0f;
    const Float z = 2.0f * part2 - 1.0f;
    const Float turns = atan2_lanes(x, z) * (0.5f * INV_PI);
    const Float segment = floor(pick(turns < 0.0f, turns + 1.0f, turns) * (float)DISK_SEGMENTS);
    Float c;
    Float s;
    cos_sin_turns((segment + 0.5f) / (float)DISK_SEGMENTS, &c, &s);
    return x * s + z * c <= cos(PI / DISK_SEGMENTS);
}

/// Draw a point of the disk uniformly, as parts of the edges of its rectangle.
static inline void sample_disk(Float u1, Float u2, Float *part1, Float *part2)
{
    const Float place = u1 * (float)DISK_SEGMENTS;
    const Float segment = min(floor(place), (Float)(DISK_SEGMENTS - 1.0f));
    const Float root = 0.5f * sqrt(place - segment);
    Float c0;
    Float s0;
    Float c1;
    Float s1;
    cos_sin_turns(segment / (float)DISK_SEGMENTS, &c0, &s0);
    cos_sin_turns((segment + 1.0f) / (float)DISK_SEGMENTS, &c1, &s1);
    *part1 = 0.5f + root * (s0 + u2 * (s1 - s0));
    *part2 = 0.5f + root * (c0 + u2 * (c1 - c0));
}
#endif
