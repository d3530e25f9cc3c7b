"""Trees of two levels: one over the placings of meshes, and one for each mesh, in one buffer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psf_cl.device.bvh import Bvh, build_bvh
from psf_cl.device.device import Device
from psf_cl.device.layout import BVH_NODE, CONSTANT, TRIANGLE_BLOCK


def build_two_levels(
    device: Device,
    parts: Sequence[np.ndarray],
    boxes: np.ndarray,
    names: np.ndarray,
    cut_out: Sequence[np.ndarray] | None = None,
) -> tuple[Bvh, np.ndarray]:
    """Build all trees and wait for them.

    Args:
        parts: ``(n, 9)`` float32 each, the triangles of a mesh.  Ids of blocks are counted through
            all parts.
        boxes: ``(m, 6)`` float32 around the placings, low and high corner; world, m.
        names: ``(m,)`` uint32, what the upper tree's leaves call them.
        cut_out: ``(n,)`` bool each, whose alpha must be looked up.

    Returns:
        The trees as one, the upper one at node 0; its ``depth`` is that of the deepest.  And the
        root of each part, ``(len(parts),)`` uint32.  The caller releases the tree.

    Raises:
        DeviceError: the device has no room.
    """
    # The builder sees a box as a triangle between its corners.
    as_triangles = np.concatenate([boxes, boxes[:, :3]], axis=1)
    trees = [_tree(device, as_triangles, None)]
    _name_leaves(trees[0][1], names)
    start = 0
    for number, positions in enumerate(parts):
        tree = _tree(device, positions, None if cut_out is None else cut_out[number])
        _name_leaves(tree[1], np.arange(start, start + len(positions), dtype=np.uint32))
        trees.append(tree)
        start += len(positions)
    roots = np.cumsum([0, *(len(nodes) for nodes, _, _ in trees)])
    first_blocks = np.cumsum([0, *(len(blocks) for _, blocks, _ in trees)])
    for (nodes, _, _), root, first in zip(trees, roots, first_blocks, strict=False):
        _move(nodes, int(root), int(first))
    nodes = np.concatenate([nodes for nodes, _, _ in trees])
    blocks = np.concatenate([blocks for _, blocks, _ in trees])
    whole = Bvh(
        nodes=device.upload("nodes", nodes),
        blocks=device.upload("blocks", blocks),
        node_count=len(nodes),
        block_count=len(blocks),
        depth=max(tree.depth for _, _, tree in trees),
        dropped=sum(tree.dropped for _, _, tree in trees[1:]),
        width=trees[0][2].width,
    )
    return whole, roots[1:-1].astype(np.uint32)


def _tree(
    device: Device, positions: np.ndarray, cut_out: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, Bvh]:
    """Return nodes and blocks of one tree on the host, and the numbers of the tree."""
    inputs = [device.upload("positions", np.ascontiguousarray(positions).reshape(-1))]
    try:
        if cut_out is not None:
            inputs.append(device.upload("alpha_flags", cut_out.astype(np.uint32)))
        tree = build_bvh(device, inputs[0], len(positions), *inputs[1:])
        try:
            nodes = device.read(tree.nodes, tree.node_count).view(BVH_NODE.dtype)
            blocks = device.read(tree.blocks, tree.block_count).view(TRIANGLE_BLOCK.dtype)
            return nodes, blocks, tree
        finally:
            device.release(tree.nodes, tree.blocks)
    finally:
        device.release(*inputs)


def _name_leaves(blocks: np.ndarray, names: np.ndarray) -> None:
    """Replace the ids in ``blocks`` by their ``names``; what is unused stays so."""
    ids = blocks["id"]
    used = ids != CONSTANT["NO_HIT"]
    alpha = np.uint32(CONSTANT["ALPHA_BIT"])
    ids[used] = names[ids[used] & ~alpha] | (ids[used] & alpha)


def _move(nodes: np.ndarray, root: int, first_block: int) -> None:
    """Let the children of ``nodes`` be where the trees before take up the room."""
    child = nodes["child"]
    leaf = child >= CONSTANT["LEAF_BIT"]
    inner = (child > 0) & ~leaf
    child[leaf] += np.uint32(first_block)
    child[inner] += np.uint32(root)
