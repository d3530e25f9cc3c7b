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
    params=["one lane", "its lanes", pytest.param("other lanes", marks=pytest.mark.slow)],
)
def lane_device(device: Device, request: pytest.FixtureRequest) -> Device:
    """Return the device with kernels for one lane, its own width, or the third of 1, 8, 16."""
    from psf_cl.device.device import Device
    from psf_cl.traits import DeviceTraits

    kind, wide = device.traits.kind, 8 if device.traits.lanes == 8 else 16
    lanes = {"one lane": 1, "its lanes": wide, "other lanes": 24 - wide}[request.param]
    return Device(device.context, DeviceTraits(kind, lanes, block=16, slots=1024, group=8))
