// Arrays of test values: planes side by side, the W values of a work item next to each other.
// Launches have exactly as many work items as there is room for, so kernels check no bounds.
#pragma once

#include "../../cl/common/lanes.h"

#define PLANE(type, array, k) ((global type *)(array))[(k) * get_global_size(0) + get_global_id(0)]
#define LOAD(array, k) PLANE(const Float, array, k)
#define LOAD_U(array, k) PLANE(const UInt, array, k)
#define LOAD_V(array, k) vec3(LOAD(array, k), LOAD(array, (k) + 1), LOAD(array, (k) + 2))
#define STORE(array, k, value) (PLANE(Float, array, k) = (value))
#define STORE_U(array, k, value) (PLANE(UInt, array, k) = (value))

static inline void store_vec3(global float *array, uint k, Vec3 v)
{
    STORE(array, k, v.x);
    STORE(array, k + 1, v.y);
    STORE(array, k + 2, v.z);
}
