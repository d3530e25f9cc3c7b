"""``psf-cl converge``: error against run time of several ways to render, as a report."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psf_cl.cli.common import (
    START,
    add_frame_arguments,
    add_picture_arguments,
    file_argument,
    positive_integer,
    positive_number,
    setting_argument,
    tell_notes,
)
from psf_cl.errors import InputError, shown
from psf_cl.settings import DEVICE_VARIABLE, PRESETS, Settings, resolve

if TYPE_CHECKING:
    from psf_cl.cli.contestants import Arena, Contestant, Mark
    from psf_cl.image import Image
    from psf_cl.measure.report import Entry, Study
    from psf_cl.scene.model import Scene

DEFAULT_SECONDS = 8.0
DEFAULT_SEEDS = 4


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``psf-cl``."""
    parser = commands.add_parser(
        "converge", help="error against run time of several presets or renderers, as a report"
    )
    add_picture_arguments(parser)
    add_frame_arguments(parser)
    parser.add_argument(
        "--change",
        metavar="N",
        type=int,
        help="with --frames: the frame from which a fresh start is the measure of lag (default: "
        "the one whose reference differs most from the one before)",
    )
    parser.add_argument(
        "--reference",
        metavar="REF.exr",
        type=file_argument,
        required=True,
        help="the truth, as tools/make_references.py makes it; --size is its size by default; with "
        "--frames, #### in it is the frame's number, or it is a folder of 0000.exr, 0001.exr, ...",
    )
    parser.add_argument(
        "--presets",
        metavar="A,B,...",
        type=_presets,
        default=(),
        help=f"of: {', '.join(PRESETS)} (default pt if nobody else takes part)",
    )
    parser.add_argument(
        "--run",
        dest="runs",
        metavar="'NAME: KEY=VALUE ...'",
        type=named_settings,
        action="append",
        default=[],
        help="one more contestant: a preset (preset=...) and settings; may be repeated",
    )
    parser.add_argument(
        "--command",
        dest="commands",
        metavar="'NAME: PROGRAM ...'",
        type=_named,
        action="append",
        default=[],
        help="another renderer; {scene} {seconds} {out} stand for the scene file, the budget and "
        "the EXR to write; {spp} {seed} {width} {height} too; it may write render_seconds and spp "
        "to the JSON file {stats}, else render time is all its time; may be repeated",
    )
    parser.add_argument(
        "--set",
        dest="settings",
        metavar="KEY=VALUE",
        type=setting_argument,
        nargs="+",
        action="extend",
        default=[],
        help="settings of all presets and runs",
    )
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--seconds",
        metavar="S",
        type=positive_number,
        help=f"look at the first pass and at 1, 2, 4, ... S seconds (default {DEFAULT_SECONDS:g}); "
        "with --frames: of each frame, with all that is done between frames and to the picture",
    )
    budget.add_argument(
        "--spp",
        metavar="A,B,...",
        type=_counts,
        help="look at these samples a pixel instead; with "
        "--frames: one number, that of each frame (default 1)",
    )
    parser.add_argument(
        "--seeds",
        metavar="K",
        type=positive_integer,
        default=DEFAULT_SEEDS,
        help=f"runs of each contestant (default {DEFAULT_SEEDS}, the least for good intervals)",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        help="of the first run; the others count on (default: from the reference's last)",
    )
    parser.add_argument(
        "--device",
        metavar="TEXT",
        help=f"part of its name; default: ${DEVICE_VARIABLE}, or the best",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="DIR",
        type=file_argument,
        help="folder of the report; finished runs are kept there and found again "
        "(default: the scene's name and -report)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run everybody in turns, and write the report; 1 if a run failed, 130 if interrupted."""
    from psf_cl.cli.contestants import Arena, find_run, time_marks
    from psf_cl.cli.render import open_prepared_device
    from psf_cl.image import read_exr
    from psf_cl.measure.curves import reference_of
    from psf_cl.measure.report import Entry, Study, write_report

    if args.frames:
        from psf_cl.cli import sequence_study
        from psf_cl.scene.load import load_scene

        contestants = _contestants(args, load_scene(args.scene))
        return sequence_study.run(args, contestants, _output_folder(args))
    image = read_exr(args.reference)
    reference = reference_of(image, args.reference)
    folder = _output_folder(args)
    background = ThreadPoolExecutor(1)
    try:
        opening = background.submit(open_prepared_device, args.device, False)
        scene = _load(args, image)
        contestants = _contestants(args, scene)
        marks = args.spp or time_marks(args.seconds or DEFAULT_SECONDS)
        device = opening.result()
    finally:
        background.shutdown(wait=False)
    arena = Arena(scene, device, marks, folder / "runs", time.perf_counter() - START)
    entries = [Entry(one.name, _settings_of(one), []) for one in contestants]
    study = Study(
        title=f"Error against run time: {Path(args.scene).stem}",
        lead=f"{scene.width}x{scene.height} pixels, {args.seeds} runs each, in turns.",
        marks=[mark.label for mark in marks],
        entries=entries,
        reference=reference,
        provenance=_provenance(args, arena, image),
        notes=_notes(args, contestants, image, reference.variance is not None, scene),
    )
    seeds = _seeds(args, image, study)
    if not args.quiet:
        tell_notes([*scene.notes, *study.notes])
    missing = sum(find_run(arena, one, seed) is None for one in contestants for seed in seeds)
    if not args.quiet:
        _tell_length(marks, missing, len(contestants) * len(seeds))
    interrupted = False
    try:
        _run_all(arena, contestants, entries, seeds, args.quiet)
    except KeyboardInterrupt:
        interrupted = True
        study.notes.append("interrupted: not all runs are there; the same command goes on")
        print("psf-cl: interrupted; finished runs are kept: run it again to go on", file=sys.stderr)
    if any(entry.runs for entry in entries):
        _drop_repeated(study)
        study.measure()
        files = write_report(study, folder)
        if not args.quiet:
            print(_summary(study))
            print(f"{files[0]}: the report")
    failed = any(entry.failures for entry in entries) or not all(entry.runs for entry in entries)
    return 130 if interrupted else int(failed)


def _run_all(
    arena: Arena,
    contestants: Sequence[Contestant],
    entries: Sequence[Entry],
    seeds: Sequence[int],
    quiet: bool,
) -> None:
    """Run in turns, one seed each, so that a slow spell of the machine hits all alike."""
    from psf_cl.cli.contestants import RunError, find_run, make_run

    for turn, seed in enumerate(seeds):
        pairs = list(zip(contestants, entries, strict=True))
        # Nobody is always the first of a turn.
        for contestant, entry in pairs[turn % len(pairs) :] + pairs[: turn % len(pairs)]:
            found = find_run(arena, contestant, seed)
            try:
                done = found or make_run(arena, contestant, seed)
            except RunError as error:
                entry.failures.append(f"seed {seed}: {error}")
                print(f"FAILED: {contestant.name}, seed {seed}: {error}", file=sys.stderr)
                continue
            entry.runs.append(done)
            if not quiet:
                last = done.snapshots[-1]
                spp = f", {last.spp} spp" if last.spp else ""
                kept = ", kept from before" if found else ""
                print(
                    f"turn {turn + 1} of {len(seeds)}: {contestant.name}: "
                    f"{last.seconds:.2f} s{spp}{kept}",
                    flush=True,
                )


def _drop_repeated(study: Study) -> None:
    """Keep one of runs whose last pictures are the same: a command that takes no seed."""
    import numpy as np

    for entry in study.entries:
        if len(entry.runs) < 2:
            continue
        first, second = (run.snapshots[-1].load() for run in entry.runs[:2])
        if np.array_equal(first, second):
            del entry.runs[1:]
            study.notes.append(
                f"{entry.name}: its runs are the same picture (a command without {{seed}}?); "
                "only one counts, and bias and variance stay together"
            )


def _contestants(args: argparse.Namespace, scene: Scene) -> list[Contestant]:
    from psf_cl.cli.contestants import Contestant, split_command

    common = dict(args.settings)
    found = [
        Contestant(name, resolve(scene.render, scene.path, name, common)) for name in args.presets
    ]
    for name, values in args.runs:
        own = common | dict(values)
        preset = own.pop("preset", None)
        try:
            settings = resolve(scene.render, scene.path, preset, own)
        except InputError as error:
            raise InputError(f"--run {name}: {error}") from error
        found.append(Contestant(name, settings))
    for name, text in args.commands:
        try:
            command = split_command(text, "{spp}" if args.spp else "{seconds}")
        except ValueError as error:
            raise InputError(f"--command {name}: {error}; got {shown(text)}") from error
        found.append(Contestant(name, command=command))
    if not found:
        found.append(Contestant("pt", resolve(scene.render, scene.path, "pt", common)))
    names = [one.name for one in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"contestants need different names; twice there: {', '.join(twice)}")
    return found


def _load(args: argparse.Namespace, reference: Image) -> Scene:
    from psf_cl.scene.load import load_scene

    size = args.size or (reference.width, reference.height)
    scene = load_scene(args.scene, environment=args.environment, camera=args.camera, size=size)
    if (reference.width, reference.height) != size:
        raise InputError(
            f"{args.reference}: expected {size[0]}x{size[1]} pixels; "
            f"got {reference.width}x{reference.height}"
        )
    return scene


def _output_folder(args: argparse.Namespace) -> Path:
    folder = Path(args.output or f"{Path(args.scene).stem}-report")
    try:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot write: {error.strerror}") from error
    from psf_cl.files import check_writable

    check_writable(folder / "report.html")
    return folder


def _notes(
    args: argparse.Namespace,
    contestants: Sequence[Contestant],
    image: Image,
    has_variance: bool,
    scene: Scene,
) -> list[str]:
    """Return what a reader should know before trusting the numbers."""
    from psf_cl.scene.digest import scene_digest

    notes = []
    if not has_variance:
        notes.append(
            f"{args.reference} does not say its variance: its noise counts as bias, and nothing "
            "is greyed out"
        )
    made_of = image.stats.get("scene_digest")
    if isinstance(made_of, str) and made_of != scene_digest(scene):
        notes.append(f"{args.reference} is of another scene, or of another state of it")
    settings = image.stats.get("settings")
    depth = settings.get("max_depth") if isinstance(settings, dict) else None
    others = [o.name for o in contestants if o.settings and o.settings.max_depth != depth]
    if depth is not None and others:
        notes.append(f"max_depth is {depth} in {args.reference}, but not in: {', '.join(others)}")
    if args.seeds < DEFAULT_SEEDS:
        notes.append(f"a claim needs at least {DEFAULT_SEEDS} seeds; these are {args.seeds}")
    return notes


def _seeds(args: argparse.Namespace, image: Image, study: Study) -> list[int]:
    """Return the runs' seeds: none of the reference's, whose noise would be theirs."""
    stored = image.stats.get("seed")
    taken = [s for s in (stored if isinstance(stored, list) else [stored]) if isinstance(s, int)]
    first = max(taken, default=-1) + 1
    if args.seed is not None:
        first = Settings().with_values({"seed": args.seed}, "--").seed
    seeds = [(first + k) & 0xFFFFFFFF for k in range(args.seeds)]
    if set(seeds) & set(taken):
        study.notes.append(
            f"{args.reference} was made with some of the runs' seeds: errors look smaller than "
            "they are"
        )
    return seeds


def _settings_of(contestant: Contestant) -> dict[str, str]:
    if contestant.settings is None:
        return {"command": " ".join(contestant.command)}
    values = {key: str(value) for key, value in asdict(contestant.settings).items()}
    values.pop("seed")
    return values


def _provenance(args: argparse.Namespace, arena: Arena, image: Image) -> dict[str, str]:
    import platform

    import numpy

    import psf_cl

    device = arena.device
    made = {key: image.stats.get(key) for key in ("spp", "version", "device")}
    said = ", ".join(f"{key} {value}" for key, value in made.items() if value is not None)
    return {
        "scene": f"{args.scene}, {arena.scene.width}x{arena.scene.height}",
        "reference": f"{args.reference}" + (f" ({said})" if said else ""),
        "device": f"{device.name}, driver {device.driver}" if device else "",
        "versions": f"psf_cl {psf_cl.__version__}, Python {platform.python_version()}, "
        f"NumPy {numpy.__version__}, {platform.platform()}",
        "made": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": "psf-cl " + shlex.join(sys.argv[1:]),
    }


def _tell_length(marks: Sequence[Mark], missing: int, total: int) -> None:
    kept = f", {total - missing} kept from before" if missing < total else ""
    text = f"{total} runs{kept}"
    if marks[-1].seconds and missing:
        minutes = missing * marks[-1].seconds / 60.0
        text += f"; about {minutes:.1f} minutes of rendering to come"
    print(text, flush=True)


def _summary(study: Study) -> str:
    lines = []
    for entry in study.entries:
        if entry.points:
            point = entry.points[-1]
            error, trimmed = (point.metrics[n].value for n in ("relmse", "relmse_trimmed"))
            text = f"{entry.name}: relMSE {error:.4g}, trimmed {trimmed:.4g}"
            text += f" after {point.seconds:.3g} s"
            if point.nonfinite:
                text += f", {point.nonfinite} pixels not finite"
            elif point.split is not None:
                bias2 = point.split.bias2
                text += f", bias^2 {bias2.value:.2g} ({bias2.low:.2g} to {bias2.high:.2g})"
            lines.append(text)
    return "\n".join(lines)


def _named(text: str) -> tuple[str, str]:
    name, separator, rest = text.partition(": ")
    if not (separator and name.strip() and rest.strip()):
        raise argparse.ArgumentTypeError(f"expected 'NAME: ...'; got {text!r}")
    return name.strip(), rest.strip()


def named_settings(text: str) -> tuple[str, list[tuple[str, str]]]:
    """Parse ``NAME: KEY=VALUE ...`` of a command line."""
    name, rest = _named(text)
    return name, [setting_argument(word) for word in rest.split()]


def _presets(text: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(","))
    unknown = [name for name in names if name not in PRESETS]
    if unknown:
        raise argparse.ArgumentTypeError(
            f"expected presets of: {', '.join(PRESETS)}; got {unknown[0]!r}"
        )
    return names


def _counts(text: str) -> tuple[Mark, ...]:
    from psf_cl.cli.contestants import Mark

    counts = [positive_integer(part) for part in text.split(",")]
    if counts != sorted(set(counts)):
        raise argparse.ArgumentTypeError(f"expected increasing counts; got {text!r}")
    return tuple(Mark(spp=count) for count in counts)
