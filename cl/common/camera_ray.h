// The way from the film into the scene.
#pragma once

#include "features.h"
#include "lanes.h"
#include "layout.h"

/// Unit direction, and `origin`, of the ray through a place of the film, in pixels from its corner.
///
/// `lens_1`, `lens_2`: two numbers in [0, 1) that a lens takes.
static inline Vec3 camera_ray(
    __global const Params *params, Float x, Float y, Float lens_1, Float lens_2, Vec3 *origin)
{
    const Float film_x = (x * (2.0f / (float)params->width) - 1.0f) * params->film_scale_x;
    const Float film_y = (1.0f - y * (2.0f / (float)params->height)) * params->film_scale_y;
    *origin = vec3_of(params->camera_origin);
    const Vec3 right = vec3_of(params->camera_right);
    const Vec3 up = vec3_of(params->camera_up);
#if LENS == 2
    Vec3 direction = vec3_of(params->camera_forward);
    *origin = add_scaled(add_scaled(*origin, right, film_x), up, film_y);
#else
    Vec3 direction = add_scaled(add_scaled(vec3_of(params->camera_forward), right, film_x), up, film_y);
#endif
#if LENS == 1
    // The point that is sharp stays where it is; the origin moves over the lens (Shirley's map).
    Float c;
    Float s;
    cos_sin_turns(lens_2, &c, &s);
    const Float radius = sqrt(lens_1) * params->lens_radius;
    const Vec3 shift = add_scaled(scale(right, radius * c), up, radius * s);
    const Vec3 focus = add_scaled(*origin, direction, (Float)(params->focus_distance));
    *origin = add(*origin, shift);
    direction = sub(focus, *origin);
#endif
    return normalize3(direction);
}
