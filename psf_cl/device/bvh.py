"""The bounding volume hierarchy, built on the device: binary tree by clustering, wide nodes."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device.device import Buffer, Device
from psf_cl.device.layout import BINARY_NODE, BVH_NODE, CONSTANT, TRIANGLE_BLOCK
from psf_cl.device.primitives import Primitives
from psf_cl.device.program import Launch, Program, load_program

#: Triangles that a tree takes at most: the binary tree has twice as many nodes, LEAF_BIT apart.
MOST_TRIANGLES = 1 << 29

#: Children that a BvhNode has room for.
NODE_LANES = 8

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
    "offsets",
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
    """A tree of wide nodes over blocks of up to four triangles; the caller releases it.

    Node 0 is the root, also of no triangles.  The same triangles give the same bits.

    Attributes:
        nodes: ``BvhNode``, ``node_count`` items, depth first: the children of a node side by side.
            Of a node's children inner ones come first, and among either kind larger ones last.
        blocks: ``TriangleBlock``, ``block_count`` items in the same order (one unused item if there
            are none).
        depth: levels of nodes, at most as many as there were rounds of clustering.
        dropped: triangles that are not in the tree because a coordinate is not finite.
        width: children that a node has at most.
    """

    nodes: Buffer
    blocks: Buffer
    node_count: int
    block_count: int
    depth: int
    dropped: int
    width: int

    @property
    def stack_size(self) -> int:
        """Entries that a traversal can need: each level leaves width - 1, the last one adds width.

        Rounded up, so that scenes share compiled kernels.
        """
        needed = (self.width - 1) * self.depth + 1
        return max(-(-needed // _STACK_STEP) * _STACK_STEP, MIN_STACK_SIZE)


def build_bvh(
    device: Device,
    positions: Buffer,
    triangle_count: int,
    alpha_flags: Buffer | None = None,
    width: int = NODE_LANES,
) -> Bvh:
    """Build the tree over ``triangle_count`` triangles and wait for it.

    Triangles with a coordinate that is not finite are left out and counted.  The build takes about
    230 bytes of scratch a triangle, given back at the end.

    Args:
        positions: float32, nine items a triangle: the corners p0, p1, p2 in world space, m.
        alpha_flags: uint32 a triangle, not 0 if a hit must be looked up in its alpha texture.
        width: children that a node gets at most: 2, 4 or 8.

    Raises:
        DeviceError: the device has no room.
        ValueError: there are more than ``MOST_TRIANGLES``.

    Sources: Meister, Bittner, "Parallel Locally-Ordered Clustering for Bounding Volume Hierarchy
    Construction", TVCG 24 (3), 2018; Ylitie, Karras, Laine, "Efficient Incoherent Ray Traversal on
    GPUs Through Compressed Wide BVHs", HPG 2017, for the wide nodes.
    """
    if triangle_count > MOST_TRIANGLES:
        raise ValueError(f"{triangle_count} triangles; a tree takes at most {MOST_TRIANGLES}")
    build = TreeBuild(device, positions, triangle_count, alpha_flags, width)
    try:
        build.sort_triangles()
        build.join_clusters()
        return build.finish()
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


def visit_cost(nodes: np.ndarray) -> float:
    """Return how many nodes and blocks a ray that meets the scene's box visits by its surfaces.

    Args:
        nodes: ``BvhNode``, all of a tree, root first.
    """
    bounds = nodes["bounds"].astype(np.float64)
    used = bounds[:, 0] <= bounds[:, 1]
    size = np.where(used[:, None], bounds[:, 1::2] - bounds[:, ::2], 0.0)
    area = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
    whole = bounds[0, 1::2].max(axis=1) - bounds[0, ::2].min(axis=1)
    root = whole[0] * whole[1] + whole[1] * whole[2] + whole[2] * whole[0]
    return 1.0 + float(area.sum() / root) if used.any() and root > 0.0 else 1.0


class Refit:
    """Fits a tree to triangles that have moved: other boxes, the same nodes and blocks.

    Triangles that were dropped from the tree stay out of it; one that is not finite now is not hit
    until it is finite again.

    Args:
        first_moving: the first triangle that may move; nodes over none that does are left alone.
    """

    def __init__(self, device: Device, bvh: Bvh, first_moving: int = 0) -> None:
        self.device = device
        self.bvh = bvh
        nodes = device.read(bvh.nodes, bvh.node_count)
        levels = [np.zeros(1, np.uint32)]
        while len(levels[-1]):
            children = nodes["child"][levels[-1]].reshape(-1)
            levels.append(children[(children != 0) & (children < CONSTANT["LEAF_BIT"])])
        levels.pop()
        if first_moving > 0:
            levels = self._moving_levels(nodes["child"], levels, first_moving)
        self.places = device.upload("places", np.concatenate(levels or [np.zeros(1, np.uint32)]))
        self.areas = device.allocate("areas", np.float32, bvh.node_count)
        self.levels = _level_ranges([len(level) for level in levels])
        self.program = _load(device, bvh.width)
        self.built_cost = self._cost()

    def _moving_levels(
        self, children: np.ndarray, levels: list[np.ndarray], first_moving: int
    ) -> list[np.ndarray]:
        """Return the nodes of each level below which there is a triangle from ``first_moving``."""
        ids = self.device.read(self.bvh.blocks, self.bvh.block_count)["id"]
        used = ids != CONSTANT["NO_HIT"]
        moves = ids & ~np.uint32(CONSTANT["ALPHA_BIT"]) >= first_moving
        moving_blocks = (used & moves).any(axis=1)
        if not moving_blocks.any():
            return []
        leaf = np.uint32(CONSTANT["LEAF_BIT"])
        moving = np.zeros(len(children), bool)
        for level in reversed(levels):
            below = children[level]
            is_leaf = below >= leaf
            blocks = moving_blocks[np.where(is_leaf, below & ~leaf, 0)]
            inner = moving[np.where(is_leaf, 0, below)] & (below != 0)
            moving[level] = np.where(is_leaf, blocks, inner).any(axis=1)
        return [level[moving[level]] for level in levels]

    def release(self) -> None:
        """Give back what is the refit's own; the tree stays."""
        self.device.release(self.places, self.areas)

    def fit(self, positions: Buffer) -> None:
        """Enqueue fitting the tree to ``positions``, of the same triangles as it was built from."""
        _fit(self.program, self.bvh, self.places, self.levels, positions)

    def cost_ratio(self) -> float:
        """Return by how much the moves have made a ray dearer, by surfaces: 1 when it was built."""
        return self._cost() / self.built_cost

    def _cost(self) -> float:
        """Return ``visit_cost`` of the tree as it is now."""
        count = self.bvh.node_count
        launch = self.program.bind(
            "measure_nodes", nodes=self.bvh.nodes, areas=self.areas, node_count=count
        )
        launch(count, group=_GROUP)
        root = self.device.read(self.bvh.nodes, 1)
        low, high = root["bounds"][0, ::2].min(axis=1), root["bounds"][0, 1::2].max(axis=1)
        x, y, z = np.maximum(high.astype(np.float64) - low, 0.0)
        whole = x * y + y * z + z * x
        total = float(self.device.read(self.areas, count).sum(dtype=np.float64))
        return 1.0 + total / whole if 0.0 < whole < np.inf else 1.0


