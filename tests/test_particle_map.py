"""The map of photons against counts: what is kept stands for all that came, however full it is."""

import numpy as np
import planes
import pytest

from psf_cl.device import layout

FILE = "particle_map_test.cl"
PLACES = layout.CONSTANT["PARTICLE_PLACES"]
NODE_BITS = 8
CELLS = 64
FULL = 0xFFFFFFFF
INITIAL = {"keys": FULL, "counts": 0, "words": FULL, "kinds": FULL, "sums": 0, "runs": 0}
TABLE = ("kinds", "sums", "runs")


class Map:
    """A map of ``CELLS`` cells on a device."""

    def __init__(self, device, seed, floor=0.1):
        params = np.zeros(1, layout.PARAMS.dtype)
        params["particle_cells"], params["node_bits"] = CELLS, NODE_BITS
        params["seed"], params["photon_floor"] = seed, floor
        self.device = device
        self.params = device.upload("params", params)
        self.keys, self.counts, self.words, self.kinds, self.sums, self.runs = (
            device.upload(name, np.full(CELLS * PLACES, value, np.uint32))
            for name, value in INITIAL.items()
        )

    def run(self, kernel, inputs, outputs, *names):
        given = {name: getattr(self, name) for name in names} | {"params": self.params}
        return planes.run(self.device, FILE, kernel, inputs, outputs, FEATURES, **given)

    def insert(self, cells, nodes):
        """Insert particles; as many as fill whole work items, so that none is padding."""
        assert len(cells) % planes.MULTIPLE == 0
        numbers = np.arange(len(cells), dtype=np.uint32)
        inputs = {"cells": cells, "nodes": nodes, "numbers": numbers}
        self.run("insert_particles", inputs, {}, "keys", "counts")
        self.run("settle_particles", inputs, {}, "keys", "words")
        rows = {"rows": np.arange(CELLS, dtype=np.uint32)}
        self.run("tabulate", rows, {}, "words", "counts", *TABLE)

    def estimates(self, cells):
        """Return how many particles the map says came to each of ``cells``."""
        outputs = {"places": (np.uint32, 1), "prints": (np.uint32, 1)}
        places, prints = self.run("list_cells", {"cells": cells}, outputs)
        counts, words = (self.device.read(b).reshape(-1, PLACES) for b in (self.counts, self.words))
        rows = places // PLACES
        own = words[rows] >> NODE_BITS == prints[:, None]
        return np.where(own, counts[rows], 0).sum(axis=1)

    def release(self):
        self.device.release(self.params, *(getattr(self, name) for name in INITIAL))


FEATURES = {"LIGHT_SAMPLING": 3, "TRANSMISSION": 0}


@pytest.mark.parametrize("load", [0.1, 1.0, 20.0])
def test_particles_that_stay_stand_for_all_that_came(device, load):
    """Weighted by random weights, estimates of all cells are right within 0.5 % in expectation."""
    rng = np.random.default_rng(int(10 * load))
    distinct = max(int(load * CELLS), 1)
    cell_numbers = rng.integers(0, 1 << 20, distinct).astype(np.uint32)
    weights = rng.uniform(0.0, 2.0, distinct)
    count = 64 * planes.MULTIPLE
    ratios = []
    for seed in range(40):
        which = rng.integers(0, distinct, count) * rng.integers(0, 2, count)
        filled = Map(device, seed)
        filled.insert(cell_numbers[which], rng.integers(0, 200, count).astype(np.uint32))
        truth = weights @ np.bincount(which, minlength=distinct)
        ratios.append(weights @ filled.estimates(cell_numbers) / truth)
        filled.release()
    ratios = np.array(ratios)
    error = ratios.std(ddof=1) / np.sqrt(len(ratios))
    assert error < 0.002
    assert abs(ratios.mean() - 1.0) < min(0.005, 4 * error + 1e-6)


def test_shares_of_a_cell_sum_to_one_and_follow_its_particles(lane_device):
    rng = np.random.default_rng(5)
    nodes = np.minimum(rng.geometric(0.2, 8 * planes.MULTIPLE), 200).astype(np.uint32)
    filled = Map(lane_device, 3)
    filled.insert(np.full(len(nodes), 77, np.uint32), nodes)
    asked = np.arange(1 << NODE_BITS, dtype=np.uint32)
    outputs = {"shares": (np.float32, 1), "kept": (np.float32, 1)}
    inputs = {"cells": np.full(len(asked), 77, np.uint32), "nodes": asked}
    shares, kept = filled.run("list_shares", inputs, outputs, *TABLE)
    assert shares.sum() == pytest.approx(1.0, abs=1e-5)
    truth = np.bincount(nodes, minlength=len(asked)) / len(nodes)
    # Nodes that share a place lose to one of them; the others are exact.
    exact = np.isclose(shares, truth, rtol=1e-4)
    assert truth[exact].sum() > 0.6
    # Hardly a node came only once: the least share is kept for what nobody saw.
    np.testing.assert_allclose(kept, 0.1, atol=0.02)
    empty = {"cells": np.full(len(asked), 78, np.uint32), "nodes": asked}
    shares, kept = filled.run("list_shares", empty, outputs, *TABLE)
    assert np.all(shares == 0.0) and np.all(kept == 1.0)
    filled.release()


def test_draws_follow_the_counts_of_a_cell_that_shares_its_places(lane_device):
    """A lattice of numbers draws each as often as the map counts, with the chance it reports."""
    rng = np.random.default_rng(9)
    cells = np.where(
        rng.random(64 * planes.MULTIPLE) < 0.5, 77, rng.integers(0, 2000, 64 * planes.MULTIPLE)
    )
    nodes = np.minimum(rng.geometric(0.1, len(cells)), 200)
    filled = Map(lane_device, 4)
    filled.insert(cells.astype(np.uint32), nodes.astype(np.uint32))
    draws = 1 << 14
    bits = (np.arange(draws, dtype=np.uint64) << 18).astype(np.uint32) + np.uint32(1 << 17)
    outputs = {"nodes": (np.uint32, 1), "blinds": (np.uint32, 1)}
    outputs |= {name: (np.float32, 1) for name in ("chances", "kept", "again")}
    inputs = {"cells": np.full(draws, 77, np.uint32), "bits": bits}
    drawn, blind, chances, kept, again = filled.run("draw_particles", inputs, outputs, *TABLE)
    places, prints = filled.run(
        "list_cells",
        {"cells": inputs["cells"][:1]},
        {"places": (np.uint32, 1), "prints": (np.uint32, 1)},
    )
    counts, words = (lane_device.read(b).reshape(-1, PLACES) for b in (filled.counts, filled.words))
    row = places[0] // PLACES
    assert len(np.unique(words[row][counts[row] > 0] >> NODE_BITS)) > 3
    own = (words[row] >> NODE_BITS == prints[0]) & (counts[row] > 0)
    alone, total = (counts[row][own] == 1).sum(), counts[row][own].sum()
    truth = np.zeros(1 << NODE_BITS)
    truth[words[row][own] & ((1 << NODE_BITS) - 1)] = counts[row][own] / total
    seen = blind == 0
    np.testing.assert_allclose(kept, max(0.1, (alone + 1) / (total + 1)), rtol=1e-6)
    assert blind.mean() == pytest.approx(kept[0], abs=2 / draws)
    np.testing.assert_allclose(chances[seen], truth[drawn[seen]], rtol=1e-6)
    np.testing.assert_array_equal(chances[seen], again[seen])
    often = np.bincount(drawn[seen], minlength=len(truth)) / seen.sum()
    np.testing.assert_allclose(often, truth, atol=4 / draws)
    filled.release()
