"""The tree and its traversal against brute force, and closed meshes against leaks."""

from pathlib import Path

import numpy as np
import pytest
from rays import (
    NO_HIT,
    all_hits,
    check_against_brute_force,
    closed_sphere,
    make_rays,
    rays_at_edges,
    rays_through,
    soup,
)

from psf_cl.device.bvh import Refit, build_bvh, visit_cost
from psf_cl.device.layout import CONSTANT
from psf_cl.device.program import load_program

KERNELS = Path(__file__).parent / "kernels"
LEAF_BIT = CONSTANT["LEAF_BIT"]
ALPHA_BIT = CONSTANT["ALPHA_BIT"]


class Traced:
    """Triangles, ``(n, 3, 3)``, with their tree on the device."""

    def __init__(self, device, triangles, alpha=None, width=8):
        self.device = device
        self.triangles = np.ascontiguousarray(triangles, np.float32).reshape(-1, 3, 3)
        count = len(self.triangles)
        positions = device.upload("positions", self.triangles)
        flags = None if alpha is None else device.upload("alpha", np.asarray(alpha, np.uint32))
        self.bvh = build_bvh(device, positions, count, flags, width)
        device.release(positions, *([] if flags is None else [flags]))
        self.read()

    def read(self):
        self.nodes = self.device.read(self.bvh.nodes, self.bvh.node_count)
        self.blocks = self.device.read(self.bvh.blocks, self.bvh.block_count)

    def refit(self, triangles):
        """Move the triangles; return the ratio of the costs."""
        self.triangles = np.ascontiguousarray(triangles, np.float32).reshape(-1, 3, 3)
        positions = self.device.upload("positions", self.triangles)
        refit = Refit(self.device, self.bvh)
        refit.fit(positions)
        ratio = refit.cost_ratio()
        self.device.release(positions)
        refit.release()
        self.read()
        return ratio

    def release(self):
        self.device.release(self.bvh.nodes, self.bvh.blocks)

    def run(self, kernel, rays, inverted=None, **outputs):
        """Trace ``rays``, ``(n, 7)``; ``inverted`` decides between two cut-outs, None for none."""
        defines = {"STACK_SIZE": self.bvh.stack_size, "CUT_OUT": inverted is not None}
        program = load_program(self.device, "traverse_test.cl", defines, KERNELS)
        buffers = {
            "rays": self.device.upload("rays", np.ascontiguousarray(rays, np.float32)),
            **{name: self.device.allocate(name, *shape) for name, shape in outputs.items()},
        }
        values = {"blocks": self.bvh.blocks, "inverted": int(inverted or 0)}
        if kernel == "meet_boxes":
            values.clear()
        program.bind(kernel, nodes=self.bvh.nodes, ray_count=len(rays), **values, **buffers)(
            len(rays), group=64
        )
        results = [self.device.read(buffers[name]) for name in outputs]
        self.device.release(*buffers.values())
        return results

    def closest(self, rays, inverted=None):
        """Return triangles ``(n,)`` and t, u, v ``(n, 3)``."""
        triangles, distances = self.run(
            "trace_closest_rays",
            rays,
            inverted,
            triangles=(np.uint32, len(rays)),
            distances=(np.float32, 3 * len(rays)),
        )
        return triangles, distances.reshape(-1, 3)

    def any(self, rays, inverted=None):
        """Return whether each ray is blocked."""
        return self.run("trace_any_rays", rays, inverted, blocked=(np.uint32, len(rays)))[0] != 0


@pytest.fixture
def traced(device):
    made = []

    def build(triangles, alpha=None, width=8):
        made.append(Traced(device, triangles, alpha, width))
        return made[-1]

    yield build
    for item in made:
        item.release()


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 17, 1000])
def test_hits_equal_brute_force(traced, count):
    tree = traced(soup(count))
    found, _ = check_against_brute_force(tree, rays_through(2000))
    assert count == 0 or (found != NO_HIT).any()


