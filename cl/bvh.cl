// The tree, built in steps: Morton codes, a binary tree over the sorted triangles, blocks of up to
// four triangles, boxes from the bottom up, wide nodes from the top down.
//
// The binary tree is implicit: its leaves are the places 0 .. count - 1 of the sorted triangles;
// its inner nodes 0 .. count - 2 each cover the places from the node's own index to ends[node]
// (either may be the lower one) and part after splits[node].  Node 0 is the root.  A *subtree* is
// named by its inner node, or LEAF_BIT | place.  Subtrees of at most BLOCK_TRIANGLES triangles
// become blocks.
//
// Karras: Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees, HPG 2012.

#include "common/geometry.h"

#define BLOCK_TRIANGLES 4
#define NODE_CHILDREN 8
#define NO_NODE 0xFFFFFFFFu
#define GRID_BITS 21 // of the Morton grid, an axis; 3 * 21 = 63 key bits

/// The corners of a box.
typedef struct {
    float low[3];
    float high[3];
} Box;

static inline Box empty_box(void)
{
    Box box;
    for (uint axis = 0; axis < 3; ++axis) {
        box.low[axis] = INFINITY;
        box.high[axis] = -INFINITY;
    }
    return box;
}

/// Grow by a coordinate; NaN changes nothing.
static inline void grow_box(Box *box, uint axis, float x)
{
    box->low[axis] = x < box->low[axis] ? x : box->low[axis];
    box->high[axis] = x > box->high[axis] ? x : box->high[axis];
}

/// Find each triangle's centre and whether all of its coordinates are finite.
///
/// reads   positions[0, 9 * triangle_count)
/// writes  centers[3 * i + (0..2)], NaN if dropped; kept[i], 0 or 1
kernel void prepare_triangles(
    global const float *positions,
    global float *centers,
    global uint *kept,
    const uint triangle_count)
{
    const uint i = get_global_id(0);
    if (i >= triangle_count)
        return;
    global const float *p = positions + 9 * (size_t)i;
    Box box = empty_box();
    uint finite = 1;
    for (uint k = 0; k < 9; ++k) {
        const float x = p[k];
        finite &= fabs(x) < INFINITY ? 1 : 0;
        grow_box(&box, k % 3, x);
    }
    kept[i] = finite;
    // Halves first: the sum of the two may be out of range.
    for (uint axis = 0; axis < 3; ++axis)
        centers[3 * (size_t)i + axis] =
            finite ? 0.5f * box.low[axis] + 0.5f * box.high[axis] : NAN;
}

/// Put two 0 bits before each of the low 21 bits.
static inline ulong spread_bits(ulong x)
{
    x = (x | x << 32) & 0x001F00000000FFFFul;
    x = (x | x << 16) & 0x001F0000FF0000FFul;
    x = (x | x << 8) & 0x100F00F00F00F00Ful;
    x = (x | x << 4) & 0x10C30C30C30C30C3ul;
    x = (x | x << 2) & 0x1249249249249249ul;
    return x;
}

/// Code the centres of the kept triangles on a cubic grid over their bounds.
///
/// reads   centers; triangles[0, count), the kept ones; bounds, of the centres
/// writes  codes[0, count)
kernel void make_codes(
    global const float *centers,
    global const uint *triangles,
    global const float *bounds,
    global ulong *codes,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    float half_size = 0.0f;
    for (uint axis = 0; axis < 3; ++axis)
        half_size = max(half_size, 0.5f * bounds[3 + axis] - 0.5f * bounds[axis]);
    const uint top = (1u << GRID_BITS) - 1;
    ulong code = 0;
    for (uint axis = 0; axis < 3; ++axis) {
        const float center = centers[3 * (size_t)triangles[i] + axis];
        const float from_low = 0.5f * center - 0.5f * bounds[axis];
        const float part = half_size > 0.0f ? from_low / half_size : 0.0f;
        const uint cell = min((uint)(part * (float)(1u << GRID_BITS)), top);
        code |= spread_bits(cell) << (2 - axis);
    }
    codes[i] = code;
}

