"""The queue scheduler: keeps the path pool full, pass after pass, until the budget is spent."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psf_cl.device.layout import COUNTER_INDEX, RAY_KINDS, rays_so_far

if TYPE_CHECKING:
    import numpy as np

#: Work that may be in flight before the host looks: Ctrl-C and time budgets react this fast.
BATCH_SECONDS = 0.05

#: Bounces in flight at most, and rays that a path of a full pool traces in each.
MAX_BOUNCES = 256
RAYS_PER_BOUNCE = 1.7

#: Passes of a render that has no number of them: counters of passes have 32 bits.
MAX_PASSES = 1 << 31

#: Bounces between two looks of the film at the ring of samples.
BOUNCES_PER_FILM = 4

#: Passes of the longest epoch, but of small pictures: what is learned or emitted between epochs is
#: that old at most.
MAX_EPOCH = 64


#: Samples below which the longest epoch of a small picture does not stay: between epochs the pool
#: drains, and photons are emitted for all that follows.
MAX_EPOCH_SAMPLES = 1 << 18


def longest_epoch(pixel_count: int) -> int:
    """Return the passes of the longest epoch of a picture."""
    return max(MAX_EPOCH, MAX_EPOCH_SAMPLES // pixel_count)


def doubling_epoch(start: int, shortest: int = 1, longest: int = MAX_EPOCH) -> int:
    """Return the pass before which the epoch ends that starts with pass ``start``.

    Epochs are 1, 1, 2, 4 .. ``longest`` passes long, or so many times ``shortest`` up to at least
    that: draining the pool soon costs next to nothing.
    """
    return start + max(min(max(start, 1), longest), shortest)


@dataclass(frozen=True)
class Progress:
    """How far a render is; handed to the progress callback."""

    passes: int
    spp_target: int | None
    seconds: float
    seconds_target: float | None
    samples_per_second: float


@dataclass(frozen=True)
class Hooks:
    """What the scheduler drives; the renderer says what each does.

    Attributes:
        bounce: enqueue one bounce of every path in the pool.
        film: enqueue adding the complete passes to the film.
        counters: wait, and return the counters.
        limit: set the first pass that must not be started.
        between: enqueue what happens while no path is on its way, before the pass that is named.
    """

    bounce: Callable[[], None]
    film: Callable[[], None]
    counters: Callable[[], np.ndarray]
    limit: Callable[[int], None]
    between: Callable[[int], None] = lambda start: None


class Clock:
    """Seconds spent on rendering: it can be stopped while something else is done."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.started: float | None = None

    def start(self) -> None:
        self.started = time.perf_counter()

    def stop(self) -> None:
        if self.started is not None:
            self.seconds += time.perf_counter() - self.started
            self.started = None

    def now(self) -> float:
        running = 0.0 if self.started is None else time.perf_counter() - self.started
        return self.seconds + running


