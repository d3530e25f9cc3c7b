"""Compare trees built on the device with one built on the host: ``tree_quality.py SCENE...``.

The host's tree is binned SAH, top down, made wide in the same way.  For each tree: nodes, blocks,
children of a node, the cost by surfaces, seconds to build; and for rays of real paths the nodes and
blocks that a ray visits, how fast the rays are (median of interleaved rounds), and how much faster
than through the host's tree (median of the rounds' ratios).
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import psf_cl
from psf_cl import tables
from psf_cl.cli.common import positive_integer
from psf_cl.device.bvh import Bvh, TreeBuild, build_bvh, visit_cost
from psf_cl.device.device import Device, open_device
from psf_cl.device.layout import BINARY_NODE, CONSTANT
from psf_cl.device.program import load_program
from psf_cl.scene.model import Scene

BINS = 32
LEAF_BIT = CONSTANT["LEAF_BIT"]
NO_HIT = CONSTANT["NO_HIT"]
WIDTH = 8
BLOCK_TRIANGLES = 4


@dataclass(frozen=True)
class Rays:
    """Rays, ``(n, 7)`` float32: origin, direction, t_max; and whether any hit will do."""

    name: str
    rays: np.ndarray
    any_hit: bool


def half_area(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return half the surface of boxes, ``(...)`` from ``(..., 3)``; 0 for inverted ones."""
    x, y, z = np.moveaxis(np.maximum(high - low, 0.0), -1, 0)
    return x * y + y * z + z * x


def split_level(
    low: np.ndarray, high: np.ndarray, segment: np.ndarray, starts: np.ndarray
) -> np.ndarray:
    """Return which boxes go to the right of the best plane of their segment, ``(n,)`` bool.

    Args:
        low, high: ``(n, 3)``, one segment after the other.
        segment: ``(n,)``, number of each box's segment.
        starts: ``(m,)``, first box of each segment.

    Source: Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies", RT 2007.
    """
    count = len(starts)
    centers = 0.5 * (low + high)
    first = np.minimum.reduceat(centers, starts)
    extent = np.maximum.reduceat(centers, starts) - first
    sizes = np.diff(np.append(starts, len(low)))
    least = np.full(count, np.inf)
    # Where all centres are one point: halves.
    right = np.arange(len(low)) - starts[segment] >= sizes[segment] // 2
    for axis in range(3):
        with np.errstate(all="ignore"):
            part = (centers[:, axis] - first[segment, axis]) / extent[segment, axis]
        bins = np.clip(np.nan_to_num(part) * BINS, 0, BINS - 1).astype(int)
        keys = segment * BINS + bins
        order = np.argsort(keys, kind="stable")
        runs = np.flatnonzero(np.diff(keys[order], prepend=-1))
        bin_low = np.full((count * BINS, 3), np.inf)
        bin_high = np.full((count * BINS, 3), -np.inf)
        bin_low[keys[order][runs]] = np.minimum.reduceat(low[order], runs)
        bin_high[keys[order][runs]] = np.maximum.reduceat(high[order], runs)
        bin_low, bin_high = (a.reshape(count, BINS, 3) for a in (bin_low, bin_high))
        members = np.bincount(keys, minlength=count * BINS).reshape(count, BINS)
        before = np.cumsum(members, axis=1)[:, :-1]
        after = sizes[:, None] - before
        left_area = half_area(
            np.minimum.accumulate(bin_low, axis=1), np.maximum.accumulate(bin_high, axis=1)
        )[:, :-1]
        right_area = half_area(
            np.minimum.accumulate(bin_low[:, ::-1], axis=1),
            np.maximum.accumulate(bin_high[:, ::-1], axis=1),
        )[:, -2::-1]
        cost = np.where((before > 0) & (after > 0), left_area * before + right_area * after, np.inf)
        plane = cost.argmin(axis=1)
        found = cost[np.arange(count), plane]
        better = found < least
        least[better] = found[better]
        right = np.where(better[segment], bins > plane[segment], right)
    return right


