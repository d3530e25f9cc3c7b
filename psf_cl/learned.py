"""What a render learned, in a file: the tables of the guide and of the radiance cache."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from psf_cl.errors import InputError
from psf_cl.settings import Settings
from psf_cl.soundness import fault_of_tables
from psf_cl.stages import cache
from psf_cl.state_file import read_state, refuse_fault, write_state

_KIND = "cache"

#: Buffers of each table.  The guide's cells are made of its sums before anything reads them.
_TABLES = {
    "guide": ("guide_keys", "guide_full", "guide_sums"),
    "cache": cache.BUFFERS,
}

#: Settings that decide what is in the tables.
SETTINGS = (
    "guiding",
    "guide_cell_size",
    "termination",
    "cache_cell_size",
    "cell_jitter",
    "max_depth",
)

#: Visits that a loaded cell keeps at most, of each part: sums have room for 2^28, and what was
#: learned by many renders gives way to what is learned now.
MOST_VISITS = 1 << 20


def table_names(settings: Settings, option: str) -> tuple[str, ...]:
    """Return the buffers that hold what a render of these settings learns.

    Raises:
        InputError: it learns nothing; ``option`` asked for it.
    """
    names: tuple[str, ...] = ()
    if settings.guiding == "learned":
        names += _TABLES["guide"]
    if settings.termination == "cache":
        names += _TABLES["cache"]
    if not names:
        raise InputError(
            f"{option}: nothing is learned with guiding={settings.guiding} and "
            f"termination={settings.termination}; expected guiding=learned or termination=cache"
        )
    return names


def write_learned(
    path: str | os.PathLike[str], identity: Mapping[str, Any], tables: Mapping[str, np.ndarray]
) -> None:
    """Write what was learned, whole or not at all.

    Raises:
        InputError: it cannot be written; an old file stays as it was.
    """
    write_state(path, _KIND, {"identity": identity}, tables)


def read_learned(
    path: str | os.PathLike[str],
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
) -> tuple[dict[str, np.ndarray], str]:
    """Read what another render learned, and return it with a digest of it.

    Raises:
        InputError: no such file, a damaged or unsound one, or one that belongs to something else
            than ``identity``.
    """
    _, tables = read_state(path, _KIND, identity, buffers)
    refuse_fault(path, _KIND, fault_of_tables(tables))
    for name, table in tables.items():
        if name.endswith("sums"):
            fade(table)
    digest = hashlib.sha256()
    for table in tables.values():
        digest.update(table.view(np.uint8))
    return tables, digest.hexdigest()


def fade(sums: np.ndarray) -> None:
    """Halve the sums of cells, in place, until no part of theirs has more than MOST_VISITS.

    Args:
        sums: records with 64-bit sums ``low`` and ``high``, and ``count``.
    """
    counts = [
        sums[name].reshape(len(sums), -1) for name in ("count", "near") if name in sums.dtype.names
    ]
    count = counts[0]
    most = count.max(axis=1)
    halvings = np.zeros(len(sums), np.uint64)
    while (late := (most >> halvings.astype(np.uint32)) > MOST_VISITS).any():
        halvings[late] += np.uint64(1)
    changed = np.flatnonzero(halvings)
    shift = halvings[changed][:, None]
    whole = sums["low"][changed] + (sums["high"][changed].astype(np.uint64) << np.uint64(32))
    whole >>= shift
    sums["low"][changed] = whole & np.uint64(0xFFFFFFFF)
    sums["high"][changed] = whole >> np.uint64(32)
    for visits in counts:
        visits[changed] >>= shift.astype(np.uint32)