def test_barycentric_coordinates_give_the_point_of_the_hit(traced):
    tree = traced(soup(100))
    rays = rays_through(2000)
    found, distances = tree.closest(rays)
    hit = found != NO_HIT
    corners = tree.triangles[found[hit]]
    t, u, v = distances[hit].T[:, :, None]
    on_triangle = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    on_ray = rays[hit, :3] + t * rays[hit, 3:6]
    np.testing.assert_allclose(on_triangle, on_ray, atol=1e-4)


def test_slivers_are_hit_where_they_are(traced):
    rng = np.random.default_rng(5)
    triangles = soup(300)
    # The third corner lies almost on the first edge.
    along = rng.random((300, 1)).astype(np.float32)
    triangles[:, 2] = triangles[:, 0] + along * (triangles[:, 1] - triangles[:, 0])
    triangles[:, 2] += 1e-3 * rng.normal(size=(300, 3)).astype(np.float32)
    tree = traced(triangles)
    weights = rng.dirichlet([4, 4, 4], 300).astype(np.float32)
    targets = np.einsum("nk,nkc->nc", weights, triangles)
    origins = rng.uniform(-3, 3, (300, 3))
    found, distances = tree.closest(make_rays(origins, targets - origins))
    # Something else may be in front, nothing may be behind.
    assert (found != NO_HIT).mean() > 0.99
    assert (distances[found != NO_HIT, 0] < 1.001).all()
    check_against_brute_force(tree, rays_through(2000), margin=1e-2)


@pytest.mark.parametrize("copies", [2, 9, 50])
def test_the_lowest_index_wins_among_equal_triangles(traced, copies):
    distinct = soup(40)
    order = np.random.default_rng(6).permutation(np.repeat(np.arange(40), copies))
    tree = traced(distinct[order])
    found, _ = tree.closest(rays_through(2000))
    hit = found[found != NO_HIT]
    first_of = np.array([np.flatnonzero(order == k)[0] for k in range(40)])
    np.testing.assert_array_equal(hit, first_of[order[hit]])
    assert len(np.unique(hit)) > 20


def test_triangles_that_are_not_finite_are_dropped_and_counted(traced):
    triangles = soup(500)
    bad = {3: np.nan, 77: np.inf, 78: -np.inf, 499: np.nan}
    for number, (index, value) in enumerate(bad.items()):
        triangles[index, number % 3, (number + 1) % 3] = value
    tree = traced(triangles)
    assert tree.bvh.dropped == len(bad)
    kept = np.setdiff1d(np.arange(500), list(bad))
    np.testing.assert_array_equal(np.sort(leaf_ids(tree)), kept)
    found, distances = tree.closest(rays_through(2000))

    found_kept, distances_kept = traced(triangles[kept]).closest(rays_through(2000))
    hit = found != NO_HIT
    np.testing.assert_array_equal(found[hit], kept[found_kept[hit]])
    np.testing.assert_array_equal(distances[hit], distances_kept[hit])


def test_only_bad_triangles_make_an_empty_tree(traced):
    tree = traced(np.full((7, 3, 3), np.nan))
    assert (tree.bvh.dropped, tree.bvh.block_count, tree.bvh.node_count) == (7, 0, 1)
    assert (tree.closest(rays_through(100))[0] == NO_HIT).all()
    assert not tree.any(rays_through(100)).any()


def test_triangles_without_area_are_never_hit(traced):
    triangles = soup(600)
    triangles[::3, 2] = triangles[::3, 1]
    triangles[1::30] = triangles[1::30, :1]
    tree = traced(triangles)
    rays = rays_through(2000)
    # Aimed exactly at their corners too.
    rays[:200, 3:6] = triangles[::3, 2] - rays[:200, :3]
    found, distances = tree.closest(rays)
    hit = found[found != NO_HIT]
    assert len(hit) and not (hit % 3 == 0).any() and not (hit % 30 == 1).any()
    assert np.isfinite(distances[found != NO_HIT]).all()


