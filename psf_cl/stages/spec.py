"""What a stage says of itself before anything runs: pure data, no OpenCL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.traits import DeviceTraits


@dataclass(frozen=True)
class BufferSpec:
    """A buffer of the plan: ``count`` items of ``dtype``; ``what`` says what it holds."""

    name: str
    dtype: np.dtype[Any]
    count: int
    what: str

    @property
    def bytes(self) -> int:
        return max(self.count, 1) * self.dtype.itemsize


@dataclass(frozen=True)
class StageSpec:
    """A stage that runs.

    Attributes:
        flags: the features that its source depends on; it is built with the others at 0.
        kernels: those that are launched.
        traces: whether it traces rays, which takes a stack of the tree's depth.
    """

    name: str
    reason: str
    source: str
    flags: tuple[str, ...] = ()
    kernels: tuple[str, ...] = ()
    buffers: tuple[BufferSpec, ...] = ()
    traces: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        return (self.source,)


@dataclass(frozen=True)
class Feature:
    """A compile-time switch: its value for this scene, and why."""

    value: int
    reason: str


@dataclass(frozen=True)
class Context:
    """What stages derive their specifications from.

    Attributes:
        pixel_count: pixels that are rendered.
        ring: passes that may be in flight, a power of two.
    """

    features: dict[str, Feature]
    traits: DeviceTraits
    pixel_count: int
    ring: int
    texel_count: int = 1
    environment_count: int = 0
    triangle_count: int = 0
    corner_count: int = 0
    material_count: int = 0
    texture_count: int = 0
    statistics: bool = False

    def on(self, name: str) -> bool:
        return bool(self.features[name].value)
