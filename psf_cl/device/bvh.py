"""The bounding volume hierarchy, built on the device: binary tree by clustering, wide nodes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device.device import Buffer, Device
from psf_cl.device.layout import BINARY_NODE, BVH_NODE, TRIANGLE_BLOCK
from psf_cl.device.primitives import Primitives
from psf_cl.device.program import Launch, load_program

#: Triangles that a tree takes at most: the binary tree has twice as many nodes, LEAF_BIT apart.
MOST_TRIANGLES = 1 << 29

#: Children of a node.
WIDTH = 8

MIN_STACK_SIZE = 128
_STACK_STEP = 32

_CODE_BITS = 63
_GROUP = 64

# Room around the clusters' boxes for what looks beyond them: RADIUS in the kernels, and a vector.
_MARGIN = 64

# Boxes that grow slowly along the curve all prefer the one before, so that a round joins only few.
# After a round that joined fewer than one of 16 the next one looks no further than runs of 8, each
# of which has a least pair: rounds are at most 2 log(count) / log(8 / 7).
_FEW = 16
_SHORT_SPAN = 8
_NO_SPAN = 1 << 31

_NODE_NUMBERS = (
    "wide",
    "firsts",
    "inner_counts",
    "block_counts",
    "nodes_below",
    "blocks_below",
    "places",
    "node_starts",
    "block_starts",
)


@dataclass(frozen=True)
class Bvh:
    """A tree of eight children a node over blocks of up to four triangles; the caller releases it.

    Node 0 is the root, also of no triangles.  The same triangles give the same bits.

    Attributes:
        nodes: ``BvhNode``, ``node_count`` items, depth first: the children of a node side by side.
        blocks: ``TriangleBlock``, ``block_count`` items in the same order (one unused item if there
            are none).
        depth: levels of nodes; no more than rounds of clustering, see ``_SHORT_SPAN``.
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
    230 bytes of scratch a triangle, given back at the end.

    Args:
        positions: float32, nine items a triangle: the corners p0, p1, p2 in world space, m.
        alpha_flags: uint32 a triangle, not 0 if a hit must be looked up in its alpha texture.

    Raises:
        DeviceError: the device has no room.
        ValueError: there are more than ``MOST_TRIANGLES``.

    Sources: Meister, Bittner, "Parallel Locally-Ordered Clustering for Bounding Volume Hierarchy
    Construction", TVCG 24 (3), 2018; Ylitie, Karras, Laine, "Efficient Incoherent Ray Traversal on
    GPUs Through Compressed Wide BVHs", HPG 2017, for the wide nodes.
    """
    if triangle_count > MOST_TRIANGLES:
        raise ValueError(f"{triangle_count} triangles; a tree takes at most {MOST_TRIANGLES}")
    build = _Build(device, positions, triangle_count, alpha_flags)
    try:
        build.make_references()
        build.sort_references()
        build.join_clusters()
        build.open_nodes()
        build.fill_nodes()
        device.wait()
        return Bvh(
            nodes=build.keep("nodes"),
            blocks=build.keep("blocks"),
            node_count=build.scalars["node_count"],
            block_count=build.scalars["block_count"],
            depth=max(len(build.levels), 1),
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
        self.launches: dict[str, Launch] = {}
        self.levels: list[tuple[int, int]] = []
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

    def run(self, kernel: str, items: int) -> None:
        """Enqueue a kernel over ``items`` work items; its parameters name what it gets."""
        values: dict[str, Any] = self.given | self.own | self.scalars
        launch = self.launches.get(kernel)
        if launch is None:
            launch = self.launches[kernel] = self.program.bind_planned(kernel, values)
        else:
            held = launch.held
            launch.set(**{name: values[name] for name in held if values[name] is not held[name]})
        launch(items, group=_GROUP)

    def count_set(self, flags: str, indices: str, count: int) -> int:
        """Write the indices of the set flags; return how many there are."""
        scratch = self.allocate("ranks", np.uint32, count)
        total = self.primitives.compact(self.own[flags], scratch, self.own[indices], count)
        found = int(self.device.read(total)[0])
        self.release("ranks")
        return found

    def make_references(self) -> None:
        """Leave the boxes of what is finite in ``references``, and their ``triangles``."""
        triangle_count = self.scalars["triangle_count"]
        self.allocate("pieces", np.uint32, triangle_count)
        self.run("count_references", triangle_count)
        self.allocate("triangles", np.uint32, triangle_count)
        count = self.scalars["count"] = self.count_set("pieces", "triangles", triangle_count)
        self.release("pieces")
        references = self.allocate("references", np.float32, 6 * count)
        self.run("box_references", count)
        bounds = self.device.read(self.primitives.bounds(references, 2 * count)).astype(np.float64)
        extent = (bounds[3:] - bounds[:3]).max() if count else 1.0
        limits = np.finfo(np.float32)
        scale = np.clip(2.0 / max(extent, limits.tiny), limits.tiny, limits.max)
        frame = np.append(bounds[:3], scale).astype(np.float32)
        self.own["frame"] = self.device.upload("frame", frame)

    def sort_references(self) -> None:
        """Leave in ``order`` the references along the Morton curve."""
        count = self.scalars["count"]
        for name in ("codes", "spare_codes"):
            self.allocate(name, np.uint64, count)
        for name in ("order", "spare_order"):
            self.allocate(name, np.uint32, count)
        self.run("make_codes", count)
        names = ("codes", "order", "spare_codes", "spare_order")
        _, order = self.primitives.sort(*(self.own[name] for name in names), count, _CODE_BITS)
        if order is self.own["spare_order"]:
            self.own["order"], self.own["spare_order"] = order, self.own["order"]
        self.release("codes", "spare_codes", "spare_order")

    def join_clusters(self) -> None:
        """Leave the binary tree in ``tree``, its root last."""
        count = self.scalars["count"]
        self.allocate("tree", BINARY_NODE.dtype, 2 * count)
        for name in ("clusters", "next_clusters", "nearest", "stays"):
            self.allocate(name, np.uint32, count)
        stride = self.scalars["stride"] = count + _MARGIN
        for name in ("boxes", "next_boxes"):
            self.allocate(name, np.float32, 6 * stride)
        self.run("make_leaves", count)
        self.release("order", "frame")
        # Scanned in place.
        self.own["places"] = self.own["stays"]
        node_start, span = count, _NO_SPAN
        while count > 1:
            self.scalars |= {
                "cluster_count": count,
                "node_start": node_start,
                "span": span,
            }
            self.run("find_nearest", count)
            self.run("mark_staying", count)
            stays = self.own["stays"]
            left = int(self.device.read(self.primitives.scan(stays, stays, count))[0])
            self.run("join_pairs", count)
            own = self.own
            for name in ("clusters", "boxes"):
                own[name], own[f"next_{name}"] = own[f"next_{name}"], own[name]
            node_start += count - left
            span = _SHORT_SPAN if (count - left) * _FEW < count else _NO_SPAN
            count = left
        del self.own["places"]
        self.release("clusters", "next_clusters", "boxes", "next_boxes", "nearest", "stays")

    def open_nodes(self) -> None:
        """Find the wide nodes level by level, and where they lie in memory."""
        count = self.scalars["count"]
        for name in _NODE_NUMBERS:
            self.allocate(name, np.uint32, count)
        self.allocate("children", np.uint32, WIDTH * count)
        self.allocate("offsets", np.uint32, count)
        self.device.write(self.own["wide"], np.array([max(2 * count - 2, 0)], np.uint32))
        level_start, level_count = 0, 1 if count else 0
        while level_count > 0:
            self.levels.append((level_start, level_count))
            self.run_level("open_nodes", -1)
            offsets = self.own["offsets"]
            total = self.primitives.scan(offsets, offsets, level_count)
            self.run_level("list_children", -1)
            level_start += level_count
            level_count = int(self.device.read(total)[0])
        for level in reversed(range(len(self.levels))):
            self.run_level("count_below", level)
        for level in range(len(self.levels)):
            self.run_level("place_children", level)
        self.scalars["node_count"] = max(level_start, 1)
        self.scalars["block_count"] = int(self.device.read(self.own["blocks_below"], 1)[0])
        self.release("wide", "firsts", "offsets", "nodes_below", "blocks_below")

    def fill_nodes(self) -> None:
        node_count = self.scalars["node_count"]
        self.allocate("nodes", BVH_NODE.dtype, node_count)
        self.allocate("blocks", TRIANGLE_BLOCK.dtype, self.scalars["block_count"])
        self.run("fill_nodes", node_count)
        for level in reversed(range(len(self.levels) - 1)):
            self.run_level("fit_nodes", level)

    def run_level(self, kernel: str, level: int) -> None:
        start, count = self.levels[level]
        self.scalars |= {"level_start": start, "level_count": count}
        self.run(kernel, count)
