// The tree, built in steps: triangles in Morton order, a binary tree over them from the bottom up,
// wide nodes from the top down, their bounds from the bottom up.
//
// Node i < count of the binary tree is the leaf of the i-th triangle in Morton order; inner nodes
// follow as they are made, so that children come before their parents.
//
// *Clusters*, the roots of the forest so far, stay in Morton order.  Each looks for the neighbour
// with which it would make the smallest box; where two choose each other they become one.
// Meister, Bittner: Parallel Locally-Ordered Clustering for Bounding Volume Hierarchy Construction,
// TVCG 24 (3), 2018.
//
// Which subtrees become wide nodes, and which blocks, is chosen to cost least.  Visiting either
// costs 1 (their ratio, from 1 : 2 to 2 : 1, does not matter), and a ray that meets the scene's box
// meets another with a chance proportional to its surface.
// Ylitie, Karras, Laine: Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs,
// HPG 2017, section 3.

#include "common/geometry.h"

#ifndef WIDTH
#error "WIDTH must be the most children of a node: 2, 4 or 8"
#endif
#define BLOCK_TRIANGLES 4
#define NODE_LANES 8 // of BvhNode; narrower trees leave some empty
#define NO_NODE 0xFFFFFFFFu
#define GRID_BITS 21 // of the Morton grid, an axis; 3 * 21 = 63 key bits
#define RADIUS 16 // how far clusters look for a neighbour, in places; a multiple of 8

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

/// A triangle's corners, vertex * 3 + axis.
typedef struct {
    float v[9];
    Box box;
    bool finite;
} Triangle;

static inline Triangle load_triangle(global const float *positions, uint index)
{
    Triangle triangle;
    triangle.box = empty_box();
    triangle.finite = true;
    for (uint k = 0; k < 9; ++k) {
        const float x = positions[9 * (size_t)index + k];
        triangle.v[k] = x;
        triangle.finite &= fabs(x) < INFINITY;
        grow_box(&triangle.box, k % 3, x);
    }
    return triangle;
}

static inline float half_area(float3 size)
{
    return size.x * size.y + size.y * size.z + size.z * size.x;
}

/// Find each triangle's box and whether all of its coordinates are finite.
///
/// reads   positions[0, 9 * triangle_count)
/// writes  triangle_boxes[6 * i + (0..5)]: low x, y, z, high x, y, z, NaN if dropped; kept[i], 0 or 1
kernel void prepare_triangles(
    global const float *positions,
    global float *triangle_boxes,
    global uint *kept,
    const uint triangle_count)
{
    const uint i = get_global_id(0);
    if (i >= triangle_count)
        return;
    const Triangle triangle = load_triangle(positions, i);
    for (uint axis = 0; axis < 3; ++axis) {
        triangle_boxes[6 * (size_t)i + axis] = triangle.finite ? triangle.box.low[axis] : NAN;
        triangle_boxes[6 * (size_t)i + 3 + axis] = triangle.finite ? triangle.box.high[axis] : NAN;
    }
    kept[i] = triangle.finite ? 1 : 0;
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

/// Return where a coordinate is in the scene, whose largest extent is 1.
static inline float in_frame(global const float *frame, uint axis, float x)
{
    // Halves: the difference of the two may be out of range.
    return (0.5f * x - 0.5f * frame[axis]) * frame[3];
}

/// Code the centres of the kept triangles on a cubic grid over the scene.
///
/// reads   triangle_boxes; triangles[0, count), the kept ones; frame: low x, y, z of the scene and
///         2 / its largest extent
/// writes  codes[0, count)
kernel void make_codes(
    global const float *triangle_boxes,
    global const uint *triangles,
    global const float *frame,
    global ulong *codes,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    global const float *box = triangle_boxes + 6 * (size_t)triangles[i];
    const uint top = (1u << GRID_BITS) - 1;
    ulong code = 0;
    for (uint axis = 0; axis < 3; ++axis) {
        const float middle =
            0.5f * (in_frame(frame, axis, box[axis]) + in_frame(frame, axis, box[3 + axis]));
        const uint cell = min((uint)(max(middle, 0.0f) * (float)(1u << GRID_BITS)), top);
        code |= spread_bits(cell) << (2 - axis);
    }
    codes[i] = code;
}

/// Make the leaves and a cluster of each.
///
/// reads   triangle_boxes; triangles[0, count), sorted; frame
/// writes  tree, clusters, boxes as in find_nearest [0, count)
kernel void make_leaves(
    global const float *triangle_boxes,
    global const uint *triangles,
    global const float *frame,
    global BinaryNode *tree,
    global uint *clusters,
    global float *boxes,
    const uint stride,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i >= count)
        return;
    global const float *box = triangle_boxes + 6 * (size_t)triangles[i];
    global BinaryNode *leaf = &tree[i];
    for (uint axis = 0; axis < 3; ++axis) {
        leaf->low[axis] = in_frame(frame, axis, box[axis]);
        leaf->high[axis] = in_frame(frame, axis, box[3 + axis]);
        boxes[axis * (size_t)stride + RADIUS + i] = leaf->low[axis];
        boxes[(3 + axis) * (size_t)stride + RADIUS + i] = leaf->high[axis];
    }
    leaf->left = triangles[i];
    leaf->right = LEAF_BIT;
    leaf->size = LEAF_BIT | 1;
    const float cost = half_area(vload3(0, leaf->high) - vload3(0, leaf->low));
    for (uint k = 1; k < WIDTH; ++k)
        leaf->costs[k - 1] = cost;
    clusters[i] = i;
}