def _load(device: Device, width: int) -> Program:
    return load_program(device, "bvh.cl", {"WIDTH": width})


def _level_ranges(sizes: list[int]) -> list[tuple[int, int]]:
    """Return the first node and the number of nodes of each level."""
    return [(sum(sizes[:level]), size) for level, size in enumerate(sizes)]


def _fit(
    program: Program,
    bvh: Bvh,
    places: Buffer,
    levels: list[tuple[int, int]],
    positions: Buffer,
) -> None:
    """Enqueue writing all corners and bounds.

    Args:
        places: uint32, the nodes level by level.
        levels: where in ``places`` each level starts, and how many nodes it has.
    """
    count = sum(size for _, size in levels)
    if not count:
        return
    program.bind(
        "fit_blocks",
        positions=positions,
        places=places,
        nodes=bvh.nodes,
        blocks=bvh.blocks,
        node_count=count,
    )(count, group=_GROUP)
    launch = program.bind("fit_nodes", places=places, nodes=bvh.nodes, level_start=0, level_count=0)
    # The last level has no inner children.
    for start, count in reversed(levels[:-1]):
        launch.set(level_start=start, level_count=count)(count, group=_GROUP)


class TreeBuild:
    """The buffers and numbers of one build, under the names of the kernels' parameters.

    Its steps in order; instead of ``join_clusters`` something else may fill ``own["tree"]``.
    """

    def __init__(
        self,
        device: Device,
        positions: Buffer,
        triangle_count: int,
        alpha_flags: Buffer | None = None,
        width: int = NODE_LANES,
    ) -> None:
        self.device = device
        self.width = width
        self.program = _load(device, width)
        self.primitives = Primitives(device)
        self.launches: dict[str, Launch] = {}
        self.positions = positions
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

    def swap(self, *names: str) -> None:
        """Exchange buffers with the ones that hold their next state."""
        for name in names:
            spare = f"next_{name}"
            self.own[name], self.own[spare] = self.own[spare], self.own[name]

    def sort_triangles(self) -> None:
        """Leave in ``triangles`` what is finite, sorted along the Morton curve."""
        triangle_count = self.scalars["triangle_count"]
        boxes = self.allocate("triangle_boxes", np.float32, 6 * triangle_count)
        for name in ("kept", "ranks", "triangles"):
            self.allocate(name, np.uint32, triangle_count)
        self.run("prepare_triangles", triangle_count)
        total = self.primitives.compact(
            *(self.own[name] for name in ("kept", "ranks", "triangles")), triangle_count
        )
        count = self.scalars["count"] = int(self.device.read(total)[0])
        self.release("kept", "ranks")

        bounds = self.device.read(self.primitives.bounds(boxes, 2 * triangle_count))
        self.own["frame"] = self.device.upload("frame", _frame(bounds))
        for name in ("codes", "next_codes"):
            self.allocate(name, np.uint64, count)
        self.allocate("next_triangles", np.uint32, count)
        self.run("make_codes", count)
        names = ("codes", "triangles", "next_codes", "next_triangles")
        _, order = self.primitives.sort(*(self.own[name] for name in names), count, _CODE_BITS)
        if order is self.own["next_triangles"]:
            self.swap("triangles")
        self.release("codes", "next_codes", "next_triangles")

    def join_clusters(self) -> None:
        """Leave the binary tree in ``tree``, its root last."""
        count = self.scalars["count"]
        stride = self.scalars["stride"] = count + _MARGIN
        self.allocate("tree", BINARY_NODE.dtype, 2 * count)
        for name in ("clusters", "next_clusters", "nearest", "places"):
            self.allocate(name, np.uint32, count)
        for name in ("boxes", "next_boxes"):
            self.allocate(name, np.float32, 6 * stride)
        self.run("make_leaves", count)
        node_start, span = count, _NO_SPAN
        while count > 1:
            self.scalars |= {"cluster_count": count, "node_start": node_start, "span": span}
            self.run("find_nearest", count)
            self.run("mark_staying", count)
            places = self.own["places"]
            left = int(self.device.read(self.primitives.scan(places, places, count))[0])
            self.run("join_pairs", count)
            self.swap("clusters", "boxes")
            joined = count - left
            node_start += joined
            span = _SHORT_SPAN if joined * _FEW < count else _NO_SPAN
            count = left
        self.release("clusters", "next_clusters", "boxes", "next_boxes", "nearest", "places")

    def finish(self) -> Bvh:
        """Make the wide nodes of ``tree`` and wait for them; the caller releases the result."""
        self.release("triangle_boxes", "triangles", "frame")
        levels = self._open_levels()
        self._lay_out(levels)
        node_count = self.scalars["node_count"] = max(sum(size for _, size in levels), 1)
        block_count = int(self.device.read(self.own["blocks_below"], 1)[0])
        self.allocate("nodes", BVH_NODE.dtype, node_count)
        self.allocate("blocks", TRIANGLE_BLOCK.dtype, block_count)
        self.run("link_nodes", node_count)
        bvh = Bvh(
            nodes=self.own["nodes"],
            blocks=self.own["blocks"],
            node_count=node_count,
            block_count=block_count,
            depth=max(len(levels), 1),
            dropped=self.scalars["triangle_count"] - self.scalars["count"],
            width=self.width,
        )
        # There is a root also of no triangles.
        _fit(
            self.program,
            bvh,
            self.own["places"],
            levels or [(0, 1)],
            self.positions,
        )
        self.device.wait()
        del self.own["nodes"], self.own["blocks"]
        return bvh

    def _open_levels(self) -> list[tuple[int, int]]:
        """Find the wide nodes level by level; return where each level starts and its size."""
        count = self.scalars["count"]
        for name in _NODE_NUMBERS:
            self.allocate(name, np.uint32, count)
        self.allocate("children", np.uint32, self.width * count)
        self.device.write(self.own["wide"], np.array([max(2 * count - 2, 0)], np.uint32))
        levels = [(0, min(count, 1))]
        while levels[-1][1]:
            self._run_level("open_nodes", levels[-1])
            offsets = self.own["offsets"]
            total = self.primitives.scan(offsets, offsets, levels[-1][1])
            self._run_level("list_children", levels[-1])
            levels.append((sum(levels[-1]), int(self.device.read(total)[0])))
        return levels[:-1]

    def _lay_out(self, levels: list[tuple[int, int]]) -> None:
        """Find where in memory each wide node and its blocks go."""
        for level in reversed(levels):
            self._run_level("count_below", level)
        for level in levels:
            self._run_level("place_children", level)

    def _run_level(self, kernel: str, level: tuple[int, int]) -> None:
        self.scalars |= {"level_start": level[0], "level_count": level[1]}
        self.run(kernel, level[1])


def _frame(bounds: np.ndarray) -> np.ndarray:
    """Return low x, y, z and 2 / the largest extent, float32, of finite bounds or of nothing's."""
    low, high = bounds.reshape(2, 3).astype(np.float64)
    if not (low <= high).all():
        return np.array([0, 0, 0, 1], np.float32)
    limits = np.finfo(np.float32)
    scale = 2.0 / max((high - low).max(), float(limits.tiny))
    return np.append(low, np.clip(scale, limits.tiny, limits.max)).astype(np.float32)
