"""The queue scheduler: keeps the path pool full, pass after pass, until the budget is spent."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psf_cl.device.layout import COUNTER_INDEX, rays_so_far

if TYPE_CHECKING:
    import numpy as np

#: Work that may be in flight before the host looks: Ctrl-C and time budgets react this fast.
BATCH_SECONDS = 0.05

#: Bounces between two looks of the film at the ring of samples.
BOUNCES_PER_FILM = 4


@dataclass(frozen=True)
class Progress:
    """How far a render is; handed to the progress callback."""

    passes: int
    spp_target: int | None
    seconds: float
    seconds_target: float | None
    samples_per_second: float


@dataclass(frozen=True)
class Frame:
    """What the scheduler drives; the renderer says what each does.

    Attributes:
        bounce: enqueue one bounce of every path in the pool.
        film: enqueue adding the complete passes to the film.
        counters: wait, and return the counters.
        limit: set the first pass that must not be started.
    """

    bounce: Callable[[], None]
    film: Callable[[], None]
    counters: Callable[[], np.ndarray]
    limit: Callable[[int], None]


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

    Attributes:
        passes: whole passes that the film holds.
        clock: seconds spent in ``run``.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.passes = 0
        self.clock = Clock()
        self.bounces = BOUNCES_PER_FILM

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
        first_samples = rays_so_far(self.frame.counters(), "camera")
        first_seconds = self.clock.now()
        limit = spp
        self.frame.limit(limit if limit is not None else 0xFFFFFFFF)
        self.clock.start()
        try:
            while limit is None or self.passes < limit:
                begin = time.perf_counter()
                for bounce in range(self.bounces):
                    self.frame.bounce()
                    if (bounce + 1) % BOUNCES_PER_FILM == 0:
                        self.frame.film()
                counters = self.frame.counters()
                self.passes = int(counters[COUNTER_INDEX["film_pass"]])
                self._adapt(time.perf_counter() - begin)
                now = self.clock.now()
                if progress is not None:
                    samples = rays_so_far(counters, "camera") - first_samples
                    rate = samples / max(now - first_seconds, 1e-9)
                    if progress(Progress(self.passes, spp, now, seconds, rate)) is False:
                        return False
                if seconds is not None and limit is None and now >= seconds:
                    # The pass in which the budget ends is finished; later ones are not begun.
                    limit = self.passes + 1
                    self.frame.limit(limit)
            return True
        finally:
            self.clock.stop()

    def _adapt(self, seconds: float) -> None:
        """Let the next batch take about BATCH_SECONDS."""
        if seconds < BATCH_SECONDS / 2:
            self.bounces = min(self.bounces * 2, 64 * BOUNCES_PER_FILM)
        elif seconds > BATCH_SECONDS * 2 and self.bounces > BOUNCES_PER_FILM:
            self.bounces = max(self.bounces // 2, BOUNCES_PER_FILM)