/// Load a coordinate of eight neighbouring boxes.
static inline float8 load_row(global const float *boxes, uint row, size_t stride, size_t place)
{
    return vload8(0, boxes + row * stride + place);
}

/// Find for each cluster the one near it in the order with which it makes the smallest box.
///
/// Looks RADIUS places to both sides, but not beyond an aligned run of `span` places.  Of equals the
/// nearest wins, and of two as near the one on the side of its pair, so that equal boxes pair up.
///
/// reads   boxes[row * stride + RADIUS + i]: low x, y, z, high x, y, z of the clusters; what lies
///         RADIUS before and after them need only be readable
/// writes  nearest[i], a place
kernel void find_nearest(
    global const float *boxes,
    global uint *nearest,
    const uint stride,
    const uint cluster_count,
    const uint span)
{
    const uint i = get_global_id(0);
    if (i >= cluster_count)
        return;
    const int start = (int)(i - i % span);
    const int end = (int)min(span, cluster_count - (uint)start) + start;
    float own[6];
    for (uint row = 0; row < 6; ++row)
        own[row] = boxes[row * (size_t)stride + RADIUS + i];
    float8 least = (float8)(INFINITY);
    // Twice the distance, and 1 more on the side away from its pair.
    int8 rank = (int8)(INT_MAX);
    for (int group = 0; group < 2 * RADIUS / 8; ++group) {
        // Groups end before i and begin after it.
        const int offset = group < RADIUS / 8 ? -8 * (group + 1) : 8 * (group - RADIUS / 8) + 1;
        const size_t place = (size_t)((int)i + offset + RADIUS);
        const float8 x = max(own[3], load_row(boxes, 3, stride, place))
                         - min(own[0], load_row(boxes, 0, stride, place));
        const float8 y = max(own[4], load_row(boxes, 4, stride, place))
                         - min(own[1], load_row(boxes, 1, stride, place));
        const float8 z = max(own[5], load_row(boxes, 5, stride, place))
                         - min(own[2], load_row(boxes, 2, stride, place));
        const float8 area = x * y + y * z + z * x;
        const int8 distance = offset + (int8)(0, 1, 2, 3, 4, 5, 6, 7);
        const int8 j = (int)i + distance;
        const int side = offset > 0 ? 1 : -1;
        const int8 found = 2 * side * distance + (((i & 1) == 0) == (side > 0) ? 0 : 1);
        const int8 better = (j >= start) & (j < end)
                            & ((area < least) | ((area == least) & (found < rank)));
        least = better ? area : least;
        rank = better ? found : rank;
    }
    float lane_least[8];
    int lane_rank[8];
    vstore8(least, 0, lane_least);
    vstore8(rank, 0, lane_rank);
    float best = INFINITY;
    int best_rank = INT_MAX;
    for (uint k = 0; k < 8; ++k) {
        if (lane_least[k] < best || (lane_least[k] == best && lane_rank[k] < best_rank)) {
            best = lane_least[k];
            best_rank = lane_rank[k];
        }
    }
    const bool up = ((i & 1) == 0) == ((best_rank & 1) == 0);
    nearest[i] = best == INFINITY ? i : up ? i + best_rank / 2 : i - best_rank / 2;
}

