"""``psf-cl converge --frames``: error frame by frame, lag and flicker, as a report."""

from __future__ import annotations

import argparse
import csv
import io
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np

import psf_cl
from psf_cl.cli.common import numbered, tell_notes
from psf_cl.cli.contestants import Contestant
from psf_cl.device.device import Device
from psf_cl.errors import InputError
from psf_cl.files import write_whole
from psf_cl.image import read_exr
from psf_cl.measure import plot, sequences
from psf_cl.renderer import Renderer
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings


@dataclass(frozen=True)
class Result:
    """What is known of one contestant; errors are the means over its runs.

    Attributes:
        errors: relMSE of each frame.
        fresh: the same of a start in the frame of the change.
        lag: see ``sequences.lag``.
        spp, seconds: of a frame, on average: samples a pixel, and wall time with all that is done
            between frames and to the picture.
    """

    name: str
    errors: np.ndarray
    fresh: np.ndarray
    lag: int | None
    flicker: float
    spp: float
    seconds: float


@dataclass(frozen=True)
class Budget:
    """What each frame gets: samples a pixel, or seconds on average (a pass at least)."""

    spp: int | None
    seconds: float | None

    def __str__(self) -> str:
        return f"{self.seconds:g} s" if self.spp is None else f"{self.spp} samples"


def read_truth(pattern: str, frames: range) -> tuple[sequences.Truth, tuple[int, int], list[int]]:
    """Return the references of all frames, their size, and the seeds that they were made with.

    Raises:
        InputError: one cannot be read, or they differ in size.
    """
    if Path(pattern).is_dir():
        pattern = str(Path(pattern) / "####.exr")
    names = [numbered(pattern, frame, "--reference") for frame in frames]
    images = [read_exr(name) for name in names]
    size = images[0].width, images[0].height
    for name, image in zip(names, images, strict=True):
        if (image.width, image.height) != size:
            raise InputError(
                f"{name}: expected {size[0]}x{size[1]} pixels as {names[0]} has; "
                f"got {image.width}x{image.height}"
            )
    seeds: list[int] = []
    for image in images:
        stored = image.stats.get("seed")
        seeds += [s for s in (stored if isinstance(stored, list) else [stored]) if type(s) is int]
    try:
        return sequences.Truth.of([image.rgb for image in images]), size, seeds
    except InputError as error:
        raise InputError(f"{pattern}: {error}") from error


def render_frames(
    scene: Scene, settings: Settings, device: Device, frames: range, fps: float, budget: Budget
) -> tuple[list[np.ndarray], float, float]:
    """Return the pictures of the frames, each ``(h, w, 3)``; the first knows of none before.

    Returns:
        The pictures, and samples and seconds of a frame on average.
    """
    renderer = Renderer(scene, settings, device, time=frames.start / fps)
    try:
        pictures, passes, spent = [], 0, 0.0
        for frame in frames:
            start = time.perf_counter()
            if frame != frames.start:
                renderer.set_frame(frame / fps)
            if budget.seconds is None:
                renderer.render(spp=budget.spp)
            else:
                # A frame that took longer leaves less for the next.
                due = (len(pictures) + 1) * budget.seconds - spent
                left = max(due - (time.perf_counter() - start), 1e-9)
                renderer.render(seconds=renderer.scheduler.clock.now() + left)
            pictures.append(renderer.snapshot().rgb)
            passes += renderer.scheduler.passes
            spent += time.perf_counter() - start
        return pictures, passes / len(pictures), spent / len(pictures)
    finally:
        renderer.close()


