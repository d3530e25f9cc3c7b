"""Checkpoints: all that a render needs to go on later, in one file that says what it belongs to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.scheduler import MAX_PASSES
from psf_cl.soundness import fault_of_tables
from psf_cl.state_file import read_state, refuse_fault, write_state

KIND = "checkpoint"


@dataclass(frozen=True)
class Checkpoint:
    """A render at the end of a pass.

    Attributes:
        identity: what it belongs to, by words that an error can name: two renders whose identities
            are equal go on with each other's checkpoints.
        passes: whole passes in it.
        epoch: first pass of the epoch, and the first after it.
        seconds: spent on rendering so far.
        device: that it was rendered on.
        buffers: name to what the device held, 1-D, of the buffer's type.
    """

    identity: Mapping[str, Any]
    passes: int
    epoch: tuple[int, int]
    seconds: float
    device: str
    buffers: Mapping[str, np.ndarray]


def write_checkpoint(path: str | os.PathLike[str], checkpoint: Checkpoint) -> None:
    """Write a checkpoint, whole or not at all: whoever looks sees the old one or the new one.

    Raises:
        InputError: it cannot be written; the old one stays as it was.
    """
    header = {
        "identity": checkpoint.identity,
        "passes": checkpoint.passes,
        "epoch": list(checkpoint.epoch),
        "seconds": checkpoint.seconds,
        "device": checkpoint.device,
    }
    write_state(path, KIND, header, checkpoint.buffers)


def read_checkpoint(
    path: str | os.PathLike[str],
    identity: Mapping[str, Any],
    buffers: Mapping[str, tuple[np.dtype[Any], int]],
) -> Checkpoint:
    """Read a checkpoint for the render that ``identity`` and ``buffers`` describe.

    Nothing is allocated for what the file claims: its size has to be that of these ``buffers``.

    Args:
        buffers: name to type and number of items.

    Raises:
        InputError: no checkpoint, a damaged or unsound one, or one of another render; the message
            says which.
    """
    header, contents = read_state(path, KIND, identity, buffers, _is_sound)
    refuse_fault(path, KIND, fault_of_tables(contents))
    first, end = header["epoch"]
    return Checkpoint(
        identity, header["passes"], (first, end), header["seconds"], header["device"], contents
    )


def _is_sound(header: Mapping[str, Any]) -> bool:
    epoch = header.get("epoch")
    counts = [header.get("passes"), *(epoch if isinstance(epoch, list) else ())]
    seconds = header.get("seconds")
    return (
        isinstance(header.get("device"), str)
        and len(counts) == 3
        and all(type(count) is int and 0 <= count <= MAX_PASSES for count in counts)
        and isinstance(seconds, (int, float))
        and 0.0 <= seconds < 1e12
        and counts[1] <= counts[0] <= counts[2]
    )