/// Mark the clusters that stay, alone or as the lower of a pair.
///
/// reads   nearest[0, cluster_count)
/// writes  places[i], 0 or 1; to be scanned
kernel void mark_staying(
    global const uint *nearest,
    global uint *places,
    const uint cluster_count)
{
    const uint i = get_global_id(0);
    if (i >= cluster_count)
        return;
    const uint other = nearest[i];
    places[i] = other < i && nearest[other] == i ? 0 : 1;
}

/// Find the least cost of a subtree as 1, at most 2 ... WIDTH - 1 children of a wide node.
static inline void weigh_node(global BinaryNode *tree, uint index)
{
    global BinaryNode *node = &tree[index];
    float left[WIDTH];
    float right[WIDTH];
    for (uint k = 1; k < WIDTH; ++k) {
        left[k] = tree[node->left].costs[k - 1];
        right[k] = tree[node->right].costs[k - 1];
    }
    const float area = half_area(vload3(0, node->high) - vload3(0, node->low));
    float parts[WIDTH + 1];
    for (uint k = 2; k <= WIDTH; ++k) {
        parts[k] = INFINITY;
        for (uint l = 1; l < k; ++l)
            parts[k] = min(parts[k], left[l] + right[k - l]);
    }
    float cost = parts[WIDTH] + area;
    if (node->size <= BLOCK_TRIANGLES && area <= cost) {
        cost = area;
        node->size |= LEAF_BIT;
    }
    for (uint k = 1; k < WIDTH; ++k) {
        if (k > 1)
            cost = min(cost, parts[k]);
        node->costs[k - 1] = cost;
    }
}

/// Join the pairs, and close up.
///
/// reads   clusters, boxes, nearest [0, cluster_count); places[i], how many before i stay
/// writes  next_clusters, next_boxes; tree[node_start ...], a node a pair
kernel void join_pairs(
    global BinaryNode *tree,
    global const uint *clusters,
    global const uint *nearest,
    global const uint *places,
    global uint *next_clusters,
    global const float *boxes,
    global float *next_boxes,
    const uint stride,
    const uint cluster_count,
    const uint node_start)
{
    const uint i = get_global_id(0);
    if (i >= cluster_count)
        return;
    const uint j = nearest[i];
    const bool paired = nearest[j] == i && j != i;
    if (paired && j < i)
        return;
    uint cluster = clusters[i];
    float box[6];
    for (uint row = 0; row < 6; ++row) {
        box[row] = boxes[row * (size_t)stride + RADIUS + i];
        if (paired) {
            const float x = boxes[row * (size_t)stride + RADIUS + j];
            box[row] = row < 3 ? min(box[row], x) : max(box[row], x);
        }
        next_boxes[row * (size_t)stride + RADIUS + places[i]] = box[row];
    }
    if (paired) {
        // The upper ones go: as many as do not stay.
        const uint index = node_start + (j - places[j]);
        global BinaryNode *node = &tree[index];
        node->left = cluster;
        node->right = clusters[j];
        node->size = (tree[node->left].size & ~LEAF_BIT) + (tree[node->right].size & ~LEAF_BIT);
        for (uint axis = 0; axis < 3; ++axis) {
            node->low[axis] = box[axis];
            node->high[axis] = box[3 + axis];
        }
        weigh_node(tree, index);
        cluster = index;
    }
    next_clusters[places[i]] = cluster;
}