def run(args: argparse.Namespace, contestants: Sequence[Contestant], folder: Path) -> int:
    """Render every contestant's frames with every seed, and write the report; return 0.

    Raises:
        InputError: the arguments do not fit a sequence, or a reference cannot be read.
    """
    from psf_cl.cli.render import open_prepared_device

    if any(one.settings is None for one in contestants):
        raise InputError("--command: not with --frames")
    frames: range = args.frames
    if args.spp and len(args.spp) > 1:
        raise InputError("--frames: expected one --spp, that of each frame (default 1)")
    spp = args.spp[0].spp if args.spp else 1
    budget = Budget(None if args.seconds else spp, args.seconds)
    truth, size, taken = read_truth(args.reference, frames)
    change = frames.start + truth.largest_change() if args.change is None else args.change
    if change not in frames:
        raise InputError(f"--change: expected one of the frames; got {change}")
    scene = load_scene(
        args.scene,
        environment=args.environment,
        camera=args.camera,
        size=args.size or size,
        clip=args.clip,
        moving=True,
    )
    if (scene.width, scene.height) != size:
        raise InputError(
            f"{args.reference}: expected {scene.width}x{scene.height} pixels; "
            f"got {size[0]}x{size[1]}"
        )
    if not args.quiet:
        tell_notes(scene.notes)
    first = max(taken, default=-1) + 1
    if args.seed is not None:
        first = Settings().with_values({"seed": args.seed}, "--").seed
    seeds = [(first + k) & 0xFFFFFFFF for k in range(args.seeds)]
    device = open_prepared_device(args.device, False)
    results = []
    for one in contestants:
        errors, fresh, flickers, spent = [], [], [], []
        for seed in seeds:
            own = replace(one.settings, seed=seed)
            pictures, *cost = render_frames(scene, own, device, frames, args.fps, budget)
            spent.append(cost)
            errors.append(sequences.frame_errors(pictures, truth))
            flickers.append(sequences.flicker(pictures, truth))
            since = range(change, frames.stop)
            pictures, *_ = render_frames(scene, own, device, since, args.fps, budget)
            fresh.append(sequences.frame_errors(pictures, truth, change - frames.start))
        mean, start = np.mean(errors, axis=0), np.mean(fresh, axis=0)
        late = sequences.lag(mean[change - frames.start :], start)
        flicker, cost = float(np.mean(flickers)), np.mean(spent, axis=0)
        results.append(Result(one.name, mean, start, late, flicker, *cost.tolist()))
        if not args.quiet:
            print(_line(results[-1]), flush=True)
    lead = (
        f"{size[0]}x{size[1]} pixels, frames {frames.start} to {frames.stop - 1} of {budget}, "
        f"means of {len(seeds)} runs; a fresh start begins in frame {change}."
    )
    files = {
        "frames.csv": frames_csv(results, frames, change),
        "sequences.csv": sequences_csv(results),
        "report.html": page(f"Frames: {Path(args.scene).stem}", lead, results, frames),
    }
    for name, text in files.items():
        write_whole(folder / name, text.encode())
    if not args.quiet:
        print(f"{folder / 'report.html'}: the report")
    return 0


def _line(result: Result) -> str:
    late = "never" if result.lag is None else f"in frame {result.lag}"
    return (
        f"{result.name}: relMSE summed {result.errors.sum():.4g}, caught up {late} since the "
        f"change, flicker {result.flicker:.3g}; a frame: {result.spp:.3g} spp, "
        f"{result.seconds:.3g} s"
    )


def frames_csv(results: Sequence[Result], frames: range, change: int) -> str:
    """Return a line for each contestant and frame: its error and that of a fresh start."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["contestant", "frame", "relmse", "fresh_relmse"])
    for one in results:
        for frame, error in zip(frames, one.errors, strict=True):
            fresh = repr(float(one.fresh[frame - change])) if frame >= change else ""
            writer.writerow([one.name, frame, repr(float(error)), fresh])
    return text.getvalue()


def sequences_csv(results: Sequence[Result]) -> str:
    """Return a line for each contestant: summed error, lag (empty for never), flicker, and cost."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = ["contestant", "relmse_sum", "lag", "flicker", "spp_per_frame", "seconds_per_frame"]
    writer.writerow(names)
    for one in results:
        late = "" if one.lag is None else one.lag
        values = [float(one.errors.sum()), late, one.flicker, one.spp, one.seconds]
        writer.writerow([one.name, *(v if isinstance(v, (int, str)) else repr(v) for v in values)])
    return text.getvalue()


def page(title: str, lead: str, results: Sequence[Result], frames: range) -> str:
    """Return the page: one file, no network."""
    nan = float("nan")
    styles = [
        (plot.COLOURS[k % len(plot.COLOURS)], plot.SHAPES[k % len(plot.SHAPES)])
        for k in range(len(results))
    ]
    curves = [
        plot.Series(
            one.name,
            *style,
            [(k + 1.0, float(error), nan, nan) for k, error in enumerate(one.errors)],
            titles=[f"{one.name}, frame {frame}" for frame in frames],
        )
        for one, style in zip(results, styles, strict=True)
    ]
    names = [(one.name, *style) for one, style in zip(results, styles, strict=True)]
    figure = plot.figure([plot.panel("relMSE", "frames rendered", curves)], names)
    rows = "".join(
        f"<tr><td>{escape(one.name)}</td><td>{one.errors.sum():.4g}</td>"
        f"<td>{'never' if one.lag is None else one.lag}</td><td>{one.flicker:.3g}</td>"
        f"<td>{one.spp:.3g}</td><td>{one.seconds:.3g}</td></tr>"
        for one in results
    )
    style = (Path(plot.__file__).parent / "report.css").read_text(encoding="utf-8")
    command = escape(" ".join(sys.argv[1:]))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{style}</style><h1>{escape(title)}</h1><p>{escape(lead)}</p>{figure.svg()}"
        "<table><tr><th></th><th>relMSE, summed</th><th>caught up in frame since the change</th>"
        "<th>flicker</th><th>samples a frame</th><th>s a frame</th></tr>"
        f"{rows}</table><p>Flicker: variance from frame to frame where the "
        f"references rest.</p><p>psf_cl {psf_cl.__version__}: psf-cl {command}</p></html>\n"
    )
