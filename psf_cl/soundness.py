"""What arrays from a file may hold: a digest says that nothing changed, not that it was ever right.

Kernels trust tables that they made themselves: a node of the tree of lights, a pixel or a count in
them is an index.  Whatever a file brings is looked at here first, so that no state of one lets a
kernel leave its buffers, wait for a pass that never ends, or begin with what is not finite.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from psf_cl.device import layout
from psf_cl.stages.photons import RECORD_WORDS

#: Plain buffers whose words are those of records with integers in them.
_WORDS = ("chains",)

#: Fields of records that have to lie between two numbers, in buffers by name.
_RANGES = {
    ("cache_cells", "ends"): (0.0, 1.0),
    ("guide_cells", "density"): (0.0, float(layout.CONSTANT["GUIDE_BINS"])),
    ("guide_cells", "rows"): (0.0, 1.0 + 1e-5),
    ("guide_cells", "visits"): (0.0, np.inf),
}

#: Records that count samples, which cannot be more than there were passes.
_COUNTED = (layout.FILM_SUM.dtype, layout.SEEN_MEAN.dtype)

_CHAIN_FLOATS = ("radiance_r", "radiance_g", "radiance_b", "independent", "lost")


def fault_of_tables(buffers: Mapping[str, np.ndarray]) -> str | None:
    """Return what is wrong with arrays of a file by themselves, in a few words, or None.

    Args:
        buffers: name to array, 1-D, of the types that the plan gives them.
    """
    for name, array in buffers.items():
        if name in _WORDS:
            continue
        fields = array.dtype.names or ("",)
        for field in fields:
            values = array[field] if field else array
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                return f"{name} holds what is not finite"
            low, high = _RANGES.get((name, field), (None, None))
            if low is not None and not ((values >= low) & (values <= high)).all():
                return f"{field} of {name} is out of range"
        # No sum is as large as to run over soon.
        if {"low", "high"} <= set(fields) and (array["high"] >> 31).any():
            return f"{name} holds sums that are too large"
    return None


def fault_of_render(
    buffers: Mapping[str, np.ndarray],
    params: np.void,
    block: int,
    passes: int,
    nodes: np.ndarray | None,
) -> str | None:
    """Return what keeps arrays from being those of a render at the end of a pass, or None.

    Args:
        params: layout.PARAMS of the render that they are for.
        block: paths of a block of its pool.
        passes: whole passes that it had.
        nodes: uint32, those of the tree of lights that a photon can stand for.
    """
    for name, array in buffers.items():
        if array.dtype in _COUNTED and (array["count"] > passes).any():
            return f"{name} counts more samples than there were passes"
    guided = "guide_cells" in buffers
    if buffers["counters"][layout.COUNTER_INDEX["guide_off"]] > guided:
        return "counters leave out a guide that is not there"
    if "particle_table" in buffers and nodes is not None:
        return _fault_of_photons(buffers, params, nodes)
    if "chains" in buffers and passes:
        return _fault_of_chains(buffers, params, block, passes)
    return None


def _fault_of_photons(
    buffers: Mapping[str, np.ndarray], params: np.void, nodes: np.ndarray
) -> str | None:
    """Look at what becomes an index: nodes of the tree of lights, and lengths of lists of them."""
    kinds, rows = layout.CONSTANT["PARTICLE_KINDS"], int(params["particle_cells"])
    table = buffers["particle_table"].reshape(rows, -1)
    lengths = table[:, 1]
    if (lengths > kinds).any():
        return "particle_table holds lists that are too long"
    told = np.arange(kinds) < lengths[:, None]
    named, shares = np.split(table[:, RECORD_WORDS : RECORD_WORDS + 2 * kinds], 2, axis=1)
    if not np.isin(named[told], nodes).all():
        return "particle_table names lights that are not there"
    for words in (shares[told], table[:, 2:4]):
        chances = np.ascontiguousarray(words).view(np.float32)
        if not ((chances >= 0.0) & (chances <= 1.0 + 1e-5)).all():
            return "particle_table holds what is no chance"
    words = buffers["particle_words"][buffers["particle_counts"] > 0]
    if not np.isin(words & np.uint32((1 << int(params["node_bits"])) - 1), nodes).all():
        return "particle_words name lights that are not there"
    return None


def _fault_of_chains(
    buffers: Mapping[str, np.ndarray], params: np.void, block: int, passes: int
) -> str | None:
    """Look at what becomes an index, and at places in the queue: a wrong one never has its turn."""
    slots, pixels = int(params["slots"]), int(params["pixel_count"])
    words = buffers["chains"].view(np.uint32).reshape(-1, len(layout.CHAIN_FIELDS), block)
    state = {name: words[:, at].reshape(-1) for name, at in layout.CHAIN_INDEX.items()}
    if not all(np.isfinite(state[name].view(np.float32)).all() for name in _CHAIN_FLOATS):
        return "chains hold what is not finite"
    if (np.maximum(state["known"], state["pairs"]) > params["chain_pairs"]).any():
        return "chains hold more numbers than there is room for"
    if (state["pixel"] >= pixels).any():
        return "chains are at pixels that are not there"
    # Mutations take turns in a queue of so many a pass: at the end of one all places are known.
    first = np.arange(slots, dtype=np.int64)
    turns = np.maximum(-((first - passes * pixels) // slots), 0)
    place = first + turns * slots
    queued = state["pass"].astype(np.int64) * pixels + state["place"]
    paths = int(params["chain_start"]) + 1 + turns
    if not (np.array_equal(queued, place) and np.array_equal(state["paths"], paths % 2**32)):
        return "chains are not at the end of a pass"
    if (buffers["starts"] >= len(buffers["candidates"])).any():
        return "starts name paths that are not there"
    if buffers["counters"][layout.COUNTER_INDEX["chain_limit"]] != 0xFFFFFFFF:
        return "chains have not started"
    return None
