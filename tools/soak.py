"""Render at random until told to stop: ``python tools/soak.py --seconds 7200 [--state FILE]``.

Each round takes a random scene, preset, settings that go with it, size and budget, and renders it
as a user would, in a process of its own: once without a stop; and once more, stopped again and
again by kill -9, SIGTERM or SIGINT, or left alone, and resumed from its checkpoint.  Of a scene
that moves it renders some frames, which have no checkpoint: the next begins anew.  A round fails
if a process ends in a traceback or by a signal that it should have handled, a pixel is not finite,
also of what a stop leaves, the two images differ in a bit, a frame that was whole when the process
was stopped is another one, or something is left in the folder.  The round of a seed is always the
same; ``--state`` keeps the next seed and the sums, so that a soak goes on in parts.

The memory of long renders is watched too: of one process that renders all still scenes with all
presets again and again.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import itertools
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from psf_cl.cli.common import positive_number
from psf_cl.errors import InputError
from psf_cl.files import write_whole
from psf_cl.image import read_exr
from psf_cl.plan import make_plan
from psf_cl.scene.load import load_scene
from psf_cl.settings import PRESETS, Settings, resolve

ROOT = Path(__file__).resolve().parent.parent
SCENES = ROOT / "scenes"
STILL = tuple(sorted(path.name for path in SCENES.glob("*.toml")))
MOVING = tuple(sorted(f"moving/{path.name}" for path in (SCENES / "moving").glob("*.toml")))

#: Rounds of moving scenes among all.
MOVING_SHARE = 0.25

#: A part of a render that was not stopped has to end after so many seconds.
MOST_SECONDS = 900.0

#: A process is stopped after so many seconds at the earliest, half of which it starts in, and so
#: many more on average; but not before it has a handler.
FIRST_STOP, MEAN_STOP = 1.0, 1.5

#: Numbers that a round may set a setting to: ends of ranges take too long for many rounds.
LARGEST = 64.0

#: Growth of a process that renders picture after picture, bytes a picture; and of these the first,
#: as often as there are scenes and presets, which compile programs and fill pools.
MOST_GROWTH = 16 << 10
WARM_UPS = 2

#: Stops after which some checkpoint has to have been there.
FEW_STOPS = 20


@dataclass(frozen=True)
class Round:
    """What a seed stands for."""

    scene: str
    preset: str
    settings: tuple[tuple[str, Any], ...]
    size: tuple[int, int]
    spp: int
    memory: int | None
    stops: tuple[tuple[str, float], ...]
    frames: tuple[int, int] | None = None

    def arguments(self) -> list[str]:
        """Return what ``psf-cl render`` is told in any case."""
        width, height = self.size
        sets = [f"{key}={json.dumps(value)}".replace('"', "") for key, value in self.settings]
        memory = ["--memory", str(self.memory)] if self.memory else []
        frames = ["--frames", "{}:{}".format(*self.frames), "--fps", "24"] if self.frames else []
        return [
            *(f"scenes/{self.scene}", "--preset", self.preset, "--quiet", *memory, *frames),
            *("--size", f"{width}x{height}", "--spp", str(self.spp)),
            *(["--set", *sets] if sets else []),
        ]


def round_of(seed: int) -> Round:
    """Return the round of a seed."""
    chance = random.Random(seed)
    moving = chance.random() < MOVING_SHARE
    scene = chance.choice(MOVING if moving else STILL)
    preset = chance.choice(list(PRESETS))
    settings = _settings(scene, preset, chance)
    pixels = 2 ** chance.uniform(0, 13)
    width = max(round(pixels ** chance.uniform(0.2, 0.8)), 1)
    stops = tuple(
        (chance.choice(["KILL", "TERM", "INT"]), FIRST_STOP + chance.expovariate(1.0 / MEAN_STOP))
        for _ in range(chance.randrange(4))
    )
    first = chance.randrange(12)
    return Round(
        scene,
        preset,
        settings,
        (width, max(round(pixels / width), 1)),
        max(round(2 ** chance.uniform(0, 6 if moving else 9)), 1),
        chance.choice([None, None, 64, 512]),
        stops,
        (first, first + chance.randrange(1, 7)) if moving else None,
    )


def _settings(scene: str, preset: str, chance: random.Random) -> tuple[tuple[str, Any], ...]:
    """Return some settings that the scene and the preset go with."""
    chosen: dict[str, Any] = {}
    loaded = load_scene(ROOT / "scenes" / scene, size=(4, 4))
    for item in chance.sample(fields(Settings), chance.randrange(5)):
        meta = item.metadata
        if "choices" in meta:
            value: Any = chance.choice(meta["choices"])
        elif meta.get("switch"):
            value = chance.random() < 0.5
        else:
            low, high = meta["range"]
            value = type(item.default)(chance.uniform(low, min(high, max(LARGEST, low))))
        with contextlib.suppress(InputError):
            both = chosen | {item.name: value}
            make_plan(loaded, resolve(loaded.render, scene, preset, both))
            chosen = both
    return tuple(chosen.items())


@dataclass
class Outcome:
    """What came of a round.

    Attributes:
        failure: what went wrong; empty if nothing did.
        refused: whether there was too little memory for it, which was said.
        stops: signals that a process got before it was done.
        resumed: parts that went on from a checkpoint.
    """

    failure: str = ""
    refused: bool = False
    stops: int = 0
    resumed: int = 0


def run_round(now: Round, folder: Path) -> Outcome:
    """Run a round."""
    number = "_##" if now.frames else ""
    whole, stopped = folder / f"whole{number}.exr", folder / f"stopped{number}.exr"
    state = folder / "state"
    outcome = Outcome()
    code, text = _render([*now.arguments(), "-o", str(whole)])
    if code == 1 and now.memory and "MiB" in text and "Traceback" not in text:
        outcome.refused = True
        return outcome
    if code != 0:
        outcome.failure = f"code {code}: {text}"
        return outcome
    again = [*now.arguments(), "-o", str(stopped)]
    if now.frames is None:
        again += ["--checkpoint", str(state), "--checkpoint-seconds", "0.05"]
    for name, seconds in now.stops:
        for path in folder.glob("stopped*") if now.frames else ():
            path.unlink()  # The next part may come less far: which is the last would not be known.
        code, text = _render([*again, *_resume(state)], name, seconds)
        outcome.stops += code != 0
        outcome.resumed += state.exists()
        if code in (0, 130) or (name == "KILL" and code == -signal.SIGKILL):
            outcome.failure = _difference(now, folder, code == 0)
        else:
            outcome.failure = f"code {code}: {text}"
        if "Traceback" in text:
            outcome.failure = text
        if outcome.failure:
            outcome.failure = f"stopped by {name}: {outcome.failure}"
            return outcome
    code, text = _render([*again, *_resume(state)])
    if code != 0:
        outcome.failure = f"the last part: code {code}: {text}"
        return outcome
    # A part of an image that was being written when the process was killed stays until the next
    # render to that name.
    left = sorted(path.name for path in folder.iterdir() if path.name.startswith(".psf_cl"))
    outcome.failure = f"left behind: {', '.join(left)}" if left else _difference(now, folder, True)
    return outcome


def _resume(state: Path) -> list[str]:
    return ["--resume", str(state)] if state.exists() else []


def _difference(now: Round, folder: Path, done: bool) -> str:
    """Compare the images that were stopped with the whole ones; return what is wrong.

    Args:
        done: whether all have to be there.  Else the last, or only one, may hold fewer samples.
    """
    ends = [f"_{frame:02d}.exr" for frame in range(*now.frames)] if now.frames else [".exr"]
    there = [end for end in ends if (folder / f"stopped{end}").exists()]
    if done and there != ends:
        return f"{len(ends) - len(there)} images are missing"
    for end in there:
        one, other = (read_exr(folder / f"{name}{end}").rgb for name in ("whole", "stopped"))
        if not (np.isfinite(one).all() and np.isfinite(other).all()):
            return f"{end}: a pixel is not finite"
        if one.tobytes() != other.tobytes() and (done or end != there[-1]):
            return f"{end}: stopped and whole are different images"
    return ""


def _render(arguments: list[str], stop: str = "", seconds: float = MOST_SECONDS) -> tuple[int, str]:
    """Run ``psf-cl render``; return its code and what it said to standard error."""
    command = [sys.executable, "-m", "psf_cl", "render", *arguments]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        try:
            _, text = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            if not stop:
                process.kill()
                return 1, f"not done after {seconds:.0f} s"
            while stop != "KILL" and process.poll() is None and not _handles(process.pid):
                time.sleep(0.01)
            process.send_signal(getattr(signal, f"SIG{stop}"))
            _, text = process.communicate(timeout=MOST_SECONDS)
    return process.returncode, text.strip()


def _handles(process: int) -> bool:
    """Return whether a process has a handler of SIGTERM; True where that is not to be known.

    Python has none, and a handler of SIGINT that ends in a traceback before the program's own code
    runs.
    """
    try:
        status = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return True
    caught = int(status.partition("SigCgt:")[2].split()[0], 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


def memory_growth(rounds: int) -> float:
    """Return how much a process grows that renders one picture after another, bytes a picture.

    Args:
        rounds: of all scenes and presets, after those that warm it up; at least two.
    """
    from psf_cl.device.device import open_device
    from psf_cl.renderer import Renderer

    device, sizes = open_device(), []
    for _ in range(WARM_UPS + rounds):
        for name, preset in itertools.product(STILL, PRESETS):
            scene = load_scene(SCENES / name, size=(64, 64))
            with contextlib.closing(
                Renderer(scene, resolve({}, scene.path, preset), device)
            ) as renderer:
                renderer.render(spp=4)
                renderer.image()
            if device.allocated_bytes:
                raise AssertionError(f"{device.allocated_bytes} bytes of the device are left")
            sizes.append(_resident())
    # Means of whole rounds: scenes differ in size.
    pictures = len(STILL) * len(PRESETS)
    means = np.reshape(sizes, (-1, pictures)).mean(axis=1)[WARM_UPS:]
    return float(np.polyfit(range(rounds), means, 1)[0]) / pictures


def _resident() -> int:
    gc.collect()
    # What is free but not given back goes up and down by more than anything that could leak.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    return pages * os.sysconf("SC_PAGE_SIZE")


def main(argv: Sequence[str] | None = None) -> int:
    """Soak; return 1 if anything failed so far, those of earlier parts too."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=positive_number, default=600.0, help="of this part")
    parser.add_argument("--seed", type=int, help="the first round; default: where --state ended")
    parser.add_argument("--state", type=Path, help="file that keeps the sums")
    parser.add_argument("--count", type=int, default=1 << 60, help="rounds at most")
    parser.add_argument(
        "--memory-rounds",
        type=int,
        choices=range(2, 100),
        metavar="N",
        default=4,
        help="of the watch on memory, at least 2",
    )
    args = parser.parse_args(argv)
    sums = dict.fromkeys(("next_seed", "rounds", "refused", "stops", "resumed"), 0)
    sums |= {"seconds": 0.0, "failures": []}
    if args.state is not None and args.state.exists():
        sums |= json.loads(args.state.read_text())
    if args.seed is not None:
        sums["next_seed"] = args.seed
    begin = last = time.monotonic()
    done = 0
    while time.monotonic() - begin < args.seconds and done < args.count:
        now, done = round_of(sums["next_seed"]), done + 1
        with tempfile.TemporaryDirectory() as folder:
            outcome = run_round(now, Path(folder))
        if outcome.failure:
            sums["failures"].append(f"seed {sums['next_seed']}: {now}: {outcome.failure}")
            print(sums["failures"][-1], flush=True)
        sums["next_seed"] += 1
        sums["rounds"] += 1
        sums["refused"] += outcome.refused
        sums["stops"] += outcome.stops
        sums["resumed"] += outcome.resumed
        sums["seconds"] += time.monotonic() - last
        last = time.monotonic()
        if args.state is not None:
            write_whole(args.state, json.dumps(sums, indent=2).encode())
    growth = memory_growth(args.memory_rounds)
    print(
        f"{sums['rounds']} rounds, {sums['refused']} refused for their memory, "
        f"{sums['stops']} stops, {sums['resumed']} parts resumed, {sums['seconds']:.0f} s: "
        f"{len(sums['failures'])} failures; memory grew by {growth / 2**10:.1f} KiB a picture"
    )
    return int(is_bad(sums, growth))


def is_bad(sums: Mapping[str, Any], growth: float) -> bool:
    """Say whether anything failed, nothing was ever resumed, or memory is not flat."""
    lost = sums["stops"] >= FEW_STOPS and not sums["resumed"]
    return bool(sums["failures"]) or lost or not growth <= MOST_GROWTH


if __name__ == "__main__":
    sys.exit(main())