class Scheduler:
    """Runs passes.  Paths of later passes go on in the pool from one call to the next.

    Tables that must not change while paths read them are written between epochs: runs of passes at
    whose end the pool is empty.  Where they end depends on the number of the pass alone.

    Args:
        epoch_end: the pass before which the epoch ends that starts with a pass; None if nothing is
            done between passes, so that the pool never needs to drain.

    Attributes:
        first: the first pass of this frame; passes are counted on from frame to frame.
        passes: whole passes that the film holds, those of this frame.
        rays: traced until the last look at the counters, by kind.
        clock: seconds spent in ``run``.
        stop: first pass that may not start.
    """

    def __init__(
        self, hooks: Hooks, slots: int, epoch_end: Callable[[int], int] | None = None
    ) -> None:
        self.hooks = hooks
        self.slots = slots
        self.epoch_end = epoch_end
        self.rays: dict[str, int] = {}
        self.bounces = 1
        self.begin_frame()

    def begin_frame(self, first: int = 0) -> None:
        """Count passes from ``first`` on as those of a new frame; the pool must be empty."""
        self.first = first
        self.epoch = range(0 if self.epoch_end is not None else MAX_PASSES)
        self.passes = 0
        self.stop = 0
        self.started = 0
        self.resting = False
        self.clock = Clock()

    @property
    def at_rest(self) -> bool:
        """Return whether tables and film are those of whole passes alone.

        Without epochs they always are: what is on its way has left no trace.
        """
        return self.epoch_end is None or self.passes >= self.stop

    @property
    def begun(self) -> int:
        """Return how many passes have begun, those included that have ended."""
        return min(self.started, self.stop)

    def rest(self) -> None:
        """Start no further pass until ``at_rest`` was seen once: a moment to save everything.

        What is rendered does not change.  Without epochs there is nothing to wait for.
        """
        self.resting = self.epoch_end is not None

    def resume(self, passes: int, epoch: tuple[int, int], seconds: float) -> None:
        """Go on where another scheduler was at rest."""
        self.passes = passes
        self.epoch = range(*epoch)
        self.clock.seconds = seconds

    def run(
        self,
        spp: int | None,
        seconds: float | None,
        progress: Callable[[Progress], bool | None] | None = None,
    ) -> bool:
        """Add passes until there are ``spp``, or the pass ends in which ``seconds`` are spent.

        Clocks decide only how many passes there are, never what is in them.

        Args:
            progress: called after every batch; False stops at once.

        Returns:
            Whether it came to its end, that is, was not stopped.
        """
        self._look_at_rays(self.hooks.counters())
        first_samples, last_rays = self.rays["camera"], sum(self.rays.values())
        first_seconds = self.clock.now()
        limit = MAX_PASSES if spp is None else spp
        self.clock.start()
        try:
            self._start(limit)
            while self.passes < limit:
                begin = time.perf_counter()
                for bounce in range(self.bounces):
                    self.hooks.bounce()
                    if (bounce + 1) % BOUNCES_PER_FILM == 0 or bounce + 1 == self.bounces:
                        self.hooks.film()
                counters = self.hooks.counters()
                self.passes = int(counters[COUNTER_INDEX["film_pass"]]) - self.first
                self.started = int(counters[COUNTER_INDEX["next_pass"]]) + 1 - self.first
                self._look_at_rays(counters)
                rays = sum(self.rays.values())
                self._adapt(time.perf_counter() - begin, rays - last_rays)
                last_rays = rays
                now = self.clock.now()
                if progress is not None:
                    samples = self.rays["camera"] - first_samples
                    rate = samples / max(now - first_seconds, 1e-9)
                    if progress(Progress(self.passes, spp, now, seconds, rate)) is False:
                        return False
                if self.resting:
                    self._rest(limit)
                if seconds is not None and now >= seconds:
                    # The pass in which the budget ends is finished; later ones are not begun.
                    # Where tables change with every pass, what has begun of an epoch is finished.
                    begun = 0 if self.epoch_end is None else self.begun
                    limit, seconds = min(max(self.passes + 1, begun), MAX_PASSES), None
                    self._start(limit)
                elif self.passes == self.epoch.stop < limit:
                    self._start(limit)
            return True
        finally:
            self.clock.stop()

    def _start(self, limit: int) -> None:
        """Let passes start up to ``limit``, or up to the end of the epoch."""
        if self.epoch_end is not None and self.passes == self.epoch.stop < limit:
            self.hooks.between(self.first + self.passes)
            self.epoch = range(self.passes, self.epoch_end(self.passes))
        self._stop_at(min(limit, self.epoch.stop))

    def _rest(self, limit: int) -> None:
        """Let the passes that have begun come to their end; then go on."""
        if self.passes >= self.stop:
            self.resting = False
            self._start(limit)
        elif self.stop > self.started:
            self._stop_at(self.started)

    def _stop_at(self, passes: int) -> None:
        self.stop = passes
        self.hooks.limit(self.first + passes)

    def _look_at_rays(self, counters: np.ndarray) -> None:
        self.rays = {kind: rays_so_far(counters, kind) for kind in RAY_KINDS}

    def _adapt(self, seconds: float, rays: int) -> None:
        """Let the next batch take about BATCH_SECONDS, even if the pool is full from now on.

        A batch of a pool that is nearly empty says little: its few rays look slow, which errs on
        the side of too little work in flight.
        """
        if rays > 0:
            bounce_seconds = seconds / rays * self.slots * RAYS_PER_BOUNCE
            self.bounces = min(max(int(BATCH_SECONDS / bounce_seconds), 1), MAX_BOUNCES)
