// What moves between frames: vertices to where morph targets, joints and nodes put them, and the records
// of their triangles.

#include "common/features.h"
#include "common/layout.h"


static inline float3 load3(__global const float *at)
{
    return vload3(0, at);
}

static inline void store3(float3 v, __global float *at)
{
    vstore3(v, 0, at);
}

/// v at length 1; 0 if it has none.
static inline float3 direction_of(float3 v)
{
    // Dividing by the largest component first keeps the squares of tiny and huge ones finite.
    const float largest = max(fabs(v.x), max(fabs(v.y), fabs(v.z)));
    if (!(largest > 0.0f && largest < INFINITY))
        return (float3)(0.0f);
    v /= largest;
    return v / sqrt(dot(v, v));
}

/// Move a vertex: morph targets first, then the weighted transforms of its joints.  One work item a vertex.
///
/// A vertex that only follows a node has that as its one joint.
///
/// reads   rest, influences, deltas, morph_weights, matrices
/// writes  moved
kernel void move_vertices(
    __global const RestVertex *rest,
    __global const uint *influences,
    const uint influence_count,
    __global const MorphDelta *deltas,
    __global const float *morph_weights,
    __global const float *matrices,
    __global MovedVertex *moved,
    const uint vertex_count)
{
    const uint index = get_global_id(0);
    if (index >= vertex_count)
        return;
    __global const RestVertex *vertex = &rest[index];
    float3 p = load3(vertex->p);
    float3 n = load3(vertex->n);
    float4 tangent = vload4(0, vertex->t);
    for (uint k = 0; k < vertex->delta_count; ++k) {
        __global const MorphDelta *delta = &deltas[vertex->first_delta + k];
        const float weight = morph_weights[delta->weight];
        if (weight == 0.0f)
            continue;
        p += weight * load3(delta->p);
        n += weight * load3(delta->n);
        tangent.xyz += weight * load3(delta->t);
    }

    float4 row0 = (float4)(0.0f);
    float4 row1 = (float4)(0.0f);
    float4 row2 = (float4)(0.0f);
    for (uint k = 0; k < influence_count; ++k) {
        const ulong at = ((ulong)index * influence_count + k) * 2u;
        const float weight = as_float(influences[at + 1u]);
        if (weight == 0.0f)
            continue;
        __global const float *matrix = &matrices[12u * influences[at]];
        row0 += weight * vload4(0, matrix);
        row1 += weight * vload4(1, matrix);
        row2 += weight * vload4(2, matrix);
    }
    const float3 a = row0.xyz;
    const float3 b = row1.xyz;
    const float3 c = row2.xyz;
    // Cofactors turn normals; they are the inverse transposed, with the sign of the determinant.
    const float3 bc = cross(b, c);
    const float side = dot(a, bc) < 0.0f ? -1.0f : 1.0f;
    __global MovedVertex *to = &moved[index];
    store3((float3)(dot(a, p) + row0.w, dot(b, p) + row1.w, dot(c, p) + row2.w), to->p);
    to->side = side;
    store3(side * direction_of((float3)(dot(bc, n), dot(cross(c, a), n), dot(cross(a, b), n))), to->n);
    const float3 along = direction_of((float3)(dot(a, tangent.xyz), dot(b, tangent.xyz), dot(c, tangent.xyz)));
    vstore4((float4)(along, tangent.w * side), 0, to->t);
}

/// Write the records of a triangle that moves, and keep its corners of the frame before.  One work item a
/// triangle, the first of them being triangle `first_triangle` of the scene.
///
/// reads   moved, moving_faces
/// writes  surfaces, normals, tangents, positions, previous
kernel void move_triangles(
    __global const MovedVertex *moved,
    __global const uint *moving_faces,
    __global Surface *surfaces,
#if SMOOTH
    __global Normals *normals,
#endif
#if TANGENTS
    __global Tangents *tangents,
#endif
#if !FEW
    __global float *positions,
#endif
    __global Corners *previous,
    const uint first_triangle,
    const uint moving_count,
    const uint is_first_frame)
{
    const uint index = get_global_id(0);
    if (index >= moving_count)
        return;
    __global const MovedVertex *v0 = &moved[moving_faces[3u * index]];
    __global const MovedVertex *v1 = &moved[moving_faces[3u * index + 1u]];
    __global const MovedVertex *v2 = &moved[moving_faces[3u * index + 2u]];
    const uint triangle = first_triangle + index;
    __global Surface *surface = &surfaces[triangle];
    const float3 p0 = load3(v0->p);
    const float3 p1 = load3(v1->p);
    const float3 p2 = load3(v2->p);
    const float3 e1 = p1 - p0;
    const float3 e2 = p2 - p0;

    const float3 old = is_first_frame ? p0 : load3(surface->p0);
    __global float *before = previous[index].p;
    store3(old, before);
    store3(old + (is_first_frame ? e1 : load3(surface->e1)), before + 3);
    store3(old + (is_first_frame ? e2 : load3(surface->e2)), before + 6);

    const float3 ng = v0->side * direction_of(cross(direction_of(e1), direction_of(e2)));
    const float3 extent = fabs(p0) + fabs(e1) + fabs(e2);
    const float largest = max(extent.x, max(extent.y, extent.z));
    store3(p0, surface->p0);
    store3(e1, surface->e1);
    store3(e2, surface->e2);
    store3(dot(ng, ng) > 0.0f ? ng : (float3)(0.0f, 0.0f, 1.0f), surface->ng);
    surface->offset = largest < INFINITY ? OFFSET_EPSILON * largest : 0.0f;
#if SMOOTH
    store3(load3(v0->n), normals[triangle].n0);
    store3(load3(v1->n), normals[triangle].n1);
    store3(load3(v2->n), normals[triangle].n2);
#endif
#if TANGENTS
    vstore4(vload4(0, v0->t), 0, tangents[triangle].t0);
    vstore4(vload4(0, v1->t), 0, tangents[triangle].t1);
    vstore4(vload4(0, v2->t), 0, tangents[triangle].t2);
#endif
#if !FEW
    __global float *corners = &positions[9ul * triangle];
    store3(p0, corners);
    store3(p1, corners + 3);
    store3(p2, corners + 6);
#endif
}

#if FEW
/// Move the corners of a small scene's list.  One work item a corner.
///
/// reads   moved, corner_vertices
/// writes  corners
kernel void move_corners(
    __global const MovedVertex *moved,
    __global const uint *corner_vertices,
    __global float *corners,
    const uint corner_count)
{
    const uint index = get_global_id(0);
    if (index >= corner_count)
        return;
    const uint vertex = corner_vertices[index];
    if (vertex != NO_VERTEX)
        store3(load3(moved[vertex].p), &corners[3u * index]);
}
#endif
