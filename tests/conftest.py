"""What all tests share: one opened device."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from psf_cl.errors import DeviceError

if TYPE_CHECKING:
    from psf_cl.device.device import Device


@pytest.fixture(scope="session")
def device() -> Device:
    """Open the device that ``$PSF_CL_DEVICE`` names, else the best.

    Without one the tests fail, so that a broken machine is not taken for a passed run;
    PSF_CL_ALLOW_NO_DEVICE=1 skips them instead.
    """
    from psf_cl.device.device import open_device

    try:
        return open_device()
    except DeviceError as error:
        if os.environ.get("PSF_CL_ALLOW_NO_DEVICE") == "1":
            pytest.skip(str(error))
        pytest.fail(f"{error}; to run only what needs no device: PSF_CL_ALLOW_NO_DEVICE=1")


@pytest.fixture(
    scope="session",
    params=[1, pytest.param(8, marks=pytest.mark.slow), 16],
    ids=lambda lanes: f"W{lanes}",
)
def lane_device(device: Device, request: pytest.FixtureRequest) -> Device:
    """Return the same device with kernels for W = 1, 8 (slow tests) and 16 lanes."""
    from psf_cl.device.device import Device
    from psf_cl.traits import DeviceTraits

    kind, lanes = device.traits.kind, request.param
    return Device(device.context, DeviceTraits(kind, lanes, block=16, slots=1024, group=8))
