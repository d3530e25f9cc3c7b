"""Extremes that once failed, and the table that finds them."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
from pathlib import Path

import check_kernels as jobs
import numpy as np
import pytest
import stability as tool
import stability_cases as cases
from scene_builder import build, camera, floor, glowing, inside_out, lambertian, render, renderer

from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.scene.animation import world_transforms
from psf_cl.scene.curve import Curve
from psf_cl.scene.far import far_from_origin, moved
from psf_cl.scene.model import Material, Node, Skin, View
from psf_cl.settings import PRESETS, Settings, resolve

ROOT = Path(__file__).resolve().parents[1]
VIEW = camera((0.0, 0.0, 0.95), (0.0, -0.2, -1.0), 60.0)


def furnace(albedo=0.5, depth=16, view=VIEW):
    """Return a closed box in which paths of ``depth`` bounces bring radiance 1."""
    glow = 1.0 / sum(albedo**k for k in range(depth + 1))
    return build([(inside_out(primitives.box()), np.eye(4), glowing(glow, albedo))], view, (16, 16))


def lit_floor():
    lamp = transform.translation((0, 2, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    return build(
        [
            floor(2.0, lambertian(0.5)),
            (primitives.box(), transform.scaling(0.4), lambertian(0.8)),
            (primitives.quad(), lamp @ transform.scaling(0.3), glowing((8.0, 6.0, 4.0))),
        ],
        camera((0, 1.5, 3), (0, 0.3, 0), 45),
        (24, 16),
    )


def test_a_scene_a_thousand_kilometers_away_looks_as_it_does_at_home(device):
    """At 1e6 m a float has steps of 6 cm."""
    scene = lit_floor()
    away = np.array([1e6, -1e6, 0.7e6])
    assert far_from_origin(scene) is None
    middle = far_from_origin(moved(scene, away))
    np.testing.assert_allclose(middle, away + np.array([0.0, 0.8, 0.0]), atol=1e-9)
    at_home = render(device, moved(scene, [0.0, -0.8, 0.0]), 16)
    opened = renderer(device, moved(scene, away))
    opened.render(spp=16)
    assert "m away from the origin" in opened.notes[0]
    np.testing.assert_allclose(opened.image().rgb, at_home.rgb, rtol=1e-3, atol=1e-4)
    opened.close()


@pytest.mark.parametrize("away", [[1e5, -1e5, 0.7e5], [0.0, 0.0, 1e6]])
def test_a_sequence_far_away_looks_as_it_does_at_home(device, away):
    """The box goes round the lamp's foot on a node below a node, seen by a camera that moves."""
    scene = lit_floor()
    times = np.array([0.0, 1.0])
    steps = Curve(times, np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.2]]))
    aims = Curve(times, np.array([[0.0, 0.3, 0.0], [0.1, 0.2, 0.0]]))
    eyes = Curve(times, np.array([[0.0, 1.5, 3.0], [0.3, 1.4, 2.8]]))
    shapes = (scene.shapes[0], dataclasses.replace(scene.shapes[1], node=2), scene.shapes[2])
    nodes = (
        Node(curves={"translation": steps}),
        Node(matrix=np.diag([0.5, 0.5, 0.5, 1.0])),
        Node(parent=0, scale=(0.4, 0.4, 0.4)),
    )
    view = View(eyes, aims, (0.0, 1.0, 0.0))
    cameras = (dataclasses.replace(scene.cameras[0], view=view),)
    scene = dataclasses.replace(scene, shapes=shapes, nodes=nodes, cameras=cameras)
    middle = far_from_origin(moved(scene, away))
    frames = []
    for one in (moved(scene, -(middle - away)), moved(scene, away)):
        opened = renderer(device, one)
        opened.render(spp=8)
        opened.set_frame(1.0)
        opened.render(spp=8)
        frames.append(opened.image().rgb)
        notes = opened.notes
        opened.close()
    assert "m away from the origin" in notes[0]
    np.testing.assert_allclose(frames[1], frames[0], rtol=2e-3, atol=2e-4)