/// Length of the common prefix of the keys at two places, -1 if j is no place.
///
/// A key is the code followed by the place itself, so that no two are equal: the tree is at most
/// 63 + 32 levels deep.
static inline int common_prefix(global const ulong *codes, uint count, uint i, int j)
{
    if (j < 0 || j >= (int)count)
        return -1;
    const ulong difference = codes[i] ^ codes[j];
    return difference != 0 ? (int)clz(difference) : 64 + (int)clz(i ^ (uint)j);
}

/// Find the inner nodes of the binary tree and the first place of each block.
///
/// One work item an inner node, at least one.
///
/// reads   codes[0, count), sorted
/// writes  ends, splits, parents [node]; starts_block[place], set where a block starts, and there
///         block_parents[place], the inner node above the block (NO_NODE if the block is all)
kernel void find_nodes(
    global const ulong *codes,
    global uint *ends,
    global uint *splits,
    global uint *parents,
    global uint *starts_block,
    global uint *block_parents,
    const uint count)
{
    const uint node = get_global_id(0);
    if (node == 0) {
        parents[0] = NO_NODE;
        if (count <= BLOCK_TRIANGLES) {
            starts_block[0] = 1;
            block_parents[0] = NO_NODE;
        }
    }
    if (node + 1 >= count)
        return;
    const int i = (int)node;
    const int with_next = common_prefix(codes, count, node, i + 1);
    const int step = with_next > common_prefix(codes, count, node, i - 1) ? 1 : -1;

    // The node covers all places that share more than it shares with its other neighbour.
    const int outside = common_prefix(codes, count, node, i - step);
    uint reach = 2;
    while (common_prefix(codes, count, node, (int)min(reach, count) * step + i) > outside)
        reach *= 2;
    uint length = 0;
    for (uint part = reach / 2; part > 0; part /= 2) {
        if (common_prefix(codes, count, node, i + (int)(length + part) * step) > outside)
            length += part;
    }
    const int end = i + (int)length * step;
    ends[node] = (uint)end;

    // It parts where the common prefix of the whole ends.
    const int inside = common_prefix(codes, count, node, end);
    uint shared = 0;
    for (uint part = reach / 2; part > 0; part /= 2) {
        if (shared + part < length
            && common_prefix(codes, count, node, i + (int)(shared + part) * step) > inside)
            shared += part;
    }
    const uint split = step > 0 ? (uint)i + shared : (uint)i - shared - 1;
    splits[node] = split;

    const uint first = (uint)min(i, end);
    const uint last = (uint)max(i, end);
    if (split > first)
        parents[split] = node;
    if (split + 1 < last)
        parents[split + 1] = node;
    if (length + 1 <= BLOCK_TRIANGLES)
        return;
    if (split - first < BLOCK_TRIANGLES) {
        starts_block[first] = 1;
        block_parents[first] = node;
    }
    if (last - split <= BLOCK_TRIANGLES) {
        starts_block[split + 1] = 1;
        block_parents[split + 1] = node;
    }
}

/// Copy the triangles of each block side by side.
///
/// reads   positions; triangles[0, count), sorted; starts[block], its first place;
///         alpha_flags[triangle] if has_alpha
/// writes  blocks[0, block_count)
kernel void fill_blocks(
    global const float *positions,
    global const uint *triangles,
    global const uint *starts,
    global const uint *alpha_flags,
    global TriangleBlock *blocks,
    const uint has_alpha,
    const uint block_count,
    const uint count)
{
    const uint index = get_global_id(0);
    if (index >= block_count)
        return;
    const uint first = starts[index];
    const uint end = index + 1 < block_count ? starts[index + 1] : count;
    global TriangleBlock *block = &blocks[index];
    for (uint lane = 0; lane < BLOCK_TRIANGLES; ++lane) {
        const bool used = first + lane < end;
        const uint triangle = used ? triangles[first + lane] : 0;
        for (uint k = 0; k < 9; ++k)
            block->v[k][lane] = used ? positions[9 * (size_t)triangle + k] : NAN;
        const uint alpha = has_alpha && alpha_flags[triangle] != 0 ? ALPHA_BIT : 0;
        block->id[lane] = used ? triangle | alpha : NO_HIT;
    }
}

static inline Box block_box(global const TriangleBlock *block)
{
    Box box = empty_box();
    for (uint k = 0; k < 9; ++k)
        for (uint lane = 0; lane < BLOCK_TRIANGLES; ++lane)
            grow_box(&box, k % 3, block->v[k][lane]);
    return box;
}

