"""Photons: from all lights into a map that says which of them light a place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import smaller
from psf_cl.settings import Settings
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec

if TYPE_CHECKING:
    from psf_cl.device.device import Buffer, Device
    from psf_cl.device.program import Launch, Program
    from psf_cl.stages.virtual_lights import VirtualLights
    from psf_cl.traits import DeviceTraits

#: Photons that a frame draws at most.
MOST_DRAWN = (1 << 32) - 1

# Odd, so that all frames begin elsewhere; 2^32 over the golden ratio, so that they do far apart.
_FRAME_STEP = 0x9E3779B1

#: Photons of an epoch at least and at most where they are a share of its rays, and the rays of a
#: path before any was traced.
FEWEST, MOST = 1 << 14, 1 << 20
RAYS_EXPECTED = 10

#: At least, where photons of the frames before are there; and how many of these there may be: what
#: the camera has left behind goes then.
FEWEST_MORE, MOST_KEPT = 1 << 10, 1 << 24

#: Cells of the map, a power of two.
CELLS = 1 << 15

#: Shadow rays of a vertex at most by ``shadow_rays=auto``.
MOST_RAYS = 4

#: AOVs of what photons know.
VIEWS = ("photons", "lights")

PLACES = layout.CONSTANT["PARTICLE_PLACES"]

#: Words of what the table knows of a cell, and of each group of lights in it.
RECORD_WORDS = 4
KIND_WORDS = 2


def photons_for(
    settings: Settings, paths: int, rays: Mapping[str, int], fewest: int = FEWEST
) -> int:
    """Return the photons to emit before an epoch of so many ``paths``.

    ``rays`` are those of the frame so far, by ``layout.RAY_KINDS``.  Of rays a path only the whole
    number counts: devices may disagree on a few rays, and all of a map depends on its photons.
    """
    if settings.photons:
        return settings.photons
    traced = round(sum(rays.values()) / rays["camera"]) if rays["camera"] else RAYS_EXPECTED
    return int(min(max(settings.photon_share * traced * paths, fewest), MOST))


def cells_of(halvings: int = 0) -> int:
    """Return the cells of a map that was halved so often."""
    return smaller(CELLS, halvings)


def parameters(settings: Settings, light_count: int, halvings: int = 0) -> dict[str, object]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    return {
        "virtual_clearance": settings.virtual_clearance,
        "node_bits": max(2 * light_count - 1, 0).bit_length(),
        "shadow_rays": 0 if settings.shadow_rays == "auto" else int(settings.shadow_rays),
        "particle_cells": cells_of(halvings),
        "particle_cell": settings.photon_cell,
        "photon_floor": settings.photon_floor,
    }


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if no photon is needed."""
    choice = context.features["LIGHT_SAMPLING"].value
    mapped = choice >= 2
    if not (mapped or context.on("VIRTUAL_LIGHTS")):
        return None
    uint32 = np.dtype(np.uint32)
    map_cells = cells_of(context.table_halvings)
    places = map_cells * PLACES
    kind_words = KIND_WORDS + (choice == 3)
    record_words = RECORD_WORDS + kind_words * layout.CONSTANT["PARTICLE_KINDS"]
    words = context.traits.slots * context.path_field_count
    settled = ("shadow_z", "toward_x") if choice == 3 else ("shadow_z",)
    ends = () if context.on("VIRTUAL_LIGHTS") else ("status",)
    emitting = (
        KernelSpec(
            "emit_photons",
            writes=("status", "origin", "direction", "beta", "seed", "sample", "pixel", "toward_x"),
            record_bytes=layout.LIGHT.dtype.itemsize,
        ),
    )
    keeping = (
        KernelSpec(
            "store_photons",
            reads=("status", "direction", "hit_triangle", "hit_u", "hit_v", "sample", "pixel"),
            writes=("shadow_z", *ends),
            record_bytes=layout.SURFACE.dtype.itemsize + 8,
            hash_accesses=1,
        ),
        KernelSpec("settle_photons", reads=settled, record_bytes=8, hash_accesses=1),
        KernelSpec("tabulate_photons", record_bytes=8 * PLACES + 4 * record_words),
    )
    flight = (
        BufferSpec("photons", np.dtype(np.float32), words, "photons in flight", True),
        BufferSpec("photon_counters", uint32, len(layout.COUNTERS) + context.ring, "of photons"),
    )
    table = (
        BufferSpec("particle_keys", uint32, places, "least random number of each place"),
        BufferSpec("particle_counts", uint32, places, "photons that came to it"),
        BufferSpec("particle_words", uint32, places, "light and cell of the one that stayed"),
        BufferSpec("particle_table", uint32, map_cells * record_words, "what each cell knows"),
    )
    if choice == 3:
        what = "where on its light that one started"
        table += (BufferSpec("particle_points", uint32, places, what),)
    return StageSpec(
        "photons",
        "photons say which lights a place sees" if mapped else "photons bring light to surfaces",
        "photons.cl",
        flags=(
            "TEXTURES",
            "VERTEX_COLORS",
            "AREA_LIGHTS",
            "RECTANGLES",
            "SPHERES",
            "PUNCTUAL_LIGHTS",
            "ENVIRONMENT",
            "ALPHA",
            "INSTANCES",
            "VIRTUAL_LIGHTS",
            *POOL_FLAGS,
        ),
        kernels=(*emitting, *(keeping if mapped else ())),
        buffers=(*flight, *(table if mapped else ())),
        per_pass=True,
        between_passes=True,
    )