def test_far_away_skins_and_matrices_go_along_with_their_nodes():
    joints = (Node(translation=(1.0, 0.0, 0.0)), Node(parent=0, translation=(0.0, 2.0, 0.0)))
    nodes = (*joints, Node(matrix=transform.translation((0.0, 0.0, 3.0))))
    inverse_bind = np.tile(np.eye(4), (2, 1, 1))
    skinned = dataclasses.replace(lit_floor().shapes[0], skin=Skin((0, 1), inverse_bind))
    scene = dataclasses.replace(lit_floor(), shapes=(skinned,), nodes=nodes)
    away = np.array([1e5, 2e5, -1e5])
    far = moved(scene, away)
    shift = transform.translation(away)
    at_home, there = (world_transforms(s.nodes, None) for s in (scene, far))
    np.testing.assert_allclose(there, shift @ at_home, atol=1e-9)
    np.testing.assert_array_equal(far.shapes[0].transform, skinned.transform)
    # One joint leaves the floor at y = 0, the other lifts it to 2.
    np.testing.assert_allclose(far_from_origin(far), np.add(away, (1.0, 1.0, 0.0)), atol=1e-9)


@pytest.mark.parametrize("place", [(0.2, -1.0, 0.3), (-1.0, -1.0, -1.0)], ids=["wall", "corner"])
def test_a_camera_on_a_wall_sees_what_is_before_the_wall(device, place):
    image = render(device, furnace(view=camera(place, (0.0, 0.0, 0.1), 60.0)), 64)
    np.testing.assert_allclose(image.rgb.mean(), 1.0, rtol=0.01)
    # A ray that met the wall it starts on would see nothing of the room.
    assert image.rgb.min() > 0.8


@pytest.mark.parametrize("albedo", [0.99, 1.0])
def test_roulette_adds_little_noise_to_paths_of_a_thousand_bounces(device, albedo):
    """Ending one in twenty of paths that carry everything made a few worth 10^3 times the rest."""
    image = render(device, furnace(albedo, 1000), 16, max_depth=1000)
    assert image.rgb.max() < 3.0
    np.testing.assert_allclose(image.rgb.mean(), 1.0, rtol=0.05)


@pytest.mark.slow
def test_the_guide_adds_little_noise_to_paths_of_a_thousand_bounces(device):
    """Where all of them were guided, a few were worth 10^3 times the rest."""
    settings = {"max_depth": 1000, "termination": "off", "guiding": "learned"}
    image = render(device, furnace(1.0, 1000), 16, **settings)
    assert image.rgb.max() < 3.0
    np.testing.assert_allclose(image.rgb.mean(), 1.0, rtol=0.05)


@pytest.mark.parametrize("ior,radii", [(5.0, (1.0,)), (1.5, (1.0, 0.7, 0.4))])
def test_roulette_does_not_take_the_step_into_glass_for_a_loss(device, ior, radii):
    """Inside of glass of index 5 a path carries a 25th until it leaves, of three of 1.5 an 11th."""
    ball = dataclasses.replace(primitives.sphere(24, 12), normals=None)
    glass = Material(base_color=(1.0, 1.0, 1.0), transmission=1.0, ior=ior, roughness=0.0)
    balls = [(ball, transform.scaling(radius), glass) for radius in radii]
    scene = build(balls, camera((0, 0.3, 3), (0, 0, 0), 45), (16, 16), environment=1.0)
    with_roulette = render(device, scene, 32, ["variance"], max_depth=64, sampler="random")
    without = render(
        device, scene, 32, ["variance"], max_depth=64, sampler="random", termination="off"
    )
    noise = [np.mean(image.aovs["variance"]) for image in (with_roulette, without)]
    assert noise[0] < 1.5 * noise[1]


def test_all_pairs_of_values_meet_in_some_row():
    values = {"a": [1, 2, 3], "b": ["x", "y"], "c": [False, True], "d": [0.5], "e": list(range(7))}

    def refusal(row):
        return "no" if row["a"] == 3 and row["b"] == "y" else None

    for rows, refused in (tool.pairwise_rows(values), tool.pairwise_rows(values, refusal)):
        assert len(rows) < 3 * 2 * 2 * 7 / 2  # Far fewer than all combinations.
        for one, other in itertools.combinations(values, 2):
            met = {(row[one], row[other]) for row in rows}
            impossible = {(3, "y")} if refused and (one, other) == ("a", "b") else set()
            assert met == set(itertools.product(values[one], values[other])) - impossible
    assert refused == ["no"]


