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
KINDS = layout.CONSTANT["PARTICLE_KINDS"]
INITIAL = {"keys": FULL, "counts": 0, "words": FULL, "table": 0}


class Map:
    """A map of ``CELLS`` cells on a device."""

    def __init__(self, device, seed, floor=0.1):
        params = np.zeros(1, layout.PARAMS.dtype)
        params["particle_cells"], params["node_bits"] = CELLS, NODE_BITS
        params["seed"], params["photon_floor"] = seed, floor
        self.device = device
        self.params = device.upload("params", params)
        self.keys, self.counts, self.words, self.table = (
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
        self.run("tabulate", rows, {}, "words", "counts", "table")

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


FEATURES = {"LIGHT_SAMPLING": 2, "TRANSMISSION": 0}


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


def shares_of(counts, words, print_):
    """Return how a record of a row should share out: chance of each node, and what is kept."""
    own = (counts > 0) & (words >> NODE_BITS == print_)
    nodes, came = words[own] & ((1 << NODE_BITS) - 1), counts[own]
    stay = np.argsort(-came.astype(np.int64), kind="stable")[:KINDS]
    shares = np.zeros(1 << NODE_BITS)
    shares[nodes[stay]] = came[stay] / came[stay].sum()
    news = ((came == 1).sum() + 1) / (came.sum() + 1)
    return shares, news, 1.0 - came[stay].sum() / came.sum()


def filled_map(device, seed, cells, nodes):
    """Return a map that particles came to, and the counts and words of its rows."""
    filled = Map(device, seed)
    filled.insert(cells.astype(np.uint32), nodes.astype(np.uint32))
    counts, words = (device.read(b).reshape(-1, PLACES) for b in (filled.counts, filled.words))
    return filled, counts, words


def test_shares_of_a_thousand_cells_sum_to_one_and_follow_their_particles(lane_device):
    """A record is of the cell that most of a row's particles came to; others know nothing."""
    rng = np.random.default_rng(5)
    count = 64 * planes.MULTIPLE
    numbers = rng.integers(0, 1000, count)
    nodes = np.minimum(rng.geometric(0.1, count) + numbers % 7, 200)
    filled, counts, words = filled_map(lane_device, 3, numbers, nodes)
    cells = np.arange(1000, dtype=np.uint32)
    outputs = {"places": (np.uint32, 1), "prints": (np.uint32, 1)}
    places, prints = filled.run("list_cells", {"cells": cells}, outputs)
    every = np.arange(256, dtype=np.uint32)
    inputs = {"cells": np.repeat(cells, 256), "nodes": np.tile(every, 1000)}
    outputs = {"shares": (np.float32, 1), "kept": (np.float32, 1)}
    shares, kept = filled.run("list_shares", inputs, outputs, "table")
    shares, kept = shares.reshape(-1, 256), kept.reshape(-1, 256)[:, 0]
    known = kept < 1.0
    assert CELLS * 0.9 < known.sum() <= CELLS  # One cell a row.
    assert np.all(shares[~known] == 0.0)
    np.testing.assert_allclose(shares[known].sum(axis=1), 1.0, atol=1e-5)
    for cell in np.flatnonzero(known):
        row = places[cell] // PLACES
        truth, news, lost = shares_of(counts[row], words[row], prints[cell])
        assert np.bincount(words[row] >> NODE_BITS, counts[row])[prints[cell]] > 0
        np.testing.assert_allclose(shares[cell].sum(), truth.sum(), atol=1e-5)
        # Which of those stay that came equally often is free.
        np.testing.assert_allclose(np.sort(shares[cell]), np.sort(truth), atol=1e-6)
        assert kept[cell] == pytest.approx(min(max(news, 0.1) + lost, 1.0), rel=1e-5)
    filled.release()


@pytest.mark.parametrize("part", [2.0**-13, 2.0**-10, 0.3125, 1.0])
def test_numbers_stay_uniform_however_small_the_choice_before_them(lane_device, part):
    """Of 24 bits few values are left: the bins between them are as full as those around them."""
    rng = np.random.default_rng(11)
    draws, bins = 1 << 18, 1 << 14
    bits = rng.choice(int(part * 2**32), draws, replace=False).astype(np.uint32)
    filled = Map(lane_device, 1)
    inputs = {"bits": bits, "parts": np.full(draws, part, np.float32)}
    (left,) = filled.run("go_on", inputs, {"left": (np.uint32, 1)})
    filled.release()
    often = np.bincount(left // np.uint32(2**32 // bins), minlength=bins)
    mean = draws / bins
    assert abs(((often - mean) ** 2 / mean).sum() - bins) < 6.0 * (2.0 * bins) ** 0.5


def test_draws_follow_the_shares_and_leave_a_number_that_is_uniform(lane_device):
    """A lattice of numbers draws each node as often as its chance says."""
    rng = np.random.default_rng(9)
    count = 16 * planes.MULTIPLE
    filled, _, _ = filled_map(lane_device, 4, np.full(count, 77), rng.geometric(0.2, count) % 9)
    draws = 1 << 14
    numbers = ((np.arange(draws) + 0.5) / draws).astype(np.float32)
    inputs = {"cells": np.full(draws, 77, np.uint32), "numbers": numbers}
    outputs = {"nodes": (np.uint32, 1), "left": (np.float32, 1), "chances": (np.float32, 1)}
    nodes, left, chances = filled.run("draw_particles", inputs, outputs, "table")
    found, often = np.unique(nodes, return_counts=True)
    assert len(found) > 5
    for node, times in zip(found, often, strict=True):
        mine = nodes == node
        assert np.ptp(chances[mine]) == 0.0
        assert chances[mine][0] == pytest.approx(times / draws, abs=2 / draws)
        np.testing.assert_allclose(np.sort(left[mine]), (np.arange(times) + 0.5) / times, atol=0.02)
    filled.release()
