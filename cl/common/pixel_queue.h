// Pixels that a work item takes in blocks of W; what only few of a block need is put off until as many wait for
// it as there are lanes.
#pragma once

#include "lanes.h"

/// Pixels from `next` to `end`, and those of the ones before that wait.
typedef struct {
    uint next;
    uint end;
    uint count; // of those that wait
    uint waiting[2u * W];
} PixelQueue;

/// W pixels, one after the other or such that have waited.
typedef struct {
    UInt pixel; // of the first lane where nothing is inside: no other work item writes what it has
    Mask inside;
    int waited;
} PixelBlock;

/// The pixels of one work item in kernels that take RUN blocks of them.
static inline PixelQueue pixel_queue(uint pixel_count)
{
    PixelQueue queue;
    queue.next = min((uint)get_global_id(0) * (W * RUN), pixel_count);
    queue.end = min(queue.next + W * RUN, pixel_count);
    queue.count = 0u;
    return queue;
}

/// Take the next block: of pixels that wait where they fill one, or nothing else is left.  Whether there is one.
static inline int take_block(PixelQueue *queue, PixelBlock *block)
{
    const UInt lane = lanes_before(MASK_ALL);
    block->waited = queue->count >= W || queue->next >= queue->end;
    if (block->waited) {
        const uint taken = min(queue->count, (uint)W);
        if (taken == 0u)
            return 0;
        queue->count -= taken;
        const uint *waiting = queue->waiting + queue->count;
        block->inside = lane < taken;
        block->pixel = pick_u(block->inside, load_lanes_u(waiting), (UInt)(waiting[0]));
        return 1;
    }
    block->inside = lane + queue->next < queue->end;
    block->pixel = pick_u(block->inside, lane + queue->next, (UInt)(queue->next));
    queue->next += W;
    return 1;
}

/// Let the lanes of `mask` wait, unless they have; returns those that do.  A single lane never waits.
static inline Mask put_off(PixelQueue *queue, const PixelBlock *block, Mask mask)
{
#if W > 1
    if (!block->waited) {
        uint lane_pixel[W];
        store_lanes_u(block->pixel, lane_pixel);
        for (uint left = lane_bits(mask); left; left &= left - 1u)
            queue->waiting[queue->count++] = lane_pixel[lowest_bit(left)];
        return mask;
    }
#endif
    return (Mask)(0);
}
