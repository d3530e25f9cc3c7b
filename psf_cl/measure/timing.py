"""Where the time of a render goes: device intervals to figures, baselines and traces.

Plain numbers in, plain numbers out; ``tools/kernel_timing.py`` measures and shows them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from psf_cl.errors import InputError, shown
from psf_cl.files import read_file

#: Stage of the commands that only move or set memory.
TRANSFER = "transfer"

_BASELINE_FORMAT = 1
_NS = 1e-9


class Interval(NamedTuple):
    """A finished command of an in-order queue; times in ns, on a clock of the device.

    Attributes:
        stage: of the kernel, or ``TRANSFER``.
        items: work items of a kernel, bytes of a transfer.
    """

    stage: str
    name: str
    items: int
    queued: int
    start: int
    end: int


@dataclass(frozen=True)
class Declared:
    """What a kernel says of itself, for its rates.

    Attributes:
        items: those that a work item computes: paths, pixels or other.
        bytes: global memory read and written for an item that does all it can, each word once;
            without what depends on the data, such as nodes of the tree and texels.
        per_sample: whether ``bytes`` are of each sample of the render instead: of a kernel whose
            items mostly have nothing to do.
        rays: kinds of rays that it traces.
        hash_accesses: look-ups and insertions of an item.
    """

    items: int = 1
    bytes: int = 0
    per_sample: bool = False
    rays: tuple[str, ...] = ()
    hash_accesses: int = 0


@dataclass
class Spent:
    """Launches, items (as of ``Interval``) and seconds of one kernel or kind of transfer."""

    launches: int = 0
    items: int = 0
    seconds: float = 0.0

    def add(self, interval: Interval) -> None:
        self.launches += 1
        self.items += interval.items
        self.seconds += (interval.end - interval.start) * _NS


@dataclass
class Tally:
    """Sums of the intervals of one repetition.

    The queue is in order, so time falls into three parts: a command runs; one is queued but does
    not run yet (launching); nothing is queued (the host's part, which only a clock of the host
    around all of it can tell).

    Attributes:
        by_command: of each (stage, name).
        launching: seconds.
    """

    by_command: dict[tuple[str, str], Spent] = field(default_factory=dict)
    launching: float = 0.0
    _end: int = 0

    def add(self, intervals: Iterable[Interval]) -> None:
        """Add finished commands, in the order of the queue."""
        for interval in intervals:
            self.by_command.setdefault((interval.stage, interval.name), Spent()).add(interval)
            self.launching += max(interval.start - max(interval.queued, self._end), 0) * _NS
            self._end = interval.end


@dataclass(frozen=True)
class Repetition:
    """One measured stretch of a render.

    Attributes:
        seconds: by the host's clock.
        samples: paths started.
        rays: traced, by kind.
    """

    seconds: float
    samples: int
    rays: Mapping[str, int]
    tally: Tally

    @property
    def kernels(self) -> float:
        """Return the seconds in which a kernel ran."""
        commands = self.tally.by_command.items()
        return sum(spent.seconds for (stage, _), spent in commands if stage != TRANSFER)

    @property
    def transfers(self) -> float:
        commands = self.tally.by_command.items()
        return sum(spent.seconds for (stage, _), spent in commands if stage == TRANSFER)

    @property
    def host(self) -> float:
        """Return the seconds in which the device had nothing to do."""
        return self.seconds - self.kernels - self.transfers - self.tally.launching


@dataclass(frozen=True)
class Typical:
    """Median of a figure over the repetitions, and the distance between its quartiles."""

    median: float
    spread: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Typical:
        low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
        return cls(float(median), float(high - low))


@dataclass(frozen=True)
class KernelFigures:
    """Medians over repetitions of one kernel; a rate is None if the kernel declares nothing of it.

    Attributes:
        launches, items: a repetition.
        seconds: a repetition.
        share: of the time of the repetition.
        ns_per_sample: nanoseconds for each path that was started.
        bytes_per_item: as declared.
    """

    stage: str
    name: str
    launches: float
    items: float
    seconds: float
    share: float
    ns_per_sample: Typical
    items_per_second: float
    declared: Declared
    bytes_per_second: float | None
    rays_per_second: float | None
    hash_accesses_per_second: float | None


def kernel_figures(
    repetitions: Sequence[Repetition], declared: Mapping[str, Declared]
) -> list[KernelFigures]:
    """Return the figures of every command, the one that takes longest first.

    Args:
        declared: by the kernel's name; commands that are not there have no rates but their items.
    """
    keys = {key: None for repetition in repetitions for key in repetition.tally.by_command}
    found = [_figures(key, repetitions, declared.get(key[1], Declared())) for key in keys]
    return sorted(found, key=lambda figures: -figures.seconds)


def _figures(
    key: tuple[str, str], repetitions: Sequence[Repetition], declared: Declared
) -> KernelFigures:
    spent = [repetition.tally.by_command.get(key, Spent()) for repetition in repetitions]
    pairs = list(zip(repetitions, spent, strict=True))
    # Repetitions in which it did not run say nothing about its rates.
    ran = [pair for pair in pairs if pair[1].seconds > 0.0]

    def rate(counts: Sequence[float]) -> float:
        rates = [count / one.seconds for count, (_, one) in zip(counts, ran, strict=True)]
        return float(np.median(rates)) if rates else 0.0

    items = [one.items * declared.items for _, one in ran]
    rays = [sum(whole.rays[kind] for kind in declared.rays) for whole, _ in ran]
    samples = [whole.samples for whole, _ in ran]
    items_rate = rate(items)
    return KernelFigures(
        *key,
        launches=float(np.median([one.launches for one in spent])),
        items=float(np.median([one.items * declared.items for one in spent])),
        seconds=float(np.median([one.seconds for one in spent])),
        share=float(np.median([one.seconds / whole.seconds for whole, one in pairs])),
        ns_per_sample=Typical.of(
            [one.seconds / _NS / max(whole.samples, 1) for whole, one in pairs]
        ),
        items_per_second=items_rate,
        declared=declared,
        bytes_per_second=declared.bytes * (rate(samples) if declared.per_sample else items_rate)
        if declared.bytes
        else None,
        rays_per_second=rate(rays) if declared.rays else None,
        hash_accesses_per_second=items_rate * declared.hash_accesses
        if declared.hash_accesses
        else None,
    )


def ns_per_sample(repetitions: Sequence[Repetition]) -> Typical:
    """Return the nanoseconds of wall time for each path that was started."""
    return Typical.of([r.seconds / _NS / max(r.samples, 1) for r in repetitions])


def chrome_trace(intervals: Sequence[Interval], queue: str) -> dict[str, Any]:
    """Return the intervals as a trace that Perfetto and chrome://tracing show.

    Times are microseconds from the first start.  Format: Google, "Trace Event Format", 2016:
    complete events ("X") and the metadata events that name process and track.

    Args:
        queue: name of the track.
    """
    first = min((interval.start for interval in intervals), default=0)
    place = {"pid": 1, "tid": 1}
    events: list[dict[str, Any]] = [
        {"name": "process_name", "ph": "M", **place, "args": {"name": "psf_cl"}},
        {"name": "thread_name", "ph": "M", **place, "args": {"name": queue}},
    ]
    for interval in sorted(intervals, key=lambda interval: interval.start):
        unit = "bytes" if interval.stage == TRANSFER else "work_items"
        events.append(
            {
                "name": interval.name,
                "cat": interval.stage,
                "ph": "X",
                "ts": (interval.start - first) / 1000,
                "dur": (interval.end - interval.start) / 1000,
                **place,
                "args": {
                    unit: interval.items,
                    "queued_before_us": (interval.start - interval.queued) / 1000,
                },
            }
        )
    return {"traceEvents": events, "displayTimeUnit": "ns"}


@dataclass(frozen=True)
class Change:
    """A figure against that of a baseline; None where only one of the two has it.

    Attributes:
        noise: what the medians may differ by for nothing: the spreads of both, added.
    """

    name: str
    before: Typical | None
    now: Typical | None

    @property
    def noise(self) -> float:
        return sum(side.spread for side in (self.before, self.now) if side is not None)

    @property
    def beyond_noise(self) -> bool:
        if self.before is None or self.now is None:
            return True
        return abs(self.now.median - self.before.median) > self.noise


def ns_by_name(repetitions: Sequence[Repetition]) -> dict[str, list[float]]:
    """Return ns a sample of each repetition: of the whole, then of each command, longest first."""

    def of_samples(seconds: Sequence[float]) -> list[float]:
        pairs = zip(seconds, repetitions, strict=True)
        return [part / _NS / max(whole.samples, 1) for part, whole in pairs]

    keys = [(figures.stage, figures.name) for figures in kernel_figures(repetitions, {})]
    tallies = [repetition.tally.by_command for repetition in repetitions]
    return {"whole": of_samples([repetition.seconds for repetition in repetitions])} | {
        f"{stage}: {name}": of_samples(
            [tally.get((stage, name), Spent()).seconds for tally in tallies]
        )
        for stage, name in keys
    }


def baseline(
    conditions: Mapping[str, Any], runs: Sequence[Mapping[str, Sequence[float]]]
) -> dict[str, Any]:
    """Return what ``read_baseline`` takes, as JSON values.

    Args:
        conditions: all that has to be the same for a comparison to mean something.
        runs: of ``ns_by_name`` or ``read_baseline``; their repetitions are joined, so that what
            changes from run to run is part of the spread.
    """
    names = {name: None for run in runs for name in run}
    return {
        "format": _BASELINE_FORMAT,
        "conditions": dict(conditions),
        "ns_per_sample": {
            name: [value for run in runs for value in run.get(name, ())] for name in names
        },
    }


def read_baseline(path: Path, conditions: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return ns a sample of each repetition of a baseline, by name.

    Raises:
        InputError: it is no baseline, or one of other conditions.
    """
    try:
        content = json.loads(read_file(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != _BASELINE_FORMAT:
        raise InputError(f"{path}: expected what --save wrote, format {_BASELINE_FORMAT}")
    measured = content.get("conditions")
    for name, value in conditions.items():
        found = measured.get(name) if isinstance(measured, dict) else None
        if found != value:
            raise InputError(f"{path}: {name}: expected {value!r}, as now; got {shown(found)}")
    values = content.get("ns_per_sample")
    if not isinstance(values, dict) or not all(_are_times(times) for times in values.values()):
        raise InputError(f"{path}: ns_per_sample: expected a list of numbers for each name")
    return values


def _are_times(values: Any) -> bool:
    # Comparing is exact for integers of any length; no infinity or NaN is in the range.
    return (
        isinstance(values, list)
        and len(values) > 0
        and all(type(value) in (int, float) and 0 <= value < 1e30 for value in values)
    )


def changes(
    before: Mapping[str, Sequence[float]], now: Mapping[str, Sequence[float]]
) -> list[Change]:
    """Compare two runs of ``ns_by_name`` name by name, in the order of the second."""

    def typical(values: Sequence[float] | None) -> Typical | None:
        return None if values is None else Typical.of(values)

    names = [*now, *(name for name in before if name not in now)]
    return [Change(name, typical(before.get(name)), typical(now.get(name))) for name in names]
