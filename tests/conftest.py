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