/// Choose the children of each wide node of a level, inner ones first, each kind by surface.
///
/// A search for any hit takes the last child first: a block, and the one most likely to be met.
///
/// reads   wide[level_start + i], its binary node; tree
/// writes  children[WIDTH * (level_start + i) + k], binary nodes, NO_NODE for none; inner_counts and
///         block_counts [level_start + i]; offsets[i], to be scanned
kernel void open_nodes(
    global const BinaryNode *tree,
    global const uint *wide,
    global uint *children,
    global uint *inner_counts,
    global uint *block_counts,
    global uint *offsets,
    const uint level_start,
    const uint level_count)
{
    const uint i = get_global_id(0);
    if (i >= level_count)
        return;
    const uint index = level_start + i;
    // What waits to be split further: a binary node and how many children it may become.
    uint names[WIDTH];
    uint shares[WIDTH];
    names[0] = wide[index];
    shares[0] = WIDTH;
    uint waiting = 1;
    uint chosen[WIDTH];
    float areas[WIDTH];
    uint inner = 0;
    uint filled = 0;
    while (waiting > 0) {
        --waiting;
        const uint name = names[waiting];
        uint share = shares[waiting];
        global const BinaryNode *node = &tree[name];
        const bool block = (node->size & LEAF_BIT) != 0;
        while (share > 1 && share < WIDTH && node->costs[share - 1] == node->costs[share - 2])
            --share;
        // With all shares it is the node itself, which is not its own child, or the only block.
        if (share == 1 || (share == WIDTH && block)) {
            const float area = half_area(vload3(0, node->high) - vload3(0, node->low));
            uint place = filled++;
            for (; place > 0; --place) {
                const bool same_kind = block == (place > inner);
                if (same_kind ? areas[place - 1] <= area : block)
                    break;
                chosen[place] = chosen[place - 1];
                areas[place] = areas[place - 1];
            }
            chosen[place] = name;
            areas[place] = area;
            inner += block ? 0 : 1;
            continue;
        }
        float least = INFINITY;
        uint for_left = 1;
        for (uint k = 1; k < share; ++k) {
            const float cost =
                tree[node->left].costs[k - 1] + tree[node->right].costs[share - k - 1];
            if (cost < least) {
                least = cost;
                for_left = k;
            }
        }
        names[waiting] = node->left;
        shares[waiting++] = for_left;
        names[waiting] = node->right;
        shares[waiting++] = share - for_left;
    }
    for (uint k = 0; k < WIDTH; ++k)
        children[WIDTH * (size_t)index + k] = k < filled ? chosen[k] : NO_NODE;
    inner_counts[index] = inner;
    block_counts[index] = filled - inner;
    offsets[i] = inner;
}

/// Make the inner children of each wide node of a level the next level.
///
/// reads   children, inner_counts; offsets[i], how many inner children the level has before
/// writes  wide[level_start + level_count ...]; firsts[level_start + i], the first of its own
kernel void list_children(
    global const uint *children,
    global const uint *inner_counts,
    global const uint *offsets,
    global uint *wide,
    global uint *firsts,
    const uint level_start,
    const uint level_count)
{
    const uint i = get_global_id(0);
    if (i >= level_count)
        return;
    const uint index = level_start + i;
    const uint first = level_start + level_count + offsets[i];
    firsts[index] = first;
    for (uint k = 0; k < inner_counts[index]; ++k)
        wide[first + k] = children[WIDTH * (size_t)index + k];
}

