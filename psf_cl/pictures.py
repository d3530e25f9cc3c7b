"""What a renderer's buffers hold, as an image: the film, and the AOVs beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psf_cl.device import layout
from psf_cl.features import restores
from psf_cl.image import Image
from psf_cl.launches import run
from psf_cl.stages import cells, film, guide, photons

if TYPE_CHECKING:
    from psf_cl.renderer import Renderer


def image_of(renderer: Renderer, names: set[str]) -> Image:
    """Return the image as it is now, with the AOVs in ``names``."""
    x, y, _, _ = renderer.plan.crop
    # Of the device: after an interrupt the host has not seen its last passes.
    counters = renderer.device.read(renderer.buffers["counters"], layout.COUNTER_INDEX["finished"])
    partial = counters[layout.COUNTER_INDEX["film_pass"]] == renderer.scheduler.first
    sums: dict[str, np.ndarray] = {}
    for ring, name, planes in film.PLANES:
        if name not in renderer.buffers:
            continue
        if partial:
            # Not one pass is complete: what is there of the first is all there is.
            renderer.device.fill(renderer.buffers[name])
            renderer.add_launch(ring, name, planes, partial=True)(
                renderer.film_items(planes), film.GROUP
            )
            if name == "film" and renderer.add_unfiltered is not None:
                renderer.add_unfiltered(renderer.plan.pixel_count, film.GROUP)
        sums[name] = renderer.device.read(renderer.buffers[name]).reshape(planes, -1)
        if partial:
            renderer.device.fill(renderer.buffers[name])

    def mean(plane: np.ndarray) -> np.ndarray:
        count = np.maximum(plane["count"], 1).astype(np.float32)
        # The part that rounding took from the sum is known: it goes back before the division.
        return _in_rows(renderer, (plane["sum"] - plane["lost"]) / count[:, None])

    aovs: dict[str, np.ndarray] = {}
    main = sums["film"][0]
    aovs["rgb"] = mean(main)
    if "film_direct" in sums:
        aovs["direct"] = mean(sums["film_direct"][0])
    if not partial:
        aovs |= _finished(renderer, aovs, counters)
    if "direct" in aovs:
        aovs["indirect"] = aovs["rgb"] - aovs["direct"]
    if "film_features" in sums:
        aovs["albedo"], aovs["normal"], depth = (mean(plane) for plane in sums["film_features"])
        aovs["depth"] = depth[..., :1]
    if "film_choices" in sums:
        choices = mean(sums["film_choices"][0])
        for index, name in enumerate((*photons.VIEWS, "light_pmf")):
            aovs[name] = choices[..., index : index + 1]

    aovs["samples"] = _in_rows(renderer, main["count"][:, None])
    if names & {"motion", "history", "alpha", "gradient"}:
        aovs |= _temporal_aovs(renderer, main["count"], bool(partial))
    if "film_bounces" in sums:
        aovs["bounces"] = mean(sums["film_bounces"][0])[..., :1]
    if names & set(guide.VIEWS):
        aovs |= _guide_aovs(renderer, bool(partial))
    if names & set(cells.VIEWS):
        aovs |= _cell_aovs(renderer, main["count"])
    count = main["count"].astype(np.float64)
    variance = main["squares"] / np.maximum(count - 1, 1) / np.maximum(count, 1)
    aovs["variance"] = _in_rows(renderer, np.where(count > 1, variance, 0.0)[:, None])
    return Image(
        aovs={name: aovs[name] for name in aovs if name in names},
        stats=renderer.stats(),
        x=x,
        y=y,
        full_width=renderer.scene.width,
        full_height=renderer.scene.height,
    )


def _finished(
    renderer: Renderer, aovs: dict[str, np.ndarray], counters: np.ndarray
) -> dict[str, np.ndarray]:
    """Return what is done to the image, and to its direct light, before they are handed out."""
    finished: dict[str, np.ndarray] = {}
    run(renderer.pictures.weigh)
    if restores(renderer.settings).value:
        finished["rgb"] = _restored(renderer, counters)
    elif renderer.pictures.blend:
        finished["rgb"] = _picture(renderer)
    dimmed = {"rgb", "direct"} & aovs.keys() - finished.keys()
    if dimmed and "kept" in renderer.buffers:
        kept = _in_rows(renderer, renderer.device.read(renderer.buffers["kept"])[:, None])
        finished |= {name: aovs[name] * kept for name in dimmed}
    return finished


def _picture(renderer: Renderer) -> np.ndarray:
    """Return the image of the light of pixels, with the frames before, ``(h, w, 3)``."""
    run([*renderer.pictures.blend, *renderer.pictures.finish])
    if "filtered" in renderer.buffers:
        pixels = renderer.device.read(renderer.buffers["filtered"]).reshape(-1, 4)[:, :3]
    else:
        pixels = renderer.device.read(renderer.buffers["light"])["rgb"]
    return _in_rows(renderer, pixels)


def _in_rows(renderer: Renderer, pixels: np.ndarray) -> np.ndarray:
    """Return pixels in the order of the queue, ``(n, c)``, as ``(h, w, c)`` float32."""
    image = np.zeros(pixels.shape, np.float32)
    image[renderer.order] = pixels
    return image.reshape(renderer.plan.crop[3], renderer.plan.crop[2], -1)


def _temporal_aovs(renderer: Renderer, count: np.ndarray, partial: bool) -> dict[str, np.ndarray]:
    """Return what frames say of one another; ``count`` are the samples of this one."""
    nothing = np.zeros(len(count), np.float32)
    aovs = {"history": count, "alpha": nothing + 1.0, "gradient": nothing}
    if renderer.plan.features["TEMPORAL"].value and not partial:
        light = renderer.device.read(renderer.buffers["light"])
        names = {"history": "count", "alpha": "alpha", "gradient": "change"}
        aovs = {name: light[field] for name, field in names.items()}
    if "motion" in renderer.buffers:
        run(renderer.pictures.motion)
        aovs["motion"] = renderer.device.read(renderer.buffers["motion"])
    return {
        name: _in_rows(renderer, values.reshape(renderer.plan.pixel_count, -1))
        for name, values in aovs.items()
    }


def _cell_aovs(renderer: Renderer, count: np.ndarray) -> dict[str, np.ndarray]:
    """Return what pixels saw of cells: means over their ``count`` samples; 0 without cells."""
    views = np.zeros(len(count), layout.CELL_VIEW.dtype)
    if "film_cells" in renderer.buffers:
        views = renderer.device.read(renderer.buffers["film_cells"])
    divisor = np.maximum(count, 1).astype(np.float32)
    return {
        name: _in_rows(
            renderer, views[field] if name == "cells" else (views[field] / divisor)[:, None]
        )
        for name, field in cells.VIEWS.items()
    }


def _guide_aovs(renderer: Renderer, partial: bool) -> dict[str, np.ndarray]:
    """Return what the guide knows at what pixels see; 0 without a guide."""
    views = np.zeros(renderer.plan.pixel_count, layout.GUIDE_VIEW.dtype)
    if "guide_views" in renderer.buffers and not partial:
        items = -(-renderer.plan.pixel_count // renderer.plan.traits.lanes)
        renderer.view_guide(items, film.GROUP)
        views = renderer.device.read(renderer.buffers["guide_views"])
    return {
        name: _in_rows(renderer, views[field].reshape(len(views), -1))
        for name, field in guide.VIEWS.items()
    }


def _restored(renderer: Renderer, counters: np.ndarray) -> np.ndarray:
    """Return the image with what averages per cell lost, ``(h, w, 3)``."""
    passes = int(counters[layout.COUNTER_INDEX["film_pass"]]) - renderer.scheduler.first
    renderer.restore(passes, renderer.settings.splits)
    return _in_rows(
        renderer, renderer.device.read(renderer.buffers["restored"]).reshape(-1, 4)[:, :3]
    )
