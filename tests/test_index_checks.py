"""Index assertions of debug builds: they find what is out of bounds, and change nothing else."""

from __future__ import annotations

import re

import numpy as np
import planes
import pytest
from scene_builder import build, camera, floor, glowing

from psf_cl.device.device import Device
from psf_cl.device.index_checks import PROLOGUE, checked_source
from psf_cl.device.layout import FILM_SUM
from psf_cl.device.program import assemble, load_program
from psf_cl.device.sources import kernel_folder
from psf_cl.errors import DeviceError
from psf_cl.renderer import Renderer
from psf_cl.settings import Settings


@pytest.fixture
def guarded(lane_device, monkeypatch):
    """Return a device whose kernels check their indices."""
    monkeypatch.setenv("PSF_CL_GUARDS", "1")
    return Device(lane_device.context, lane_device.traits)


@pytest.mark.parametrize(
    "kernel,last,broken",
    [
        ("read_item", 7, "source"),
        ("write_item", 5, "target"),
        ("read_group", 1, "source"),
        ("write_group", 0, "target"),
        ("gather_words_of_lanes", 7, "source"),
        ("gather_records", 1, "source"),
        ("begin_inside", 7, "source"),
        ("begin_group_inside", 1, "source"),
    ],
)
def test_the_first_index_behind_an_array_is_told_and_the_last_inside_is_not(
    guarded, kernel, last, broken
):
    dtype, count = (FILM_SUM.dtype, 2) if kernel == "gather_records" else (np.float32, 8)
    program = load_program(guarded, "index_test.cl", folder=planes.KERNELS)
    for index in (last, last + 1):
        at = guarded.upload("at", np.array([index], np.uint32))
        source = guarded.allocate("source", dtype, count)
        target = guarded.allocate("target", np.float32, 6)
        program.bind(kernel, at=at, source=source, target=target)(1)
        if index == last:
            guarded.release(at, source, target)
            continue
        words = (
            rf"a kernel wanted item {index} of \d+ bytes of {broken}, .* at cl/index_test\.cl:\d+"
        )
        with pytest.raises(DeviceError, match=words):
            guarded.read(target)
        with pytest.raises(DeviceError, match=words):
            guarded.release(at, source, target)
    assert guarded.allocated_bytes == 0


@pytest.mark.parametrize("path", sorted(kernel_folder().glob("*.cl")), ids=lambda path: path.name)
def test_a_checked_source_without_its_checks_is_the_source(path):
    text = assemble(path.name)
    checked = checked_source(text)[0].removeprefix(PROLOGUE)
    checked = re.sub(r"#undef SITE_FILE\n#define SITE_FILE \d+u\n", "", checked)
    # What GATHER is in checked sources is in both.
    both = (re.sub(r"\s", "", without_checks(one)) for one in (checked, text))
    assert next(both) == next(both)
    assert checked.count("AT(") > text.count("AT(")


def without_checks(text):
    """Return ``text`` with AT(array, index) and GROUP_AT(array, index, count) as the index."""
    while match := re.search(r"\b(?:GROUP_)?AT\((?:\([^()]*\))?\w+, ", text):
        depth, end, comma = 1, match.end(), None
        while depth:
            depth += (text[end] in "([") - (text[end] in ")]")
            comma = end if text[end] == "," and depth == 1 else comma
            end += 1
        inner = text[match.end() : comma if match[0].startswith("GROUP") else end - 1]
        text = text[: match.start()] + inner + text[end:]
    return text


@pytest.mark.slow
def test_checks_and_guards_change_no_bit_of_an_image(device, guarded):
    scene = build([floor(1.0, glowing(0.5, 0.5))], camera((0, 1, 2), (0, 0, 0), 45), (8, 8))
    images = []
    for one in (Device(device.context, guarded.traits), guarded):
        opened = Renderer(scene, Settings(path_filter="hash_grid"), one)
        opened.render(spp=2)
        images.append(opened.image().rgb)
        opened.close()
    assert images[0].tobytes() == images[1].tobytes()
