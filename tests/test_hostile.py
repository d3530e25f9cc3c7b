"""Input that is wrong, broken or hostile: one line that names it, exit code 2, no file left."""

from __future__ import annotations

import io
import json
import os
import struct
import zlib
from pathlib import Path

import fuzz_readers as fuzz
import numpy as np
import PIL.Image
import pytest

from psf_cl.cli.main import main
from psf_cl.errors import InputError
from psf_cl.image import Image, read_exr, write_exr

SCENE = '[[shapes]]\nprimitive = "quad"\n'
RUN = "--size 8x8 --spp 1 -o out.exr"


def triangle_gltf(**accessor: object) -> dict[str, object]:
    """Return a glTF file of one triangle, with members of its position accessor replaced."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    indices = np.array([0, 1, 2, 0], "<u2").tobytes()
    return {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "buffers": [{"byteLength": 44}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 8},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **accessor},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "_binary": positions + indices,
    }


def glb(document: dict[str, object]) -> bytes:
    document = dict(document)
    binary = document.pop("_binary")
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def zeros_gltf(nodes: int, primitives: int, count: int = 1 << 20) -> str:
    """Return a small glTF file of very many triangles whose corners are all zero."""
    primitive = {"attributes": {"POSITION": 0}}
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "meshes": [{"primitives": [primitive] * primitives}],
            "nodes": [{"mesh": 0}] * nodes,
            "accessors": [{"componentType": 5126, "count": count, "type": "VEC3"}],
        }
    )


def obj(*lines: str) -> str:
    return "\n".join(("v 0 0 0", "v 1 0 0", "v 0 1 0", *lines)) + "\n"


def png(width: int, height: int, pixels: bytes) -> bytes:
    """Return a PNG whose header claims a size, whatever the pixels are."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(pixels))
        + chunk(b"IEND", b"")
    )


def good_png() -> bytes:
    data = io.BytesIO()
    noise = np.random.default_rng(1).integers(0, 256, (32, 32, 4), np.uint8)
    PIL.Image.fromarray(noise).save(data, "png")
    return data.getvalue()


def good_exr(size: int = 32) -> bytes:
    path = Path("whole.exr")
    noise = np.random.default_rng(1).random((size, size, 3), np.float32)
    write_exr(path, Image({"rgb": noise}))
    data = path.read_bytes()
    path.unlink()
    return data


def textured(name: str) -> str:
    material = f'[materials.m]\nbase_color_texture = "{name}"\n'
    return material + SCENE + 'material = "m"\n'


