"""Sources, builds and launches: what is accepted, what is refused, and in which words."""

import re
from pathlib import Path

import numpy as np
import pytest

from psf_cl.device import layout
from psf_cl.device.program import assemble, load_program
from psf_cl.device.sources import kernel_folder
from psf_cl.errors import DeviceError

KERNELS = Path(__file__).parent / "kernels"


@pytest.fixture
def fill(device):
    """Return the program, and a buffer that its kernel writes."""
    buffer = device.allocate("out", np.uint32, 100)
    yield load_program(device, "include_test.cl", folder=KERNELS), buffer
    device.release(buffer)


def test_includes_are_expanded_once_with_their_lines_named():
    text = assemble("include_test.cl", KERNELS)
    assert "#include" not in text and "#pragma once" not in text
    assert text.count("#define INNER 7") == text.count("#define OUTER") == 1
    # Every line is still at the place that the last #line gives it.
    name, number, found = None, 0, 0
    for line in text.splitlines():
        seam = re.fullmatch(r'#line (\d+) "cl/(.+)"', line)
        if seam:
            number, name = int(seam[1]), seam[2]
            continue
        original = (KERNELS / name).read_text(encoding="utf-8").splitlines()[number - 1]
        if line:
            assert line == original, f"{name}:{number}"
            found += 1
        number += 1
    assert found == 9


@pytest.mark.parametrize("path", sorted(kernel_folder().glob("*.cl")), ids=lambda path: path.name)
def test_assembled_sources_hold_all_that_they_depend_on(path):
    text = assemble(path.name)
    assert not re.search(r"^\s*#\s*include", text, re.MULTILINE)


def test_missing_include_names_file_and_line(tmp_path):
    (tmp_path / "a.cl").write_text('// first\n#include "b.h"\n')
    (tmp_path / "b.h").write_text('\n\n#include "nothing.h"\n')
    with pytest.raises(DeviceError, match=r"b\.h:3: no file nothing\.h"):
        assemble("a.cl", tmp_path)


def test_build_errors_name_the_header_and_the_line(device, tmp_path):
    (tmp_path / "broken.h").write_text(
        "inline int fine(void) { return 1; }\nint broken = nonsense;\n"
    )
    (tmp_path / "main.cl").write_text('#include "broken.h"\nkernel void k(void) {}\n')
    with pytest.raises(DeviceError) as error:
        load_program(device, "main.cl", folder=tmp_path)
    assert "main.cl does not build on" in str(error.value)
    assert re.search(r"broken\.h:2\b.*nonsense", str(error.value))

    (tmp_path / "after.cl").write_text(
        '#include "fine.h"\n\nkernel void k(void) { undeclared = 1; }\n'
    )
    (tmp_path / "fine.h").write_text("#define A 1\n#define B 2\n#define C 3\n")
    with pytest.raises(DeviceError, match=r"after\.cl:3\b.*undeclared"):
        load_program(device, "after.cl", folder=tmp_path)


def test_programs_are_built_once_a_set_of_defines(device):
    first = load_program(device, "include_test.cl", {"X": 1}, KERNELS)
    assert load_program(device, "include_test.cl", {"X": 1}, KERNELS) is first
    other = load_program(device, "include_test.cl", {"X": 2}, KERNELS)
    assert other is not first
    traits = device.traits
    assert other.defines == {"X": 2, "W": traits.lanes, "BLOCK": traits.block, "RUN": traits.run}


def test_launches_keep_their_own_arguments(device, fill):
    program, out = fill
    one = program.bind("fill", out=out, count=100, value=1.0, offset=0)
    two = program.bind("fill", out=out, count=10, value=2.0, offset=-1)
    one(100)
    np.testing.assert_array_equal(device.read(out), 708)
    two(10)
    one.set(count=5, offset=40)(5)
    np.testing.assert_array_equal(device.read(out), [748] * 5 + [708] * 95)
    one(0)
    one(-3)
    np.testing.assert_array_equal(device.read(out)[:5], 748)


def test_kernels_of_launches_that_are_gone_are_used_again(device, fill):
    """Each that is made costs memory for good."""
    program, out = fill
    given = {"out": out, "count": 100, "value": 1.0, "offset": 0}
    one, other = (program.bind("fill", **given) for _ in range(2))
    gone = one.kernel
    assert gone is not other.kernel
    one(100)
    del one
    again = program.bind("fill", **given | {"value": 2.0, "count": 10})
    assert again.kernel is gone
    again(10)
    np.testing.assert_array_equal(device.read(out), [709] * 10 + [708] * 90)


def test_unknown_kernels_are_refused(fill):
    program, out = fill
    with pytest.raises(TypeError, match=r"include_test\.cl: empty: no such kernel"):
        program.bind("empty", out=out)


@pytest.mark.parametrize(
    "change,words",
    [
        ({"value": None}, "missing value"),
        ({"extra": 1}, "no argument extra; has out, count, value, offset"),
        ({"out": 5}, r"out is uint\*, got int"),
        ({"count": "ten"}, "count is uint, got str"),
        ({"count": 2.5}, "count is uint, got float"),
        ({"count": -1}, "count is uint, got -1"),
        ({"offset": 2**31}, f"offset is int, got {2**31}"),
        ({"value": np.zeros(3)}, "value is float, got ndarray"),
    ],
)
def test_wrong_arguments_are_refused_in_words(fill, change, words):
    program, out = fill
    arguments = {"out": out, "count": 1, "value": 1, "offset": 0} | change
    arguments = {name: value for name, value in arguments.items() if value is not None}
    with pytest.raises(TypeError, match=words):
        program.bind("fill", **arguments)


def test_buffers_of_another_type_are_refused(device, fill):
    program, out = fill
    for dtype, name in ((np.float32, "float"), (layout.LIGHT.dtype, "Light")):
        wrong = device.allocate("wrong", dtype, 100)
        with pytest.raises(TypeError, match=rf"out is uint\*, got a buffer of {name}"):
            program.bind("fill", out=wrong, count=1, value=1.0, offset=0)
        device.release(wrong)
    with pytest.raises(TypeError, match="value is float, got Buffer"):
        program.bind("fill", out=out, count=1, value=out, offset=0)


def test_planned_buffers_are_found_by_name_and_lacking_ones_named(device, fill):
    program, out = fill
    with pytest.raises(TypeError, match="missing count, offset, value"):
        program.bind_planned("fill", {"out": out, "unused": out})


def test_an_include_inside_a_condition_is_refused(tmp_path):
    """It would be expanded there, once, and might be cut away for those who need it."""
    (tmp_path / "part.h").write_text("#define PART 1\n")
    (tmp_path / "whole.cl").write_text('#if 1\n#include "part.h"\n#endif\n')
    with pytest.raises(DeviceError, match=r"whole\.cl:2: an include inside a condition"):
        assemble("whole.cl", tmp_path)
