// The functions of sphere.h, one point a lane.

#include "planes.h"
#include "../../cl/common/sphere.h"

/// Directions from the center of a sphere that random numbers draw as seen from points, with their densities; the
/// mesh along them.
kernel void draw_on_spheres(
    global const Light *lights,
    global const float *points,
    global const float *random,
    global float *directions,
    global float *densities,
    global float *distances,
    global float *normals,
    global float *areas)
{
    const Sphere sphere = fetch_sphere(lights, (UInt)(0u));
    const SeenSphere seen = see_sphere(sphere, LOAD_V(points, 0));
    const Vec3 n = draw_around(seen, LOAD(random, 0), LOAD(random, 1));
    Vec3 ng;
    const Float r = face_along(sphere, n, &ng);
    const Float density = density_around(seen, n);
    store_vec3(directions, 0, n);
    STORE(densities, 0, density);
    STORE(distances, 0, r);
    store_vec3(normals, 0, ng);
    STORE(areas, 0, area_along(density, n, r, ng));
}