def test_both_sides_count_and_hits_lie_strictly_between_0_and_t_max(traced):
    triangle = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]])
    tree = traced(triangle)
    toward = [0, 0, 1]
    rays = make_rays(
        [[0, 0, 0], [0, 0, 4], [0, 0, 3], [0, 0, 0], [0, 0, 0], [0, 0, 2]],
        [toward, [0, 0, -1], toward, toward, toward, toward],
        [np.inf, np.inf, np.inf, 2.0, np.nextafter(np.float32(2), np.float32(3)), np.inf],
    )
    expected = np.array([True, True, False, False, True, False])
    found, distances = tree.closest(rays)
    np.testing.assert_array_equal(found == 0, expected)
    np.testing.assert_array_equal(tree.any(rays), expected)
    np.testing.assert_array_equal(distances[expected, 0], 2.0)


@pytest.mark.parametrize(
    "ray",
    [
        [np.nan, 0, 0, 0, 0, 1, np.inf],
        [0, 0, 0, 0, np.nan, 1, np.inf],
        [np.inf, 0, 0, 0, 0, 1, np.inf],
        [0, 0, 0, np.inf, 0, 1, np.inf],
        [0, 0, 0, 0, 0, 0, np.inf],
        [0, 0, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 1, -1],
        [0, 0, 0, 0, 0, 1, np.nan],
    ],
)
def test_rays_that_are_none_hit_nothing(traced, ray):
    tree = traced(soup(1000))
    rays = np.array([ray], np.float32)
    assert tree.closest(rays)[0][0] == NO_HIT
    assert not tree.any(rays)[0]


def test_cut_out_triangles_count_only_where_they_are_there(traced):
    triangles = soup(200)
    alpha = np.arange(200) % 2
    tree = traced(triangles, alpha)
    rays = rays_through(2000)
    t, u, v, edge = all_hits(triangles, rays)
    hit = np.isfinite(t)
    sure = (edge.min(axis=1) > 1e-4) & ~(hit & (np.abs(u - v) < 1e-4)).any(axis=1)
    assert sure.mean() > 0.8
    for inverted in (False, True):
        found, _ = tree.closest(rays, inverted)
        blocked = tree.any(rays, inverted)
        there = (alpha == 0) | ((u >= v) if inverted else (u < v))
        left = np.where(there, t, np.inf)
        expected = np.where(np.isfinite(left.min(axis=1)), left.argmin(axis=1), NO_HIT)
        np.testing.assert_array_equal(found[sure], expected[sure])
        np.testing.assert_array_equal(blocked[sure], expected[sure] != NO_HIT)
        # Some rays go through a hole.
        assert (hit[sure].any(axis=1) & (expected[sure] != t[sure].argmin(axis=1))).sum() > 10


@pytest.mark.parametrize("width", [2, 4])
@pytest.mark.parametrize("count", [0, 1, 2, 5, 1000])
def test_narrow_trees_give_the_same_hits(traced, width, count):
    triangles = soup(count)
    wide, narrow = traced(triangles), traced(triangles, width=width)
    check_tree(narrow)
    assert (narrow.nodes["child"][:, width:] == 0).all()
    rays = rays_through(2000)
    for expected, found in zip(wide.closest(rays), narrow.closest(rays), strict=True):
        np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(narrow.any(rays), wide.any(rays))


def leaf_ids(tree):
    ids = tree.blocks["id"]
    return ids[ids != NO_HIT] & ~np.uint32(ALPHA_BIT)


