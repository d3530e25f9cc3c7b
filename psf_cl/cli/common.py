"""What several commands share: options, their types, and how text is shown."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from psf_cl.errors import InputError
from psf_cl.settings import AOVS, PRESETS, Settings, resolve

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import RenderableType

    from psf_cl.plan import Room
    from psf_cl.scene.model import Scene


#: When the program started, by ``time.perf_counter()``.
START = time.perf_counter()


#: Frames of one sequence.
MAX_FRAMES = 100_000


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(allow_abbrev=False, **arguments)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (see {self.prog} --help)")


def size_argument(text: str) -> tuple[int, int]:
    """Parse ``WxH``; the scene knows the largest size."""
    numbers = _integers(text, text.lower().split("x"), 2)
    if numbers is None or min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"expected WxH in pixels; got {text!r}")
    return numbers[0], numbers[1]


def crop_argument(text: str) -> tuple[int, int, int, int]:
    """Parse ``X,Y,W,H``; ``make_plan`` knows whether it lies in the picture."""
    numbers = _integers(text, text.split(","), 4)
    if numbers is None or min(numbers[:2]) < 0 or min(numbers[2:]) < 1:
        raise argparse.ArgumentTypeError(
            f"expected X,Y,W,H in pixels, top left first; got {text!r}"
        )
    return numbers[0], numbers[1], numbers[2], numbers[3]


def aov_argument(text: str) -> frozenset[str]:
    """Parse a list of AOV names, or ``all``; ``make_plan`` knows which there are."""
    names = frozenset(part.strip() for part in text.split(","))
    return names - {"all"} | set(AOVS) if "all" in names else names


def frames_argument(text: str) -> range:
    """Parse ``A:B``: the frames from A to B - 1."""
    numbers = _integers(text, text.split(":"), 2)
    if numbers is None or not numbers[0] < numbers[1] <= numbers[0] + MAX_FRAMES < 1 << 31:
        raise argparse.ArgumentTypeError(
            f"expected A:B, frames A to B - 1, at most {MAX_FRAMES}; got {text!r}"
        )
    return range(*numbers)


def numbered(name: str, frame: int, option: str) -> str:
    """Return a name of files with the number of a frame in place of its run of #.

    Raises:
        InputError: it has none, or several; ``option`` is what gave it.
    """
    folder, last = os.path.split(name)
    marks = re.findall("#+", last)
    if len(marks) != 1:
        raise InputError(
            f"{option}: expected one run of # in the name, for the frame; got {name!r}"
        )
    number = str(frame).zfill(len(marks[0]))
    return os.path.join(folder, last.replace(marks[0], number))


def file_argument(text: str) -> str:
    """Parse the name of a file."""
    if not text:
        raise argparse.ArgumentTypeError(f"expected the name of a file; got {text!r}")
    return text


def positive_integer(text: str) -> int:
    """Parse an integer above 0 that a 32-bit counter holds."""
    numbers = _integers(text, [text], 1)
    if numbers is None or not 1 <= numbers[0] < 1 << 31:
        raise argparse.ArgumentTypeError(f"expected an integer from 1 to 2147483647; got {text!r}")
    return numbers[0]


def positive_number(text: str) -> float:
    """Parse a finite number above 0."""
    number = _number(text)
    if not (0.0 < number < math.inf):
        raise argparse.ArgumentTypeError(f"expected a number above 0; got {text!r}")
    return number


def number_from_zero(text: str) -> float:
    """Parse a finite number, 0 or above."""
    number = _number(text)
    if not (0.0 <= number < math.inf):
        raise argparse.ArgumentTypeError(f"expected a number, 0 or above; got {text!r}")
    return number


def exposure_argument(text: str) -> float:
    """Parse an exposure in EV."""
    number = _number(text)
    if not abs(number) <= 100.0:
        raise argparse.ArgumentTypeError(f"expected a number from -100 to 100; got {text!r}")
    return number


def setting_argument(text: str) -> tuple[str, str]:
    """Parse ``key=value``."""
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise argparse.ArgumentTypeError(
            f"expected key=value; got {text!r} (the scene goes before --set)"
        )
    return key.strip(), value.strip()


def add_picture_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what decides what the picture is of."""
    parser.add_argument(
        "scene",
        metavar="SCENE",
        type=file_argument,
        help=".toml, .gltf, .glb, .obj, .ply or .stl",
    )
    parser.add_argument(
        "--size", metavar="WxH", type=size_argument, help="pixels; the vertical field of view stays"
    )
    parser.add_argument("--camera", metavar="NAME", help="a camera of the scene, by its name")
    parser.add_argument(
        "--environment",
        metavar="FILE",
        type=file_argument,
        help="lat-long image (.exr, .hdr) as the scene's sky; none for no sky",
    )


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Add all that decides what is rendered and how: the same for ``render`` and ``plan``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _settings_help()
    add_picture_arguments(parser)
    parser.add_argument("--preset", metavar="NAME", help=f"one of: {', '.join(PRESETS)}")
    parser.add_argument(
        "--set",
        dest="settings",
        metavar="KEY=VALUE",
        type=setting_argument,
        nargs="+",
        action="extend",
        default=[],
        help="change settings (listed below)",
    )
    parser.add_argument("--seed", metavar="N", help="the same as --set seed=N")
    parser.add_argument(
        "--crop", metavar="X,Y,W,H", type=crop_argument, help="render only this part"
    )
    parser.add_argument(
        "--memory",
        metavar="MIB",
        type=positive_integer,
        help="device memory that may be taken; less than the device has makes the pool smaller",
    )
    parser.add_argument(
        "--aov",
        metavar="A,B,...",
        type=aov_argument,
        default=frozenset(),
        help=f"further channels: {', '.join(AOVS)}; or all",
    )