/// The places that a subtree covers, and its parts.
typedef struct {
    uint first;
    uint size;
    uint left;
    uint right;
} Subtree;

static inline Subtree find_subtree(
    global const uint *ends, global const uint *splits, uint subtree)
{
    Subtree found;
    found.first = subtree & ~LEAF_BIT;
    found.size = 1;
    found.left = subtree;
    found.right = subtree;
    if ((subtree & LEAF_BIT) == 0) {
        const uint end = ends[subtree];
        const uint split = splits[subtree];
        const uint last = max(subtree, end);
        found.first = min(subtree, end);
        found.size = last - found.first + 1;
        found.left = split == found.first ? LEAF_BIT | split : split;
        found.right = split + 1 == last ? LEAF_BIT | last : split + 1;
    }
    return found;
}

/// Box of a subtree that is a block, or whose box is already in `boxes`.
static inline Box subtree_box(
    global const uint *ends,
    global const uint *splits,
    global const uint *ranks,
    global const TriangleBlock *blocks,
    volatile global const float *boxes,
    uint subtree)
{
    const Subtree found = find_subtree(ends, splits, subtree);
    if (found.size <= BLOCK_TRIANGLES)
        return block_box(&blocks[ranks[found.first]]);
    Box box;
    for (uint axis = 0; axis < 3; ++axis) {
        box.low[axis] = boxes[6 * (size_t)subtree + axis];
        box.high[axis] = boxes[6 * (size_t)subtree + 3 + axis];
    }
    return box;
}

/// Box the inner nodes above the blocks, each by the second of the two work items that reach it.
///
/// Which one that is does not matter: it reads both children.
///
/// reads   blocks; starts[block]; ends, splits, parents, block_parents; ranks[place], the block
///         that starts there
/// writes  boxes[6 * node + (0..5)]; visits[node], zero before
kernel void fit_boxes(
    global const TriangleBlock *blocks,
    global const uint *starts,
    global const uint *ranks,
    global const uint *ends,
    global const uint *splits,
    global const uint *parents,
    global const uint *block_parents,
    volatile global uint *visits,
    volatile global float *boxes,
    const uint block_count)
{
    const uint index = get_global_id(0);
    if (index >= block_count)
        return;
    uint node = block_parents[starts[index]];
    while (node != NO_NODE) {
        // Boxes written before the count went up are seen by whoever finds it raised.
        mem_fence(CLK_GLOBAL_MEM_FENCE);
        if (atomic_inc(&visits[node]) == 0)
            break;
        mem_fence(CLK_GLOBAL_MEM_FENCE);
        const Subtree parts = find_subtree(ends, splits, node);
        const Box left = subtree_box(ends, splits, ranks, blocks, boxes, parts.left);
        const Box right = subtree_box(ends, splits, ranks, blocks, boxes, parts.right);
        for (uint axis = 0; axis < 3; ++axis) {
            boxes[6 * (size_t)node + axis] = min(left.low[axis], right.low[axis]);
            boxes[6 * (size_t)node + 3 + axis] = max(left.high[axis], right.high[axis]);
        }
        node = parents[node];
    }
}

/// Choose the children of a wide node: open the largest inner subtree until there are eight.
///
/// Opens `subtree` itself first, unless it is a block (or nothing): then that is the only child.
/// Returns the number of children; writes them and their first places and sizes.
static inline uint open_subtree(
    global const uint *ends,
    global const uint *splits,
    global const float *boxes,
    uint subtree,
    uint count,
    Subtree *children,
    uint *names)
{
    if (count == 0)
        return 0;
    // Sizes relative to the whole keep the areas in the range of float.
    float whole = 0.0f;
    for (uint axis = 0; axis < 3 && count > BLOCK_TRIANGLES; ++axis)
        whole = max(whole, 0.5f * boxes[3 + axis] - 0.5f * boxes[axis]);
    const float scale = whole > 0.0f ? 0.5f / whole : 0.0f;

    float areas[NODE_CHILDREN];
    names[0] = subtree;
    children[0] = find_subtree(ends, splits, subtree);
    areas[0] = 0.0f;
    uint filled = 1;
    while (filled < NODE_CHILDREN) {
        uint widest = NODE_CHILDREN;
        for (uint k = 0; k < filled; ++k) {
            if (children[k].size > BLOCK_TRIANGLES
                && (widest == NODE_CHILDREN || areas[k] > areas[widest]))
                widest = k;
        }
        if (widest == NODE_CHILDREN)
            break;
        const Subtree opened = children[widest];
        for (uint part = 0; part < 2; ++part) {
            const uint k = part == 0 ? widest : filled;
            names[k] = part == 0 ? opened.left : opened.right;
            children[k] = find_subtree(ends, splits, names[k]);
            areas[k] = 0.0f;
            if (children[k].size > BLOCK_TRIANGLES) {
                global const float *box = boxes + 6 * (size_t)names[k];
                const float x = box[3] * scale - box[0] * scale;
                const float y = box[4] * scale - box[1] * scale;
                const float z = box[5] * scale - box[2] * scale;
                areas[k] = x * y + y * z + z * x;
            }
        }
        ++filled;
    }
    return filled;
}