# Scene file and its content; then what the error has to say.  A content that is no text or bytes
# is a function that makes the file.
BAD_SCENES: dict[str, tuple[str, object, str]] = {
    "missing": ("no.toml", None, "no.toml: expected a file, got nothing"),
    "a folder": ("folder.toml", lambda path: path.mkdir(), "expected a file, got a folder"),
    "a named pipe": ("pipe.toml", os.mkfifo, "expected a file, got something else"),
    "a link to itself": ("a.toml", lambda path: path.symlink_to(path.name), "a.toml"),
    "a device": ("a.toml", lambda path: path.symlink_to("/dev/zero"), "expected a file"),
    "a pipe as a mesh": ("pipe.ply", os.mkfifo, "expected a file, got something else"),
    "unknown suffix": ("a.blend", "", "expected a file ending in .toml"),
    "no suffix": ("scene", "", "expected a file ending in .toml"),
    "empty": ("a.toml", "", "no triangles"),
    "bytes that are no text": ("a.toml", b"\xff\xfe\x00\x01" * 9, "a.toml"),
    "a NUL": ("a.toml", SCENE + "name = 'a\0b'", "a.toml"),
    "a byte order mark": ("a.toml", b"\xef\xbb\xbf[film", "a.toml"),
    "half a key": ("a.toml", SCENE + "[film]\nwidth =", "a.toml"),
    "deep nesting": ("a.toml", "a = " + "[" * 100000, "a.toml"),
    "unknown key": (
        "a.toml",
        SCENE + "[film]\nwidht = 4",
        "film.widht: unknown key; did you mean",
    ),
    "unknown table": ("a.toml", SCENE + "[flim]\nwidth = 4", "flim"),
    "wrong type": ("a.toml", SCENE + "[film]\nwidth = '4'", "film.width"),
    "wrong length": ("a.toml", SCENE + "[camera]\nposition = [1, 2]", "camera.position"),
    "not a number": ("a.toml", SCENE + "[camera]\nfov_y = nan", "camera.fov_y"),
    "unknown setting": (
        "a.toml",
        SCENE + "[render]\nmax_dept = 4",
        "a.toml: render.max_dept: unknown setting; did you mean max_depth?",
    ),
    "setting of a wrong type": ("a.toml", SCENE + "[render]\nseed = 1.5", "seed"),
    "a setting of 400 digits": (
        "a.toml",
        SCENE + f"[render]\nmax_depth = 1{'0' * 400}",
        "max_depth must be from 0 to 1048576; got 1000",
    ),
    "a setting that cannot be printed": (
        "a.toml",
        SCENE + f"[render]\nmax_depth = 0x{'f' * 5000}",
        "max_depth must be from 0 to 1048576; got a huge integer",
    ),
    "a choice that cannot be printed": (
        "a.toml",
        SCENE + f"[render]\nsampler = [0x{'f' * 5000}]",
        "sampler must be one of sobol, random; got a huge integer",
    ),
    "unknown preset": ("a.toml", SCENE + "[render]\npreset = 'fast'", "render.preset must be"),
    "huge film": ("a.toml", SCENE + "[film]\nwidth = 1000000000000", "film.width"),
    "missing mesh": ("a.toml", '[[shapes]]\nmesh = "no.obj"', "no.obj"),
    "itself as a mesh": ("a.toml", '[[shapes]]\nmesh = "a.toml"', "expected a file ending in"),
    "unknown material": ("a.toml", SCENE + 'material = "no"', "no"),
    "missing texture": ("a.toml", textured("no.png"), "base_color_texture: no such file: no.png"),
    "empty OBJ": ("a.obj", "", "a.obj has no triangles"),
    "vertices only": ("a.obj", obj(), "a.obj has no triangles"),
    "empty PLY": ("a.ply", "", "not a sound PLY file"),
    "empty STL": ("a.stl", "", "a.stl"),
    "index out of range": ("a.obj", obj("f 1 2 4"), "index"),
    "index of zero": ("a.obj", obj("f 0 1 2"), "index"),
    "no finite vertex": ("a.obj", "v nan 0 0\nv 1 inf 0\nv 0 nan 1\nf 1 2 3\n", "finite"),
    "billions of faces": (
        "a.ply",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\n"
        b"property float y\nproperty float z\nend_header\n",
        "not a sound PLY file",
    ),
    "a billion triangles in many places": ("a.gltf", zeros_gltf(3000, 1), "134217728 triangles"),
    "billions of zeros": (
        "a.gltf",
        zeros_gltf(1, 1, count=1 << 25),
        "accessors[0].count: expected at most 16777216",
    ),
    "empty GLB": ("a.glb", b"", "GLB"),
    "cut GLB": ("a.glb", glb(triangle_gltf())[:-20], "truncated"),
    "GLB header alone": ("a.glb", glb(triangle_gltf())[:15], "truncated"),
    "count beyond the buffer": ("a.glb", glb(triangle_gltf(count=4)), "accessors[0]"),
    "count beyond memory": ("a.glb", glb(triangle_gltf(count=1 << 60)), "accessors[0]"),
    "negative count": ("a.glb", glb(triangle_gltf(count=-1)), "accessors[0].count"),
    "unknown component type": ("a.glb", glb(triangle_gltf(componentType=7)), "componentType"),
    "glTF that is no JSON": ("a.gltf", "{", "a.gltf"),
    "glTF of deep nesting": ("a.gltf", "[" * 100000, "a.gltf"),
    "missing glTF buffer": (
        "a.gltf",
        json.dumps(
            triangle_gltf() | {"_binary": 0, "buffers": [{"byteLength": 44, "uri": "no.bin"}]}
        ),
        "no.bin",
    ),
}

