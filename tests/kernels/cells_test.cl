// The functions of cells.h, one value a lane.

#include "planes.h"
#include "../../cl/common/cells.h"

/// wo: unit directions; tagged: a packed normal with their parts; keys: what tells cells apart.
kernel void tag_directions(
    global const float *wo, global const uint *random, global uint *tagged, global uint *keys, const uint side)
{
    const Vec3 up = vec3((Float)(0.0f), (Float)(1.0f), (Float)(0.0f));
    const UInt tag = with_direction(pack_unit(up), side, LOAD_V(wo, 0), LOAD_U(random, 0));
    STORE_U(tagged, 0, tag);
    STORE_U(keys, 0, gloss_of(tag));
}

/// alpha: of GGX; metal: 1 or 0; keys: what tells cells apart.
kernel void tag_gloss(global const float *alpha, global const float *metal, global uint *keys)
{
    const Vec3 up = vec3((Float)(0.0f), (Float)(1.0f), (Float)(0.0f));
    STORE_U(keys, 0, gloss_of(with_gloss(pack_unit(up), LOAD(metal, 0) > 0.5f, LOAD(alpha, 0))));
}
