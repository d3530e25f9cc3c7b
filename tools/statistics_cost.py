"""What ``--stats`` costs: ``python tools/statistics_cost.py SCENE``.

Renders with and without statistics (profiling events, census of the pool) in turns and prints the
ratio of the processor time that both took, with a 95 % bootstrap interval of the median of the
rounds' ratios. Processor time, because on a shared machine wall time tells more of the neighbours.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from measuring import interleaved

import psf_cl
from psf_cl.cli.common import positive_integer, size_argument
from psf_cl.device.device import open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.renderer import Renderer

RESAMPLES = 4000


def stepper(scene: psf_cl.Scene, statistics: bool, passes: int) -> Callable[[], float]:
    """Return what renders ``passes`` more samples a pixel and returns the processor time in s."""
    renderer = Renderer(scene, device=open_device(profiling=statistics), statistics=statistics)

    ends = itertools.count(passes, passes)

    def step() -> float:
        start = time.process_time()
        renderer.render(spp=next(ends))
        return time.process_time() - start

    step()
    return step


def interval(ratios: np.ndarray) -> tuple[float, float]:
    """Return the 95 % bootstrap interval of the median of ``ratios`` (float[rounds])."""
    draws = np.random.default_rng(0).integers(0, len(ratios), (RESAMPLES, len(ratios)))
    low, high = np.percentile(np.median(ratios[draws], axis=1), [2.5, 97.5])
    return float(low), float(high)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the tool; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--size", type=size_argument, default=(256, 256))
    parser.add_argument("--spp", type=positive_integer, default=16, help="a round (%(default)s)")
    parser.add_argument("--rounds", type=positive_integer, default=60)
    args = parser.parse_args(arguments)
    try:
        scene = psf_cl.load_scene(args.scene, size=args.size)
        subjects = {"off": stepper(scene, False, args.spp), "on": stepper(scene, True, args.spp)}
    except (InputError, DeviceError) as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    times = interleaved(subjects, args.rounds).values
    ratios = np.asarray(times["on"]) / np.asarray(times["off"])
    low, high = interval(ratios)
    median = float(np.median(ratios))
    print(f"--stats: {median:.4f} of the processor time without ({low:.4f} to {high:.4f})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
