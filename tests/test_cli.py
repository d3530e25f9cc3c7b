"""The command line: exit codes, one line an error, and nothing rendered that cannot be written."""

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import types
from pathlib import Path
from typing import ClassVar

import numpy as np
import PIL.Image
import pytest

import psf_cl.image
from psf_cl.cli.main import main
from psf_cl.cli.progress import describe, seconds_left
from psf_cl.errors import DeviceError, InputError
from psf_cl.image import AOVS, Image, read_exr, write_exr
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings


@dataclasses.dataclass
class Progress:
    passes: int
    spp_target: int | None
    seconds: float
    seconds_target: float | None
    samples_per_second: float


class FakeRenderer:
    """Adds 1 / 4 s a pass; pass n makes a picture of 1 + 1 / n.  Class attributes steer it."""

    made: ClassVar[dict] = {}
    on_pass = staticmethod(lambda passes: None)
    build_error: BaseException | None = None
    notes: ClassVar[tuple[str, ...]] = ()
    value = 1.0
    started = 1.0

    def __init__(
        self,
        scene,
        settings,
        device=None,
        outputs=frozenset(),
        crop=None,
        statistics=False,
        halves=False,
        room=None,
    ):
        type(self).made = {"settings": settings, "outputs": outputs, "crop": crop, "device": device}
        if self.build_error is not None:
            raise self.build_error
        self.x, self.y, self.width, self.height = crop or (0, 0, scene.width, scene.height)
        self.scene, self.passes, self.outside = scene, 0, 0
        self.closed = False
        type(self).made["renderer"] = self

    def render(self, spp=None, seconds=None, progress=None):
        type(self).made |= {"spp": spp, "seconds": seconds}
        while True:
            self.passes += 1
            self.on_pass(self.passes)
            time = self.passes * 0.25
            if not progress(Progress(self.passes, spp, time, seconds, 1e6)):
                return
            if self.passes == spp or (seconds is not None and time >= seconds):
                return

    @contextlib.contextmanager
    def outside_time(self):
        self.outside += 1
        yield

    def snapshot(self, names=("rgb",)):
        value = self.value + 1.0 / max(self.passes, 1)
        aovs = {"rgb": np.full((self.height, self.width, 3), value, np.float32)}
        aovs["samples"] = np.full((self.height, self.width, 1), self.started, np.float32)
        place = (self.x, self.y, self.scene.width, self.scene.height)
        return Image({name: aovs[name] for name in names}, self.stats(), *place)

    def image(self):
        return self.snapshot()

    def stats(self):
        return {
            "scene": self.scene.path,
            "spp": self.passes,
            "render_seconds": self.passes * 0.25,
            "seed": 0,
            "settings": {},
        }

    def settle(self):
        pass

    def close(self):
        self.closed = True


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Work in an empty folder, with a scene of 8 x 6 pixels and a renderer that needs no device."""

    class Renderer(FakeRenderer):
        pass

    def load_scene(path, environment=None, camera=None, size=None):
        width, height = size or (8, 6)
        return Scene(path, width, height, render={"max_depth": 3}, notes=("a note",))

    def module(name, **members):
        made = types.ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    module(
        "psf_cl.renderer",
        Renderer=Renderer,
        prepare_device=lambda name, profiling, read: f"device {name}",
    )
    module("psf_cl.scene.load", load_scene=load_scene)
    monkeypatch.chdir(tmp_path)
    return Renderer


ROOT = Path(__file__).resolve().parents[1]


def files_in(folder):
    return sorted(path.name for path in folder.iterdir())


def constant(path, value, width=8, height=6):
    write_exr(path, Image({"rgb": np.full((height, width, 3), value, np.float32)}))


def one_error(captured):
    """Return the only line on standard error, checked for being one of ours."""
    assert captured.out == ""
    assert captured.err.startswith("psf-cl: error: ") and captured.err.count("\n") == 1
    return captured.err


def test_render_writes_both_pictures_and_one_summary_line(fake, tmp_path, capsys):
    assert main(["render", "some/box.toml"]) == 0
    assert files_in(tmp_path) == ["box.exr", "box.png"]
    assert (fake.made["spp"], fake.made["seconds"]) == (64, None)
    assert fake.made["settings"] == Settings(max_depth=3)
    assert fake.made["renderer"].closed
    captured = capsys.readouterr()
    assert captured.out == "box.exr: 64 spp in 16.00 s, 0.00 Msamples/s\n"
    assert captured.err.startswith("note: a note\n") and "rendering: " in captured.err
    assert read_exr("box.exr").stats["scene"] == "some/box.toml"


def test_options_reach_the_renderer(fake, tmp_path, capsys):
    arguments = "render a.glb -o x.exr --seconds 0.7 --set max_depth=4 sampler=random --seed 5"
    arguments += " --set roulette_depth=2 --size 20x10 --crop 5,2,8,6 --aov depth,normal"
    arguments += " --device pocl --half --stats s.json --quiet"
    assert main(arguments.split()) == 0
    assert capsys.readouterr() == ("", "")
    made = fake.made
    assert made["settings"] == Settings(max_depth=4, sampler="random", seed=5, roulette_depth=2)
    assert made["outputs"] == {"depth", "normal"} and made["crop"] == (5, 2, 8, 6)
    assert made["device"] == "device pocl" and (made["spp"], made["seconds"]) == (None, 0.7)
    assert files_in(tmp_path) == ["s.json", "x.exr", "x.png"]
    stats = json.loads((tmp_path / "s.json").read_text())
    assert stats["spp"] == 3 and "error" not in stats
    image = read_exr("x.exr")
    assert (image.x, image.y, image.full_width, image.full_height) == (5, 2, 20, 10)


def test_errors_are_measured_at_the_first_pass_at_powers_of_two_and_at_the_end(fake, capsys):
    constant("ref.exr", 1.0)
    arguments = "render a.toml --spp 23 --reference ref.exr --stats s.json"
    assert main(arguments.split()) == 0
    with open("s.json") as file:
        points = json.load(file)["error"]
    assert [point["spp"] for point in points] == [1, 4, 8, 16, 23]
    assert [point["seconds"] for point in points] == [0.25, 1.0, 2.0, 4.0, 5.75]
    for point in points:
        assert point["mse"] == pytest.approx(point["spp"] ** -2.0, rel=1e-5)
        assert point["relmse"] == pytest.approx(point["spp"] ** -2.0 / 1.01, rel=1e-5)
        assert "relmse_trimmed" in point
    assert fake.made["renderer"].outside == 4  # The last point is the finished image.
    assert "relMSE 0.001872" in capsys.readouterr().out


def test_a_full_reference_serves_a_crop(fake):
    rgb = np.zeros((6, 8, 3), np.float32)
    rgb[2:4, 3:5] = 1.0
    write_exr("ref.exr", Image({"rgb": rgb}))
    arguments = "render a.toml --spp 1 --crop 3,2,2,2 --reference ref.exr --stats s.json"
    assert main(arguments.split()) == 0
    with open("s.json") as file:
        assert [point["mse"] for point in json.load(file)["error"]] == [1.0]


def test_pixels_that_are_not_finite_stay_valid_json_and_are_said(fake, capsys):
    constant("ref.exr", 1.0)
    fake.value = np.nan
    assert main("render a.toml --spp 1 --reference ref.exr --stats s.json".split()) == 0
    with open("s.json") as file:
        point = json.load(file)["error"][0]
    assert point["nonfinite"] == 48 and point["mse"] is None
    assert "48 pixels not finite" in capsys.readouterr().out


BAD_USAGE = {
    "": "required",
    "paint a.toml": "paint",
    "render": "SCENE",
    "render a.toml b.toml": "b.toml",
    "render a.toml --spp 0": "--spp",
    "render a.toml --spp 1.5": "--spp",
    "render a.toml --spp 99999999999": "--spp",
    "render a.toml --seconds 0": "--seconds",
    "render a.toml --seconds nan": "--seconds",
    "render a.toml --seconds inf": "--seconds",
    "render a.toml --spp 4 --seconds 2": "not allowed with",
    "render a.toml --size 0x5": "--size",
    "render a.toml --size 5": "--size",
    "render a.toml --crop 0,0,5": "--crop",
    "render a.toml --crop 0,0,0,5": "--crop",
    "render a.toml --crop -1,0,5,5": "--crop",
    "render a.toml --crop 4,0,5,5": "--crop: 4,0,5,5",
    "render a.toml --exposure big": "--exposure",
    "render a.toml --set max_depth": "key=value",
    "render --set max_depth=1 a.toml": "before --set",
    "render a.toml --set max_dept=1": "did you mean max_depth",
    "render a.toml --set max_depth=-1": "max_depth",
    "render a.toml --set seed=-1": "error: --set seed must be from 0",
    "render a.toml --seed -1": "error: --seed must be from 0",
    "render a.toml --seed x": "error: --seed must be an integer",
    "render a.toml --preset none": "error: --preset must be one of",
    "render a.toml --aov depth,hue": "hue",
    "render a.toml --aov all,hue": "unknown hue",
    "render a.toml -o a.png": ".exr",
    "render a.toml -o none/a.exr": "cannot write: there is no folder",
    "render a.toml -o file/a.exr": "cannot write: Not a directory",
    "render a.toml --stats none/a.json": "cannot write",
    "render a.toml --stats a.png": "another input or output",
    "render a.toml -o small.exr --reference small.exr": "another input or output",
    "render a.toml --reference none.exr": "none.exr: expected a file, got nothing",
    "render a.toml --reference file": "expected an OpenEXR image",
    "render a.toml --reference small.exr": "small.exr: expected 8x6 pixels; got 4x4",
    "render a.toml --reference black.exr": "black.exr: the reference is black",
    "compare small.exr": "B.exr",
    "compare small.exr none.exr": "none.exr: expected a file, got nothing",
    "compare small.exr black.exr": "black.exr: expected 4x4 pixels; got 8x6",
    "compare small.exr small.exr --blocks 9": "1 to 4 blocks",
    "compare small.exr small.exr --blocks 0": "--blocks",
    "compare small.exr small.exr --difference none/d.png": "cannot write",
    "compare small.exr small.exr --difference small.exr": "expected a name that ends in .png",
    "compare small.exr black.exr --blocks 2 --difference d.png": "(--difference needs equal sizes)",
    "compare small.exr black.exr --blocks 2 --max-relmse 0": "(--max-relmse needs equal sizes)",
    "compare small.exr small.exr --max-relmse -1": "--max-relmse: expected a number, 0 or above",
    "compare small.exr small.exr --max-relmse inf": "--max-relmse: expected a number, 0 or above",
}


@pytest.mark.parametrize("arguments", BAD_USAGE)
def test_bad_input_is_one_line_exit_code_2_and_no_file(fake, tmp_path, capsys, arguments):
    (tmp_path / "file").touch()
    constant("small.exr", 1.0, 4, 4)
    constant("black.exr", 0.0)
    before = files_in(tmp_path)
    assert main(arguments.split()) == 2
    error = one_error(capsys.readouterr())
    assert BAD_USAGE[arguments] in error
    assert files_in(tmp_path) == before
    assert fake.made == {}, "the renderer was built before everything was checked"


FILES = {
    "render": ["--output", "--reference", "--stats", "--environment"],
    "compare": ["--difference"],
}


@pytest.mark.parametrize(("command", "option"), [(c, o) for c in FILES for o in FILES[c]])
def test_an_empty_file_name_is_refused(fake, tmp_path, capsys, command, option):
    names = ["a.toml"] if command == "render" else ["a.exr", "a.exr"]
    assert main([command, *names, option, ""]) == 2
    error = one_error(capsys.readouterr())
    assert option in error and "expected the name of a file; got ''" in error
    assert files_in(tmp_path) == []


@pytest.mark.parametrize("names", ["all", "depth,all"])
def test_all_images_can_be_asked_for_at_once(fake, names):
    assert main(["render", "a.toml", "--spp", "1", "--aov", names]) == 0
    assert fake.made["outputs"] == set(AOVS)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (DeviceError("no such\ndevice"), 1, "no such device"),
        (MemoryError(), 1, "out of memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_failures_of_the_run_have_their_own_codes(fake, tmp_path, capsys, error, code, text):
    fake.build_error = error
    assert main(["render", "a.toml", "--quiet"]) == code
    assert text in one_error(capsys.readouterr())
    assert files_in(tmp_path) == []


def test_a_missing_pyopencl_is_one_line(fake, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "psf_cl.renderer", None)
    assert main(["render", "a.toml", "--quiet"]) == 1
    assert "psf-cl doctor" in one_error(capsys.readouterr())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_ctrl_c_or_sigterm_keeps_what_is_rendered(fake, tmp_path, capsys, number):
    def press(passes):
        if passes == 3:
            signal.raise_signal(number)

    fake.on_pass = staticmethod(press)
    before = signal.getsignal(number)
    assert main("render a.toml --spp 1000 --stats s.json".split()) == 130
    assert signal.getsignal(number) is before
    assert files_in(tmp_path) == ["a.exr", "a.png", "s.json"]
    assert read_exr("a.exr").stats["spp"] == 3
    captured = capsys.readouterr()
    assert captured.out.startswith("a.exr: 3 spp") and "interrupted" in captured.err


def test_a_checkpoint_that_cannot_be_written_costs_no_picture(fake, tmp_path, capsys):
    def save(self, path):
        raise InputError(f"{path}: cannot write: No space left on device")

    fake.save = save
    command = "render a.toml --spp 9 --checkpoint c.state --checkpoint-seconds 0.5"
    assert main(command.split()) == 2
    assert files_in(tmp_path) == ["a.exr", "a.png"] and read_exr("a.exr").stats["spp"] == 9
    lines = capsys.readouterr().err.splitlines()
    told = "c.state: cannot write: No space left on device"
    assert f"note: {told}; rendering goes on without a checkpoint" in lines
    assert lines[-1] == f"psf-cl: error: {told}"


@pytest.mark.parametrize("moment", ["image", "write_exr", "write_png"])
def test_ctrl_c_after_the_last_pass_still_writes_everything(
    fake, tmp_path, capsys, monkeypatch, moment
):
    owner = fake if moment == "image" else psf_cl.image
    work = getattr(owner, moment)

    def pressed(*arguments):
        signal.raise_signal(signal.SIGINT)
        return work(*arguments)

    monkeypatch.setattr(owner, moment, pressed)
    assert main("render a.toml --spp 2 --stats s.json".split()) == 130
    assert files_in(tmp_path) == ["a.exr", "a.png", "s.json"]
    assert read_exr("a.exr").stats["spp"] == 2
    assert "what was rendered is written" in capsys.readouterr().err


def test_the_second_ctrl_c_stops_at_once_and_writes_nothing(fake, tmp_path, capsys):
    def press(passes):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    fake.on_pass = staticmethod(press)
    assert main(["render", "a.toml", "--quiet"]) == 130
    assert "interrupted" in one_error(capsys.readouterr())
    assert files_in(tmp_path) == [] and fake.made["renderer"].closed


@pytest.mark.parametrize(
    ("started", "files"), [(0.0, []), (0.5, ["a.exr", "a.png"])], ids=["nothing", "some pixels"]
)
def test_of_an_incomplete_first_pass_what_is_there_is_written(
    fake, tmp_path, capsys, started, files
):
    def render(self, spp=None, seconds=None, progress=None):
        signal.raise_signal(signal.SIGINT)
        assert not progress(Progress(0, spp, 0.0, seconds, 0.0))

    fake.render, fake.started = render, started
    assert main(["render", "a.toml"]) == 130
    assert files_in(tmp_path) == files
    captured = capsys.readouterr()
    assert captured.out.startswith("a.exr: part of the first pass" if files else "")
    assert "interrupted" in captured.err


@pytest.fixture
def all_features(tmp_path, monkeypatch):
    """Work in a folder with ``all.toml``, a scene that needs all features of a large one."""
    monkeypatch.chdir(tmp_path)
    sky = np.random.default_rng(1).random((4, 8, 3), np.float32)
    write_exr("sky.exr", Image({"rgb": sky}))
    checks = np.indices((8, 8)).sum(0)[..., None] % 2 * np.full(4, 255)
    PIL.Image.fromarray(checks.astype(np.uint8)).save("checks.png")
    (tmp_path / "all.toml").write_text(ALL_FEATURES)
    return tmp_path


ALL_FEATURES = """
film = { width = 24, height = 16 }
environment = { image = "sky.exr" }