# Options after ``render good.toml``, and what the error has to say.
BAD_OPTIONS = {
    "--spp 0": "--spp",
    "--spp -3": "--spp",
    "--spp 1e3": "--spp",
    "--seconds -1": "--seconds",
    "--seconds 0": "--seconds",
    "--size 99999x99999": "99999x99999",
    "--size 0x0": "--size",
    f"--size {'9' * 5000}x9": "--size",
    "--crop 0,0,9,9": "--crop: 0,0,9,9",
    "--crop 8,8,1,1": "--crop: 8,8,1,1",
    "--crop 99999999999,0,1,1": "--crop: 99999999999,0,1,1",
    "--crop a,b,c,d": "--crop",
    "--aov beauty": "--aov",
    "--aov ,": "--aov",
    "--seed 4294967296": "error: --seed must be from 0",
    "--seed 1.5": "seed",
    f"--seed {'9' * 400}": "seed must be from 0 to 4294967295; got '9999",
    f"--seed {'9' * 5000}": "seed must be an integer",
    f"--set max_depth=-{'9' * 400}": "max_depth must be from 0",
    "--set max_depth=1e400": "max_depth",
    "--set max_depth=": "max_depth",
    "--set sampler=halton": "sampler must be one of sobol, random",
    "--set light_sampling=photons": "light_sampling",
    "--set direct_sampling=": "direct_sampling",
    "--set termination=1": "termination",
    "--set integrator=mlt": "integrator",
    "--set roulette_depth=x": "roulette_depth",
    "--preset fast": "preset",
    "--camera nobody": "no camera 'nobody'",
    "--exposure nan": "--exposure",
    "--environment no.exr": "no.exr: expected a file, got nothing",
    "--environment good.toml": "expected an environment image",
    "--environment cut.exr": "cut.exr: damaged or truncated",
    "--environment cut.hdr": "cut.hdr",
    "--environment pipe.exr": "pipe.exr: expected a file, got something else",
    "--reference cut.exr": "cut.exr: damaged or truncated",
    "--reference wide.exr": "wide.exr: expected 8x8 pixels",
    "--reference pipe.exr": "pipe.exr: expected a file, got something else",
    "--reference folder": "folder: expected a file, got a folder",
    "--device of_nobody": "--device: no device matches 'of_nobody'",
    "-o none/out.exr": "there is no folder",
    "-o folder/": "expected a name that ends in .exr",
    "-o dir.exr": "dir.exr: cannot write: it exists and is not a file",
    "-o pipe.exr": "pipe.exr: cannot write: it exists and is not a file",
    "-o good.toml": "expected a name that ends in .exr",
    "--stats folder": "folder: cannot write",
    "--stats good.toml": "another input or output",
    f"-o {'a' * 300}.exr": "cannot write",
}


def everything_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def refused(arguments: list[str], capfd: pytest.CaptureFixture[str], folder: Path) -> str:
    """Run the command; return its one line on standard error, checked for all that holds always."""
    before = everything_in(folder)
    code = main(arguments)
    output = capfd.readouterr()
    assert output.out == ""
    assert output.err.startswith("psf-cl: error: ") and output.err.count("\n") == 1
    assert code == 2, output.err
    assert everything_in(folder) == before
    return output.err


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("case", BAD_SCENES)
def test_a_bad_scene_is_one_line(folder, capfd, case):
    name, content, expected = BAD_SCENES[case]
    path = folder / name
    if callable(content):
        content(path)
    elif content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for command in (["render", name, *RUN.split()], ["plan", name]):
        error = refused(command, capfd, folder)
        assert name in error and expected in error


