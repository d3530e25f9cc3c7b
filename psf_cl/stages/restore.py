"""Restore: what averages per cell took from the picture goes back where it is no noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from psf_cl.device import layout
from psf_cl.stages import film
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

if TYPE_CHECKING:
    from psf_cl.device.device import Buffer
    from psf_cl.device.program import Program

#: Pixels to each side of the windows in which it is looked for, one after the other: of few passes
#: nothing shows in the ones between.
RADII_OF_FEW, RADII = (8, 2), (8, 4, 2, 1)
MANY_PASSES = 16


def radii(passes: int) -> tuple[int, ...]:
    """Return the windows of so many passes."""
    return RADII if passes >= MANY_PASSES else RADII_OF_FEW


def caution(passes: int) -> float:
    """Return how much of a squared mean counts as noise, in variances of it.

    One is right where means are normal (James, Stein 1961), which those of few samples are not: two
    up to 32 passes, ever less from there.
    """
    return 1.0 + min(1.0, 32.0 / max(passes, 1))


def tilt(passes: int, splits: int = 1) -> float:
    """Return how much more of so many passes the first half has than the second, of 1 in all.

    The halves are those of ``pass_is_in_half`` (``cl/common/passes.h``) of as many ``splits``, for
    these begin alike.
    """
    if passes < 1:
        return 1.0
    numbers = np.arange(passes, dtype=np.int64) // splits
    run = np.frexp(np.maximum(numbers, 1))[1] - 1 >> 1
    return float(1.0 - 2.0 * ((numbers >> run) & 1).mean())


def tiles(size: tuple[int, int]) -> int:
    """Return the tiles of a picture of so many pixels across and down."""
    edge = layout.CONSTANT["RESTORE_TILE"]
    return -(-size[0] // edge) * -(-size[1] // edge)


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if nothing is put back."""
    if not context.on("RESTORE"):
        return None
    pixels, lost = context.pixel_count, layout.LOST.dtype
    count = tiles(context.crop_size)
    return StageSpec(
        "restore",
        "what averages lost is added back before the picture is handed out",
        "restore.cl",
        flags=("FIREFLIES",),
        kernels=(
            KernelSpec("take_lost", lanes=False),
            KernelSpec("sum_tiles", lanes=False),
            KernelSpec("lift_noise", lanes=False),
            KernelSpec("sum_rows"),
            KernelSpec("restore_windows"),
            KernelSpec("restore_pixels"),
        ),
        buffers=(
            BufferSpec(
                "film_lost", lost, 2 * pixels, "what averages took from the pixels, and excess"
            ),
            BufferSpec(
                "film_shared", np.dtype(np.float32), pixels, "luminance of what came from cells"
            ),
            BufferSpec("mean_light", np.dtype(np.float32), pixels, "its mean, and some more", True),
            BufferSpec("unrestored", lost, pixels, "of that, what is not put back yet", True),
            BufferSpec("tiles", np.dtype(np.float32), 3 * count, "their noise and light", True),
            BufferSpec("rows", lost, pixels, "the same, summed over rows", True),
            BufferSpec("restored", np.dtype(np.float32), 4 * pixels, "the picture with it", True),
        ),
        per_pass=True,
    )


class Restore:
    """Makes the picture in ``restored`` of the film and what averages took from it."""

    def __init__(
        self, program: Program, buffers: Mapping[str, Buffer], size: tuple[int, int]
    ) -> None:
        """Bind the kernels; ``size`` are the pixels across and down."""
        self.pixels, self.tiles = size[0] * size[1], tiles(size)
        self.per_lanes = -(-self.pixels // program.device.traits.lanes)
        self.take = program.bind_planned("take_lost", buffers, tilt=1.0, caution=2.0)
        self.of_tiles = [
            program.bind_planned(name, buffers) for name in ("sum_tiles", "lift_noise")
        ]
        self.of_windows = {
            radius: (
                program.bind_planned("sum_rows", buffers, radius=radius),
                program.bind_planned(
                    "restore_windows", buffers, radius=radius, is_first=int(radius == RADII[0])
                ),
            )
            for radius in RADII
        }
        self.of_pixels = program.bind_planned("restore_pixels", buffers)

    def __call__(self, passes: int, splits: int) -> None:
        """Enqueue what it takes after so many ``passes``."""
        self.take.set(tilt=tilt(passes, splits), caution=caution(passes))
        self.take(self.pixels, film.GROUP)
        for launch in self.of_tiles:
            launch(self.tiles, film.GROUP)
        for radius in radii(passes):
            for launch in self.of_windows[radius]:
                launch(self.per_lanes, film.GROUP)
        self.of_pixels(self.per_lanes, film.GROUP)