[[cameras]]
name = "front"
position = [0, 1, 4]
target = [0, 0, 0]
lens_radius = 0.05

[[cameras]]
name = "above"
position = [0, 9, 0]
target = [0, 0, 0]
up = [0, 0, 1]

[materials]
net = { base_color_texture = "checks.png", alpha_mode = "mask" }
glass = { transmission = 1.0, roughness = 0.2 }

[[shapes]]
primitive = "quad"
material = "net"

[[shapes]]
primitive = "sphere"
material = "glass"

[[shapes]]
primitive = "disk"
emission = [1, 1, 1]
transform = [{ translate = [0, 2, 0] }]

[[lights]]
type = "point"
position = [1, 1, 1]
"""


def test_plan_prints_what_it_plans_with_reasons_and_bytes(all_features, capsys):
    assert main("plan all.toml --json --aov depth".split()) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["total_bytes"] == sum(
        buffer["bytes"]
        for owner in [{"buffers": plan["scene_buffers"]}, *plan["stages"]]
        for buffer in owner["buffers"]
    )
    assert main("plan all.toml --aov depth".split()) == 0
    words = " ".join(capsys.readouterr().out.split())
    for stage in plan["stages"]:
        assert stage["reason"] in words
        for text in stage["kernels"]:
            assert text in words
    for buffer in plan["scene_buffers"] + [b for s in plan["stages"] for b in s["buffers"]]:
        assert buffer["what"] in words and f"{buffer['bytes']:,}" in words
    for name, feature in plan["features"].items():
        assert (name if feature["value"] else name.lower()) in words
        assert feature["reason"] in words
    assert f"{plan['total_bytes']:,}" in words


def test_plan_follows_the_options(all_features, capsys):
    def features(arguments):
        assert main(["plan", "all.toml", "--json", *arguments.split()]) == 0
        planned = json.loads(capsys.readouterr().out)
        return planned, {name for name, f in planned["features"].items() if not f["value"]}

    plan, off = features("")
    unused = {
        "AOV_BOUNCES",
        "AOV_CELLS",
        "AOV_GUIDE",
        "BACK_FACES",
        "BASE",
        "CACHE",
        "CELLS",
        "CELL_HISTORY",
        "CELL_LAYERS",
        "FEW",
        "FIREFLIES",
        "GUIDE",
        "INSTANCES",
        "LAYERS",
        "LIGHT_SAMPLING",
        "MATERIAL_CELLS",
        "METROPOLIS",
        "MOTION",
        "RECTANGLES",
        "RESTORE",
        "SEEN",
        "SPARSE",
        "SPHERES",
        "TANGENTS",
        "TEMPORAL",
        "TEXTURE_LEVELS",
        "VERTEX_COLORS",
        "WALLS",
    }
    unused |= {"AOV_LIGHTS", "SHADOW_RAYS", "VIRTUAL_LIGHTS"}
    off_by_default = unused | {"AOV_DIRECT", "AOV_FEATURES"}
    assert off == off_by_default and plan["crop"] == [0, 0, 24, 16]
    plan, off = features("--camera above --aov direct --crop 1,2,3,4")
    assert off == unused | {"LENS", "AOV_FEATURES"} and plan["crop"] == [1, 2, 3, 4]


@pytest.mark.parametrize("output", ["sky.exr", "checks.exr", "box.exr"])
def test_no_file_that_the_scene_names_is_overwritten(all_features, capsys, output):
    (all_features / "box.obj").write_text("mtllib box.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (all_features / "box.mtl").write_text("newmtl a\nmap_Kd box.png\n")
    PIL.Image.new("RGB", (2, 2)).save(all_features / "box.png")
    with open("all.toml", "a") as file:
        file.write('[[shapes]]\nmesh = "box.obj"\n')
    before = {path: path.read_bytes() for path in all_features.iterdir()}
    assert main(["render", "all.toml", "--spp", "1", "-o", output]) == 2
    assert "it is another input or output" in one_error(capsys.readouterr())
    assert {path: path.read_bytes() for path in all_features.iterdir()} == before


@pytest.mark.parametrize(
    ("names", "asked", "hint"),
    [
        (["", ""], "foo", "no camera 'foo'; its cameras have no names"),
        (["near", ""], "foo", "no camera 'foo'; known: 'near'"),
        (["near", ""], "", "no camera ''; known: 'near'"),
        ([], "foo", "no camera 'foo'; it has no cameras"),
    ],
)
def test_a_camera_that_is_not_there_is_answered_by_those_that_are(
    tmp_path, capsys, names, asked, hint
):
    path = tmp_path / "a.toml"
    camera = "[[cameras]]\nposition = [0, 1, 4]\ntarget = [0, 0, 0]\n"
    cameras = [camera + (f'name = "{name}"\n' if name else "") for name in names]
    path.write_text('[[shapes]]\nprimitive = "quad"\n' + "".join(cameras))
    assert main(["plan", str(path), "--camera", asked]) == 2
    assert one_error(capsys.readouterr()).endswith(f"a.toml: {hint}\n")


def test_notes_are_lines_of_one_style(tmp_path, capsys):
    path = tmp_path / "a.toml"
    path.write_text('[[shapes]]\nprimitive = "quad"\n')
    assert main(["plan", str(path)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2, "no camera and no light are two notes"
    for line in lines:
        assert line.startswith("note: the ") and not line.endswith(".")


def test_plan_is_for_the_kind_of_device_that_was_asked_for(all_features, capsys):
    for kind, slots in (("cpu", 1 << 15), ("gpu", 1 << 18)):
        assert main(["plan", "all.toml", "--kind", kind]) == 0
        assert f"for a {kind.upper()}: {slots} paths in flight" in capsys.readouterr().out
    assert main(["plan", "all.toml", "--kind", "toaster"]) == 2


def rendered(arguments):
    """Render with the device of this machine; return the image that was written."""
    assert main(["render", *arguments.split(), "-o", "out.exr"]) == 0
    return read_exr("out.exr")


def test_a_real_render_delivers_all_that_was_asked_for(device, all_features, capfd):
    white = np.ones((16, 24, 3), np.float32)
    write_exr("white.exr", Image({"rgb": white}))
    arguments = f"all.toml --spp 3 --seed 7 --aov {','.join(AOVS)} --stats s.json"
    image = rendered(f"{arguments} --reference white.exr")
    captured = capfd.readouterr()
    assert captured.out.startswith("out.exr: 3 spp") and captured.out.count("\n") == 1
    assert captured.err == ""
    with PIL.Image.open("out.png") as png:
        assert png.size == (24, 16)

    # Of photons there is nothing to show with one light.
    assert set(image.aovs) == {"rgb", *AOVS} - {"photons", "lights"}
    assert (image.aovs["samples"] == 3.0).all()
    total = image.aovs["direct"] + image.aovs["indirect"]
    np.testing.assert_allclose(total, image.rgb, rtol=1e-5, atol=1e-6)

    stats = json.loads((all_features / "s.json").read_text())
    assert (stats["spp"], stats["passes"], stats["seed"]) == (3, 3, 7)
    assert stats["device"] == device.name and stats["scene"] == "all.toml"
    assert stats["settings"] == dataclasses.asdict(Settings(seed=7))
    assert stats["rays"]["camera"] == 3 * 24 * 16
    assert stats["peak_device_bytes"] > 0 and stats["counters"]["rejected_samples"] == 0
    assert sum(stats["occupancy"]) > 0
    ran = {stage["name"]: stage["launches"] for stage in stats["stages"]}
    assert min(ran[kernel] for kernel in ("shade_paths", "intersect_closest", "add_samples")) > 0
    for part in ("render", "build", "load"):
        assert 0.0 < stats[f"{part}_seconds"] < stats["process_seconds"]
    # Two threads compile side by side, and their times are added.
    assert 0.0 < stats["compile_seconds"] < 2 * stats["process_seconds"]
    last = stats["error"][-1]
    squared = np.mean((image.rgb.astype(np.float64) - 1.0) ** 2)
    assert last["spp"] == 3 and last["mse"] == pytest.approx(squared, rel=1e-5)
    assert last["relmse"] == pytest.approx(squared / 1.01, rel=1e-5)


def test_a_crop_has_the_bits_of_the_whole_picture(device, all_features):
    whole = rendered("all.toml --spp 2 --quiet")
    crop = rendered("all.toml --spp 2 --quiet --crop 5,3,9,8")
    assert whole.covers(crop)
    np.testing.assert_array_equal(crop.rgb, whole.cropped(5, 3, 9, 8).rgb)


def test_seconds_give_the_bits_of_as_many_samples(device, all_features):
    timed = rendered("all.toml --seconds 0.2 --quiet")
    counted = rendered(f"all.toml --spp {timed.stats['spp']} --quiet")
    np.testing.assert_array_equal(timed.rgb, counted.rgb)


def test_half_floats_cameras_environments_and_sizes_reach_the_picture(device, all_features):
    write_exr("red.exr", Image({"rgb": np.full((2, 4, 3), (3.0, 0.0, 0.0), np.float32)}))
    front = rendered("all.toml --spp 1 --quiet --half")
    np.testing.assert_array_equal(front.rgb, front.rgb.astype(np.float16))
    above = rendered("all.toml --spp 1 --quiet --size 10x20 --camera above --environment red.exr")
    assert above.rgb.shape == (20, 10, 3)
    # Past the quad in the corners of the narrow picture; bilinear weights round.
    np.testing.assert_allclose(above.rgb[0, 0], (3.0, 0.0, 0.0), rtol=3e-7)


@pytest.mark.parametrize(
    "settings",
    [
        "light_sampling=uniform direct_sampling=light termination=off sampler=random max_depth=3",
        "light_sampling=power direct_sampling=bsdf termination=roulette roulette_depth=0",
        "sampler=sobol direct_sampling=mis integrator=path max_depth=0 seed=4294967295",
    ],
)
def test_every_value_of_every_setting_renders(device, all_features, settings):
    image = rendered(f"all.toml --spp 1 --quiet --preset pt --set {settings}")
    assert np.isfinite(image.rgb).all() and image.rgb.any()
    for name, value in (setting.split("=") for setting in settings.split()):
        assert str(image.stats["settings"][name]) == value


def test_vertices_that_are_not_finite_are_dropped_counted_and_harmless(device, all_features):
    quad = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n"
    (all_features / "whole.obj").write_text(quad)
    (all_features / "broken.obj").write_text(quad + "v nan 0 0\nf 1 2 5\nf 2 3 5\n")
    whole = rendered("whole.obj --size 8x8 --spp 2 --quiet")
    broken = rendered("broken.obj --size 8x8 --spp 2 --quiet --stats s.json")
    np.testing.assert_array_equal(broken.rgb, whole.rgb)
    stats = json.loads((all_features / "s.json").read_text())
    assert stats["counters"]["dropped_triangles"] == 2


def test_the_device_is_chosen_by_option_before_variable(device, all_features, monkeypatch, capfd):
    monkeypatch.setenv("PSF_CL_DEVICE", "of_nobody")
    assert main("render all.toml --spp 1 -o out.exr".split()) == 2
    assert "PSF_CL_DEVICE: no device matches 'of_nobody'" in one_error(capfd.readouterr())
    some = device.name.split(": ")[1][:6]
    assert main(["render", "all.toml", "--spp", "1", "-o", "out.exr", "--device", some]) == 0


def test_ctrl_c_in_a_real_render_writes_what_is_there(device, all_features):
    command = [sys.executable, "-m", "psf_cl", "render", str(all_features / "all.toml")]
    command += ["--spp", "100000000", "-o", str(all_features / "out.exr")]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        line = process.stderr.readline()
        assert line.startswith("rendering: "), line
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "psf-cl: interrupted; what was rendered is written\n"
    image = read_exr(all_features / "out.exr")
    assert image.stats["spp"] > 0 and np.isfinite(image.rgb).all() and image.rgb.any()
    assert out.endswith("Msamples/s\n")
    assert files_in(all_features) == ["all.toml", "checks.png", "out.exr", "out.png", "sky.exr"]


@dataclasses.dataclass
class Report:
    platform: str = "Some platform"
    device: str = "Some device"
    driver: str = "1.0"
    ok: bool = True
    reason: str = ""
    seconds: float = 0.5


@pytest.mark.parametrize(
    ("reports", "code", "texts"),
    [
        ([Report()], 0, ["passed in 0.50 s", "1 of 1 devices can be used"]),
        (
            [Report(), Report(ok=False, reason="wrong results: atomic adds")],
            0,
            ["1 of 2", "fix: do not render on it"],
        ),
        (
            [Report(ok=False, reason="the driver crashed (SIGILL)")],
            1,
            ["SIGILL", "fix: the driver is broken", "no OpenCL device can be used"],
        ),
        (
            [Report(ok=False, reason="too little memory of the device: 64 MiB")],
            1,
            ["64 MiB", "fix: take another device with --device, or give this one more"],
        ),
        (
            [Report(ok=False, reason="cannot compile: error in <pyopencl.Device 'some'>")],
            1,
            ["fix: unset what changes how the driver compiles"],
        ),
        (
            [Report(device="none", ok=False, reason="this platform has no device")],
            1,
            ["Some platform: none: this platform has no device", "fix: unset what hides"],
        ),
        ([], 1, ["no OpenCL device can be used", "fix: install"]),
        (DeviceError("OpenCL does not start: No module named 'pyopencl'"), 1, ["pip install"]),
    ],
)
def test_doctor_says_what_works_and_how_to_fix_the_rest(monkeypatch, capsys, reports, code, texts):
    def probe_devices():
        if isinstance(reports, DeviceError):
            raise reports
        return reports

    module = types.ModuleType("psf_cl.device.selftest")
    module.probe_devices = probe_devices
    monkeypatch.setitem(sys.modules, "psf_cl.device.selftest", module)
    assert main(["doctor"]) == code
    out = capsys.readouterr().out
    for text in ["numpy", "OpenEXR", *texts]:
        assert text in out


def test_compare_prints_metrics_and_judges_by_the_limit(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    constant("a.exr", 1.5)
    constant("b.exr", 1.0)
    assert main("compare a.exr b.exr".split()) == 0
    out = capsys.readouterr().out
    assert "0.25" in out and "relmse_trimmed" in out and "mae" in out
    assert main("compare a.exr b.exr --max-relmse 0.25".split()) == 0
    assert main("compare a.exr b.exr --max-relmse 0.24".split()) == 1
    assert "FAILED: relMSE above 0.24" in capsys.readouterr().out
    assert main("compare a.exr b.exr --max-relmse 0".split()) == 1
    assert "FAILED: relMSE above 0\n" in capsys.readouterr().out
    assert main("compare b.exr b.exr --max-relmse 0".split()) == 0


@pytest.mark.parametrize("overwritten", ["a.exr", "b.exr"])
def test_compare_overwrites_no_image_that_it_compares(tmp_path, monkeypatch, capsys, overwritten):
    monkeypatch.chdir(tmp_path)
    constant("a.exr", 1.5)
    constant("b.exr", 1.0)
    before = Path(overwritten).read_bytes()
    # A name that ends in .png may still lead to an input.
    Path("d.png").symlink_to(overwritten)
    assert main("compare a.exr b.exr --difference d.png".split()) == 2
    assert "d.png: cannot write: it is another input or output" in one_error(capsys.readouterr())
    assert Path(overwritten).read_bytes() == before


def test_compare_fails_on_pixels_that_are_not_finite(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rgb = np.ones((6, 8, 3), np.float32)
    write_exr("b.exr", Image({"rgb": rgb}))
    rgb[0, 0, 0] = np.nan
    write_exr("a.exr", Image({"rgb": rgb}))
    assert main("compare a.exr b.exr --max-relmse 1 --blocks 4 --difference d.png".split()) == 1
    assert "not finite" in capsys.readouterr().out


def test_compare_shows_the_sign_of_the_difference(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rgb = np.ones((1, 4, 3), np.float32)
    write_exr("b.exr", Image({"rgb": rgb}))
    rgb[0] *= np.array([[1.0], [9.0], [0.1], [np.inf]], np.float32)
    write_exr("a.exr", Image({"rgb": rgb}))
    assert main("compare a.exr b.exr --difference d.png".split()) == 1
    with PIL.Image.open("d.png") as png:
        pixels = np.asarray(png)[0].tolist()
    assert pixels == [[255, 255, 255], [255, 0, 0], [0, 0, 255], [0, 255, 0]]


def test_compare_of_two_resolutions_gives_blocks_only(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    constant("a.exr", 1.1, 16, 8)
    constant("b.exr", 1.0, 8, 4)
    assert main("compare a.exr b.exr --blocks 4".split()) == 0
    out = capsys.readouterr().out
    assert "100.0 %" in out and "1.10000" in out and "mse" not in out
    assert main("compare a.exr b.exr --blocks 4 --max-relmse 1".split()) == 2


def test_progress_is_told_in_words():
    by_spp = Progress(16, 64, 2.0, None, 2.5e6)
    assert describe(by_spp) == "16/64 spp, 2.0 s, 2.50 Msamples/s, 6 s left"
    by_time = Progress(16, None, 2.0, 4000.0, 2.5e6)
    assert describe(by_time) == "16 spp, 2.0/4000 s, 2.50 Msamples/s, 1:06:38 h left"
    assert seconds_left(Progress(0, 64, 2.0, None, 0.0)) is None
    assert seconds_left(Progress(9, None, 5.0, 4.0, 0.0)) == 0.0


def run(*arguments, **options):
    command = [sys.executable, "-m", "psf_cl", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def test_the_program_ends_without_a_traceback(tmp_path):
    missing = run("render", str(tmp_path / "no.toml"), "-o", str(tmp_path / "a.exr"))
    assert missing.returncode == 2 and missing.stdout == ""
    assert missing.stderr.count("\n") == 1 and "no.toml" in missing.stderr
    help_text = run("render", "--help")
    assert help_text.returncode == 0 and "default 64" in help_text.stdout
    assert "max_depth" in help_text.stdout
    assert "true | false; default true" in help_text.stdout and "None" not in help_text.stdout


# What modules make of an exception while they are imported.
IMPORTS = {
    "replaced": "raise ImportError('initialization failed') from None",
    "swallowed": "pass",
}


@pytest.mark.parametrize("fate", IMPORTS)
def test_ctrl_c_during_an_import_is_one_line(tmp_path, fate):
    (tmp_path / "OpenEXR.py").write_text(
        "import signal\n"
        "try:\n    signal.raise_signal(signal.SIGINT)\n"
        f"except KeyboardInterrupt:\n    {IMPORTS[fate]}\n"
    )
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = run("compare", "a.exr", "b.exr", env=os.environ | {"PYTHONPATH": paths}, cwd=ROOT)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "psf-cl: error: interrupted\n"


def test_help_imports_nothing_heavy():
    script = (
        "import sys\nfrom psf_cl.cli.main import main\n"
        "try: main(['render', '--help'])\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'pyopencl', 'OpenEXR', 'PIL', 'rich', 'trimesh'} & set(sys.modules)\n"
        "sys.exit(', '.join(sorted(heavy)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_closed_pipe_is_no_error(tmp_path):
    constant(tmp_path / "a.exr", 1.0)
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "psf_cl", "compare", *[str(tmp_path / "a.exr")] * 2]
    done = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, check=False)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (0, b"")


def test_triangles_with_broken_vertices_are_said(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv nan 0 0\nf 1 2 3\nf 1 2 4\n", encoding="utf-8"
    )
    assert main(["render", "torn.obj", "--size", "8x8", "--spp", "1"]) == 0
    assert "note: 1 triangles are left out: a coordinate is not finite" in capsys.readouterr().err