def check_tree(tree):
    """Walk the tree: each node and block once, boxes around all below, the depth as stated."""
    ids = leaf_ids(tree)
    kept = np.flatnonzero(np.isfinite(tree.triangles).all(axis=(1, 2)))
    np.testing.assert_array_equal(np.sort(ids), kept)
    for block in tree.blocks:
        used = block["id"] != NO_HIT
        assert used[0] and np.isnan(block["v"][:, ~used]).all()
        corners = tree.triangles[block["id"][used] & ~np.uint32(ALPHA_BIT)]
        np.testing.assert_array_equal(block["v"][:, used], corners.reshape(-1, 9).T)

    seen_nodes, seen_blocks = [], []
    deepest = 0
    # Each entry: node, level, and the box that its parent keeps for it.
    stack = [(0, 1, np.full(3, -np.inf), np.full(3, np.inf))]
    while stack:
        index, level, low, high = stack.pop()
        seen_nodes.append(index)
        deepest = max(deepest, level)
        node = tree.nodes[index]
        for k in range(8):
            child_low, child_high = node["bounds"][::2, k], node["bounds"][1::2, k]
            if child_low[0] > child_high[0]:
                assert (child_low == np.inf).all() and (child_high == -np.inf).all()
                continue
            assert (child_low >= low).all() and (child_high <= high).all()
            child = int(node["child"][k])
            if child & LEAF_BIT:
                block = tree.blocks[child & ~LEAF_BIT]
                seen_blocks.append(child & ~LEAF_BIT)
                corners = block["v"].reshape(3, 3, 4)[:, :, block["id"] != NO_HIT]
                assert (corners >= child_low[:, None]).all()
                assert (corners <= child_high[:, None]).all()
            else:
                stack.append((child, level + 1, child_low, child_high))
    assert sorted(seen_nodes) == list(range(tree.bvh.node_count))
    assert sorted(seen_blocks) == list(range(tree.bvh.block_count))
    assert deepest == tree.bvh.depth
    assert tree.bvh.stack_size >= (tree.bvh.width - 1) * deepest + 1


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 5, 6, 8, 9, 33, 64, 65, 5000])
def test_every_triangle_is_in_one_leaf_and_every_box_holds_what_is_below(traced, count):
    check_tree(traced(soup(count, size=0.1), alpha=np.arange(count) % 3 == 0))


def test_leaves_and_nodes_are_well_filled(traced):
    tree = traced(soup(5000, size=0.1))
    assert len(leaf_ids(tree)) / tree.bvh.block_count > 2
    # Every node but the root is one child, every block is one.
    assert (tree.bvh.node_count + tree.bvh.block_count - 1) / tree.bvh.node_count > 6


def halves_cost(triangles):
    """Return the visits of a tree by halving the longest axis at its median, eight children a node.

    Not a good tree, but a plain one to be better than.
    """
    low, high = triangles.min(axis=1), triangles.max(axis=1)

    def parts(members, levels):
        if levels == 0 or len(members) <= 4:
            return [members]
        centers = low[members] + high[members]
        axis = np.ptp(centers, axis=0).argmax()
        ordered = members[np.argsort(centers[:, axis], kind="stable")]
        half = len(members) // 2
        return parts(ordered[:half], levels - 1) + parts(ordered[half:], levels - 1)

    def area(members):
        size = (high[members].max(axis=0) - low[members].min(axis=0)).astype(np.float64)
        return size[0] * size[1] + size[1] * size[2] + size[2] * size[0]

    total, stack = 0.0, [np.arange(len(triangles))]
    while stack:
        members = stack.pop()
        total += area(members)
        stack += parts(members, 3) if len(members) > 4 else []
    return total / area(np.arange(len(triangles)))


def test_a_tree_costs_less_than_one_of_halves(traced):
    # Small triangles in clumps, and a few that span the scene.
    rng = np.random.default_rng(9)
    clumps = rng.uniform(-1, 1, (40, 1, 1, 3)) + 0.05 * rng.normal(size=(40, 100, 1, 3))
    small = (clumps + 0.01 * rng.normal(size=(40, 100, 3, 3))).reshape(-1, 3, 3)
    triangles = np.concatenate([small, rng.uniform(-1, 1, (20, 3, 3))]).astype(np.float32)
    cost = visit_cost(traced(triangles).nodes)
    assert cost < 0.8 * halves_cost(triangles)


