"""``psf-cl render``: a scene in, an EXR and a PNG out."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psf_cl.cli.common import (
    START,
    add_frame_arguments,
    add_scene_arguments,
    check_distinct,
    exposure_argument,
    file_argument,
    first_time,
    load_with_settings,
    numbered,
    positive_integer,
    positive_number,
    room_of,
    tell_notes,
)
from psf_cl.cli.progress import ProgressDisplay
from psf_cl.errors import DeviceError, InputError
from psf_cl.settings import DEVICE_VARIABLE

if TYPE_CHECKING:
    import numpy as np

    from psf_cl.device.device import Device
    from psf_cl.image import Image
    from psf_cl.renderer import Progress, Renderer
    from psf_cl.scene.model import Scene

DEFAULT_SPP = 64

#: Signals that ask for an end with all that is there.
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``psf-cl``."""
    parser = commands.add_parser("render", help="render a scene to an EXR and a PNG")
    add_scene_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.exr",
        type=file_argument,
        help="default: the scene's name in this folder",
    )
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--spp", metavar="N", type=positive_integer, help=f"samples a pixel (default {DEFAULT_SPP})"
    )
    budget.add_argument(
        "--seconds", metavar="S", type=positive_number, help="stop after the pass that ends then"
    )
    budget.add_argument(
        "--noise",
        metavar="E",
        type=positive_number,
        help="stop when the relMSE, estimated from the samples, is below E",
    )
    add_frame_arguments(parser)
    parser.add_argument(
        "--exposure",
        metavar="EV",
        type=exposure_argument,
        default=0.0,
        help="brightness of the PNG: 1 doubles it; the EXR stays as it is",
    )
    parser.add_argument("--half", action="store_true", help="16-bit floats in the EXR")
    parser.add_argument(
        "--device",
        metavar="TEXT",
        help=f"part of its name; default: ${DEVICE_VARIABLE}, or the best",
    )
    parser.add_argument(
        "--reference",
        metavar="REF.exr",
        type=file_argument,
        help="measure the error against this image",
    )
    parser.add_argument(
        "--stats", metavar="FILE.json", type=file_argument, help="write times, counts and errors"
    )
    parser.add_argument(
        "--checkpoint",
        metavar="FILE",
        type=file_argument,
        help="write what it takes to go on: now and then, at the end, and when interrupted",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        metavar="S",
        type=positive_number,
        default=30.0,
        help="render time between two checkpoints (default 30)",
    )
    parser.add_argument(
        "--resume",
        metavar="FILE",
        type=file_argument,
        help="go on from a checkpoint; budgets count what it holds",
    )
    parser.add_argument(
        "--save-cache",
        metavar="FILE",
        type=file_argument,
        help="write what guide and radiance cache have learned, for renders from other places",
    )
    parser.add_argument(
        "--load-cache", metavar="FILE", type=file_argument, help="begin with what was learned"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check everything that can be checked, render, write; return 130 if interrupted on the way."""
    from psf_cl.files import check_writable, remove_leftovers, write_whole
    from psf_cl.image import json_text, output_paths, write_exr, write_png
    from psf_cl.learned import table_names
    from psf_cl.plan import make_plan

    if args.frames and (args.checkpoint or args.resume):
        raise InputError("--frames: not with --checkpoint or --resume, which are of one image")
    frames = args.frames or range(1)
    paths = [output_paths(_frame_name(args, frame)) for frame in frames]
    outputs = [path for pair in paths for path in pair]
    outputs += [Path(name) for name in (args.stats, args.checkpoint, args.save_cache) if name]
    for path in outputs:
        check_writable(path)
        remove_leftovers(path)
    statistics = args.stats is not None
    # The device gets ready while the scene is read; a mistake in the scene does not wait for it.
    background = ThreadPoolExecutor(1)
    try:
        read = threading.Event()
        opening = background.submit(open_prepared_device, args.device, statistics, read)
        scene, settings = load_with_settings(args)
        read.set()
        inputs = [_other(args.resume, args.checkpoint), _other(args.load_cache, args.save_cache)]
        check_distinct(outputs, [*scene.files, args.reference, *inputs])
        for option in ("save_cache", "load_cache"):
            if getattr(args, option):
                table_names(settings, f"--{option.replace('_', '-')}")
        # For its checks; the device's own traits come later.
        make_plan(scene, settings, args.aov, crop=args.crop, room=room_of(args))
        reference = _reference(args, scene) if args.reference else None
        device = opening.result()
    finally:
        background.shutdown(wait=False)

    from psf_cl.renderer import Renderer

    if not args.quiet:
        tell_notes(scene.notes)
    renderer = Renderer(
        scene,
        settings,
        device,
        outputs=args.aov,
        crop=args.crop,
        statistics=statistics,
        halves=args.noise is not None,
        **first_time(args),
        room=room_of(args),
    )
    with closed_on_error(renderer):
        if args.load_cache:
            renderer.load_cache(args.load_cache)
        if args.resume:
            _resume(renderer, args)
    if not args.quiet:
        tell_notes(renderer.notes)
    all_stats = []
    checkpoints = Checkpoints(renderer, args.checkpoint, args.checkpoint_seconds)
    # Until the files are written, Ctrl-C must not throw the picture away.
    with stop_on_interrupt() as interrupted, contextlib.closing(renderer):
        for frame, (exr, png) in zip(frames, paths, strict=True):
            if args.frames and frame != frames.start:
                renderer.set_frame(frame / args.fps)
            image = _render_frame(args, renderer, reference, checkpoints, interrupted)
            write_exr(exr, image, args.half)
            write_png(png, image, args.exposure)
            all_stats.append(image.stats)
            if not args.quiet:
                print(_summary(exr, image))
            if interrupted():
                break
        if args.stats:
            stats = {"frames": all_stats} if args.frames else all_stats[0]
            stats["process_seconds"] = time.perf_counter() - START
            write_whole(args.stats, (json_text(stats, indent=2) + "\n").encode())
        if args.save_cache:
            # The largest file: if it finds no room, all else is written.
            renderer.save_cache(args.save_cache)
        stopped = interrupted()
    if checkpoints.failure is not None:
        raise checkpoints.failure
    if stopped:
        print("psf-cl: interrupted; what was rendered is written", file=sys.stderr)
    return 130 if stopped else 0


def _frame_name(args: argparse.Namespace, frame: int) -> str:
    """Return the name of the EXR of a frame: its number stands for the name's run of #."""
    default = Path(args.scene).stem + ("_####" if args.frames else "") + ".exr"
    name = args.output or default
    if args.frames is None:
        return name
    return numbered(name, frame, "-o")


def _render_frame(
    args: argparse.Namespace,
    renderer: Renderer,
    reference: np.ndarray | None,
    checkpoints: Checkpoints,
    interrupted: Callable[[], bool],
) -> Image:
    """Spend the budget on the frame that the renderer is at; return its image.

    Raises:
        KeyboardInterrupt: it was interrupted before there was a sample.
    """
    curve = ErrorCurve(reference)
    with ProgressDisplay(args.quiet) as display:

        def on_progress(progress: Progress) -> bool:
            display.update(progress)
            curve.follow(renderer, progress)
            checkpoints.follow(progress)
            return not interrupted()

        if args.noise:
            renderer.render_to(args.noise, on_progress)
        else:
            spp = None if args.seconds else args.spp or DEFAULT_SPP
            renderer.render(spp=spp, seconds=args.seconds, progress=on_progress)
    if args.checkpoint:
        renderer.settle()
    image = renderer.image()
    stats = image.stats
    checkpoints.save(stats["spp"])
    if args.noise:
        stats["estimated_relmse"] = renderer.estimated_error()
    if not stats["spp"] and not renderer.snapshot(("rgb", "samples")).aovs["samples"].any():
        raise KeyboardInterrupt
    if reference is not None:
        if stats["spp"]:
            curve.add(stats["render_seconds"], stats["spp"], image.rgb)
        stats["error"] = curve.points
    return image


def open_prepared_device(
    text: str | None, profiling: bool, read: threading.Event | None = None
) -> Device:
    """Open a device and make it ready, or say what a missing OpenCL needs."""
    try:
        from psf_cl.renderer import prepare_device
    except ImportError as error:
        raise DeviceError(f"no OpenCL ({error}); psf-cl doctor says what to do") from error
    return prepare_device(text, profiling, read)


def _resume(renderer: Renderer, args: argparse.Namespace) -> None:
    renderer.resume(args.resume)
    passes = renderer.scheduler.passes
    if args.spp and passes > args.spp:
        raise InputError(
            f"--spp: {args.resume} holds {passes} samples a pixel already, got {args.spp}"
        )


def _other(read: str | None, written: str | None) -> str | None:
    """Return the file that is read, unless it is the one to be written too, as it may be."""
    same = read and written and os.path.realpath(read) == os.path.realpath(written)
    return None if same else read


@contextlib.contextmanager
def closed_on_error(renderer: Renderer) -> Iterator[None]:
    """Give the device memory back if what is done inside fails."""
    try:
        yield
    except BaseException:
        renderer.close()
        raise


class Checkpoints:
    """Writes a checkpoint whenever one is due.

    Args:
        path: of the file; None for no checkpoints.
        seconds: render time between two.  Where writing takes long they are further apart, so that
            it costs a twentieth of the time at most.

    Attributes:
        failure: why the last one could not be written: no reason to lose the picture too.
    """

    def __init__(self, renderer: Renderer, path: str | None, seconds: float) -> None:
        self.failure: InputError | None = None
        self._renderer = renderer
        self._path = path
        self._seconds = seconds
        self._next: float | None = None
        self._saved = 0

    def follow(self, progress: Progress) -> None:
        """Save if it is time to; render time does not count it."""
        if self._path is None:
            return
        if self._next is None:
            self._next, self._saved = progress.seconds + self._seconds, progress.passes
        if progress.seconds >= self._next and progress.passes > self._saved:
            with self._renderer.outside_time():
                start = time.perf_counter()
                if self.save(progress.passes):
                    pause = max(self._seconds, 20.0 * (time.perf_counter() - start))
                    self._next, self._saved = progress.seconds + pause, progress.passes

    def save(self, passes: int) -> bool:
        """Write the checkpoint; return False if this is no moment for one."""
        if self._path is None or passes == 0:
            return False
        try:
            done = self._renderer.save(self._path)
            self.failure = None
            return done
        except InputError as error:
            if self.failure is None:
                tell_notes([f"{error}; rendering goes on without a checkpoint"])
            self.failure = error
            return True


class ErrorCurve:
    """Error over render time: after the first pass, at 1, 2, 4, ... seconds, and at the end.

    Attributes:
        points: seconds, spp and metrics, in order of time.
    """

    def __init__(self, reference: np.ndarray | None) -> None:
        self.points: list[dict[str, float]] = []
        self._reference = reference
        self._next_seconds = 0.0

    def follow(self, renderer: Renderer, progress: Progress) -> None:
        """Take a snapshot if it is time for one; render time does not count it."""
        if self._reference is None or progress.passes < 1 or progress.seconds < self._next_seconds:
            return
        with renderer.outside_time():
            self.add(progress.seconds, progress.passes, renderer.snapshot(("rgb",)).rgb)
        self._next_seconds = 1.0
        while self._next_seconds <= progress.seconds:
            self._next_seconds *= 2.0

    def add(self, seconds: float, spp: int, rgb: np.ndarray) -> None:
        """Append a point; in place of the last if no sample has been added since."""
        from psf_cl.measure.errors import compare

        if self.points and self.points[-1]["spp"] == spp:
            self.points.pop()
        metrics = compare(rgb, self._reference).as_dict()
        self.points.append({"seconds": seconds, "spp": spp, **metrics})


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C was pressed; the second Ctrl-C interrupts at once.

    SIGTERM is another Ctrl-C.  Outside the main thread, where Python delivers no signals, both keep
    their meanings.
    """
    pressed = False

    def on_signal(number: int, frame: object) -> None:
        nonlocal pressed
        pressed = True
        for each in INTERRUPTS:
            signal.signal(each, signal.default_int_handler)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {each: signal.signal(each, on_signal) for each in INTERRUPTS}
    try:
        yield lambda: pressed
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def _reference(args: argparse.Namespace, scene: Scene) -> np.ndarray:
    """Read the reference and return the part to be rendered, checked for being one."""
    import numpy as np

    from psf_cl.image import Image, read_exr
    from psf_cl.measure.errors import matching_part, mean_luminance

    x, y, width, height = args.crop or (0, 0, scene.width, scene.height)
    wanted = Image(
        {"rgb": np.empty((height, width, 3), np.float32)}, {}, x, y, scene.width, scene.height
    )
    rgb = matching_part(read_exr(args.reference), wanted, args.reference).rgb
    try:
        mean_luminance(rgb)
    except InputError as error:
        raise InputError(f"{args.reference}: {error}") from error
    return rgb


def _summary(path: Path, image: Image) -> str:
    stats = image.stats
    spp, seconds = stats["spp"], stats["render_seconds"]
    samples = image.width * image.height * spp
    rate = samples / seconds / 1e6 if seconds > 0.0 else math.inf
    count = f"{spp} spp" if spp else "part of the first pass"
    text = f"{path}: {count} in {seconds:.2f} s, {rate:.2f} Msamples/s"
    if "estimated_relmse" in stats:
        text += f", estimated relMSE {stats['estimated_relmse']:.4g}"
    if stats.get("error"):
        last = stats["error"][-1]
        text += f", relMSE {last['relmse']:.4g}, trimmed {last['relmse_trimmed']:.4g}"
        if last["nonfinite"]:
            text += f", {last['nonfinite']} pixels not finite"
    return text
