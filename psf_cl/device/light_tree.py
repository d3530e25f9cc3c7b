"""The tree of lights: joined by the builder of the BVH, with power and the directions they face."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from psf_cl.device.alias import alias_chances, alias_table
from psf_cl.device.bvh import TreeBuild, warm_up_builder
from psf_cl.device.device import Buffer, Device
from psf_cl.device.layout import CONSTANT, LIGHT_BOUNDS, LIGHT_GROUP, LIGHT_PAIR
from psf_cl.device.program import Program, load_program

_LEAF = CONSTANT["LEAF_BIT"]
_NONE = CONSTANT["NO_LIGHT"]
_FAR = (CONSTANT["LIGHT_ENVIRONMENT"], CONSTANT["LIGHT_DIRECTIONAL"])
_GROUP = 64

#: Photons do not tell lights apart, but groups: subtrees of at most one part in so many of all.
#: What is seen of large groups is soon known, and in them the tree picks well (measured: the least
#: error of 4, 8, 16, 32, 128 and 512, with many photons too).
LEAST_GROUPS = 16

#: From far away clusters draw by power, with one look-up: subtrees of at most so many lights, if
#: there are enough for groups to be larger (measured with 2^17: 1024 and 4096 are no faster).
MOST_IN_CLUSTER = 256
FEWEST_CLUSTERED = LEAST_GROUPS * MOST_IN_CLUSTER

#: Part of its cluster that all lights of it have alike: the brightest may be hidden.
LEVELLED = 2.0**-6


@dataclass(frozen=True)
class Topology:
    """Which nodes of the tree are siblings.

    Attributes:
        links: ``(p, 2)`` uint32, the children of each pair: another pair, or LEAF_BIT | light, or
            NO_LIGHT.  Pair 0 is the root.
        levels: the pairs of each level from the root down.
        places: ``(lights + p,)`` uint32, 2 * pair + side of every light, then of every pair.
        groups: ``(lights,)`` uint32, the same of the group around each: the largest subtree of at
            most one part in LEAST_GROUPS of all lights.
        clusters: ``(lights,)`` uint32, the same of the largest subtree of at most MOST_IN_CLUSTER
            lights; NO_LIGHT where that is one light, and all of them if there are few lights.
    """

    links: np.ndarray
    levels: list[np.ndarray]
    places: np.ndarray
    groups: np.ndarray
    clusters: np.ndarray


class LightTree:
    """Buffers of the tree, by the names of the kernels' parameters; ``fit`` after lights moved."""

    def __init__(
        self,
        device: Device,
        table: np.ndarray,
        lights: Buffer,
        near_share: float,
        radius: float,
        apart: bool = False,
    ) -> None:
        """Join ``table``, layout.LIGHT, which ``lights`` holds too, and fit the tree.

        Args:
            near_share: chance that a light is drawn that is not infinitely far, if there are both.
            radius: of the scene, m.
            apart: whether each light is a group of its own.
        """
        self.device = device
        self.program = _load(device)
        topology = arrange(table, _join_near(device, table), apart)
        pairs = np.zeros(len(topology.links), LIGHT_PAIR.dtype)
        pairs["child"] = topology.links
        self.buffers = {
            "light_pairs": device.upload("light_pairs", pairs),
            "light_places": device.upload("light_places", topology.places),
            "light_clusters": device.allocate(
                "light_clusters", np.uint32, CONSTANT["CLUSTER_PARTS"] * len(table)
            ),
            "light_groups": device.allocate("light_groups", LIGHT_GROUP.dtype, len(table)),
            "light_order": device.upload("light_order", np.concatenate(topology.levels)),
            "light_bounds": device.allocate("light_bounds", LIGHT_BOUNDS.dtype, len(pairs)),
        }
        sizes = [len(level) for level in topology.levels]
        self.levels = [(sum(sizes[:k]), size) for k, size in enumerate(sizes)]
        # As far away as the scene is large, the brightest has 1: nothing over- or underflows.
        largest = float(table["power"].max())
        with np.errstate(over="ignore"):
            unit = np.float32(radius) ** 2 / np.float32(largest) if largest > 0.0 else 1.0
        self.launch = self.program.bind(
            "fit_light_pairs",
            lights=lights,
            order=self.buffers["light_order"],
            pairs=self.buffers["light_pairs"],
            bounds=self.buffers["light_bounds"],
            power_unit=float(np.clip(unit, 1e-30, 1e30)),
            near_share=near_share,
            level_start=0,
            level_count=0,
        )
        self.groups, self.clusters = topology.groups, topology.clusters
        self.links = topology.links
        self.fit(table)

    def fit(self, table: np.ndarray) -> None:
        """Enqueue fitting every pair to the lights as they are now, of which this is the table."""
        # Lights without a group are never drawn from the table either.
        index = np.where(self.groups == _NONE, 0, self.groups)
        chances = np.bincount(index, table["pmf"].astype(np.float64))
        groups = np.zeros(len(table), LIGHT_GROUP.dtype)
        groups["node"], groups["chance"] = self.groups, chances[index]
        self.device.write(self.buffers["light_groups"], groups)
        clusters = _cluster_words(table["power"], self.clusters, self.links)
        self.device.write(self.buffers["light_clusters"], clusters)
        for start, count in reversed(self.levels):
            self.launch.set(level_start=start, level_count=count)(count, group=_GROUP)


