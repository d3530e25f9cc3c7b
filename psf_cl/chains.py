"""Chains of paths on the device: first states, the brightness that scales them, and counts."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from psf_cl.device import layout
from psf_cl.device.device import Buffer, Device
from psf_cl.stages import metropolis

#: Bounces between two looks at how many of the first paths have ended.
BOUNCES_PER_LOOK = 8


class Chains:
    """What happens to the chains of a render while no path is on its way.

    Args:
        buffers: those of the plan.
        count: chains, which is slots of the pool.
        block: chains of a block.
        bounce: enqueues one bounce of every path.
        counters: waits, and returns the counters.
    """

    def __init__(
        self,
        device: Device,
        buffers: Mapping[str, Buffer],
        count: int,
        block: int,
        seed: int,
        bounce: Callable[[], None],
        counters: Callable[[], np.ndarray],
    ) -> None:
        self.device = device
        self.buffers = buffers
        self.count = count
        self.block = block
        self.seed = seed
        self.bounce = bounce
        self.counters = counters

    def start(self) -> None:
        """Trace independent paths, and choose the first states among them."""
        self.device.fill(self.buffers["chains"])
        self._set_counter("chain_starts", 0)
        rounds = metropolis.starts_per_chain(self.count)
        self._run(rounds)
        luminances = self.device.read(self.buffers["candidates"])
        starts, brightness = metropolis.choose_starts(luminances, self.count, self.seed)
        self.device.write(self.buffers["starts"], starts)
        self._set_brightness(brightness)
        self._run(rounds + 1)
        self._set_counter("chain_limit", 0xFFFFFFFF)

    def measure(self) -> None:
        """Set the brightness to the mean over all independent paths so far."""
        self._set_brightness(self.brightness())

    def brightness(self) -> float:
        """Return the mean luminance of all independent paths so far.

        Sums of chains are added in the order of chains: the same bits on any number of threads.
        """
        candidates = self.device.read(self.buffers["candidates"])
        states = self._states()
        total = candidates.sum(dtype=np.float64) + self._sum(states, "independent", np.float32)
        total -= self._sum(states, "lost", np.float32)
        return float(total / (len(candidates) + self._sum(states, "large", np.uint32)))

    def statistics(self) -> dict[str, int | float]:
        """Return how many steps there were, and the shares of those that were accepted."""
        states = self._states()

        def whole(name: str) -> int:
            return int(self._sum(states, name, np.uint32))

        large, small = whole("large"), whole("small")
        return {
            "chains": self.count,
            "start_paths": self.buffers["candidates"].count,
            "brightness": self.brightness(),
            "large_steps": large,
            "small_steps": small,
            "large_accepted": whole("large_accepted") / max(large, 1),
            "small_accepted": whole("small_accepted") / max(small, 1),
        }

    def _states(self) -> np.ndarray:
        """Return the words of all chains: ``(blocks, fields, block)``."""
        words = self.device.read(self.buffers["chains"])
        return words.reshape(-1, len(layout.CHAIN_FIELDS), self.block)

    def _sum(self, states: np.ndarray, name: str, dtype: type[np.generic]) -> float:
        values = np.ascontiguousarray(states[:, layout.CHAIN_INDEX[name]]).view(dtype)
        return float(values.sum(dtype=np.float64))

    def _run(self, paths: int) -> None:
        """Let every chain come to the end of its first ``paths``."""
        self._set_counter("chain_limit", paths)
        ended = layout.COUNTER_INDEX["chain_starts"]
        while True:
            for _ in range(BOUNCES_PER_LOOK):
                self.bounce()
            if int(self.counters()[ended]) >= paths * self.count:
                return

    def _set_counter(self, name: str, value: int) -> None:
        word = np.array([value], np.uint32)
        self.device.write(self.buffers["counters"], word, layout.COUNTER_INDEX[name])

    def _set_brightness(self, value: float) -> None:
        self.device.write(self.buffers["brightness"], np.array([value], np.float32))
