"""Time the kernels of a render: ``python tools/kernel_timing.py SCENE``.

After a warm-up the render is measured in repetitions, with the pool of paths always full; all
figures are medians over them.  The time of a repetition falls into kernels, transfers, launching
(something is queued but nothing runs) and the host's part (nothing is queued).  Rates are of the
time in which the kernel ran.  Bytes are those that a kernel declares for an item that does all it
can, without tree nodes and texels, from memory or from caches; beside them is the bandwidth at
which the device copies a large buffer, as a measure.

``--save`` keeps the times of the repetitions, ``--baseline`` compares with what was kept: beyond
noise is what differs by more than both spreads (the distances between the quartiles) together.
Machines are faster and slower for minutes: ``--add`` adds a run to a baseline, and what differed
between its runs is noise from then on; a change that all kernels have in common is told.
``--full`` renders also with every feature compiled in, in turns, to show what leaving out gains.
``--trace`` writes the last repetition for https://ui.perfetto.dev or chrome://tracing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from psf_cl.cli.common import (
    Parser,
    add_scene_arguments,
    check_distinct,
    file_argument,
    load_with_settings,
    positive_integer,
    positive_number,
    show,
    tell_notes,
)
from psf_cl.device.device import Device, open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import check_writable, write_whole
from psf_cl.image import json_text
from psf_cl.measure import timing
from psf_cl.measure.timing import Interval, KernelFigures, Repetition, Tally, Typical
from psf_cl.renderer import Renderer
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings

BAR_WIDTH = 10

#: Intervals that a trace takes; later ones of the repetition are left out, and counted.
TRACE_LIMIT = 200_000


class Stopwatch:
    """Measures a renderer in repetitions; only one at a time on a device.

    Attributes:
        repetitions: so far.
        intervals: the first ``TRACE_LIMIT`` of the last repetition, if they are kept.
        left_out: how many more it had.
    """

    def __init__(self, renderer: Renderer, keep_intervals: bool = False) -> None:
        self.renderer = renderer
        self.repetitions: list[Repetition] = []
        self.keep_intervals = keep_intervals
        self.intervals: list[Interval] = []
        self.left_out = 0
        self.tally = Tally()

    def warm_up(self, seconds: float) -> None:
        """Fill the pool, and let batches find their size."""
        self._run(seconds)

    def repeat(self, seconds: float) -> None:
        """Measure about ``seconds`` of rendering."""
        scheduler = self.renderer.scheduler
        self.tally = Tally()
        self.intervals.clear()
        self.left_out = 0
        before = dict(scheduler.rays)
        start = time.perf_counter()
        self.renderer.device.on_intervals = self._take
        try:
            self._run(seconds)
        finally:
            self.renderer.device.on_intervals = None
        passed = time.perf_counter() - start
        rays = {kind: count - before[kind] for kind, count in scheduler.rays.items()}
        self.repetitions.append(Repetition(passed, rays["camera"], rays, self.tally))

    def _run(self, seconds: float) -> None:
        # Stopped by progress, the paths stay in the pool: nothing drains.
        end = time.perf_counter() + seconds
        self.renderer.render(spp=1 << 31, progress=lambda _: time.perf_counter() < end)

    def _take(self, intervals: list[Interval]) -> None:
        self.tally.add(intervals)
        if self.keep_intervals:
            room = TRACE_LIMIT - len(self.intervals)
            self.intervals += intervals[:room]
            self.left_out += max(len(intervals) - room, 0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and show; return 1 if kernels and transfers are under 95 % of the time."""
    parser = Parser()
    add_scene_arguments(parser)
    # After that call, which makes the settings the epilog.
    parser.description = __doc__
    parser.add_argument("--repetitions", metavar="N", type=positive_integer, default=9, help="(9)")
    parser.add_argument(
        "--seconds", metavar="S", type=positive_number, default=0.5, help="of a repetition (0.5)"
    )
    parser.add_argument("--warm-up", metavar="S", type=positive_number, default=1.0, help="(1.0)")
    parser.add_argument("--save", metavar="FILE.json", type=file_argument, help="keep a baseline")
    parser.add_argument("--add", metavar="FILE.json", type=file_argument, help="to a baseline")
    parser.add_argument("--baseline", metavar="FILE.json", type=file_argument, help="compare")
    parser.add_argument("--trace", metavar="FILE.json", type=file_argument, help="write a trace")
    parser.add_argument("--full", action="store_true", help="compare with every feature built in")
    parser.add_argument("--device", metavar="TEXT", help="part of its name")
    args = parser.parse_args(arguments)
    if args.repetitions < 3:
        parser.error("--repetitions: expected at least 3: the spread shows between them")
    outputs = [path for path in (args.save, args.add, args.trace) if path]
    for path in outputs:
        check_writable(path)

    scene, settings = load_with_settings(args)
    check_distinct(outputs, [*scene.files, args.baseline])
    tell_notes(scene.notes)
    device = open_device(args.device, profiling=True)
    conditions = _conditions(args, scene, settings, device)
    before, added_to = (
        timing.read_baseline(Path(path), conditions) if path else {}
        for path in (args.baseline, args.add)
    )

    own = Stopwatch(_renderer(args, scene, settings, device), keep_intervals=bool(args.trace))
    watches = [own]
    if args.full:
        watches.append(Stopwatch(_renderer(args, scene, settings, device, full=True)))
    for watch in watches:
        watch.warm_up(args.warm_up)
    for _ in range(args.repetitions):
        for watch in watches:
            watch.repeat(args.seconds)

    _show_measured(own, device, args)
    measured = timing.ns_by_name(own.repetitions)
    if args.baseline:
        stages = {stage.name for stage in own.renderer.plan.stages}
        show(Text(), _change_table(timing.changes(before, measured), args.baseline, stages))
    if args.full:
        show(Text(), _full_table(own, watches[1]))
    for path, runs in ((args.save, [measured]), (args.add, [added_to, measured])):
        if path:
            kept = timing.baseline(conditions, runs)
            write_whole(path, (json_text(kept, indent=2) + "\n").encode())
    if args.trace:
        trace = timing.chrome_trace(own.intervals, device.name)
        write_whole(args.trace, json_text(trace).encode())
        if own.left_out:
            tell_notes([f"the trace ends {own.left_out} commands before the repetition does"])
    for watch in watches:
        watch.renderer.close()
    covered = _covered(own.repetitions)
    if covered < 0.95:
        tell_notes([f"kernels and transfers are only {covered:.1%} of the time"])
        return 1
    return 0


