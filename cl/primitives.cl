// Scan, compaction and reduction over chunks: each work item walks one run of consecutive items.
//
// Nothing is assumed about which chunk runs when, and there are no barriers: what joins the chunks
// is the order of the launches.

/// Sum the items of each chunk.
///
/// reads   values[0, count)
/// writes  sums[chunk]
kernel void sum_chunks(
    global const uint *values,
    global uint *sums,
    const uint count,
    const uint chunk_items,
    const uint chunk_count)
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunk_count)
        return;
    const uint begin = chunk * chunk_items;
    const uint end = min(begin + chunk_items, count);
    uint sum = 0;
    for (uint i = begin; i < end; ++i)
        sum += values[i];
    sums[chunk] = sum;
}

/// Replace the sums by what lies before each chunk, in one work item.
///
/// reads   sums[0, chunk_count)
/// writes  sums[0, chunk_count), total[0]
kernel void scan_sums(
    global uint *sums,
    global uint *total,
    const uint chunk_count)
{
    if (get_global_id(0) != 0)
        return;
    uint before = 0;
    for (uint chunk = 0; chunk < chunk_count; ++chunk) {
        const uint sum = sums[chunk];
        sums[chunk] = before;
        before += sum;
    }
    total[0] = before;
}

/// Write the exclusive prefix sums.
///
/// reads   values[0, count), sums[chunk]
/// writes  target[0, count); may be values itself
kernel void scan_chunks(
    global const uint *values,
    global uint *target,
    global const uint *sums,
    const uint count,
    const uint chunk_items,
    const uint chunk_count)
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunk_count)
        return;
    const uint begin = chunk * chunk_items;
    const uint end = min(begin + chunk_items, count);
    uint before = sums[chunk];
    for (uint i = begin; i < end; ++i) {
        const uint value = values[i];
        target[i] = before;
        before += value;
    }
}

/// Write the index of each set flag to the place that its rank names.
///
/// reads   flags[0, count), each 0 or 1; ranks[0, count), their exclusive prefix sums
/// writes  indices[0, number of set flags)
kernel void scatter_set(
    global const uint *flags,
    global const uint *ranks,
    global uint *indices,
    const uint count)
{
    const uint i = get_global_id(0);
    if (i < count && flags[i] != 0)
        indices[ranks[i]] = i;
}

/// Bound the points of each chunk, component by component, leaving out NaN.
///
/// reads   points[0, 3 * count)
/// writes  partial[6 * chunk + (0..5)]: low x, y, z, high x, y, z; inverted if there is nothing
kernel void bound_chunks(
    global const float *points,
    global float *partial,
    const uint count,
    const uint chunk_items,
    const uint chunk_count)
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunk_count)
        return;
    const size_t begin = (size_t)chunk * chunk_items;
    const size_t end = min(begin + chunk_items, (size_t)count);
    float low[3] = {INFINITY, INFINITY, INFINITY};
    float high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (size_t i = begin; i < end; ++i) {
        for (uint axis = 0; axis < 3; ++axis) {
            const float x = points[3 * i + axis];
            // The order of the operands keeps the old value when x is NaN.
            low[axis] = x < low[axis] ? x : low[axis];
            high[axis] = x > high[axis] ? x : high[axis];
        }
    }
    for (uint axis = 0; axis < 3; ++axis) {
        partial[6 * chunk + axis] = low[axis];
        partial[6 * chunk + 3 + axis] = high[axis];
    }
}

/// Join the bounds of the chunks, one work item per component.
///
/// reads   partial[0, 6 * chunk_count)
/// writes  bounds[0, 6)
kernel void join_bounds(
    global const float *partial,
    global float *bounds,
    const uint chunk_count)
{
    const uint component = get_global_id(0);
    if (component >= 6)
        return;
    float value = component < 3 ? INFINITY : -INFINITY;
    for (uint chunk = 0; chunk < chunk_count; ++chunk) {
        const float x = partial[6 * chunk + component];
        const bool better = component < 3 ? x < value : x > value;
        value = better ? x : value;
    }
    bounds[component] = value;
}
