"""The bounding volume hierarchy, built on the device: Morton codes, binary tree, wide nodes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device.device import Buffer, Device
from psf_cl.device.layout import BVH_NODE, TRIANGLE_BLOCK
from psf_cl.device.primitives import Primitives
from psf_cl.device.program import load_program

#: Triangles that a tree takes at most: kernels search over twice their number with int.
MOST_TRIANGLES = 1 << 29

_CODE_BITS = 63
_GROUP = 64
_STACK_STEP = 32
MIN_STACK_SIZE = 128


@dataclass(frozen=True)
class Bvh:
    """A tree of eight children a node over blocks of up to four triangles; the caller releases it.

    Node 0 is the root, also of no triangles.  The same triangles give the same bits.

    Attributes:
        nodes: ``BvhNode``, ``node_count`` items, level by level.
        blocks: ``TriangleBlock``, ``block_count`` items (one unused item if there are none).
        depth: levels of nodes, at most 95: each level of the binary tree takes a bit of the code
            (63) or, where codes are equal, of the place (32).
        dropped: triangles that are not in the tree because a coordinate is not finite.
    """

    nodes: Buffer
    blocks: Buffer
    node_count: int
    block_count: int
    depth: int
    dropped: int

    @property
    def stack_size(self) -> int:
        """Entries that a traversal can need: each level leaves 7 behind, the last one adds 8.

        Rounded up, so that scenes share compiled kernels.
        """
        return max(-(-(7 * self.depth + 1) // _STACK_STEP) * _STACK_STEP, MIN_STACK_SIZE)


def build_bvh(
    device: Device, positions: Buffer, triangle_count: int, alpha_flags: Buffer | None = None
) -> Bvh:
    """Build the tree over ``triangle_count`` triangles and wait for it.

    Triangles with a coordinate that is not finite are left out and counted.  The build takes about
    60 bytes of scratch a triangle, given back at the end.

    Args:
        positions: float32, nine items a triangle: the corners p0, p1, p2 in world space, m.
        alpha_flags: uint32 a triangle, not 0 if a hit must be looked up in its alpha texture.

    Raises:
        DeviceError: the device has no room.
        ValueError: there are more than ``MOST_TRIANGLES``.

    Source: Karras, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees",
    HPG 2012; wide nodes by opening the child with the largest surface.
    """
    if triangle_count > MOST_TRIANGLES:
        raise ValueError(f"{triangle_count} triangles; a tree takes at most {MOST_TRIANGLES}")
    build = _Build(device, positions, triangle_count, alpha_flags)
    try:
        build.sort_triangles()
        build.find_binary_tree()
        build.fill_blocks()
        build.fit_boxes()
        depth = build.open_levels()
        build.fill_nodes()
        device.wait()
        return Bvh(
            nodes=build.keep("nodes"),
            blocks=build.keep("blocks"),
            node_count=build.scalars["node_count"],
            block_count=build.scalars["block_count"],
            depth=depth,
            dropped=triangle_count - build.scalars["count"],
        )
    finally:
        build.release()


def warm_up_builder(device: Device) -> float:
    """Build a small tree, so that all kernels of the builder are ready; return the seconds."""
    start = time.perf_counter()
    corners = np.arange(9 * 64, dtype=np.float32) % 7.0
    positions = device.upload("positions", corners)
    try:
        tree = build_bvh(device, positions, 64)
        device.release(tree.nodes, tree.blocks)
    finally:
        device.release(positions)
    return time.perf_counter() - start


class _Build:
    """The buffers and numbers of one build, under the names of the kernels' parameters."""

    def __init__(
        self, device: Device, positions: Buffer, triangle_count: int, alpha_flags: Buffer | None
    ) -> None:
        self.device = device
        self.program = load_program(device, "bvh.cl")
        self.primitives = Primitives(device)
        self.given: dict[str, Buffer] = {"positions": positions}
        self.own: dict[str, Buffer] = {}
        self.scalars = {"triangle_count": triangle_count, "has_alpha": int(alpha_flags is not None)}
        if alpha_flags is None:
            self.allocate("alpha_flags", np.uint32, 1)
        else:
            self.given["alpha_flags"] = alpha_flags

    def allocate(self, name: str, dtype: Any, count: int) -> Buffer:
        self.own[name] = self.device.allocate(name, dtype, count)
        return self.own[name]

    def keep(self, name: str) -> Buffer:
        """Hand a buffer over to the caller."""
        return self.own.pop(name)

    def release(self, *names: str) -> None:
        """Give the named buffers back; without names, everything."""
        for name in names or list(self.own):
            self.device.release(self.own.pop(name))
        if not names:
            self.primitives.release()

    def run(self, kernel: str, items: int, *names: str) -> None:
        """Enqueue a kernel over ``items`` work items with the named arguments."""
        values: dict[str, Any] = self.given | self.own | self.scalars
        arguments = {name: values[name] for name in names}
        self.program.bind(kernel, **arguments)(items, group=_GROUP)

    def count_set(self, flags: str, indices: str, count: int) -> int:
        """Write the indices of the set flags, and to ``ranks`` how many lie before each."""
        total = self.primitives.compact(
            self.own[flags], self.own["ranks"], self.own[indices], count
        )
        return int(self.device.read(total)[0])

    def sort_triangles(self) -> None:
        """Leave in ``codes`` and ``triangles`` what is finite, sorted along the Morton curve."""
        triangle_count = self.scalars["triangle_count"]
        centers = self.allocate("centers", np.float32, 3 * triangle_count)
        self.allocate("kept", np.uint32, triangle_count)
        self.allocate("ranks", np.uint32, triangle_count)
        self.allocate("triangles", np.uint32, triangle_count)
        self.run(
            "prepare_triangles", triangle_count, "positions", "centers", "kept", "triangle_count"
        )
        count = self.scalars["count"] = self.count_set("kept", "triangles", triangle_count)
        self.release("kept")

        self.given["bounds"] = self.primitives.bounds(centers, triangle_count)
        self.allocate("codes", np.uint64, count)
        self.run("make_codes", count, "centers", "triangles", "bounds", "codes", "count")
        self.release("centers")
        self.allocate("spare_codes", np.uint64, count)
        self.allocate("spare_triangles", np.uint32, count)
        names = ("codes", "triangles", "spare_codes", "spare_triangles")
        codes, _ = self.primitives.sort(*(self.own[name] for name in names), count, _CODE_BITS)
        if codes is self.own["spare_codes"]:
            for name in names[:2]:
                spare = f"spare_{name}"
                self.own[name], self.own[spare] = self.own[spare], self.own[name]
        self.release("spare_codes", "spare_triangles")

    def find_binary_tree(self) -> None:
        """Leave the inner nodes in ``ends``, ``splits`` and ``parents``, and where blocks start."""
        count = self.scalars["count"]
        for name in ("ends", "splits", "parents", "starts_block", "block_parents"):
            self.allocate(name, np.uint32, count)
        tree = ("codes", "ends", "splits", "parents", "starts_block", "block_parents", "count")
        if count > 0:
            self.run("find_nodes", max(count - 1, 1), *tree)
        self.release("codes")
        self.allocate("starts", np.uint32, count)
        self.scalars["block_count"] = self.count_set("starts_block", "starts", count)
        self.release("starts_block")

    def fill_blocks(self) -> None:
        block_count = self.scalars["block_count"]
        self.allocate("blocks", TRIANGLE_BLOCK.dtype, block_count)
        self.run(
            "fill_blocks",
            block_count,
            "positions",
            "triangles",
            "starts",
            "alpha_flags",
            "blocks",
            "has_alpha",
            "block_count",
            "count",
        )
        self.release("triangles")

    def fit_boxes(self) -> None:
        self.allocate("visits", np.uint32, self.scalars["count"])
        self.allocate("boxes", np.float32, 6 * self.scalars["count"])
        self.run(
            "fit_boxes",
            self.scalars["block_count"],
            "blocks",
            "starts",
            "ranks",
            "ends",
            "splits",
            "parents",
            "block_parents",
            "visits",
            "boxes",
            "block_count",
        )
        self.release("visits", "parents", "block_parents", "starts")

    def open_levels(self) -> int:
        """Find the wide nodes level by level; return how many levels there are."""
        for name in ("wide", "first_children", "inner_counts"):
            self.allocate(name, np.uint32, self.scalars["block_count"])
        # Node 0 of the binary tree, which a tree of one triangle does not have.
        root = 0x80000000 if self.scalars["count"] == 1 else 0
        self.device.write(self.own["wide"], np.array([root], np.uint32))
        # Scanned in place.
        self.own["offsets"] = self.own["inner_counts"]
        depth, level_start, level_count = 0, 0, 1
        tree = ("ends", "splits", "boxes", "wide", "level_start", "level_count", "count")
        while level_count > 0:
            self.scalars |= {"level_start": level_start, "level_count": level_count}
            self.run("count_children", level_count, *tree, "inner_counts")
            counts = self.own["inner_counts"]
            total = self.primitives.scan(counts, counts, level_count)
            self.run("place_children", level_count, *tree, "offsets", "first_children")
            depth += 1
            level_start += level_count
            level_count = int(self.device.read(total)[0])
        del self.own["offsets"]
        self.scalars["node_count"] = level_start
        return depth

    def fill_nodes(self) -> None:
        node_count = self.scalars["node_count"]
        self.allocate("nodes", BVH_NODE.dtype, node_count)
        self.run(
            "fill_nodes",
            node_count,
            "ends",
            "splits",
            "boxes",
            "wide",
            "first_children",
            "ranks",
            "blocks",
            "nodes",
            "node_count",
            "count",
        )
