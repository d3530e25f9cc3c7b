"""Write cl/common/layout.h from psf_cl/device/layout.py."""

from __future__ import annotations

from pathlib import Path

from psf_cl.device.layout import header

HEADER = Path(__file__).resolve().parent.parent / "cl" / "common" / "layout.h"

if __name__ == "__main__":
    HEADER.write_text(header(), encoding="utf-8")
    print(HEADER)
