// Where points of the world are on the film.
#pragma once

#include "lanes.h"
#include "layout.h"

/// A camera, of this frame or the one before.
typedef struct {
    Vec3 origin;
    Vec3 right;
    Vec3 up;
    Vec3 forward;
    float scale_x;
    float scale_y;
} View;

static inline View view_of(__global const Params *params)
{
    View v;
    v.origin = vec3_of(params->camera_origin);
    v.right = vec3_of(params->camera_right);
    v.up = vec3_of(params->camera_up);
    v.forward = vec3_of(params->camera_forward);
    v.scale_x = params->film_scale_x;
    v.scale_y = params->film_scale_y;
    return v;
}

static inline View previous_view_of(__global const Params *params)
{
    View v;
    v.origin = vec3_of(params->previous_origin);
    v.right = vec3_of(params->previous_right);
    v.up = vec3_of(params->previous_up);
    v.forward = vec3_of(params->previous_forward);
    v.scale_x = params->previous_scale_x;
    v.scale_y = params->previous_scale_y;
    return v;
}

/// Edge of a pixel at `p`, m.
static inline Float footprint_at(__global const Params *params, View view, Vec3 p)
{
    const float pixel = 2.0f * view.scale_y / (float)params->height;
#if LENS == 2
    return (Float)(pixel);
#else
    const Vec3 away = sub(p, view.origin);
    return sqrt(dot3(away, away)) * pixel;
#endif
}

/// A place on the film, pixels from its top left corner; whether it is in front of the camera.
typedef struct {
    Float x;
    Float y;
    Mask ahead;
} FilmPlace;

/// Where on the film is what lies along `away` from the camera's origin.
static inline FilmPlace place_on_film(__global const Params *params, View view, Vec3 away)
{
    const Float depth = dot3(away, view.forward);
    FilmPlace place;
#if LENS == 2
    const Float closeness = (Float)(1.0f);
    place.ahead = MASK_ALL;
#else
    place.ahead = depth > 0.0f;
    const Float closeness = 1.0f / pick(place.ahead, depth, (Float)(1.0f));
#endif
    const Float right = dot3(away, view.right) * closeness / view.scale_x;
    const Float up = dot3(away, view.up) * closeness / view.scale_y;
    place.x = (0.5f + 0.5f * right) * (float)params->width;
    place.y = (0.5f - 0.5f * up) * (float)params->height;
    return place;
}

/// Direction of what is seen through the middle of a pixel and lies infinitely far away; not unit.
static inline Vec3 direction_through(__global const Params *params, View view, UInt x, UInt y)
{
#if LENS == 2
    return view.forward;
#else
    const Float right = ((to_float(x) + 0.5f) * (2.0f / (float)params->width) - 1.0f) * view.scale_x;
    const Float up = (1.0f - (to_float(y) + 0.5f) * (2.0f / (float)params->height)) * view.scale_y;
    return add_scaled(add_scaled(view.forward, view.right, right), view.up, up);
#endif
}