def warm_up_light_tree(device: Device) -> float:
    """Make all kernels that build a tree of lights ready; return the seconds."""
    start = time.perf_counter()
    warm_up_builder(device)
    _load(device).warm_up("fit_light_pairs")
    return time.perf_counter() - start


def _load(device: Device) -> Program:
    return load_program(device, "light_tree.cl", {"W": 1})


def _join_near(device: Device, table: np.ndarray) -> np.ndarray:
    """Return the binary tree of the lights at finite distance, ``BINARY_NODE``, root last.

    Its leaves name lights of ``table``; a light that is not finite is in none.
    """
    near = np.flatnonzero(~np.isin(table["kind"], _FAR)).astype(np.uint32)
    corners = np.repeat(table["position"][near][:, None], 3, axis=1)
    on_triangle = table["kind"][near] == CONSTANT["LIGHT_TRIANGLE"]
    with np.errstate(over="ignore", invalid="ignore"):
        for corner, edge in ((1, "e1"), (2, "e2")):
            corners[on_triangle, corner] += table[edge][near][on_triangle]
    if not len(near):
        return np.zeros(0, [("left", np.uint32), ("right", np.uint32)])
    positions = device.upload("positions", corners.astype(np.float32).reshape(-1))
    build = TreeBuild(device, positions, len(near))
    try:
        build.sort_triangles()
        build.join_clusters()
        count = int(build.scalars["count"])
        tree = device.read(build.own["tree"], max(2 * count - 1, 1))[: max(2 * count - 1, 0)]
    finally:
        build.release()
        device.release(positions)
    leaf = tree["right"] == _LEAF
    tree["left"][leaf] = near[tree["left"][leaf]]
    return tree[["left", "right"]]


