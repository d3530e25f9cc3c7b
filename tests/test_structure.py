"""The rules of the tree: who may import whom, and what kernel sources may hold."""

from __future__ import annotations

import ast
import configparser
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import psf_cl
from psf_cl.device.sources import kernel_folder

ROOT = Path(__file__).resolve().parents[1]

# A module imports its own row and lower ones; "" is `import psf_cl`.
ROWS = [
    {"errors", "files", "settings", "traits", "image", "state_file", "__version__", ""},
    {"scene", "measure"},
    {"device"},
    {"stages", "few", "tables", "whole_lights", "instancing", "motion", "mover"},
    {"features"},
    {"chains", "launches", "plan", "scheduler", "soundness", "checkpoint", "learned"},
    {"renderer", "pictures", "stats"},
    {"cli"},
    {"__init__", "__main__"},
]
ROW_OF = {name: row for row, names in enumerate(ROWS) for name in names}

# Names of packages on PyPI where they differ from what one imports.
DISTRIBUTIONS = {"PIL": "Pillow"}

# Packages that only an extra brings.
EXTRAS = {"DracoPy": "draco"}

KERNEL_FILES = sorted(
    path
    for folder in (kernel_folder(), ROOT / "tests" / "kernels")
    for path in folder.rglob("*")
    if path.suffix in (".cl", ".h")
)


def python_files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


def imports_of(path: Path) -> Iterator[str]:
    """Yield the dotted name of everything that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def part_of(path: Path) -> str:
    """Return the name of the module or package of ``psf_cl`` that a file belongs to."""
    return path.relative_to(ROOT / "psf_cl").parts[0].removesuffix(".py")


def code_of(path: Path) -> str:
    """Return a kernel file without comments and strings, on the same lines."""
    text = path.read_text(encoding="utf-8")
    pattern = r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"'
    return re.sub(pattern, lambda match: "\n" * match[0].count("\n"), text, flags=re.DOTALL)


def double_literals(code: str) -> list[str]:
    """Return the floating-point literals that have no ``f`` suffix."""
    numbers = re.findall(r"(?<![\w.])\.?\d(?:[eEpP][+-]|[\w.])*", code)
    is_float = re.compile(r"0[xX].*[.pP]|(?!0[xX]).*[.eE]")
    return [number for number in numbers if is_float.match(number) and number[-1] not in "fF"]


def test_imports_point_down_only():
    wrong = []
    for path in python_files("psf_cl"):
        assert part_of(path) in ROW_OF, f"give {part_of(path)} a row in this test"
        row = ROW_OF[part_of(path)]
        for name in imports_of(path):
            package, _, rest = name.partition(".")
            if package == "psf_cl" and ROW_OF.get(rest.split(".")[0], len(ROWS)) > row:
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not wrong


def test_only_the_device_package_imports_pyopencl():
    files = [*python_files("psf_cl"), *python_files("tools")]
    importers = {
        path.relative_to(ROOT).parts[:2]
        for path in files
        if any(name.split(".")[0] == "pyopencl" for name in imports_of(path))
    }
    assert importers == {("psf_cl", "device")}


@pytest.mark.parametrize("arguments", [["plan", "scenes/cornell_box.toml"], ["--help"]])
def test_planning_needs_no_opencl(arguments):
    # None in sys.modules makes every import of pyopencl fail, as if it were not installed.
    script = (
        "import sys; sys.modules['pyopencl'] = None; import psf_cl; psf_cl.load_scene; "
        f"from psf_cl.cli.main import main; sys.exit(main({arguments!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_public_names_resolve():
    for name in psf_cl.__all__:
        assert getattr(psf_cl, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = psf_cl.nothing


def test_setup_lists_every_package_and_dependency():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    folders = {".".join(path.parent.relative_to(ROOT).parts) for path in python_files("psf_cl")}
    assert set(config["options"]["packages"].split()) == folders | {"psf_cl.cl"}
    assert all((ROOT / folder.replace(".", "/") / "__init__.py").is_file() for folder in folders)

    imported = {
        name.split(".")[0] for path in python_files("psf_cl") for name in imports_of(path)
    } - {"psf_cl", "__future__", *sys.stdlib_module_names}
    required = {
        re.match(r"[\w-]+", line)[0]
        for line in config["options"]["install_requires"].strip().splitlines()
    }
    assert {DISTRIBUTIONS.get(name, name) for name in imported - set(EXTRAS)} == required
    for name, extra in EXTRAS.items():
        assert name in imported and name in config["options.extras_require"][extra]


@pytest.mark.parametrize("path", sorted(kernel_folder().glob("*.cl")), ids=lambda path: path.name)
def test_a_stage_that_looks_up_hits_knows_of_places(path):
    """Built without them it would take the tree over the places for one of triangles."""
    if re.search(r"\b(surface_point|closest_hits|blocked_rays)\(", path.read_text()):
        assert '"INSTANCES"' in (ROOT / "psf_cl" / "stages" / f"{path.stem}.py").read_text()


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)
def test_inline_functions_are_static(path):
    """Else OpenCL C emits none of them, and a call that is not inlined has nothing to call."""
    assert not re.findall(r"^inline\b.*", path.read_text(), re.MULTILINE)


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)
def test_kernels_have_no_doubles_and_64_bit_atomics_only_where_the_device_has_them(path):
    code = code_of(path)
    code = re.sub(r"(?s)#if defined\(cl_khr_int64_base_atomics\).*?#else", "", code)
    # A literal without f makes the whole expression double where the device has doubles.
    assert not double_literals(code)
    # Not every OpenCL 1.2 device has these; atomic_* is the 32-bit family.
    assert not re.findall(r"\bdouble\d*\b|\bcl_khr_fp64\b|\batom_\w+|\bcl_khr_int64\w*", code)


@pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)
def test_kernels_include_headers_that_exist(path):
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"^\s*#\s*include\s+(\S+)", text, re.MULTILINE):
        assert name.startswith('"') and name.endswith('.h"'), f"{path.name} includes {name}"
        assert (path.parent / name.strip('"')).is_file(), f"{path.name} includes {name}"


def test_the_search_for_doubles_knows_how_numbers_are_spelled():
    doubles = ["0.5", "1.", ".25", "1e-3", "2.5E+4", "0x1.8p3", "0x1p-24"]
    others = ["1", "0.5f", "1.f", "1e-3f", "0x1p-24f", "0xE0", "0x9E3779B9u", "v.s0", "float16(x)"]
    assert double_literals(" + ".join(doubles + others)) == doubles
