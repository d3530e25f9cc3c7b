"""Metropolis: chains of paths, each a mutation of the last one that its chain accepted."""

from __future__ import annotations

from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.device.hash_map import fixed_point
from psf_cl.settings import Settings
from psf_cl.stages.camera import pool_buffers
from psf_cl.stages.spec import POOL_FLAGS, BufferSpec, Context, KernelSpec, StageSpec
from psf_cl.traits import DeviceTraits

#: Independent paths before the first pass: they give the mean brightness and the first states.
CANDIDATES = 1 << 16

#: Vertices of a path whose random numbers a chain keeps; deeper ones get new numbers every time.
KEPT_VERTICES = 24

#: Mutations of a chain that fit into the passes in flight: chains of long paths are slower.
MUTATIONS_IN_FLIGHT = 64

#: Mutations of a chain in the shortest epoch, at whose end the fast chains wait for the slow ones.
MUTATIONS_PER_EPOCH = 512

#: Steps of a splat of mean brightness: sums seldom need their high words, and nothing shows.
MOST_STEPS = 2.0**24

#: No splat is brighter than so many times the mean: twice its luminance, all of it in blue.
BRIGHTEST_SPLAT = 32.0


def chain_count(settings: Settings, traits: DeviceTraits) -> int:
    """Return how many chains there are: whole blocks of the pool."""
    return -(-settings.chains // traits.block) * traits.block


def starts_per_chain(chains: int) -> int:
    """Return the independent paths of each chain before its first state."""
    return max(-(-CANDIDATES // chains), 1)


def kept_pairs(max_depth: int) -> int:
    """Return the pairs of random numbers that a chain keeps."""
    vertices = min(max(max_depth, 1), KEPT_VERTICES)
    return layout.CONSTANT["PAIR_VERTEX"] + layout.CONSTANT["VERTEX_PAIRS"] * vertices


def kept_numbers(max_depth: int) -> int:
    """Return the words from the numbers of a chain to those of the next: whole cache lines."""
    return -(-2 * kept_pairs(max_depth) // 16) * 16


def shortest_epoch(chains: int, pixel_count: int) -> int:
    """Return the passes of the shortest epoch."""
    return max(MUTATIONS_PER_EPOCH * chains // pixel_count, 1)


def parameters(settings: Settings, chains: int, pixel_count: int) -> dict[str, Any]:
    """Return what the kernels need to know, by the names of ``layout.PARAMS``."""
    steps = fixed_point(BRIGHTEST_SPLAT, 2 * pixel_count)
    return {
        "chain_start": starts_per_chain(chains),
        "chain_pairs": kept_pairs(settings.max_depth),
        "chain_numbers": kept_numbers(settings.max_depth),
        "large_steps": settings.large_steps,
        "splat_steps": min(steps, MOST_STEPS),
    }


def choose_starts(luminances: np.ndarray, chains: int, seed: int) -> tuple[np.ndarray, float]:
    """Choose the first states among candidates, and return them with the mean luminance.

    Each is chosen with a chance in proportion to its luminance, so that the chains start from the
    density that they go on to sample: all of them have the same weight, the mean (Veach, Guibas:
    Metropolis Light Transport, SIGGRAPH 1997, section 3.1).  Equal distances along the sum of all
    luminances choose them, from one random number.

    Args:
        luminances: float32, of the candidates.

    Returns:
        Numbers of candidates, uint32, one a chain, in ascending order.
    """
    sums = np.cumsum(luminances, dtype=np.float64)
    if not sums[-1] > 0.0:
        return np.arange(chains, dtype=np.uint32), 0.0
    offset = np.random.default_rng(seed).random()
    wanted = (np.arange(chains) + offset) * (sums[-1] / chains)
    chosen = np.minimum(np.searchsorted(sums, wanted, side="right"), len(sums) - 1)
    return chosen.astype(np.uint32), float(sums[-1] / len(sums))


def plan(context: Context) -> StageSpec | None:
    """Return the stage, or None if paths are independent."""
    if not context.on("METROPOLIS"):
        return None
    chains = context.traits.slots
    float32, uint32 = np.dtype(np.float32), np.dtype(np.uint32)
    started = ("origin", "direction", "beta", "radiance", "seed", "sample", "pixel", "status")
    numbers = kept_numbers(context.max_depth)
    buffers = (
        *pool_buffers(context),
        BufferSpec(
            "chains", float32, chains * len(layout.CHAIN_FIELDS), f"states of {chains} chains"
        ),
        BufferSpec("chain_numbers", uint32, chains * numbers, "random numbers of their paths"),
        BufferSpec(
            "candidates",
            float32,
            chains * starts_per_chain(chains),
            "luminance of the paths before the first pass",
        ),
        BufferSpec("starts", uint32, chains, "which of them are the first states"),
        BufferSpec("brightness", float32, 1, "mean luminance of independent paths"),
    )
    kernel = KernelSpec(
        "mutate_paths",
        reads=started,
        writes=started,
        # Two splats, and a state that is read and written.
        record_bytes=4 * layout.SPLAT_SUM.dtype.itemsize
        + 2 * 4 * (len(layout.CHAIN_FIELDS) + numbers),
        runs=True,
    )
    return StageSpec(
        "metropolis",
        "paths are mutations of those before them",
        "metropolis.cl",
        flags=("LENS", "METROPOLIS", *POOL_FLAGS),
        kernels=(kernel,),
        buffers=buffers,
        between_passes=True,
    )