class PhotonMap:
    """Fills the map between epochs; photons of earlier epochs stay in it.

    Attributes:
        fewest: photons of an epoch at least.
    """

    fewest = FEWEST

    def __init__(
        self,
        device: Device,
        programs: Mapping[str, Program],
        buffers: Mapping[str, Buffer],
        traits: DeviceTraits,
        runs_per_trace: int,
        virtual_lights: VirtualLights | None = None,
    ) -> None:
        """Bind the kernels; ``runs_per_trace`` are the paths of an item of intersect_closest."""
        self.device, self.buffers, self.traits = device, buffers, traits
        own = programs["photons"]
        traced = dict(buffers) | {
            "pool": buffers["photons"],
            "counters": buffers["photon_counters"],
        }
        self.emit = own.bind_planned("emit_photons", buffers, first=0, count=0)
        self.keep: tuple[Launch, ...] = ()
        self.tabulate: Launch | None = None
        if "particle_table" in buffers:
            self.keep = (
                own.bind_planned("store_photons", buffers),
                own.bind_planned("settle_photons", buffers),
            )
            self.tabulate = own.bind_planned("tabulate_photons", buffers)
            self.cells = buffers["particle_keys"].count // PLACES
        self.virtual_lights = virtual_lights
        self.trace = programs["intersect"].bind_planned("intersect_closest", traced)
        self.trace_items = -(-traits.slots // runs_per_trace)

    def begin_frame(self, changed: bool) -> None:
        """Forget all photons, unless neither lights nor surfaces have ``changed`` since."""
        stays = not changed and self.virtual_lights is None and 0 < self.drawn() < MOST_KEPT
        self.fewest = FEWEST_MORE if stays else FEWEST
        if not stays:
            self.clear()

    def clear(self) -> None:
        """Forget all photons."""
        if self.tabulate is not None:
            self.device.fill(self.buffers["particle_keys"], 0xFF)
            for name in ("counts", "words", "table"):
                self.device.fill(self.buffers[f"particle_{name}"])
        if self.virtual_lights is not None:
            self.virtual_lights.clear()
        self.device.fill(self.buffers["photon_counters"])

    def add(self, count: int, first_pass: int) -> None:
        """Emit ``count`` photons and enqueue that the map and its table keep them.

        Those of a frame, which begins with ``first_pass``, are others than those of the frames
        before.  Counters have 32 bits: what would go beyond is not emitted.
        """
        drawn, items = self.drawn(), -(-self.traits.slots // self.traits.lanes)
        count = min(count, MOST_DRAWN - drawn)
        first = first_pass * _FRAME_STEP + drawn
        for start in range(0, count, self.traits.slots):
            batch = min(count - start, self.traits.slots)
            # Numbers of 32 bits: they begin again.
            self.emit.set(first=(first + start) % (1 << 32), count=batch)(items)
            self.trace(self.trace_items)
            for launch in self.keep:
                launch(items)
            if self.virtual_lights is not None:
                self.virtual_lights.scatter_all(items)
                for _ in range(self.virtual_lights.surfaces - 1):
                    self.trace(self.trace_items)
                    self.virtual_lights.scatter_all(items)
        if self.tabulate is not None:
            self.tabulate(self.cells)

    def counts(self) -> dict[str, int]:
        """Return what became of the photons so far, by the names of ``layout.PHOTON_COUNTERS``."""
        names = [name for name, _ in layout.PHOTON_COUNTERS]
        values = self.device.read(self.buffers["photon_counters"], len(names))
        return dict(zip(names, map(int, values), strict=True))

    def drawn(self) -> int:
        """Return how many photons were drawn since the map was cleared."""
        counts = self.counts()
        return counts["emitted"] + counts["dark"]
