"""Animate: what moves is put where it is in a frame, before its first pass."""

from __future__ import annotations

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if no triangle moves."""
    moving = context.moving
    if not context.on("MOTION") or moving is None:
        return None
    float32, uint32 = np.dtype(np.float32), np.dtype(np.uint32)
    buffers = [
        BufferSpec("rest", layout.REST_VERTEX.dtype, moving.vertices, "vertices at rest"),
        BufferSpec("influences", uint32, 2 * moving.influences, "joints of vertices, and weights"),
        BufferSpec("deltas", layout.MORPH_DELTA.dtype, moving.deltas, "morph targets"),
        BufferSpec("morph_weights", float32, moving.weights, "of this frame"),
        BufferSpec("matrices", float32, 12 * moving.matrices, "of nodes and joints, this frame"),
        BufferSpec("moved", layout.MOVED_VERTEX.dtype, moving.vertices, "vertices in this frame"),
        BufferSpec("moving_faces", uint32, 3 * moving.triangles, "triangles between them"),
        BufferSpec(
            "previous", layout.CORNERS.dtype, moving.triangles, "their corners in the frame before"
        ),
    ]
    kernels = [
        KernelSpec("move_vertices", lanes=False),
        KernelSpec("move_triangles", lanes=False),
    ]
    if context.on("FEW"):
        kernels.append(KernelSpec("move_corners", lanes=False))
        what = "vertices of the corners that move"
        buffers.append(BufferSpec("corner_vertices", uint32, context.corner_count, what))
    else:
        what = "corners of all triangles, to fit the tree to"
        buffers.append(BufferSpec("positions", float32, 9 * context.triangle_count, what))
    return StageSpec(
        "animate",
        "what moves is put where it is, frame by frame",
        "animate.cl",
        flags=("FEW", "SMOOTH", "TANGENTS"),
        kernels=tuple(kernels),
        buffers=tuple(buffers),
        per_frame=True,
    )
