"""Interleaved measurements: what disturbs the machine disturbs every subject alike."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from psf_cl.renderer import Renderer

# More passes than any measurement comes to.
ENDLESS = 1 << 30


@dataclass(frozen=True)
class Spread:
    """A median with the least and the greatest of the rounds."""

    median: float
    low: float
    high: float

    def text(self, digits: int = 2) -> str:
        return f"{self.median:.{digits}f} ({self.low:.{digits}f}-{self.high:.{digits}f})"


@dataclass(frozen=True)
class Rounds:
    """What ``interleaved`` measured.

    Attributes:
        values: of each subject, one a round.
        cores: of each subject, the least processor time that it had in a round, over the wall time:
            far below the cores of the machine if others took them.
    """

    values: dict[str, list[float]]
    cores: dict[str, float]


def interleaved(subjects: Mapping[str, Callable[[], float]], rounds: int) -> Rounds:
    """Measure every subject once a round, every second round in reverse order."""
    values: dict[str, list[float]] = {name: [] for name in subjects}
    cores = dict.fromkeys(subjects, float(os.cpu_count() or 1))
    names = list(subjects)
    for index in range(rounds):
        for name in names if index % 2 == 0 else reversed(names):
            wall, processor = time.perf_counter(), time.process_time()
            values[name].append(subjects[name]())
            used = (time.process_time() - processor) / (time.perf_counter() - wall)
            cores[name] = min(cores[name], used)
    return Rounds(values, cores)


def spread(values: Sequence[float]) -> Spread:
    """Return the median of ``values`` and their range.

    Raises:
        ValueError: there are none.
    """
    return Spread(statistics.median(values), min(values), max(values))


def ratio(above: Sequence[float], below: Sequence[float]) -> Spread:
    """Return the spread of the quotients of the rounds.

    Raises:
        ValueError: not as many rounds of both.
    """
    return spread([a / b for a, b in zip(above, below, strict=True)])


def samples_per_second(renderer: Renderer, seconds: float) -> float:
    """Render on for at least ``seconds``; return the samples started per second of wall time.

    Paths in flight stay in the pool, so of a pool that was full these are the samples finished.
    """
    before = renderer.stats()["rays"]["camera"]
    start = time.perf_counter()
    renderer.render(spp=ENDLESS, progress=lambda progress: time.perf_counter() - start < seconds)
    elapsed = time.perf_counter() - start
    return (renderer.stats()["rays"]["camera"] - before) / elapsed
