"""The queue scheduler, driven by a pool that only counts."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from psf_cl.device.layout import COUNTER_INDEX
from psf_cl.scheduler import MAX_EPOCH, Hooks, Progress, Scheduler, doubling_epoch, longest_epoch


class CountingPool:
    """A pool in which every bounce ends a pass, and nothing passes its limit."""

    def __init__(self) -> None:
        self.last = 0
        self.finished = 0
        self.starts: list[int] = []

    def bounce(self) -> None:
        self.finished = min(self.finished + 1, self.last)

    def counters(self) -> np.ndarray:
        return counters_of(self)

    def limit(self, passes: int) -> None:
        self.last = passes

    def between(self, start: int) -> None:
        assert self.finished == start == self.last, "paths are on their way"
        self.starts.append(start)


def counters_of(pool: CountingPool, begun: int = 0) -> np.ndarray:
    values = np.zeros(max(COUNTER_INDEX.values()) + 1, np.uint32)
    values[COUNTER_INDEX["film_pass"]] = pool.finished
    values[COUNTER_INDEX["next_pass"]] = begun
    return values


def _scheduler(pool: CountingPool, in_epochs: bool = True) -> Scheduler:
    hooks = Hooks(pool.bounce, lambda: None, pool.counters, pool.limit, pool.between)
    return Scheduler(hooks, 16, doubling_epoch if in_epochs else None)


@pytest.mark.parametrize("pieces", [[40], [1, 2, 3, 4, 17, 40], [*range(1, 41)]])
def test_epochs_begin_at_the_same_passes_in_however_many_calls_they_run(
    pieces: list[int],
) -> None:
    pool = CountingPool()
    scheduler = _scheduler(pool)
    for passes in pieces:
        assert scheduler.run(passes, None)
        assert scheduler.passes == pool.finished == passes
    assert pool.starts == [0, 1, 2, 4, 8, 16, 32]


def test_epochs_also_begin_in_a_run_by_the_clock_and_after_it() -> None:
    pool = CountingPool()
    scheduler = _scheduler(pool)
    scheduler.run(None, 1e-9)
    first = scheduler.passes
    scheduler.run(first + 9, None)
    assert pool.starts == [start for start in (0, 1, 2, 4, 8, 16, 32) if start < first + 9]


def test_epochs_grow_to_a_limit() -> None:
    starts = [0]
    while starts[-1] < 1000:
        starts.append(doubling_epoch(starts[-1]))
    lengths = [after - before for before, after in pairwise(starts)]
    assert lengths[:8] == [1, 1, 2, 4, 8, 16, 32, 64]
    assert max(lengths) == lengths[-1] == MAX_EPOCH


def test_epochs_of_one_pixel_hold_as_many_samples_as_those_of_small_pictures() -> None:
    """Epochs of 64 samples took a thousand times as long as their paths did."""
    assert longest_epoch(64 * 64) == longest_epoch(8192 * 64) == MAX_EPOCH
    for pixels in (1, 10, 1000):
        assert (1 << 18) - pixels < pixels * longest_epoch(pixels) <= 1 << 18
    starts = [0]
    while starts[-1] < 10**6:
        starts.append(doubling_epoch(starts[-1], longest=longest_epoch(1)))
    assert len(starts) < 25


def test_nothing_happens_between_passes_without_epochs() -> None:
    pool = CountingPool()
    assert _scheduler(pool, in_epochs=False).run(40, None)
    assert pool.starts == [] and pool.finished == 40


def test_a_rest_comes_at_the_end_of_the_passes_that_have_begun_and_moves_no_epoch() -> None:
    pool = CountingPool()
    pool.counters = lambda: counters_of(pool, begun=pool.finished + 3)
    scheduler = _scheduler(pool)
    scheduler.bounces = 1
    rests = []

    def progress(now: Progress) -> bool:
        if now.passes in (20, 40) or scheduler.resting:
            if scheduler.at_rest:
                rests.append(now.passes)
            else:
                scheduler.rest()
        scheduler.bounces = 1
        return True

    assert scheduler.run(50, None, progress)
    # When 20 passes are done, those up to the 23rd have begun.
    assert rests == [24, 44]
    assert pool.starts == [0, 1, 2, 4, 8, 16, 32]


def test_without_epochs_every_moment_is_one_of_rest() -> None:
    pool = CountingPool()
    scheduler = _scheduler(pool, in_epochs=False)
    scheduler.rest()
    assert scheduler.at_rest and not scheduler.resting
    assert scheduler.run(40, None, lambda now: scheduler.at_rest)
