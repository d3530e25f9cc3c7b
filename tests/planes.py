"""Run a kernel of tests/kernels on arrays, whatever its lane width."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psf_cl.device.device import Buffer, Device
from psf_cl.device.program import load_program

KERNELS = Path(__file__).parent / "kernels"

#: Values of a plane come in multiples of this: whole groups of whole work items for every W.
GROUP = 16
MULTIPLE = GROUP * 16


def run(
    device: Device,
    file: str,
    kernel: str,
    inputs: dict[str, np.ndarray],
    outputs: dict[str, tuple[type, int]],
    defines: dict[str, int] | None = None,
    **arguments: Buffer | int | float,
) -> list[np.ndarray]:
    """Return what ``kernel`` makes of ``inputs``.

    Args:
        inputs: arrays of float32 or uint32, ``(n,)`` or ``(planes, n)``, all with the same n.
        outputs: scalar type and number of planes of each array that the kernel writes.

    Returns:
        For each output ``(n,)`` if it has one plane, else ``(planes, n)``.
    """
    count = next(iter(inputs.values())).shape[-1]
    padded = -(-count // MULTIPLE) * MULTIPLE
    buffers = {}
    for name, values in inputs.items():
        planes = np.atleast_2d(values)
        full = np.pad(planes, ((0, 0), (0, padded - count)), mode="edge")
        buffers[name] = device.upload(name, full)
    for name, (dtype, planes) in outputs.items():
        buffers[name] = device.allocate(name, dtype, planes * padded)
    program = load_program(device, file, defines, KERNELS)
    program.bind(kernel, **buffers, **arguments)(padded // device.traits.lanes, group=GROUP)
    results = []
    for name, (_, planes) in outputs.items():
        values = device.read(buffers[name]).reshape(planes, padded)[:, :count]
        results.append(values[0] if planes == 1 else values)
    device.release(*buffers.values())
    return results