/// Count the inner children of each wide node of a level.
///
/// reads   wide[level_start + i], the subtree of each wide node; ends, splits, boxes
/// writes  inner_counts[i]
kernel void count_children(
    global const uint *ends,
    global const uint *splits,
    global const float *boxes,
    global const uint *wide,
    global uint *inner_counts,
    const uint level_start,
    const uint level_count,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= level_count)
        return;
    Subtree children[NODE_CHILDREN];
    uint names[NODE_CHILDREN];
    const uint filled =
        open_subtree(ends, splits, boxes, wide[level_start + i], count, children, names);
    uint inner = 0;
    for (uint k = 0; k < filled; ++k)
        inner += children[k].size > BLOCK_TRIANGLES ? 1 : 0;
    inner_counts[i] = inner;
}

/// Give the inner children of each wide node of a level their places in the next level.
///
/// reads   as count_children; offsets[i], the exclusive scan of inner_counts
/// writes  wide[level_start + level_count ...], first_children[level_start + i]
kernel void place_children(
    global const uint *ends,
    global const uint *splits,
    global const float *boxes,
    global uint *wide,
    global uint *first_children,
    global const uint *offsets,
    const uint level_start,
    const uint level_count,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= level_count)
        return;
    Subtree children[NODE_CHILDREN];
    uint names[NODE_CHILDREN];
    const uint filled =
        open_subtree(ends, splits, boxes, wide[level_start + i], count, children, names);
    uint next = level_start + level_count + offsets[i];
    first_children[level_start + i] = next;
    for (uint k = 0; k < filled; ++k) {
        if (children[k].size > BLOCK_TRIANGLES)
            wide[next++] = names[k];
    }
}

/// Write the wide nodes.
///
/// reads   wide, first_children [0, node_count); ranks; blocks; ends, splits, boxes
/// writes  nodes[0, node_count)
kernel void fill_nodes(
    global const uint *ends,
    global const uint *splits,
    global const float *boxes,
    global const uint *wide,
    global const uint *first_children,
    global const uint *ranks,
    global const TriangleBlock *blocks,
    global BvhNode *nodes,
    const uint node_count,
    const uint count)
{
    const uint index = get_global_id(0);
    if (index >= node_count)
        return;
    Subtree children[NODE_CHILDREN];
    uint names[NODE_CHILDREN];
    const uint filled = open_subtree(ends, splits, boxes, wide[index], count, children, names);
    global BvhNode *node = &nodes[index];
    uint next = first_children[index];
    for (uint k = 0; k < NODE_CHILDREN; ++k) {
        Box box = empty_box();
        uint child = 0;
        float reach = 0.0f;
        if (k < filled) {
            box = subtree_box(ends, splits, ranks, blocks, boxes, names[k]);
            const bool inner = children[k].size > BLOCK_TRIANGLES;
            child = inner ? next++ : LEAF_BIT | ranks[children[k].first];
            for (uint axis = 0; axis < 3; ++axis)
                reach = max(reach, max(fabs(box.low[axis]), fabs(box.high[axis])));
        }
        for (uint axis = 0; axis < 3; ++axis) {
            node->bounds[2 * axis][k] = box.low[axis] - BOX_SLACK * reach;
            node->bounds[2 * axis + 1][k] = box.high[axis] + BOX_SLACK * reach;
        }
        node->child[k] = child;
        node->unused[k] = 0;
    }
}
