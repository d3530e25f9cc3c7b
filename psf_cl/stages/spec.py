"""What a stage says of itself before anything runs: pure data, no OpenCL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device.layout import OPTIONAL_PATH_FIELDS, path_field_count, path_fields
from psf_cl.measure.timing import Declared
from psf_cl.traits import DeviceTraits

#: Features that decide what a path's state is: flags of every stage that works on the pool.
POOL_FLAGS = tuple(dict.fromkeys(feature for feature, _, _ in OPTIONAL_PATH_FIELDS))


@dataclass(frozen=True)
class BufferSpec:
    """A buffer of the plan: ``count`` items of ``dtype``; ``what`` says what it holds.

    Attributes:
        passing: it holds what is on its way, which nobody misses once whole passes are done: all
            other buffers of stages go into checkpoints.
    """

    name: str
    dtype: np.dtype[Any]
    count: int
    what: str
    passing: bool = False

    @property
    def bytes(self) -> int:
        return max(self.count, 1) * self.dtype.itemsize


@dataclass(frozen=True)
class KernelSpec:
    """A kernel that is launched, and what it does for an item that needs everything.

    Attributes:
        reads, writes: fields of the path's state; a vector by its stem (``origin``).
        record_bytes: read and written outside of it: records of tables, samples, film.
        per_sample: whether ``record_bytes`` are those of each sample of the render instead.
        lanes: whether a work item computes as many items as the device has lanes.
        runs: whether a work item takes as many blocks of lanes as the device's ``run`` says.
        rays: kinds of rays that it traces (camera, bounce, shadow).
        hash_accesses: look-ups and insertions.
    """

    name: str
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    record_bytes: int = 0
    per_sample: bool = False
    lanes: bool = True
    runs: bool = False
    rays: tuple[str, ...] = ()
    hash_accesses: int = 0

    def paths_per_item(self, traits: DeviceTraits) -> int:
        """Return how many paths, pixels or the like a work item computes."""
        return (traits.lanes if self.lanes else 1) * (traits.run if self.runs else 1)

    def declared(self, traits: DeviceTraits) -> Declared:
        """Return what its rates are computed from on a device of these traits."""
        words = len(path_fields(*self.reads)) + len(path_fields(*self.writes))
        return Declared(
            items=self.paths_per_item(traits),
            bytes=4 * words + self.record_bytes,
            per_sample=self.per_sample,
            rays=self.rays,
            hash_accesses=self.hash_accesses,
        )


@dataclass(frozen=True)
class StageSpec:
    """A stage that runs.

    Attributes:
        flags: the features that its source depends on; it is built with the others at 0.
        kernels: those that are launched.
        traces: whether it traces rays, which takes a stack of the tree's depth.
        per_pass: whether it works on complete passes, not on the pool.
        between_passes: whether it works between epochs, which have the pool drain.
        per_frame: whether it works before the first pass of a frame alone.
    """

    name: str
    reason: str
    source: str
    flags: tuple[str, ...] = ()
    kernels: tuple[KernelSpec, ...] = ()
    buffers: tuple[BufferSpec, ...] = ()
    traces: bool = False
    per_pass: bool = False
    between_passes: bool = False
    per_frame: bool = False

    @property
    def kernel_names(self) -> tuple[str, ...]:
        return tuple(kernel.name for kernel in self.kernels)

    @property
    def sources(self) -> tuple[str, ...]:
        return (self.source,)


@dataclass(frozen=True)
class Feature:
    """A compile-time switch: its value for this scene, and why."""

    value: int
    reason: str


@dataclass(frozen=True)
class MovingCounts:
    """Sizes of the tables of what moves."""

    triangles: int
    vertices: int
    influences: int
    deltas: int
    matrices: int
    weights: int


@dataclass(frozen=True)
class Context:
    """What stages derive their specifications from.

    Attributes:
        pixel_count: pixels that are rendered.
        ring: passes that may be in flight, a power of two.
        crop_size: width and height of what is rendered, pixels.
        range_search: whether light is shared in balls, not in cells.
        table_halvings: how often the hash tables were halved, for want of room.
    """

    features: dict[str, Feature]
    traits: DeviceTraits
    pixel_count: int
    ring: int
    crop_size: tuple[int, int] = (0, 0)
    max_depth: int = 0
    texel_count: int = 1
    environment_count: int = 0
    triangle_count: int = 0
    instance_count: int = 0
    corner_count: int = 0
    material_count: int = 0
    texture_count: int = 0
    statistics: bool = False
    halves: bool = False
    moving: MovingCounts | None = None
    range_search: bool = False
    table_halvings: int = 0

    @property
    def path_field_count(self) -> int:
        """Return the words of a path's state."""
        return path_field_count({name: item.value for name, item in self.features.items()})

    def on(self, name: str) -> bool:
        return bool(self.features[name].value)