def test_triangles_are_counted_before_all_meshes_are_made(folder, capfd, monkeypatch):
    monkeypatch.setattr("psf_cl.scene.gltf.MAX_TRIANGLES", 14)
    document = json.loads(zeros_gltf(1, 1000, count=9))
    # Equal primitives would share one mesh.
    for number, primitive in enumerate(document["meshes"][0]["primitives"]):
        primitive["extensions"] = {"OTHER": {"number": number}}
    (folder / "a.gltf").write_text(json.dumps(document))
    error = refused(["plan", "a.gltf"], capfd, folder)
    assert "meshes[0].primitives[4].indices: expected at most 14 triangles in all meshes" in error


@pytest.mark.parametrize("options", BAD_OPTIONS, ids=lambda options: options[:40])
def test_a_bad_option_is_one_line(folder, capfd, options):
    (folder / "good.toml").write_text(SCENE)
    (folder / "folder").mkdir()
    (folder / "dir.exr").mkdir()
    os.mkfifo(folder / "pipe.exr")
    (folder / "cut.exr").write_bytes(good_exr()[:-500])
    (folder / "wide.exr").write_bytes(good_exr())
    (folder / "cut.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 9 +X 9\n\x01")
    # A later option of the same name wins, and these keep a render small that should not start.
    small = ["--size", "8x8", "-o", "out.exr"]
    assert BAD_OPTIONS[options] in refused(
        ["render", "good.toml", *small, *options.split()], capfd, folder
    )


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(lambda: b"", id="empty"),
        pytest.param(lambda: b"no picture at all", id="no picture"),
        pytest.param(lambda: good_png()[:-900], id="cut"),
        pytest.param(lambda: good_png().replace(b"IDAT", b"IDAX"), id="without pixels"),
        pytest.param(lambda: good_png()[:90] + bytes(200) + good_png()[290:], id="damaged"),
        pytest.param(lambda: png(1 << 30, 1 << 30, b""), id="a header of 2^60 pixels"),
        pytest.param(lambda: png(16000, 4000, b""), id="a header of 64 million pixels"),
    ],
)
def test_an_unreadable_texture_is_one_line(folder, capfd, data):
    (folder / "a.toml").write_text(textured("skin.png"))
    (folder / "skin.png").write_bytes(data())
    error = refused(["render", "a.toml", *RUN.split()], capfd, folder)
    assert "skin.png: unreadable texture" in error


def test_a_folder_that_cannot_be_written_is_one_line(folder, capfd):
    (folder / "good.toml").write_text(SCENE)
    (folder / "shut").mkdir(mode=0o555)
    # Root may write anywhere but where the system itself refuses.
    place = "shut/out.exr" if os.geteuid() else "/proc/out.exr"
    error = refused(["render", "good.toml", "-o", place], capfd, folder)
    assert f"{place}: cannot write" in error


def test_file_names_may_be_any_bytes(folder, capfd):
    name = os.fsdecode(b"sc\xe9ne.toml")
    error = refused(["render", name, *RUN.split()], capfd, folder)
    assert "expected a file, got nothing" in error
    (folder / name).write_text(SCENE + "[camera]\nposition = [0, 2, 4]\ntarget = [0, 0, 0]\n")
    error = refused(["render", name, *RUN.split(), "--camera", "none"], capfd, folder)
    assert "no camera 'none'" in error


def test_a_name_with_a_line_break_is_still_one_line(folder, capfd):
    assert "a b.toml" in refused(["render", "a\nb.toml", *RUN.split()], capfd, folder)


@pytest.mark.parametrize("command", ["render", "plan"])
def test_a_clip_of_one_image_is_refused(folder, capfd, command):
    (folder / "a.glb").write_bytes(glb(triangle_gltf()))
    assert "--clip: expected --frames" in refused(
        [command, "a.glb", "--clip", "walk"], capfd, folder
    )


def assert_render_is_quiet(capfd, scene: str, note: str, *options: str) -> None:
    assert main(["render", scene, *options, *RUN.split()]) == 0
    told = capfd.readouterr().err
    assert told.count("\n") == 2 and told.startswith("note: ") and note in told
    pixels = read_exr("out.exr").rgb
    assert np.isfinite(pixels).all() and pixels.max() > 1e10


