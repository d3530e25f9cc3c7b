// Back faces that the camera looks through: its rays do not meet them, all others do.
#pragma once

#include "geometry.h"
#include "lanes.h"
#include "layout.h"

#if BACK_FACES

/// Whether the camera's `ray` comes from behind to a triangle that it sees only from the front.
static inline bool is_looked_through(
    uint triangle, const RaySetup *ray, __global const Surface *surfaces, __global const Material *materials)
{
    __global const Surface *surface = &surfaces[triangle];
    if (!(materials[surface->material].flags & MATERIAL_HIDES_BACK))
        return false;
    // The direction along kx, ky, kz over that along kz.
    const float ahead = ray->shear[0] * surface->ng[ray->axis[0]] + ray->shear[1] * surface->ng[ray->axis[1]]
                        + surface->ng[ray->axis[2]];
    return ray->shear[2] < 0.0f ? ahead < 0.0f : ahead > 0.0f;
}

/// The same of the lanes of `camera` for one triangle.
static inline Mask looked_through_lanes(
    Mask camera,
    uint triangle,
    Vec3 direction,
    __global const Surface *surfaces,
    __global const Material *materials)
{
    __global const Surface *surface = &surfaces[triangle];
    if (!(materials[surface->material].flags & MATERIAL_HIDES_BACK))
        return (Mask)(0);
    return camera & (dot3(vec3_of(surface->ng), direction) > 0.0f);
}

#endif