def test_the_cost_counts_the_boxes_by_their_surface(traced):
    # Two blocks: four triangles that fill the unit cube's box, and four in a corner of it.
    big = np.tile([[[0, 0, 0], [1, 1, 0], [1, 1, 1]]], (4, 1, 1))
    small = 0.25 * big + 0.75
    tree = traced(np.concatenate([big, small]))
    assert (tree.bvh.node_count, tree.bvh.block_count) == (1, 2)
    # The node, a block in all of the box, one in a box of 1/16 of the surface.
    np.testing.assert_allclose(visit_cost(tree.nodes), 1 + 1 + 1 / 16, rtol=1e-5)


def test_alpha_flags_reach_the_leaves(traced):
    flags = np.random.default_rng(7).integers(0, 2, 1000)
    ids = traced(soup(1000), alpha=flags).blocks["id"]
    ids = ids[ids != NO_HIT]
    np.testing.assert_array_equal((ids & ALPHA_BIT) != 0, flags[ids & ~np.uint32(ALPHA_BIT)] == 1)


def test_a_rebuild_gives_the_same_bits(traced):
    triangles = np.concatenate([soup(20_000, size=0.02), np.repeat(soup(3), 500, axis=0)])
    first, second = traced(triangles), traced(triangles)
    assert first.nodes.tobytes() == second.nodes.tobytes()
    assert first.blocks.tobytes() == second.blocks.tobytes()


def test_equal_triangles_make_a_shallow_tree(traced):
    tree = traced(np.repeat(soup(1), 100_000, axis=0))
    assert tree.bvh.depth <= 8
    assert len(leaf_ids(tree)) == 100_000
    assert set(tree.closest(rays_through(200))[0]) == {0, NO_HIT}


def test_nested_triangles_make_a_tree_of_bounded_depth(traced):
    # Of one centre, in the order of their sizes: every box is nearest to the one before it, so that
    # only the first two choose each other.  Powers of two: centres must not move by rounding.
    count = 4096
    sizes = (1 + np.arange(count)) / count
    corners = np.array([[-1, -1, -1], [1, 1, 1], [1, -1, 1]])
    tree = traced(sizes[:, None, None] * corners)
    check_tree(tree)
    # At the worst every other round joins one of 8.
    assert tree.bvh.depth <= 2 * np.log(count) / np.log(8 / 7)


@pytest.mark.parametrize("count", [0, 1, 3, 5, 3000])
def test_a_refit_without_moves_gives_the_same_bits(traced, count):
    tree = traced(soup(count))
    nodes, blocks = tree.nodes.tobytes(), tree.blocks.tobytes()
    assert tree.refit(tree.triangles) == 1.0
    assert (tree.nodes.tobytes(), tree.blocks.tobytes()) == (nodes, blocks)


@pytest.mark.parametrize("finite", [True, False], ids=["still", "nothing in the tree"])
def test_a_refit_of_nothing_that_moves_leaves_the_tree(device, finite):
    corners = np.random.default_rng(5).random((300, 3, 3)).astype(np.float32)
    if not finite:
        corners[:, 0, 0] = np.nan
    positions = device.upload("positions", corners)
    bvh = build_bvh(device, positions, 300)
    before = device.read(bvh.nodes).tobytes(), device.read(bvh.blocks).tobytes()
    refit = Refit(device, bvh, 300)
    refit.fit(positions)
    assert refit.cost_ratio() == 1.0
    assert before == (device.read(bvh.nodes).tobytes(), device.read(bvh.blocks).tobytes())
    refit.release()
    device.release(positions, bvh.nodes, bvh.blocks)


