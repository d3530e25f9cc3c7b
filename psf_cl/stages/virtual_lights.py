"""Virtual lights: photons go on, and where they come to stands for what is reflected there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from psf_cl.device import layout
from psf_cl.settings import Settings
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec

if TYPE_CHECKING:
    from psf_cl.device.device import Buffer, Device
    from psf_cl.device.program import Program

COUNT = layout.CONSTANT["VIRTUAL_LIGHTS_MOST"]

#: Surfaces that a photon comes to at most: so many bounces have random numbers of their own.
MOST_SURFACES = 16


def surfaces_for(settings: Settings) -> int:
    """Return how many surfaces a photon may come to before the one that the camera sees."""
    return min(max(settings.max_depth - 1, 0), MOST_SURFACES)


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths bring all light."""
    if not context.on("VIRTUAL_LIGHTS"):
        return None
    uint32, record = np.dtype(np.uint32), layout.VIRTUAL_LIGHT.dtype
    left = ("shadow", "light", "pdf", "toward_y", "toward_z")
    kernels = (
        KernelSpec(
            "scatter_photons",
            reads=("status", "direction", "beta", "hit", "sample", "seed"),
            writes=("status", "origin", "direction", "beta", *left),
            record_bytes=layout.SURFACE.dtype.itemsize + layout.MATERIAL.dtype.itemsize + 8,
            hash_accesses=1,
        ),
        KernelSpec(
            "settle_virtual_lights",
            reads=left,
            record_bytes=4 + record.itemsize,
        ),
    )
    return StageSpec(
        "virtual_lights",
        "photons that go on stand for reflected light",
        "virtual_lights.cl",
        flags=(
            "INSTANCES",
            "TEXTURES",
            "SMOOTH",
            "GLOSSY",
            "TRANSMISSION",
            "VERTEX_COLORS",
            "LAYERS",
            "ALPHA",
            *POOL_FLAGS,
        ),
        kernels=kernels,
        buffers=(
            BufferSpec("virtual_keys", uint32, COUNT, "least random number of each slot"),
            BufferSpec("virtual_counts", uint32, COUNT, "photons that came to it"),
            BufferSpec("virtual_lights", record, COUNT, "light of the one that stayed"),
        ),
        per_pass=True,
        between_passes=True,
    )


class VirtualLights:
    """Sends photons on from surface to surface; they leave a light at each."""

    def __init__(
        self,
        device: Device,
        program: Program,
        buffers: dict[str, Buffer],
        settings: Settings,
    ) -> None:
        """Bind the kernels."""
        self.device, self.buffers = device, buffers
        self.surfaces = surfaces_for(settings)
        self.scatter = program.bind_planned(
            "scatter_photons", buffers, most_bounces=max(self.surfaces - 1, 0)
        )
        self.settle = program.bind_planned("settle_virtual_lights", buffers)

    def clear(self) -> None:
        """Forget all lights."""
        self.device.fill(self.buffers["virtual_keys"], 0xFF)
        self.device.fill(self.buffers["virtual_counts"])

    def scatter_all(self, items: int) -> None:
        """Enqueue that the photons that hit something leave a light there and go on."""
        self.scatter(items)
        self.settle(items)
