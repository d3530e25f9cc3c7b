"""Who takes part in ``psf-cl converge``, and how one run of each is made, kept and found again.

A finished run is a folder: ``run.json`` and one EXR for each mark.  Its name is a digest of all
that decides the pictures, so that a rerun finds what is done and only that.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shlex
import shutil
import signal
import subprocess
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import psf_cl
from psf_cl.device.sources import kernel_folder
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import write_whole
from psf_cl.image import Image, json_text, read_exr, write_exr
from psf_cl.measure.curves import Run, Snapshot
from psf_cl.scene.digest import scene_digest
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings

if TYPE_CHECKING:
    from psf_cl.device.device import Device
    from psf_cl.renderer import Progress

#: A budget so short that a renderer stops after its first pass.
FIRST_PASS_SECONDS = 0.001

# A command that is still not back after this many times its budget, and that many seconds, hangs.
_PATIENCE, _PATIENCE_SECONDS = 20.0, 300.0


class RunError(Exception):
    """One run failed; the others go on.  The message is one line."""


@dataclass(frozen=True)
class Mark:
    """A budget at which the picture is looked at: samples a pixel, or seconds of rendering."""

    spp: int = 0
    seconds: float = 0.0

    @property
    def label(self) -> str:
        if self.seconds:
            return f"{self.seconds:g} s"
        return "first pass" if self.spp == 1 else f"{self.spp} spp"


@dataclass(frozen=True)
class Contestant:
    """A way of rendering: settings of ours, or a command line (a tuple of arguments)."""

    name: str
    settings: Settings | None = None
    command: tuple[str, ...] = ()


@dataclass(frozen=True)
class Arena:
    """What is the same for all contestants.

    Attributes:
        start_seconds: spent before the first run on what every process has to do: importing,
            opening the device, reading the scene.
        folder: where runs are kept.
    """

    scene: Scene
    device: Device | None
    marks: tuple[Mark, ...]
    folder: Path
    start_seconds: float = 0.0


def time_marks(seconds: float) -> tuple[Mark, ...]:
    """Return the first pass, 1, 2, 4, ... seconds, and ``seconds``."""
    powers = range(math.ceil(math.log2(max(seconds, 1.0))))
    budgets = [2.0**power for power in powers if 2.0**power < seconds] + [seconds]
    return (Mark(spp=1), *(Mark(seconds=budget) for budget in budgets))


def run_key(arena: Arena, contestant: Contestant, seed: int) -> str:
    """Return a digest of all that decides the pictures of a run."""
    content: dict[str, Any] = {
        "scene": scene_digest(arena.scene),
        "marks": [asdict(mark) for mark in arena.marks],
        "seed": seed,
    }
    if contestant.settings is not None and arena.device is not None:
        content["settings"] = asdict(replace(contestant.settings, seed=seed))
        content["device"] = [arena.device.name, arena.device.driver]
        content["version"] = [psf_cl.__version__, code_digest()]
    else:
        content["command"] = contestant.command
    return hashlib.sha256(json_text(content).encode()).hexdigest()[:16]


def code_digest() -> str:
    """Return the SHA-256 of the sources that decide what is rendered, and how fast."""
    package = Path(psf_cl.__file__).parent
    sources = [p for p in package.rglob("*.py") if p.parent.name not in ("cli", "measure")]
    kernels = [p for p in kernel_folder().rglob("*") if p.suffix in (".cl", ".h")]
    digest = hashlib.sha256()
    for path in sorted(sources) + sorted(kernels):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def find_run(arena: Arena, contestant: Contestant, seed: int) -> Run | None:
    """Return a finished run, or None if there is none (whole)."""
    folder = _run_folder(arena, contestant, seed)
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        snapshots = tuple(_snapshot(folder, int(row["mark"]), row) for row in record["snapshots"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    whole = all((folder / _file_name(snapshot.mark)).is_file() for snapshot in snapshots)
    return Run(seed, snapshots) if whole and snapshots else None


def make_run(arena: Arena, contestant: Contestant, seed: int) -> Run:
    """Render once, and keep it.

    Raises:
        RunError: it failed.  Nothing of it is kept.
    """
    folder = _run_folder(arena, contestant, seed)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    render = _render if contestant.settings is not None else _command
    try:
        part.mkdir(parents=True)
        rows = render(arena, contestant, seed, part)
        record = {"contestant": contestant.name, "seed": seed, "snapshots": rows}
        write_whole(part / "run.json", (json_text(record, indent=2) + "\n").encode())
        shutil.rmtree(folder, ignore_errors=True)
        part.rename(folder)
    except (DeviceError, InputError) as error:
        raise RunError(str(error)) from error
    except MemoryError as error:
        raise RunError("out of memory") from error
    except OSError as error:
        raise RunError(f"{folder}: cannot write: {error.strerror}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return Run(seed, tuple(_snapshot(folder, row["mark"], row) for row in rows))


def _run_folder(arena: Arena, contestant: Contestant, seed: int) -> Path:
    return arena.folder / run_key(arena, contestant, seed)


def _file_name(mark: int) -> str:
    return f"{mark}.exr"


def _snapshot(folder: Path, mark: int, row: dict[str, Any]) -> Snapshot:
    seconds, process_seconds = float(row["seconds"]), float(row["process_seconds"])
    load = partial(_load, folder / _file_name(mark))
    return Snapshot(mark, seconds, process_seconds, int(row["spp"]), load)


def _load(path: Path) -> np.ndarray:
    return read_exr(path).rgb


def _render(
    arena: Arena, contestant: Contestant, seed: int, folder: Path
) -> list[dict[str, float]]:
    """Render with settings of ours; return a row for each snapshot."""
    from psf_cl.renderer import Renderer

    assert contestant.settings is not None
    rows: list[dict[str, float]] = []
    begin = time.perf_counter()
    renderer = Renderer(arena.scene, replace(contestant.settings, seed=seed), arena.device)
    set_up = arena.start_seconds + time.perf_counter() - begin

    def take(mark: int, seconds: float, spp: int) -> None:
        write_exr(folder / _file_name(mark), renderer.snapshot())
        rows.append(
            {"mark": mark, "seconds": seconds, "process_seconds": set_up + seconds, "spp": spp}
        )

    def later(mark: int, seconds: float) -> bool:
        return arena.marks[mark].seconds > seconds

    try:
        clock, last = renderer.scheduler.clock, len(arena.marks) - 1
        if not arena.marks[last].seconds:
            for index, mark in enumerate(arena.marks):
                renderer.render(spp=mark.spp)
                take(index, clock.now(), mark.spp)
            return rows

        # The first pass apart: a batch may complete several.
        renderer.render(spp=1)
        take(0, clock.now(), 1)
        due = next(k for k in range(1, last + 1) if k == last or later(k, clock.now()))

        def follow(progress: Progress) -> None:
            nonlocal due
            # The last mark waits for the end: the pass in which the budget ends counts.
            if due < last and not later(due, progress.seconds):
                with renderer.outside_time():
                    take(due, progress.seconds, progress.passes)
                while due < last and not later(due, progress.seconds):
                    due += 1

        if later(last, clock.now()):
            renderer.render(seconds=arena.marks[last].seconds, progress=follow)
        passes = renderer.scheduler.passes
        if passes > rows[-1]["spp"]:
            take(last, clock.now(), passes)
    finally:
        renderer.close()
    return rows


def _command(
    arena: Arena, contestant: Contestant, seed: int, folder: Path
) -> list[dict[str, float]]:
    """Run a command once for each mark; return a row for each."""
    rows = []
    for index, mark in enumerate(arena.marks):
        out, stats = folder / _file_name(index), folder / "stats.json"
        stats.unlink(missing_ok=True)
        budget = mark.seconds or FIRST_PASS_SECONDS
        values = {
            "{scene}": os.path.abspath(arena.scene.path),
            "{seconds}": f"{budget:g}",
            "{spp}": str(mark.spp),
            "{out}": str(out.absolute()),
            "{seed}": str(seed),
            "{width}": str(arena.scene.width),
            "{height}": str(arena.scene.height),
            "{stats}": str(stats.absolute()),
        }
        arguments = list(contestant.command)
        for word, value in values.items():
            arguments = [argument.replace(word, value) for argument in arguments]
        seconds = _spend(arguments, _PATIENCE_SECONDS + _PATIENCE * budget)
        image = read_exr(out)
        _check_size(image, arena.scene)
        said = _said(stats)
        rows.append(
            {
                "mark": index,
                "seconds": said.get("render_seconds", seconds),
                "process_seconds": seconds,
                "spp": int(said.get("spp", 0)),
            }
        )
    (folder / "stats.json").unlink(missing_ok=True)
    return rows


def _spend(arguments: list[str], patience: float) -> float:
    """Run a command to its end; return the seconds that it took.

    Raises:
        RunError: it cannot be started, fails, or hangs.
    """
    begin = time.perf_counter()
    name = arguments[0]
    try:
        # In a group of its own, so that what it started ends with it.
        with subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as process:
            try:
                said, _ = process.communicate(timeout=patience)
            except subprocess.TimeoutExpired:
                raise RunError(f"{name}: not back after {patience:.0f} s") from None
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
    except (OSError, ValueError) as error:
        raise RunError(f"{name}: cannot be started: {error}") from error
    if process.returncode != 0:
        lines = said.decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "no message")
        raise RunError(f"{name}: exit code {process.returncode}: {last[:200]}")
    return time.perf_counter() - begin


def _said(path: Path) -> dict[str, float]:
    """Return the numbers that a command wrote of itself; none if it did not."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(content, dict):
        return {}
    numbers = {name: content.get(name) for name in ("render_seconds", "spp")}
    return {
        name: float(value)
        for name, value in numbers.items()
        if isinstance(value, (int, float)) and 0.0 < value < math.inf
    }


def _check_size(image: Image, scene: Scene) -> None:
    if (image.width, image.height) != (scene.width, scene.height):
        raise RunError(
            f"expected {scene.width}x{scene.height} pixels; got {image.width}x{image.height}"
        )


def split_command(text: str, budget: str) -> tuple[str, ...]:
    """Parse a command line as a shell would, without variables, pipes and the like.

    Args:
        budget: the placeholder of the budget, ``{seconds}`` or ``{spp}``.

    Raises:
        ValueError: a quote is open, or ``{out}`` or the budget is missing.
    """
    arguments = tuple(shlex.split(text))
    for word in ("{out}", budget):
        if not any(word in argument for argument in arguments):
            raise ValueError(f"expected a command with {word} in it")
    return arguments
