"""Guide: directions drawn by what was learned of where light comes from."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import SUM_BITS, buckets_of, fixed_point, slots_for, smaller
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings
from psf_cl.stages.cells import HEADROOM, brightest, pixel_per_meter
from psf_cl.stages.spec import BufferSpec, Context, KernelSpec, StageSpec

#: Slots of the table: a slot for so many pixels, within these bounds (a slot takes 1092 bytes).
PIXELS_PER_SLOT = 4
LEAST_SLOTS, MOST_SLOTS = 1 << 14, 1 << 17

#: Visits that the sums of a part of a cell have room for.
MOST_VISITS = 1 << 28

#: Edges of cells, in radii of the scene.
LEAST_EDGE, MOST_EDGE = 2.0**-10, 2.0**-3

#: Passes of an epoch that are learned from at least, and pixels up to which all of them are: of
#: longer epochs the rest would add little, and learning takes a tenth of the time.
LEARNED_PASSES = 16
LEARNED_PIXELS = 1 << 14

#: First passes whose epochs count half after each: what was learned from little fades.
FADING_PASSES = 32

#: From this pass on the guide is left out if it finds that it would leave more noise than this: it
#: takes about half as much time again.  A visit falls into a cell of so many, or nothing is found.
FIRST_DECISION = 8
MOST_NOISE_LEFT = 0.6
ENOUGH_VISITS = 32.0

#: Halvings of what the passes before the first decision count for in a film, by the most noise that
#: the guide leaves: little was known when they were drawn.  Those of the ajar door have six times
#: the noise of later ones; where the guide leaves half of it, a fourth would throw too much away.
EARLY_HALVINGS = ((0.35, 2), (MOST_NOISE_LEFT, 1))

#: Passes of a sequence without the guide, before a change in the scene has it tried again.
PASSES_WITHOUT = 256


#: Images of the guide, and where ``layout.GUIDE_VIEW`` has them.
VIEWS = {"guide": "direction", "guide_entropy": "entropy", "visits": "visits"}


def slots_of(pixel_count: int, halvings: int = 0) -> int:
    """Return the slots of the table."""
    slots = min(max(slots_for(pixel_count // PIXELS_PER_SLOT), LEAST_SLOTS), MOST_SLOTS)
    return smaller(slots, halvings)


def parameters(
    scene: Scene, settings: Settings, pixel_count: int, scene_radius: float, halvings: int = 0
) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    steps = fixed_point(HEADROOM * brightest(scene), MOST_VISITS)
    return {
        "guide_slots": slots_of(pixel_count, halvings),
        "guide_width": settings.guide_cell_size * pixel_per_meter(scene),
        "guide_least": LEAST_EDGE * scene_radius,
        "guide_most": MOST_EDGE * scene_radius,
        "guide_share": settings.guide_share,
        "guide_steps": steps,
        "guide_limit": 2.0**SUM_BITS / steps / MOST_VISITS,
    }


def learn_limit(epoch: range, pixel_count: int) -> int:
    """Return the first pass of the epoch that nothing is learned from."""
    share = max(LEARNED_PASSES, len(epoch) * LEARNED_PIXELS // pixel_count)
    return epoch.start + min(len(epoch), share)


def noise_left(cells: np.ndarray, share: float) -> float:
    """Return the second moment that is left of what the cosine would leave, as the cells expect it.

    Args:
        cells: records ``layout.GUIDE_CELL``; ``share`` is the setting ``guide_share``.

    A part with the radiance q brings q^2 / density; both are of cells of mean 1, by visits.
    """
    taught = cells[cells["visits"] >= layout.CONSTANT["GUIDE_BINS"]]
    if len(taught) == 0 or share == 0.0:
        return 1.0
    density = taught["density"].astype(np.float64)
    squares = np.maximum((density - (1.0 - share)) / share, 0.0) ** 2
    visits = taught["visits"].astype(np.float64)[:, None]
    return float((visits * squares / density).sum() / (visits * squares).sum())


def is_worth_it(cells: np.ndarray, share: float) -> bool:
    """Return whether the guide pays, as far as ``cells`` tell; arguments of ``noise_left``."""
    visits = cells["visits"].astype(np.float64)
    if (visits**2).sum() < ENOUGH_VISITS * visits.sum():
        return True
    return noise_left(cells, share) <= MOST_NOISE_LEFT


def early_halvings(cells: np.ndarray, share: float) -> int:
    """Return how often to halve what the first passes count for; arguments of ``noise_left``."""
    left = noise_left(cells, share)
    return next((halvings for most, halvings in EARLY_HALVINGS if left <= most), 0)


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if directions are not guided."""
    if not context.on("GUIDE"):
        return None
    slots = slots_of(context.pixel_count, context.table_halvings)
    uint32 = np.dtype(np.uint32)
    sums, cells = layout.GUIDE_SUM.dtype, layout.GUIDE_CELL.dtype
    buffers = (
        BufferSpec("guide_keys", uint32, slots, "fingerprints of the guide's cells"),
        BufferSpec("guide_full", uint32, buckets_of(slots), "parts of the table that are full"),
        BufferSpec("guide_sums", sums, slots, "what the guide learns"),
        BufferSpec("guide_cells", cells, slots, "what the guide knows"),
    )
    views: tuple[KernelSpec, ...] = ()
    if context.on("AOV_GUIDE"):
        what = "what the guide knows at what pixels see"
        view = BufferSpec("guide_views", layout.GUIDE_VIEW.dtype, context.pixel_count, what, True)
        buffers += (view,)
        views = (KernelSpec("view_guide"),)
    kernels = (
        KernelSpec("renew_guide", record_bytes=4, lanes=False),
        KernelSpec("freeze_guide", record_bytes=4 + sums.itemsize + cells.itemsize, lanes=False),
        KernelSpec("fade_film", record_bytes=2 * layout.FILM_SUM.dtype.itemsize),
        *views,
    )
    return StageSpec(
        "guide",
        "directions are drawn by what was learned",
        "guide.cl",
        flags=("GUIDE", "AOV_GUIDE"),
        kernels=kernels,
        buffers=buffers,
        per_pass=True,
        between_passes=True,
    )
