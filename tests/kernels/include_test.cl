// Includes that meet again, and arguments of every kind.

#include "include_outer.h"
#include "include_inner.h"
#include "include_outer.h"

kernel void fill(global uint *out, const uint count, const float value, const int offset)
{
    const uint i = get_global_id(0);
    if (i < count)
        out[i] = OUTER + INNER + (uint)((int)value + offset);
}