def sah_tree(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a binary tree over boxes ``(n, 3)``, n > 1, as ``BINARY_NODE``, and its levels.

    Leaves, whose ``left`` is the box, come first, the root last; ``levels`` are its inner nodes
    from the root down.
    """
    count = len(low)
    nodes = np.zeros(2 * count - 1, BINARY_NODE.dtype)
    order = np.arange(count)
    # Segments of order, each an inner node.
    starts, ends, names = np.array([0]), np.array([count]), np.array([2 * count - 2])
    unused = 2 * count - 2
    levels = []
    while len(names):
        levels.append(names)
        sizes = ends - starts
        segment = np.repeat(np.arange(len(names)), sizes)
        offsets = np.cumsum(sizes) - sizes
        places = np.arange(len(segment)) + (starts - offsets)[segment]
        boxes = order[places]
        right = split_level(low[boxes], high[boxes], segment, offsets)
        order[places] = boxes[np.argsort(2 * segment + right, kind="stable")]
        middles = ends - np.bincount(segment, weights=right, minlength=len(names)).astype(int)
        part_starts = np.stack([starts, middles], axis=1).reshape(-1)
        part_ends = np.stack([middles, ends], axis=1).reshape(-1)
        inner = part_ends - part_starts > 1
        parts = part_starts.copy()
        parts[inner] = unused - 1 - np.arange(inner.sum())
        unused -= int(inner.sum())
        nodes["left"][names], nodes["right"][names] = parts.reshape(-1, 2).T
        starts, ends, names = part_starts[inner], part_ends[inner], parts[inner]
    nodes["left"][:count], nodes["right"][:count] = order, LEAF_BIT
    nodes["low"][:count], nodes["high"][:count] = low[order], high[order]
    return nodes, levels


def weigh(nodes: np.ndarray, levels: list[np.ndarray]) -> None:
    """Fill boxes, costs and sizes from the leaves up, as the device's builder means them."""
    leaves = nodes[: (len(nodes) + 1) // 2]
    leaves["size"] = LEAF_BIT | 1
    leaves["costs"] = half_area(leaves["low"], leaves["high"])[:, None]
    for level in reversed(levels):
        left, right = nodes[nodes["left"][level]], nodes[nodes["right"][level]]
        low, high = np.minimum(left["low"], right["low"]), np.maximum(left["high"], right["high"])
        area = half_area(low, high)
        size = (left["size"] & ~np.uint32(LEAF_BIT)) + (right["size"] & ~np.uint32(LEAF_BIT))

        def parts(k: int, left: np.ndarray = left, right: np.ndarray = right) -> np.ndarray:
            shares = range(1, k)
            return np.min(
                [left["costs"][:, i - 1] + right["costs"][:, k - i - 1] for i in shares], 0
            )

        cost = parts(WIDTH) + area
        block = (size <= BLOCK_TRIANGLES) & (area <= cost)
        cost = np.where(block, area, cost)
        for k in range(1, WIDTH):
            cost = np.minimum(cost, parts(k)) if k > 1 else cost
            nodes["costs"][level, k - 1] = cost
        nodes["low"][level], nodes["high"][level] = low, high
        nodes["size"][level] = np.where(block, size | np.uint32(LEAF_BIT), size)


def build_on_host(device: Device, positions: np.ndarray) -> Bvh:
    """Return the host's tree over ``(n, 9)`` finite corners, made wide on the device."""
    corners = positions.reshape(-1, 3, 3)
    origin = corners.min(axis=(0, 1))
    scaled = (corners - origin) / np.ptp(corners, axis=(0, 1)).max()
    nodes, levels = sah_tree(scaled.min(axis=1), scaled.max(axis=1))
    weigh(nodes, levels)
    buffer = device.upload("positions", positions.reshape(-1))
    build = TreeBuild(device, buffer, len(positions))
    try:
        build.sort_triangles()
        build.own["tree"] = device.upload("tree", np.append(nodes, nodes[:1]))
        return build.finish()
    finally:
        build.release()
        device.release(buffer)


class Tracer:
    """Traces rays through trees, counting visits or taking the time."""

    def __init__(self, device: Device) -> None:
        self.device = device

    def trace(
        self, bvh: Bvh, rays: Rays, counted: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, float]:
        """Return triangles, distances (None for any hit), mean nodes and blocks, and seconds."""
        device, count = self.device, len(rays.rays)
        defines = {"STACK_SIZE": bvh.stack_size, "COUNTED": counted}
        program = load_program(device, "tree_quality.cl", defines, Path(__file__).parent)
        buffers = {
            "rays": device.upload("rays", rays.rays),
            "triangles": device.allocate("triangles", np.uint32, count),
            "counts": device.allocate("counts", np.uint32, 2 * count),
        }
        if not rays.any_hit:
            buffers["distances"] = device.allocate("distances", np.float32, count)
        kernel = "trace_any_rays" if rays.any_hit else "trace_closest_rays"
        launch = program.bind(
            kernel, nodes=bvh.nodes, blocks=bvh.blocks, ray_count=count, **buffers
        )
        device.wait()
        start = time.perf_counter()
        launch(-(-count // device.traits.lanes))
        device.wait()
        seconds = time.perf_counter() - start
        visits = device.read(buffers["counts"]).reshape(-1, 2).mean(axis=0)
        distances = None if rays.any_hit else device.read(buffers["distances"])
        triangles = device.read(buffers["triangles"])
        device.release(*buffers.values())
        return triangles, distances, visits, seconds


def make_rays(origins: np.ndarray, directions: np.ndarray, t_max: float = np.inf) -> np.ndarray:
    """Return rays ``(n, 7)`` that all end at ``t_max``."""
    ends = np.full((len(origins), 1), t_max)
    return np.concatenate([origins, directions, ends], axis=1).astype(np.float32)


def camera_rays(scene: Scene, size: int) -> np.ndarray:
    """Return one ray a pixel of a square film, in tiles of 8 by 8."""
    camera = scene.cameras[scene.camera]
    pixels = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
    x, y = pixels[np.lexsort((*(pixels % 8).T, *(pixels // 8).T))].T
    half = np.tan(camera.fov_y / 2)
    across, down = ((2 * (v + 0.5) / size - 1) * half for v in (x, y))
    directions = np.stack([across, -down, -np.ones(len(x))], axis=1) @ camera.transform[:3, :3].T
    origins = np.broadcast_to(camera.transform[:3, 3], directions.shape)
    return make_rays(origins, directions / np.linalg.norm(directions, axis=1, keepdims=True))


def bounce(
    positions: np.ndarray,
    rays: np.ndarray,
    triangles: np.ndarray,
    distances: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points just off the surfaces that were hit and cosine-distributed directions there."""
    hit = triangles != NO_HIT
    origins, directions = rays[hit, :3].astype(float), rays[hit, 3:6].astype(float)
    corners = positions[triangles[hit]].reshape(-1, 3, 3).astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign(np.sum(normals * directions, axis=1, keepdims=True))
    points = origins + distances[hit, None] * directions
    points += 1e-5 * np.abs(points).max() * normals
    # A point of the unit sphere around the normal's tip is cosine-distributed.
    sphere = rng.normal(size=points.shape)
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    return points, normals + 0.999 * sphere


def make_ray_sets(
    tracer: Tracer, scene: Scene, positions: np.ndarray, bvh: Bvh, size: int
) -> list[Rays]:
    """Return camera rays, two bounces, and shadow rays between points that they hit."""
    rng = np.random.default_rng(0)
    sets = [Rays("camera", camera_rays(scene, size), False)]
    for name in ("bounce 1", "bounce 2"):
        triangles, distances, _, _ = tracer.trace(bvh, sets[-1])
        assert distances is not None
        points, directions = bounce(positions, sets[-1].rays, triangles, distances, rng)
        sets.append(Rays(name, make_rays(points, directions), False))
    points = sets[-1].rays[:, :3]
    shadow = make_rays(points, rng.permutation(points) - points, 1.0)
    return [*sets, Rays("shadow", shadow, True)]


def compare(device: Device, path: str, size: int, rounds: int, console: Console) -> None:
    """Build both trees of a scene, trace through them and print the tables."""
    scene = psf_cl.load_scene(path)
    positions = tables.flatten(scene).positions
    positions = positions[np.isfinite(positions).all(axis=1)]
    buffer = device.upload("positions", positions.reshape(-1))
    device.release(*_buffers(build_bvh(device, buffer, len(positions))))
    start = time.perf_counter()
    on_device = build_bvh(device, buffer, len(positions))
    built = time.perf_counter()
    trees = {"device": on_device, "host": build_on_host(device, positions)}
    seconds = {"device": built - start, "host": time.perf_counter() - built}

    title = f"{Path(path).stem}: {len(positions)} triangles"
    table = Table("tree", "nodes", "blocks", "children", "depth", "cost", "build s", title=title)
    for name, bvh in trees.items():
        cost = visit_cost(device.read(bvh.nodes, bvh.node_count))
        children = (bvh.node_count + bvh.block_count - 1) / bvh.node_count
        counts = (str(n) for n in (bvh.node_count, bvh.block_count))
        shown = (f"{children:.2f}", str(bvh.depth), f"{cost:.2f}", f"{seconds[name]:.3f}")
        table.add_row(name, *counts, *shown)
    console.print(table)

    tracer = Tracer(device)
    table = Table("rays", "device nodes + blocks", "Mrays/s", "host nodes + blocks", "Mrays/s")
    table.add_column("device / host")
    for rays in make_ray_sets(tracer, scene, positions, on_device, size):
        taken: dict[str, list[float]] = {name: [] for name in trees}
        for _ in range(rounds):
            for name, bvh in trees.items():
                taken[name].append(tracer.trace(bvh, rays)[3])
        row = []
        for name, bvh in trees.items():
            nodes, blocks = tracer.trace(bvh, rays, counted=True)[2]
            speed = len(rays.rays) / statistics.median(taken[name]) / 1e6
            row += [f"{nodes:.2f} + {blocks:.2f}", f"{speed:.2f}"]
        pairs = zip(taken["host"], taken["device"], strict=True)
        ratio = statistics.median(host / own for host, own in pairs)
        table.add_row(rays.name, *row, f"{ratio:.2f}")
    console.print(table)
    device.release(buffer, *(b for bvh in trees.values() for b in _buffers(bvh)))


def _buffers(bvh: Bvh) -> tuple:
    return bvh.nodes, bvh.blocks


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the trees of each scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", metavar="SCENE", nargs="+")
    parser.add_argument("--size", type=positive_integer, default=256, help="film, pixels (256)")
    parser.add_argument("--rounds", type=positive_integer, default=9, help="of timing (9)")
    args = parser.parse_args(arguments)
    device = open_device()
    for path in args.scenes:
        compare(device, path, args.size, args.rounds, Console())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