/// Count what lies below each wide node of a level, which the level below has done already.
///
/// reads   firsts, inner_counts, block_counts
/// writes  nodes_below, blocks_below
kernel void count_below(
    global const uint *firsts,
    global const uint *inner_counts,
    global const uint *block_counts,
    global uint *nodes_below,
    global uint *blocks_below,
    const uint level_start,
    const uint level_count)
{
    if (get_global_id(0) >= level_count)
        return;
    const uint index = level_start + get_global_id(0);
    uint nodes = inner_counts[index];
    uint blocks = block_counts[index];
    for (uint k = 0; k < inner_counts[index]; ++k) {
        nodes += nodes_below[firsts[index] + k];
        blocks += blocks_below[firsts[index] + k];
    }
    nodes_below[index] = nodes;
    blocks_below[index] = blocks;
}

/// Lay the tree out depth first: the children of a node side by side, then what is below each.
///
/// reads   firsts, inner_counts, block_counts, nodes_below, blocks_below; node_starts and
///         block_starts of the level, where its nodes' children begin
/// writes  places, node_starts, block_starts of the level below
kernel void place_children(
    global const uint *firsts,
    global const uint *inner_counts,
    global const uint *block_counts,
    global const uint *nodes_below,
    global const uint *blocks_below,
    global uint *places,
    global uint *node_starts,
    global uint *block_starts,
    const uint level_start,
    const uint level_count)
{
    if (get_global_id(0) >= level_count)
        return;
    const uint index = level_start + get_global_id(0);
    // The root, which is no child, comes first.
    if (index == 0) {
        places[0] = 0;
        node_starts[0] = 1;
        block_starts[0] = 0;
    }
    uint nodes = node_starts[index] + inner_counts[index];
    uint blocks = block_starts[index] + block_counts[index];
    for (uint k = 0; k < inner_counts[index]; ++k) {
        const uint child = firsts[index] + k;
        places[child] = node_starts[index] + k;
        node_starts[child] = nodes;
        block_starts[child] = blocks;
        nodes += nodes_below[child];
        blocks += blocks_below[child];
    }
}

/// Set the bounds of a child, with the slack that the rounding of its corners needs.
///
/// Whatever holds these bounds needs no more: a ray that meets them meets it.
static inline void set_bounds(global BvhNode *node, uint k, Box box)
{
    float reach = 0.0f;
    // Slack of an empty box would be infinite, and so its bounds no numbers.
    for (uint axis = 0; axis < 3 && box.low[0] <= box.high[0]; ++axis)
        reach = max(reach, max(fabs(box.low[axis]), fabs(box.high[axis])));
    for (uint axis = 0; axis < 3; ++axis) {
        node->bounds[2 * axis][k] = box.low[axis] - BOX_SLACK * reach;
        node->bounds[2 * axis + 1][k] = box.high[axis] + BOX_SLACK * reach;
    }
}

/// Link the wide nodes and fill their blocks, but for everything that depends on where corners are.
///
/// reads   tree; children, inner_counts, block_counts, places, node_starts, block_starts;
///         alpha_flags[triangle] if has_alpha
/// writes  nodes[0, node_count).child, blocks.id
kernel void link_nodes(
    global const uint *alpha_flags,
    global const BinaryNode *tree,
    global const uint *children,
    global const uint *inner_counts,
    global const uint *block_counts,
    global const uint *places,
    global const uint *node_starts,
    global const uint *block_starts,
    global BvhNode *nodes,
    global TriangleBlock *blocks,
    const uint has_alpha,
    const uint node_count)
{
    const uint index = get_global_id(0);
    if (index >= node_count)
        return;
    global BvhNode *node = &nodes[places[index]];
    const uint inner = inner_counts[index];
    for (uint k = 0; k < NODE_LANES; ++k) {
        node->unused[k] = 0;
        node->child[k] = k < inner ? node_starts[index] + k : 0;
        if (k < inner || k - inner >= block_counts[index])
            continue;
        const uint place = block_starts[index] + k - inner;
        node->child[k] = LEAF_BIT | place;
        uint waiting[BLOCK_TRIANGLES];
        waiting[0] = children[WIDTH * (size_t)index + k];
        uint count = 1;
        uint lane = 0;
        while (count > 0) {
            global const BinaryNode *below = &tree[waiting[--count]];
            if (below->right == LEAF_BIT) {
                const uint triangle = below->left;
                const uint alpha = has_alpha && alpha_flags[triangle] != 0 ? ALPHA_BIT : 0;
                blocks[place].id[lane++] = triangle | alpha;
            } else {
                waiting[count++] = below->right;
                waiting[count++] = below->left;
            }
        }
        for (; lane < BLOCK_TRIANGLES; ++lane)
            blocks[place].id[lane] = NO_HIT;
    }
}