def test_hits_after_a_refit_equal_brute_force(traced):
    tree = traced(soup(1000), alpha=np.arange(1000) % 3 == 0)
    links = tree.nodes["child"].copy(), tree.blocks["id"].copy()
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    moved = (tree.triangles @ turn + 0.1 * np.sin(5 * tree.triangles)).astype(np.float32)
    tree.refit(moved)
    check_tree(tree)
    check_against_brute_force(tree, rays_through(2000))
    np.testing.assert_array_equal(tree.nodes["child"], links[0])
    np.testing.assert_array_equal(tree.blocks["id"], links[1])


def test_a_refit_tells_when_the_tree_no_longer_suits(traced):
    triangles = soup(2000, size=0.02)
    tree = traced(triangles)
    np.testing.assert_allclose(tree.refit(2 * triangles + 1), 1.0, rtol=1e-3)
    tree = traced(triangles)
    shuffled = np.random.default_rng(10).permutation(2000)
    ratio = tree.refit(triangles[shuffled])
    assert ratio > 5
    check_against_brute_force(tree, rays_through(500))


def test_a_triangle_that_is_not_finite_after_a_move_comes_back(traced):
    triangles = soup(300)
    tree = traced(triangles)
    rays = rays_through(2000)
    found, distances = tree.closest(rays)
    gone = [int(k) for k in np.unique(found[found != NO_HIT])[:5]]
    broken = triangles.copy()
    broken[gone, 1, 2] = [np.nan, np.inf, -np.inf, np.nan, np.inf]
    tree.refit(broken)
    left, _ = tree.closest(rays)
    assert not np.isin(left, gone).any()
    np.testing.assert_array_equal(left[~np.isin(found, gone)], found[~np.isin(found, gone)])
    tree.refit(triangles)
    again, distances_again = tree.closest(rays)
    np.testing.assert_array_equal(again, found)
    np.testing.assert_array_equal(distances_again, distances)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e30])
def test_any_scale_gives_the_same_hits(traced, scale):
    triangles = soup(300)
    plain, _ = traced(triangles).closest(rays_through(1000))
    scaled, distances = traced(triangles * np.float32(scale)).closest(
        rays_through(1000, scale=scale)
    )
    # Scales are no powers of two: hits near an edge may move.
    assert (plain == scaled).mean() > 0.995
    assert (distances[scaled != NO_HIT, 0] > 0).all()


def test_a_far_corner_leaves_the_rest_of_the_scene_right(traced):
    triangles = soup(1000)
    triangles[500, 1] = [1e30, -1e25, 3e38]
    tree = traced(triangles)
    check_tree(tree)
    rest = np.delete(triangles, 500, axis=0)
    rays = rays_through(1000)
    found, _ = tree.closest(rays)
    alone, _ = traced(rest).closest(rays)
    moved = np.where(alone == NO_HIT, NO_HIT, alone + (alone >= 500))
    same = found != 500
    assert same.mean() > 0.9
    np.testing.assert_array_equal(found[same], moved[same])