def test_a_table_without_a_case_or_a_column_is_not_whole():
    named = {"case": "room", "preset": "pt", "verdict": "ok", "why": ""}
    whole = dict.fromkeys(tool.COLUMNS, 1.0) | named
    assert tool.missing_rows([whole], [("room", "pt")]) == []
    assert tool.missing_rows([whole], [("room", "pt"), ("glass", "pt")]) == ["glass with pt"]
    empty = whole | {"of calm": ""}
    del whole["counters"]
    assert tool.missing_rows([whole], [("room", "pt")]) == ["counters of room with pt"]
    assert tool.missing_rows([empty], [("room", "pt")]) == ["of calm of room with pt"]


#: What the table is promised to have, by the names of its cases.
EXTREMES = """
scaled by 0.0001, scaled by 100000, scaled by 1e-06, moved by 1000, moved by 1e+06
1e-6 and 1e4 m together, slivers, duplicates, coplanar overlaps, a million triangles in a point
light of 1e-4 m at 1e8, lights 1e6 : 1, no light, 2^17 lights
furnace of albedo 0.99, furnace of albedo 0.999, furnace of albedo 1
metal of roughness 0, metal of roughness 1e-4, metal of roughness 1
plane at 89.9 degrees, metal at 89.9 degrees
glass of index 1, glass of index 1.0001, glass of index 5, nested glass
camera inside of glass, camera on a wall, camera in a corner, field of view 0.1, field of view 179
tiny cells, huge cells, tables of one slot, a table 99 % full, alpha 0, alpha 1
newest frame weighs 1e-06, newest frame weighs 1, beyond 2^24 passes, after 2^26 samples
what was learned decides nothing, what was learned decides 99 %, 1 photon, 1e7 photons
1x1 pixel, 8192x64 pixels, 1e6 samples of a pixel, depth 0, depth 1, depth 1000
"""


def test_no_extreme_that_was_promised_is_missing():
    names = [case.name for case in tool.CASES]
    assert len(set(names)) == len(names)
    assert set(EXTREMES.strip().replace("\n", ", ").split(", ")) <= set(names)
    # 2^17 lights are told apart by a tree and by photons too, not only by a table of their power.
    chosen = {
        case.features["LIGHT_SAMPLING"]
        for case in tool.CASES
        if case.name.startswith("2^17 lights,")
    }
    assert chosen == {1, 2}


def test_a_case_has_a_calm_one_or_says_why_there_is_none():
    case = tool.CASES[0]
    with pytest.raises(ValueError, match="expected a calm case, or why there is none"):
        dataclasses.replace(case, calm=None)
    with pytest.raises(ValueError, match="expected a calm case, or why there is none"):
        dataclasses.replace(case, untimed="nobody knows")
    names = {case.name for case in tool.CASES}
    for case in tool.CASES:
        assert case.calm is None or case.calm in names, case.name
        assert not isinstance(case.truth, str) or case.truth.partition(" * ")[0] in names


@pytest.mark.parametrize(
    "change,why",
    [
        ({}, ""),
        ({"bad": 1}, "1 pixels are not finite"),
        ({"rejected": 2}, "2 rejected"),
        ({"mean": 1.0201}, "the mean is off"),
        ({"mean": float("nan")}, "the mean is off"),
        ({"error": 0.01}, "too noisy to tell"),
        ({"largest": 4.1}, "a pixel is too bright"),
        ({"seconds": 2.1}, "it is too slow"),
        ({"loads": {"cells": 0.9}}, "0.9 of the cells are full, not 0.99"),
        ({"loads": {"cells": 0.99, "guide": 0.5}}, ""),
        ({"otherwise": ("FEW is 1, not 0: few triangles",)}, "FEW is 1, not 0: few triangles"),
    ],
)
def test_each_number_of_a_row_can_fail(monkeypatch, change, why):
    case = next(case for case in tool.CASES if case.name == "a table 99 % full")
    calm = tool.Picture(0, 0, 1.0, 0.0, 1.0, 64, 64, 1.0, "by power", {}, np.ones((8, 8)))
    calm = dataclasses.replace(calm, loads={"cells": 0.99})
    seen = dataclasses.replace(calm, **change)
    bench = tool.Bench(None, 8, 1, timed=True)
    monkeypatch.setattr(bench, "render", lambda one, *_: seen if one is case else calm)
    row = bench.row(case, "psf")
    assert (row["verdict"], row["why"]) == ("FAILED" if why else "ok", why)