def _renderer(
    args: argparse.Namespace, scene: Scene, settings: Settings, device: Device, full: bool = False
) -> Renderer:
    return Renderer(scene, settings, device, args.aov, args.crop, full=full)


def _conditions(
    args: argparse.Namespace, scene: Scene, settings: Settings, device: Device
) -> dict[str, Any]:
    """Return what must not differ between a baseline and what is compared with it."""
    return {
        "scene": Path(scene.path).name,
        "size": [scene.width, scene.height],
        "crop": list(args.crop) if args.crop else None,
        "aov": sorted(args.aov),
        "settings": {name: getattr(settings, name) for name in settings.__dataclass_fields__},
        "device": device.name,
    }


def _covered(repetitions: Sequence[Repetition]) -> float:
    """Return the share of the time in which a kernel or a transfer ran."""
    return Typical.of([(r.kernels + r.transfers) / r.seconds for r in repetitions]).median


def _show_measured(watch: Stopwatch, device: Device, args: argparse.Namespace) -> None:
    renderer, repetitions = watch.renderer, watch.repetitions
    figures = timing.kernel_figures(repetitions, renderer.plan.declared)
    whole = timing.ns_per_sample(repetitions)
    traits = renderer.plan.traits
    width, height = renderer.plan.crop[2:]
    rays = Typical.of([sum(r.rays.values()) / r.seconds for r in repetitions])
    copied = device.copy_bandwidth()
    show(
        f"{renderer.scene.path}, {width}x{height}, on {device.name}: {traits.slots} paths in "
        f"flight, {traits.lanes} a work item",
        f"{1e3 / whole.median:.2f} Msamples/s, {whole.median:.1f} ns a sample "
        f"(quartiles {whole.spread:.1f} ns apart), {rays.median / 1e6:.1f} Mrays/s; medians of "
        f"{len(repetitions)} repetitions of {args.seconds:g} s after {args.warm_up:g} s",
        f"copy bandwidth of the device, read and written: {copied / 1e9:.1f} GB/s; "
        f"set-up: load {renderer.load_seconds:.2f} s, tree {renderer.build_seconds:.2f} s, "
        f"compile {renderer.compile_seconds:.2f} s ({_compile_times(renderer)})",
        Text(),
        _kernel_table(figures, copied),
        Text(),
        _time_table(repetitions),
        _next_step(figures),
    )


def _compile_times(renderer: Renderer) -> str:
    return ", ".join(
        f"{stage} {program.seconds:.2f}" for stage, program in renderer.programs.items()
    )


def _kernel_table(figures: Sequence[KernelFigures], copied: float) -> Table:
    """Return the kernels, the one that takes longest first; columns that nothing fills are left."""
    hashing = any(figure.hash_accesses_per_second is not None for figure in figures)
    numbers = ["ms", "ns/sample", "launches", "items", "Mitems/s", "B/item", "GB/s", "of copy"]
    numbers += ["Mrays/s", *(["Maccesses/s"] if hashing else [])]
    table = _table("Kernels", ["kernel", "share of the time"], numbers)
    longest = max((figure.share for figure in figures), default=0.0)
    for figure in figures:
        if figure.stage == timing.TRANSFER:
            continue
        bandwidth = figure.bytes_per_second
        cells = [
            f"{figure.stage}: {figure.name}",
            _bar(figure.share, longest),
            f"{1e3 * figure.seconds:.1f}",
            f"{figure.ns_per_sample.median:.2f}",
            f"{figure.launches:.0f}",
            _short(figure.items),
            f"{figure.items_per_second / 1e6:.1f}",
            _declared_bytes(figure.declared),
            "" if bandwidth is None else f"{bandwidth / 1e9:.2f}",
            "" if bandwidth is None else f"{bandwidth / copied:.0%}",
            _millions(figure.rays_per_second),
        ]
        table.add_row(*cells, *([_millions(figure.hash_accesses_per_second)] if hashing else []))
    if any(figure.declared.per_sample for figure in figures):
        table.caption = "* bytes a sample, for most of the items have nothing to do"
        table.caption_justify = "left"
    return table