def add_frame_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what makes a render a sequence."""
    parser.add_argument(
        "--frames",
        metavar="A:B",
        type=frames_argument,
        help="render frames A to B - 1, each with the budget; #### in OUT is the frame's number",
    )
    parser.add_argument(
        "--fps", metavar="F", type=positive_number, default=24.0, help="frames a second (24)"
    )
    parser.add_argument(
        "--clip", metavar="NAME", help="the animation of a glTF file to play, by name or number"
    )


def room_of(args: argparse.Namespace) -> Room | None:
    """Return what ``--memory`` allows, None if it was not given."""
    from psf_cl.plan import Room

    return None if args.memory is None else Room(args.memory << 20)


def first_time(args: argparse.Namespace) -> dict[str, float]:
    """Return the time of the first frame as an argument of ``Renderer``; none for one image."""
    return {"time": args.frames.start / args.fps} if args.frames else {}


def load_with_settings(args: argparse.Namespace) -> tuple[Scene, Settings]:
    """Load the scene and combine the settings.

    Raises:
        InputError: anything about them is wrong.
    """
    from psf_cl.scene.load import load_scene

    if getattr(args, "clip", None) and not args.frames:
        raise InputError("--clip: expected --frames A:B with it: in one image nothing moves")
    # Only a sequence reads what moves.
    motion = {"moving": True, "clip": args.clip} if getattr(args, "frames", None) else {}
    scene = load_scene(
        args.scene, environment=args.environment, camera=args.camera, size=args.size, **motion
    )
    settings = resolve(scene.render, scene.path, args.preset, dict(args.settings))
    if args.seed is not None:
        settings = settings.with_values({"seed": args.seed}, "--")
    return scene, settings


def check_distinct(outputs: Iterable[str | Path], inputs: Iterable[str | Path | None]) -> None:
    """Make sure that no output is an input or another output.

    Raises:
        InputError: one is, by whatever name.
    """
    taken = {os.path.realpath(path) for path in inputs if path is not None}
    for path in outputs:
        real = os.path.realpath(path)
        if real in taken:
            raise InputError(f"{path}: cannot write: it is another input or output of this command")
        taken.add(real)


def tell_notes(notes: Iterable[str]) -> None:
    """Print what was assumed or left out, a line each: names in files may have line breaks."""
    for note in notes:
        print(f"note: {' '.join(note.split())}", file=sys.stderr)


def show(*renderables: RenderableType, file: TextIO | None = None) -> None:
    """Print tables and text to standard output (or ``file``), wide enough when it is no terminal.

    Text is taken as it is: brackets in names are no markup.
    """
    from rich.console import Console

    file = file or sys.stdout
    width = None if file.isatty() else 120
    console = Console(file=file, width=width, markup=False, highlight=False, emoji=False)
    # By way of a string, because rich turns a closed pipe into an exit of its own.
    with console.capture() as capture:
        for renderable in renderables:
            console.print(renderable)
    file.write(capture.get())


def _settings_help() -> str:
    """Return what each setting is for and may be, in lines as wide as those of the options."""
    import dataclasses
    import shutil
    import textwrap

    width = max(shutil.get_terminal_size().columns - 2, 60)
    column = max(len(item.name) for item in dataclasses.fields(Settings)) + 3
    indent = " " * column
    lines = ["settings:"]
    for item in dataclasses.fields(Settings):
        default = str(item.default).lower() if isinstance(item.default, bool) else item.default
        if isinstance(item.default, bool):
            values = "true | false"
        elif "choices" in item.metadata:
            values = " | ".join(item.metadata["choices"])
        else:
            low, high = item.metadata["range"]
            values = f"{low:g} to {high:g}" if isinstance(low, float) else f"{low} to {high}"
        for text, start in (
            (item.metadata["doc"], f"  {item.name}".ljust(column)),
            (f"{values}; default {default}", indent),
        ):
            lines += textwrap.wrap(
                text, width, initial_indent=start, subsequent_indent=indent, break_on_hyphens=False
            )
    return "\n".join(lines)


def _integers(text: str, parts: list[str], count: int) -> list[int] | None:
    """Return ``parts`` as integers, or None if they are not ``count`` plain decimal numbers."""
    if len(parts) != count or not all(p.strip().isascii() and p.strip().isdigit() for p in parts):
        return None
    # Longer numbers are out of every range, and int() itself refuses thousands of digits.
    return [int(part) for part in parts] if len(text) < 64 else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