def test_tables_are_as_small_as_a_case_wants_them(device):
    scene, settings = lit_floor(), resolve({}, "a case", "game")

    def slots():
        plan = make_plan(scene, settings, traits=device.traits)
        counts = {buffer.name: buffer.count for stage in plan.stages for buffer in stage.buffers}
        return counts["cell_keys"] // plan.ring, counts["guide_keys"], plan.cell_buckets

    usual = slots()
    with tool.tables_of(1):
        assert slots() == (1, 1, 1)
    with tool.tables_of(None):
        assert slots() == usual


def test_the_part_of_a_picture_around_a_ball_is_that_of_its_outline():
    square = np.array([[0, 0], [2, 0], [2, 2], [0, 2], [1, 1], [1, 0], [0.5, 1.5]])
    assert cases.convex_area(square) == 4.0
    # A sphere of radius 1 is a cone around its middle, seen somewhat wider than the ball of facets.
    distance = np.hypot(0.3, 3.0)
    sphere = np.pi / (distance**2 - 1.0) / (2.0 * np.tan(np.radians(45.0) / 2.0)) ** 2
    assert 0.0 < cases.around_ball() - (1.0 - sphere) < 0.01


def test_the_largest_pixel_is_that_of_all_samples_also_where_they_come_in_parts(monkeypatch):
    def part_of(device, scene, settings, spp, *others):
        pixels = np.zeros((1, tool.SEEDS))
        pixels[0, settings.seed] = 16.0
        return tool.Picture(0, 0, 2.0, 0.0, 16.0, 8, 8, 1.0, "by power", {}, pixels)

    monkeypatch.setattr(tool, "part_of", part_of)
    settings = Settings(integrator="metropolis")
    assert tool.picture(None, None, settings, 64).largest == 16.0 / tool.SEEDS


def test_the_table_tells_good_from_bad(device, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tool, "open_device", lambda name: device)
    case = tool.CASES[[case.name for case in tool.CASES].index("depth 1")]
    cases = [case, dataclasses.replace(case, name="depth 1, wrong", truth=1.05)]
    below = {"max_depth": -1}
    cases += [dataclasses.replace(case, name="depth 1, refused", settings=below)]
    cases += [dataclasses.replace(cases[-1], name="depth 1, rightly refused", refused=("pt",))]
    cases += [dataclasses.replace(case, name="depth 1, not refused", refused=("pt",))]
    monkeypatch.setattr(tool, "CASES", cases)
    arguments = "--presets pt --cases depth --edge 16 --no-times --spp 256 -o".split()
    assert tool.main([*arguments, str(tmp_path)]) == 1
    assert "5 rows, 3 failed, 0 missing" in capsys.readouterr().out
    text = (tmp_path / "stability.csv").read_text()
    good, wrong, refused, rightly, not_refused = text.splitlines()[1:]
    assert good.startswith("depth 1,pt,ok,")
    assert "FAILED,the mean is off," in wrong and "max_depth must be from 0" in refused
    assert ",ok,refused: " in rightly and "max_depth must be from 0" in rightly
    assert "FAILED,it is not refused," in not_refused
    page = (tmp_path / "stability.html").read_text()
    assert page.count("<tr") == 6 and page.count("class=failed") == 3


def test_jobs_of_the_simulator_are_renders_that_are_not_refused():
    planned = set()
    for name, job in jobs.JOBS.items():
        settings = resolve({}, name, job.preset, jobs.SMALL | dict(job.settings))
        outputs = (jobs.OUTPUTS if job.everything else ()) + job.outputs
        plan = make_plan(job.picture(), settings, outputs, halves=job.everything)
        assert plan.stages
        planned |= {kernel.name for stage in plan.stages for kernel in stage.kernels}
    assert planned >= {"view_guide", "scatter_photons", "settle_virtual_lights"}


@pytest.mark.slow
def test_a_simulator_finds_no_fault_in_any_kernel():
    """Out of bounds, races, divergent barriers; and no kernel is left out."""
    command = [sys.executable, "tools/check_kernels.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if "Oclgrind is not there" in done.stderr:
        pytest.skip("Oclgrind is not installed")
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_the_table_of_extremes_has_no_failure(preset):
    command = [sys.executable, "tools/stability.py", "--presets", preset, "--no-times"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_guide_and_the_filter_of_the_picture_build_together(device):
    settings = {"guiding": "learned", "screen_filter": "path_space"}
    assert np.isfinite(render(device, furnace(), 2, **settings).rgb).all()