def count_misses(tree, points, faces, ray_count, center, scale):
    misses = 0
    chunk = 1 << 18
    for seed in range(-(-ray_count // chunk)):
        rng = np.random.default_rng(1000 + seed)
        size = min(chunk, ray_count - seed * chunk)
        origins = (center + scale * rng.uniform(-0.3, 0.3, (size, 3))).astype(np.float32)
        rays = rays_at_edges(points, faces, origins, seed)
        misses += int((tree.closest(rays)[0] == NO_HIT).sum()) + int((~tree.any(rays)).sum())
    return misses


@pytest.mark.parametrize("offset", [0.0, 100.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_no_ray_leaves_a_closed_mesh(traced, scale, offset):
    points, faces = closed_sphere(40, 50)
    center = scale * offset * np.array([1.0, -0.3, 0.7])
    points = (center + scale * points).astype(np.float32)
    tree = traced(points[faces])
    assert count_misses(tree, points, faces, 100_000, center, scale) == 0


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_no_ray_of_ten_million_leaves_a_fine_closed_mesh(traced, scale):
    points, faces = closed_sphere(300, 420)
    assert len(faces) > 250_000
    points = (scale * points).astype(np.float32)
    tree = traced(points[faces])
    assert count_misses(tree, points, faces, 10_000_000, np.zeros(3), scale) == 0


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-5])
def test_no_ray_from_close_to_an_edge_leaves_a_box(traced, gap):
    # Edges that are long beside the distance to them: what the far corners add to the rounding
    # error decides which wall is hit, and that wall's box must be met.
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    points = 1.7 * corners
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])
    tree = traced(points[faces])
    rng = np.random.default_rng(8)
    count = 100_000
    along = rng.integers(0, 3, count)
    targets = np.zeros((count, 3))
    targets[np.arange(count), along] = rng.uniform(0.2, 1.5, count)
    origins = gap * rng.uniform(0.5, 2.0, (count, 3))
    origins[np.arange(count), along] = targets[np.arange(count), along]
    origins[np.arange(count), along] += gap * rng.uniform(-10, 10, count)
    targets += 1e-8 * rng.normal(size=(count, 3))
    rays = make_rays(origins, targets - origins)
    assert (tree.closest(rays)[0] != NO_HIT).all()
    assert tree.any(rays).all()


def test_rays_along_the_axes_do_not_slip_between_faces(traced):
    # A grid of quads in the plane z = 1: rays straight at its corners and edges.
    x, y = np.meshgrid(np.arange(-8, 8), np.arange(-8, 8), indexing="ij")
    a = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) / np.array([8.0, 8.0, 1.0])
    step_x, step_y = np.array([0.125, 0, 0]), np.array([0, 0.125, 0])
    triangles = np.concatenate(
        [
            np.stack([a, a + step_x, a + step_y], axis=1),
            np.stack([a + step_x, a + step_x + step_y, a + step_y], axis=1),
        ]
    )
    tree = traced(triangles)
    targets = np.concatenate([triangles.reshape(-1, 3), triangles.mean(axis=1)])
    targets = targets[(np.abs(targets[:, :2]) < 1).all(axis=1)]
    for sign in (1.0, -1.0):
        # -0.0 on the way back: a zero of either sign.
        directions = np.array([[0.0, 0.0, 1.0]]) * sign
        origins = targets - 3 * directions
        found, distances = tree.closest(make_rays(origins, directions))
        assert (found != NO_HIT).all()
        np.testing.assert_allclose(distances[:, 0], 3.0, rtol=1e-6)
        assert tree.any(make_rays(origins, directions)).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0, 0.0, -0.0])
def test_rays_across_an_axis_pass_by_boxes_beside_them(traced, axis, sign):
    """Where the ray does not move, or hardly does, only the box that it is in is met."""
    rng = np.random.default_rng(3)
    corners = rng.uniform(0, 0.5, (32, 3, 3))
    # Eight heaps of four along the axis, on both sides of 0.
    corners[:, :, axis] += np.repeat(np.arange(8), 4)[:, None] - 4
    tree = traced(corners)
    other = (axis + 1) % 3
    bounds = tree.nodes[0]["bounds"].reshape(3, 2, 8)
    middles = bounds.mean(axis=1).T
    directions = np.zeros((8, 3))
    directions[:, other] = 1.0
    directions[:, axis] = sign * 1e-30
    origins = middles - 3.0 * directions
    origins[:, axis] = middles[:, axis]
    met = tree.run("meet_boxes", make_rays(origins, directions), met=(np.uint32, 8))[0]
    lo, hi = bounds[axis]
    inside = (middles[:, axis, None] >= lo) & (middles[:, axis, None] <= hi)
    assert inside.sum() == 8
    np.testing.assert_array_equal(met, (inside << np.arange(8)).sum(axis=1))