/// Copy the triangles of each wide node's blocks side by side, and bound its children but inner ones.
///
/// A triangle that is not finite now is not there: all NaN, outside of every box.
///
/// reads   positions; places[0, node_count); nodes.child; blocks.id
/// writes  blocks.v; nodes[places].bounds
kernel void fit_blocks(
    global const float *positions,
    global const uint *places,
    global BvhNode *nodes,
    global TriangleBlock *blocks,
    const uint node_count)
{
    if (get_global_id(0) >= node_count)
        return;
    global BvhNode *node = &nodes[places[get_global_id(0)]];
    for (uint k = 0; k < NODE_LANES; ++k) {
        Box box = empty_box();
        if ((node->child[k] & LEAF_BIT) != 0) {
            global TriangleBlock *block = &blocks[node->child[k] & ~LEAF_BIT];
            for (uint lane = 0; lane < BLOCK_TRIANGLES; ++lane) {
                const uint id = block->id[lane];
                Triangle triangle;
                triangle.finite = false;
                if (id != NO_HIT)
                    triangle = load_triangle(positions, id & ~ALPHA_BIT);
                for (uint c = 0; c < 9; ++c) {
                    block->v[c][lane] = triangle.finite ? triangle.v[c] : NAN;
                    if (triangle.finite)
                        grow_box(&box, c % 3, triangle.v[c]);
                }
            }
        }
        set_bounds(node, k, box);
    }
}

/// Bound the inner children of each wide node of a level by what they hold.
///
/// reads   places; nodes of the level below
/// writes  nodes[places[level_start + i]].bounds of inner children
kernel void fit_nodes(
    global const uint *places,
    global BvhNode *nodes,
    const uint level_start,
    const uint level_count)
{
    if (get_global_id(0) >= level_count)
        return;
    global BvhNode *node = &nodes[places[level_start + get_global_id(0)]];
    for (uint k = 0; k < NODE_LANES; ++k) {
        const uint child = node->child[k];
        // The root is nobody's child: 0 is none.
        if (child == 0 || (child & LEAF_BIT) != 0)
            continue;
        for (uint axis = 0; axis < 3; ++axis) {
            float low = INFINITY;
            float high = -INFINITY;
            for (uint lane = 0; lane < NODE_LANES; ++lane) {
                low = min(low, nodes[child].bounds[2 * axis][lane]);
                high = max(high, nodes[child].bounds[2 * axis + 1][lane]);
            }
            node->bounds[2 * axis][k] = low;
            node->bounds[2 * axis + 1][k] = high;
        }
    }
}

/// Sum the areas of the children's boxes of each node.  One work item a node.
///
/// reads   nodes
/// writes  areas
kernel void measure_nodes(global const BvhNode *nodes, global float *areas, const uint node_count)
{
    const uint index = get_global_id(0);
    if (index >= node_count)
        return;
    global const BvhNode *node = &nodes[index];
    float sum = 0.0f;
    for (uint k = 0; k < NODE_LANES; ++k) {
        const float x = node->bounds[1][k] - node->bounds[0][k];
        const float y = node->bounds[3][k] - node->bounds[2][k];
        const float z = node->bounds[5][k] - node->bounds[4][k];
        // An empty box is inverted.
        if (x >= 0.0f)
            sum += x * y + y * z + z * x;
    }
    areas[index] = sum;
}