def _time_table(repetitions: Sequence[Repetition]) -> Table:
    """Return where the time of a repetition is: on the device, on its way there, or elsewhere."""
    launches = [sum(s.launches for s in r.tally.by_command.values()) for r in repetitions]
    parts = {
        "kernels": [r.kernels for r in repetitions],
        "transfers": [r.transfers for r in repetitions],
        "launching: queued, nothing runs": [r.tally.launching for r in repetitions],
        "host: nothing queued": [r.host for r in repetitions],
    }
    overhead = Typical.of(
        [r.tally.launching / max(n, 1) for r, n in zip(repetitions, launches, strict=True)]
    )
    table = _table("Time", ["where", "share of the time"], ["ms", ""])
    notes = {"launching: queued, nothing runs": f"{1e6 * overhead.median:.1f} us a command"}
    for name, seconds in parts.items():
        pairs = zip(seconds, repetitions, strict=True)
        share = Typical.of([part / r.seconds for part, r in pairs]).median
        milliseconds = f"{1e3 * Typical.of(seconds).median:.1f}"
        table.add_row(name, _bar(share, 1.0), milliseconds, notes.get(name, ""))
    return table


def _next_step(figures: Sequence[KernelFigures]) -> str:
    first = figures[0]
    return (
        f"next: {first.name}, {first.share:.0%} of the time; "
        f"twice as fast it would save {first.ns_per_sample.median / 2:.1f} ns a sample"
    )


def _change_table(changes: Sequence[timing.Change], path: str, stages: Collection[str]) -> Table:
    headings = ["before", "now", "change", "noise", ""]
    table = _table(f"Against {path}, ns a sample", ["what"], headings)
    ratios: list[float] = []
    for change in changes:
        before, now = change.before, change.now
        cells = [change.name, _nanoseconds(before), _nanoseconds(now)]
        if before is None or now is None:
            table.add_row(*cells, "", "", "new" if before is None else "gone")
            continue
        ratio = f"{now.median / before.median - 1.0:+.1%}" if before.median > 0.0 else ""
        if before.median > 0.0 and change.name.partition(":")[0] in stages:
            ratios.append(now.median / before.median)
        verdict = Text("within noise", style="dim")
        if change.beyond_noise:
            faster = now.median < before.median
            verdict = Text(*(("FASTER", "green") if faster else ("SLOWER", "red")))
        table.add_row(*cells, ratio, f"{change.noise:.2f}", verdict)
    if ratios:
        common = Typical.of(ratios).median - 1.0
        table.caption = f"median change of the kernels: {common:+.1%}; the machine's part is in it"
        table.caption_justify = "left"
    return table


def _full_table(own: Stopwatch, full: Stopwatch) -> Table:
    """Return the scene's own build beside the full one, kernel by kernel."""
    features = full.renderer.plan.features
    own_features = own.renderer.plan.features
    more = [name for name in features if features[name].value > own_features[name].value]
    less = [name for name in features if features[name].value < own_features[name].value]
    headings = ["own build", "full build", "full / own", "noise"]
    table = _table("What leaving out gains, ns a sample", ["what"], headings)
    table.caption = f"only the full build has {', '.join(more) or 'nothing'}"
    table.caption += f"; only the own build has {', '.join(less)}" if less else ""
    table.caption_justify = "left"
    times = [timing.ns_by_name(watch.repetitions) for watch in (own, full)]
    for change in timing.changes(*times):
        now, was = change.now, change.before
        ratio = f"{now.median / was.median:.2f}" if now and was and was.median > 0.0 else ""
        noise = f"{change.noise:.2f}"
        table.add_row(change.name, _nanoseconds(was), _nanoseconds(now), ratio, noise)
    return table


def _table(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """Return an empty table with a column for each heading."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False)
    table.padding = 0
    for heading in words:
        table.add_column(heading, no_wrap=True)
    for heading in numbers:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def _declared_bytes(declared: timing.Declared) -> str:
    return f"{declared.bytes}" + "*" * declared.per_sample if declared.bytes else ""


def _bar(share: float, longest: float) -> str:
    blocks = round(BAR_WIDTH * share / longest) if longest > 0.0 else 0
    return f"{share:6.1%} {'#' * blocks}"


def _short(count: float) -> str:
    """Return a count in few characters."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= size:
            return f"{count / size:.1f}{unit}"
    return f"{count:.0f}"


def _millions(rate: float | None) -> str:
    return "" if rate is None else f"{rate / 1e6:.2f}"


def _nanoseconds(value: Typical | None) -> str:
    return "" if value is None else f"{value.median:.2f}"


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        print(f"kernel_timing: {error}", file=sys.stderr)
        sys.exit(2)
    except DeviceError as error:
        sys.exit(f"kernel_timing: {error}")
