"""What is launched for whole passes and for pictures: kernels bound to a renderer's buffers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psf_cl.stages import film, probes

if TYPE_CHECKING:
    from psf_cl.device.device import Buffer
    from psf_cl.device.program import Launch, Program
    from psf_cl.plan import Plan

#: Launches in their order, each with its work items.
Launches = list[tuple["Launch", int]]


def run(launches: Launches) -> None:
    """Enqueue launches that visit every pixel, in their order."""
    for launch, items in launches:
        launch(items, film.GROUP)


@dataclass(frozen=True)
class PictureLaunches:
    """What makes the picture of sums and history, and the history of the picture.

    Attributes:
        motion: finds where pixels were in the frame before.
        blend: makes the light of pixels of their film and history.
        weigh: finds what pixels of the film keep, where there is no such light.
        finish: makes the picture of that light; with ``blend`` before it.
        keep: keeps that light for the next frame.
        place, compare: of the probes for changes, before the scene moves and after it.
    """

    motion: Launches
    blend: Launches
    weigh: Launches
    finish: Launches
    keep: Launches
    place: Launches
    compare: Launches


def bind_pictures(
    plan: Plan, programs: Mapping[str, Program], buffers: Mapping[str, Buffer]
) -> PictureLaunches:
    """Bind those of the kernels that the plan has."""

    def launches(*names: str, count: int = plan.pixel_count) -> Launches:
        return [
            (
                programs[stage.name].bind_planned(name, buffers),
                -(-count // kernel.paths_per_item(plan.traits)),
            )
            for name in names
            for stage in plan.stages
            for kernel in stage.kernels
            if kernel.name == name
        ]

    motion = launches("find_motion")
    shared = bool(plan.features["TEMPORAL"].value)
    count = probes.count(*plan.crop[2:])
    return PictureLaunches(
        motion=motion,
        blend=[*motion, *launches("blend_history")] if shared else launches("resolve_light"),
        weigh=launches("weigh_film"),
        finish=launches("weigh_light", "hold_light", "find_arriving", "filter_screen"),
        keep=launches("keep_history"),
        place=launches("place_probes", "measure_probes", count=count),
        compare=launches("measure_probes", "pool_probes", "spread_changes", count=count),
    )


@dataclass(frozen=True)
class CellLaunches:
    """What shares the light of a pass in cells.

    Attributes:
        share: stores, averages and looks up.
        clear: empties the table; one work item a bucket.
        keep: keeps cells for the next frame, if they have a history; one work item a bucket.
    """

    share: Launches
    clear: Launch
    keep: Launch | None


def bind_cells(
    plan: Plan, program: Program, history: Program | None, buffers: Mapping[str, Buffer]
) -> CellLaunches:
    """Bind those of the kernels that the plan has, of cells and of their ``history``."""
    per_pixel = -(-plan.pixel_count // (plan.traits.lanes * plan.traits.run))
    per_bucket = plan.cell_buckets
    stage = next(stage for stage in plan.stages if stage.name == "cells")
    order = (
        (program, "count_crowds", per_pixel),
        (program, "mark_near_cells", per_pixel),
        (program, "store_cells", per_pixel),
        (history, "gather_cells", per_bucket),
        (program, "resolve_cells", per_bucket),
        (program, "look_up_cells", per_pixel),
    )
    return CellLaunches(
        share=[
            (where.bind_planned(name, buffers), items)
            for where, name, items in order
            if where is not None and (where is history or name in stage.kernel_names)
        ],
        clear=program.bind_planned("clear_cells", buffers),
        keep=None if history is None else history.bind_planned("keep_cells", buffers),
    )
