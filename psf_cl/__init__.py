"""Path tracing with OpenCL: the image with the least error that a time budget allows.

The public names are loaded when first used, so that importing the package needs no OpenCL.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from psf_cl.image import Image
    from psf_cl.renderer import Renderer, render
    from psf_cl.scene.load import load_scene
    from psf_cl.settings import Settings

__version__ = "0.1.0"
__all__ = ["Image", "Renderer", "Settings", "__version__", "load_scene", "render"]

_HOMES = {
    "Image": "psf_cl.image",
    "Renderer": "psf_cl.renderer",
    "Settings": "psf_cl.settings",
    "load_scene": "psf_cl.scene.load",
    "render": "psf_cl.renderer",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