def arrange(table: np.ndarray, tree: np.ndarray, apart: bool = False) -> Topology:
    """Number the pairs of the binary ``tree`` of near lights, and add the lights that are far.

    Args:
        tree: fields ``left`` and ``right``: nodes, or a light and LEAF_BIT; the root is last.
        apart: whether each light is a group of its own.
    """
    links: list[tuple[int, int]] = []
    far = [_LEAF | int(i) for i in np.flatnonzero(np.isin(table["kind"], _FAR))]
    roots = [*far]
    while len(roots) > 1:
        joined = []
        for a, b in zip(roots[::2], roots[1::2], strict=False):
            joined.append(len(links))
            links.append((a, b))
        roots = [*joined, *roots[2 * len(joined) :]]
    count = (len(tree) + 1) // 2
    if count:
        start = len(links) - count
        inner = tree[count:]
        children = np.stack([inner["left"], inner["right"]], axis=1).astype(np.int64)
        names = np.concatenate([_LEAF | tree["left"][:count].astype(np.int64), np.zeros(count - 1)])
        names[count:] = start + np.arange(count, len(tree))
        links += [(int(a), int(b)) for a, b in names.astype(np.int64)[children]]
        roots.append(len(links) - 1 if count > 1 else int(names[0]))
    if len(roots) == 2:
        links.append((roots[1], roots[0]))
    elif not roots or roots[0] >= _LEAF:
        links.append((roots[0] if roots else _NONE, _NONE))
    largest = 1 if apart else max(len(table) // LEAST_GROUPS, 1)
    return _from_the_root(np.array(links, np.int64), len(table), largest)


def _from_the_root(links: np.ndarray, light_count: int, most: int) -> Topology:
    """Return the pairs, whose last is the root, numbered from it; ``most`` lights in a group."""
    pairs = len(links)
    links = links[::-1]
    links = np.where(links < _LEAF, pairs - 1 - links, links)
    places = np.full(light_count + pairs, _NONE, np.uint32)
    leaf = (links >= _LEAF) & (links != _NONE)
    slots = 2 * np.arange(pairs)[:, None] + np.arange(2)
    places[links[leaf] & ~_LEAF] = slots[leaf]
    places[light_count + links[links < _LEAF]] = slots[links < _LEAF]
    levels = [np.zeros(1, np.uint32)]
    while len(levels[-1]):
        children = links[levels[-1]].reshape(-1)
        levels.append(children[children < _LEAF].astype(np.uint32))
    levels = levels[:-1]
    sizes = np.zeros(pairs, np.int64)
    below = np.zeros((pairs, 2), np.int64)
    for level in reversed(levels):
        inner = links[level] < _LEAF
        below[level] = np.where(leaf[level], 1, 0)
        below[level] += np.where(inner, sizes[np.where(inner, links[level], 0)], 0)
        sizes[level] = below[level].sum(axis=1)
    # The root is no node of a pair: its children are the largest subtrees that there can be.
    whole = np.where(np.arange(pairs) == 0, light_count + 1, sizes)[:, None]

    def largest_of(most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which nodes are the largest subtrees of at most so many lights; each light's."""
        tops = (below > 0) & (below <= most) & (whole > most)
        own = np.full(light_count, _NONE, np.uint32)
        around = np.full(pairs, _NONE, np.int64)
        for level in levels:
            of = np.where(tops[level], slots[level], around[level][:, None])
            children, inner = links[level], links[level] < _LEAF
            around[children[inner]] = of[inner]
            own[children[leaf[level]] & ~_LEAF] = of[leaf[level]]
        return tops, own

    tops, groups = largest_of(most)
    small, clusters = largest_of(MOST_IN_CLUSTER)
    small &= ~leaf & (light_count >= FEWEST_CLUSTERED)
    bits = np.where(tops, CONSTANT["GROUP_BIT"], 0) | np.where(small, CONSTANT["CLUSTER_BIT"], 0)
    there = small.reshape(-1)[np.where(clusters == _NONE, 0, clusters)]
    clusters = np.where(there, clusters, _NONE).astype(np.uint32)
    return Topology((links | bits).astype(np.uint32), levels, places, groups, clusters)


def _cluster_words(power: np.ndarray, clusters: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return ``light_clusters``, by the parts that ``layout.CONSTANTS`` lists.

    Args:
        power: of each light, in any one unit.
        clusters, links: as in ``Topology``.
    """
    count = len(power)
    words = np.zeros((CONSTANT["CLUSTER_PARTS"], count), np.uint32)
    words[CONSTANT["CLUSTER_PLACE"]] = _NONE
    lights = np.flatnonzero(clusters != _NONE)
    lights = lights[np.argsort(clusters[lights], kind="stable")]
    if not len(lights):
        return words.reshape(-1)
    nodes, first, lengths = np.unique(clusters[lights], return_index=True, return_counts=True)
    pairs = links.reshape(-1)[nodes] & CONSTANT["NODE_MASK"]
    keep, chance = np.zeros((2, count), np.float32)
    for node, pair, start, length in zip(nodes, pairs, first, lengths, strict=True):
        own = lights[start : start + length]
        weight = np.maximum(power[own].astype(np.float64), 0.0)
        shines = weight > 0.0
        if not shines.any():
            continue
        level = LEVELLED / (1.0 - LEVELLED) * weight.sum() / shines.sum()
        slots = slice(start, start + length)
        keep[slots], other = alias_table(weight + level * shines)
        chance[own] = alias_chances(keep[slots], other)
        words[CONSTANT["CLUSTER_LIGHT"], slots] = own
        words[CONSTANT["CLUSTER_OTHER"], slots] = own[other]
        words[CONSTANT["CLUSTER_PLACE"], own] = node
        words[CONSTANT["CLUSTER_FIRST"], pair] = start
        words[CONSTANT["CLUSTER_LENGTH"], pair] = length
    words[CONSTANT["CLUSTER_KEEP"]] = keep.view(np.uint32)
    words[CONSTANT["CLUSTER_CHANCE"]] = chance.view(np.uint32)
    return words.reshape(-1)
