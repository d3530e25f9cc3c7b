"""Interleaved measurements: what disturbs the machine disturbs every subject alike."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Spread:
    """A median with the least and the greatest of the rounds."""

    median: float
    low: float
    high: float

    def text(self, digits: int = 2) -> str:
        return f"{self.median:.{digits}f} ({self.low:.{digits}f}-{self.high:.{digits}f})"


def interleaved(subjects: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Measure every subject once a round, every second round in reverse order."""
    values: dict[str, list[float]] = {name: [] for name in subjects}
    names = list(subjects)
    for index in range(rounds):
        for name in names if index % 2 == 0 else reversed(names):
            values[name].append(subjects[name]())
    return values


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
