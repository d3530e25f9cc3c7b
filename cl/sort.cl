// Stable radix sort, least significant digit first, 8 bits a pass, over chunks of consecutive
// items.
//
// The table has a column a chunk and a row a digit, so that its exclusive scan gives each chunk the
// places of its items: all of a digit together, and within a digit in the order of the chunks.

#if KEY_BITS == 64
#define Key ulong
#else
#define Key uint
#endif

/// Count how often each digit occurs in each chunk.
///
/// reads   keys[0, count)
/// writes  table[digit * chunk_count + chunk]
kernel void count_digits(
    global const Key *keys,
    global uint *table,
    const uint count,
    const uint chunk_items,
    const uint chunk_count,
    const uint shift)
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunk_count)
        return;
    const uint begin = chunk * chunk_items;
    const uint end = min(begin + chunk_items, count);
    uint counts[256];
    for (uint digit = 0; digit < 256; ++digit)
        counts[digit] = 0;
    for (uint i = begin; i < end; ++i)
        ++counts[(uint)(keys[i] >> shift) & 255u];
    for (uint digit = 0; digit < 256; ++digit)
        table[digit * chunk_count + chunk] = counts[digit];
}

/// Move keys and values to their places.
///
/// reads   keys, values [0, count); table, scanned
/// writes  sorted_keys, sorted_values [0, count)
kernel void scatter_digits(
    global const Key *keys,
    global const uint *values,
    global Key *sorted_keys,
    global uint *sorted_values,
    global const uint *table,
    const uint count,
    const uint chunk_items,
    const uint chunk_count,
    const uint shift)
{
    const uint chunk = get_global_id(0);
    if (chunk >= chunk_count)
        return;
    const uint begin = chunk * chunk_items;
    const uint end = min(begin + chunk_items, count);
    uint places[256];
    for (uint digit = 0; digit < 256; ++digit)
        places[digit] = table[digit * chunk_count + chunk];
    for (uint i = begin; i < end; ++i) {
        const Key key = keys[i];
        const uint place = places[(uint)(key >> shift) & 255u]++;
        sorted_keys[place] = key;
        sorted_values[place] = values[i];
    }
}
