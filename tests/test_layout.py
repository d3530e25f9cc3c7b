"""The records are the same on host and device."""

import numpy as np
import pytest

from psf_cl.device.layout import RECORDS, header
from psf_cl.device.program import load_program
from psf_cl.device.sources import kernel_folder


def test_header_is_current():
    written = (kernel_folder() / "common" / "layout.h").read_text(encoding="utf-8")
    assert written == header(), "run tools/make_layout.py"


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.name)
def test_sizes_are_multiples_of_16_bytes(record):
    assert record.dtype.itemsize % 16 == 0


def test_device_agrees_on_every_offset_and_size(device, tmp_path):
    expected = []
    lines = []
    for record in RECORDS:
        name = record.name
        # The next record shows the size with its padding.
        lines.append(f"    {{ {name} r[2];")
        lines.append("    *out++ = (uint)((uchar *)&r[1] - (uchar *)&r[0]);")
        expected.append(record.dtype.itemsize)
        for field in record.fields:
            lines.append(f"    *out++ = (uint)((uchar *)&r[0].{field.name} - (uchar *)&r[0]);")
            expected.append(record.dtype.fields[field.name][1])
            lines.append(f"    *out++ = (uint)sizeof(r[0].{field.name});")
            expected.append(record.dtype.fields[field.name][0].itemsize)
        lines.append("    }")
    source = [header(), "kernel void list_offsets(global uint *out) {", *lines, "}"]
    (tmp_path / "offsets.cl").write_text("\n".join(source), encoding="utf-8")

    offsets = device.allocate("offsets", np.uint32, len(expected))
    program = load_program(device, "offsets.cl", folder=tmp_path)
    program.bind("list_offsets", out=offsets)(1, group=1)
    np.testing.assert_array_equal(device.read(offsets), expected)
    device.release(offsets)