def test_a_note_on_a_name_with_a_line_break_is_still_one_line(folder, capfd):
    document = triangle_gltf()
    document["extensionsUsed"] = ["OTHER\nname"]
    (folder / "a.glb").write_bytes(glb(document))
    assert main(["plan", "a.glb"]) == 0
    lines = capfd.readouterr().err.splitlines()
    assert all(line.startswith("note: ") for line in lines)
    assert "note: extensions are ignored: OTHER name" in lines


def test_light_beyond_float32_in_an_mtl_file_is_limited_and_told(device, folder, capfd):
    (folder / "a.obj").write_text("mtllib a.mtl\n" + obj("usemtl lamp", "f 1 2 3"))
    (folder / "a.mtl").write_text("newmtl lamp\nKe 1e308 1e308 1\n")
    note = "Ke of lamp above 1e+20 is set to that"
    assert_render_is_quiet(capfd, "a.obj", note, "--environment", "none")


def test_light_beyond_float32_in_a_gltf_file_is_limited_and_told(device, folder, capfd):
    document = triangle_gltf()
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 3e38}}
    document["materials"] = [{"emissiveFactor": [1, 1, 1], "extensions": strength}]
    document["meshes"][0]["primitives"][0]["material"] = 0
    light = {"type": "directional", "intensity": 3e38}
    document["extensions"] = {"KHR_lights_punctual": {"lights": [light]}}
    document["nodes"] = [{"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}]
    (folder / "a.glb").write_bytes(glb(document))
    assert_render_is_quiet(capfd, "a.glb", "above 1e+20 are set to that (2 times)")


@pytest.mark.parametrize("value", ["inf", "1e400", "nan"])
def test_light_that_is_not_finite_is_one_line(folder, capfd, value):
    (folder / "a.obj").write_text("mtllib a.mtl\n" + obj("usemtl lamp", "f 1 2 3"))
    (folder / "a.mtl").write_text(f"newmtl lamp\nKe 1 {value} 1\n")
    error = refused(["render", "a.obj", *RUN.split()], capfd, folder)
    assert "a.obj: material lamp: Ke: expected finite numbers" in error


def test_a_sky_beyond_float32_is_limited_and_told(device, folder, capfd):
    write_exr("sky.exr", Image({"rgb": np.full((2, 4, 3), 3e38, np.float32)}))
    (folder / "a.toml").write_text(SCENE + '[environment]\nimage = "sky.exr"\n')
    arguments = [*RUN.split(), "--quiet"]
    assert main(["render", "a.toml", *arguments]) == 0
    assert capfd.readouterr().err == ""
    assert np.isfinite(read_exr("out.exr").rgb).all()
    (folder / "out.exr").unlink()
    (folder / "out.png").unlink()
    (folder / "a.toml").write_text(SCENE + '[environment]\nimage = "sky.exr"\nscale = 2\n')
    assert "environment.scale" in refused(["render", "a.toml", *arguments], capfd, folder)


@pytest.mark.parametrize("kind", ["exr", "hdr", "png", "jpg", "checkpoint", "cache"])
def test_damaged_images_and_states_load_soundly_or_are_refused(folder, kind):
    files = fuzz.corpus(kind, [])
    assert files
    for whole in files:
        fuzz.try_file(kind, whole, folder)
    refused = 0
    for seed in range(40):
        data = fuzz.file_of(kind, files, seed)
        fuzz.try_file(kind, data, folder)
        path = folder / "a.toml" if kind in fuzz.USED_BY else folder / f"a.{kind}"
        try:
            if kind == "checkpoint":
                fuzz.read_checkpoint(path, fuzz.IDENTITY, fuzz.BUFFERS)
            elif kind == "cache":
                fuzz.read_learned(path, fuzz.IDENTITY, fuzz.TABLES)
            else:
                fuzz.load_scene(path)
        except InputError:
            refused += 1
    assert refused > 0
