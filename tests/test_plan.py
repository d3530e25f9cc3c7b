"""The plan: what a scene does not need is not compiled, not launched and not allocated."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_builder import (
    IDENTITY,
    SMALL,
    build,
    camera,
    floor,
    glowing,
    inside_out,
    lambertian,
    renderer,
)

from psf_cl.device.device import Device, open_device
from psf_cl.device.program import assemble, load_program
from psf_cl.device.sources import kernel_folder
from psf_cl.errors import InputError
from psf_cl.image import AOVS
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Environment, Light, Material, Texture
from psf_cl.settings import Settings
from psf_cl.traits import DeviceTraits

ROOT = Path(__file__).resolve().parents[1]

LEVELS = Texture("levels", np.full((2, 2, 4), 128, np.uint8))
LIFTED = transform.translation((0, 0.5, 0)) @ transform.scaling(0.3)
LOW = transform.translation((0, 0.2, 0))
FLAT_QUAD = primitives.quad()
#: No rectangle: these are another flag.
RHOMBUS = replace(
    FLAT_QUAD, positions=FLAT_QUAD.positions + 0.1 * FLAT_QUAD.positions[:, [2, 1, 0]]
)

#: What a flag of the plan needs: shapes, lights, a sky, a lens, an AOV or a device that wants it.
PARTS = {
    "TEXTURES": (FLAT_QUAD, LIFTED, lambertian(0.5, base_color_texture=0)),
    "ALPHA": (
        FLAT_QUAD,
        LOW,
        lambertian(0.5, base_color_texture=0, alpha_cutoff=0.6, alpha_mode="mask"),
    ),
    "SMOOTH": (primitives.sphere(5, 4), LIFTED, lambertian(0.5)),
    "GLOSSY": (FLAT_QUAD, LIFTED, Material()),
    "TRANSMISSION": (primitives.box(), LIFTED, Material(transmission=1.0, roughness=0.3)),
    "AREA_LIGHTS": (inside_out(RHOMBUS), LIFTED, glowing(3.0)),
}
LIGHTS = {"PUNCTUAL_LIGHTS": Light("point", (1.0, 1.0, 1.0), position=(0.0, 1.0, 1.0))}
SKIES = {
    "ENVIRONMENT": Environment((1.0, 1.0, 1.0)),
    "ENVIRONMENT image": Environment((1.0, 1.0, 1.0), np.ones((2, 4, 3), np.float32)),
}
OUTPUTS = {"AOV_BOUNCES": "bounces", "AOV_DIRECT": "direct", "AOV_FEATURES": "albedo"}
CHOICES = [*PARTS, *LIGHTS, *SKIES, "LENS", *OUTPUTS, "FEW"]

ALWAYS = {
    *("params", "surfaces", "materials"),
    *("pool", "counters", "samples", "film"),
}
TREE = {"nodes", "blocks"}
LIST = {"corners", "faces", "plates"}
TEXTURE_BUFFERS = {"uvs", "textures", "texels", "srgb_to_linear"}
NEEDED = {
    "TEXTURES": TEXTURE_BUFFERS,
    "ALPHA": TEXTURE_BUFFERS,
    "SMOOTH": {"normals"},
    "AREA_LIGHTS": {"lights"},
    "PUNCTUAL_LIGHTS": {"lights"},
    "ENVIRONMENT": {"lights"},
    "ENVIRONMENT image": {"lights", "environment"},
    "AOV_BOUNCES": {"bounces", "film_bounces"},
    "AOV_DIRECT": {"direct", "film_direct"},
    "AOV_FEATURES": {"features", "film_features"},
}


def with_flags(*flags):
    """Return a scene that needs these flags and no other, and the outputs to ask for.

    It is small enough for a list of triangles; whether it gets one is the device's choice.
    """
    lens = {"lens_radius": 0.05, "focus_distance": 3.0} if "LENS" in flags else {}
    sky = next((SKIES[flag] for flag in flags if flag in SKIES), Environment())
    scene = build(
        [floor(2.0, lambertian(0.5)), *(PARTS[flag] for flag in flags if flag in PARTS)],
        camera((0, 1.5, 3), (0, 0.3, 0), 40, **lens),
        (8, 8),
        lights=[LIGHTS[flag] for flag in flags if flag in LIGHTS],
        environment=sky,
        textures=[LEVELS] if {"TEXTURES", "ALPHA"} & set(flags) else (),
    )
    return scene, [OUTPUTS[flag] for flag in flags if flag in OUTPUTS]


def values_of(flags):
    """Return the macros that are not 0 for these flags."""
    values = {flag.split()[0]: 2 if flag.endswith("image") else 1 for flag in flags}
    if "FEW" in values:
        values["FEW"] = 32
    if "TRANSMISSION" in values:
        values["GLOSSY"] = 1
    if "ALPHA" in values:
        values["TEXTURES"] = 1
    if values.keys() & {"AREA_LIGHTS", "PUNCTUAL_LIGHTS", "ENVIRONMENT"}:
        values["CONNECT"] = 1
    return values


def buffers_of(flags):
    """Return the names of the buffers that these flags bring."""
    tree = LIST if "FEW" in flags else TREE
    return (ALWAYS | tree).union(*(NEEDED.get(flag, set()) for flag in flags))


def few(device):
    """Return the same device, but small scenes get a list of triangles in place of a tree."""
    return Device(device.context, replace(device.traits, **SMALL))


@pytest.fixture(scope="module")
def narrow(device):
    """Open a device with one lane, whose programs are the quickest to build, and trees for all."""
    traits = replace(device.traits, lanes=1, block=8, slots=64, few_triangles=0, few_corners=0)
    return open_device(traits=traits)


@pytest.fixture(scope="module")
def wants(narrow):
    """Return the narrow device that ``flags`` want."""
    listed = few(narrow)
    return lambda flags: listed if "FEW" in flags else narrow


def bounce_arguments(opened):
    """Return the names of all arguments of the launches of a bounce and of the film."""
    launches = [launch for launch, _ in (*opened.bounce_launches, *opened.film_launches)]
    return {name for launch in launches for name in launch.parameters}


def test_no_flag_at_all_leaves_the_least(narrow):
    scene, _ = with_flags()
    narrow.programs.clear()
    opened = renderer(narrow, scene)
    assert not any(feature.value for feature in opened.plan.features.values())
    assert set(opened.buffers) == buffers_of(())
    stages = [stage.name for stage in opened.plan.stages]
    assert stages == ["camera", "intersect", "shade", "film"]
    launched = [launch.name for launch, _ in opened.bounce_launches]
    assert launched == ["regenerate_paths", "intersect_closest", "shade_paths"]
    left_out = dict(opened.plan.left_out)
    assert left_out["connect"] == "the scene has no light"
    assert left_out["textures"] == "no material has a texture"
    assert left_out["lens"] == "the camera is a pinhole"
    built = {program.file for program in narrow.programs.values()}
    assert "connect.cl" not in built and "shade.cl" in built
    opened.render(spp=2)
    assert not opened.image().rgb.any()
    opened.close()


@pytest.mark.parametrize("flag", CHOICES)
def test_each_flag_alone_brings_its_own_and_renders(wants, flag):
    scene, outputs = with_flags(flag)
    device = wants([flag])
    device.programs.clear()
    opened = renderer(device, scene, outputs)
    on = {name: f.value for name, f in opened.plan.features.items() if f.value}
    assert on == values_of([flag])
    expected = buffers_of([flag])
    assert set(opened.buffers) == expected
    assert bounce_arguments(opened) - {"film", "planes", "partial"} <= expected
    for program in device.programs.values():
        nonzero = {n: v for n, v in program.defines.items() if n in opened.plan.features and v}
        assert nonzero.items() <= on.items()
    has_light = flag in (*SKIES, *LIGHTS, "AREA_LIGHTS")
    assert ("connect_lights" in [launch.name for launch, _ in opened.bounce_launches]) == has_light
    opened.render(spp=4)
    image = opened.image()
    assert np.isfinite(image.rgb).all()
    assert image.rgb.any() == has_light
    opened.close()


def test_what_is_cut_out_whole_is_not_there(narrow):
    # It lies between the camera, the floor and the light.
    pictures = []
    for flags in (("AREA_LIGHTS",), ("AREA_LIGHTS", "ALPHA")):
        scene, _ = with_flags(*flags)
        opened = renderer(narrow, scene)
        opened.render(spp=16)
        pictures.append(opened.image().rgb)
        opened.close()
    assert pictures[0].any()
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-4)


def test_a_shape_that_no_ray_can_hit_is_left_out(narrow):
    scene, _ = with_flags("AREA_LIGHTS", "TEXTURES")
    nothing = Material(alpha_mode="mask", alpha=0.2, base_color=(1, 1, 1), emission=(5, 5, 5))
    materials = (*scene.materials, nothing)
    shape = replace(scene.shapes[0], material=len(materials) - 1, transform=LOW)
    more = replace(scene, materials=materials, shapes=(*scene.shapes, shape))
    pictures = []
    for variant in (scene, more):
        opened = renderer(narrow, variant)
        opened.render(spp=2)
        pictures.append(opened.image().rgb)
        lights = opened.buffers["lights"].count
        opened.close()
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert lights == 2
    plan = make_plan(more, Settings())
    assert not plan.features["ALPHA"].value
    assert ("shapes", "1 are cut out whole") in plan.left_out


@pytest.mark.parametrize(
    ("settings", "flag", "planned"),
    [
        ({"max_depth": 0}, "PUNCTUAL_LIGHTS", False),
        ({"max_depth": 0}, "AREA_LIGHTS", False),
        ({"direct_sampling": "bsdf"}, "AREA_LIGHTS", False),
        ({"direct_sampling": "bsdf"}, "ENVIRONMENT image", False),
        ({"direct_sampling": "bsdf"}, "PUNCTUAL_LIGHTS", True),
        ({"direct_sampling": "light"}, "AREA_LIGHTS", True),
    ],
)
def test_lights_are_sampled_only_where_the_settings_do(narrow, settings, flag, planned):
    scene, _ = with_flags(flag)
    opened = Renderer(scene, Settings(**settings), narrow)
    assert bool(opened.plan.features["CONNECT"].value) == planned
    assert ("lights" in opened.buffers) == planned
    assert ("connect" in [stage.name for stage in opened.plan.stages]) == planned
    opened.render(spp=2)
    assert np.isfinite(opened.image().rgb).all()
    opened.close()


def test_every_flag_at_once_renders(wants):
    flags = [flag for flag in CHOICES if flag != "ENVIRONMENT"]
    scene, _ = with_flags(*flags)
    # Flags that bring others with them: colours of corners, a tangent frame, layers over the base.
    layered = Material(clearcoat=1.0, anisotropy=0.5, back_hidden=True)
    colored = replace(FLAT_QUAD, colors=np.ones((len(FLAT_QUAD.positions), 4), np.float32))
    shape = replace(scene.shapes[0], mesh=colored, material=len(scene.materials))
    lamp = replace(scene.shapes[0], mesh=FLAT_QUAD, material=len(scene.materials) + 1)
    materials = (*scene.materials, layered, glowing(1.0))
    scene = replace(scene, shapes=(*scene.shapes, shape, lamp), materials=materials)
    opened = renderer(
        wants(flags),
        scene,
        AOVS,
        path_filter="hash_grid",
        screen_filter="path_space",
        filter_fireflies=True,
        temporal="adaptive",
        light_sampling="hierarchy",
        guiding="learned",
        cell_min_count=2,
        termination="cache",
        material_cache="hash_grid",
        area_sampling="solid_angle",
        texture_level="footprint",
        shadow_rays="2",
    )
    # Chains of paths would leave out what samples of pixels are for, places and balls the list of
    # triangles.
    off = {name for name, feature in opened.plan.features.items() if not feature.value}
    # What averages take from a pixel is kept apart only for what the screen filter is in place of.
    unused = {"METROPOLIS", "INSTANCES", "MOTION", "RESTORE", "SPHERES"}
    assert off == unused | {"VIRTUAL_LIGHTS"}
    left_out = dict(opened.plan.left_out)
    assert left_out.keys() == {name.lower() for name in off}
    assert left_out["metropolis"] == "integrator is path"
    opened.render(spp=4)
    image = opened.image()
    # Of photons there is nothing to show with a tree of lights.
    assert set(image.aovs) == {"rgb", *AOVS} - {"photons", "lights"}
    assert all(np.isfinite(pixels).all() for pixels in image.aovs.values())
    opened.close()


def pairs():
    """Return pairs of flags that are not two values of one."""
    pairs = itertools.combinations(CHOICES, 2)
    return [(a, b) for a, b in pairs if a.split()[0] != b.split()[0]]


def test_planned_bytes_are_those_that_are_allocated(wants):
    for flags in [(), *((flag,) for flag in CHOICES), tuple(CHOICES[:5]), tuple(CHOICES[5:])]:
        scene, outputs = with_flags(*flags)
        opened = renderer(wants(flags), scene, outputs)
        planned = {buffer.name: buffer.bytes for buffer in opened.plan.buffers}
        allocated = {name: buffer.bytes for name, buffer in opened.buffers.items()}
        for estimate in TREE & planned.keys():
            del planned[estimate], allocated[estimate]
        assert planned == allocated, flags
        opened.close()


def test_estimates_of_the_hierarchy_are_of_the_right_size(narrow):
    ball = primitives.sphere(64, 32)
    scene = build([(ball, IDENTITY, lambertian(0.5))], camera((0, 0, 4), (0, 0, 0)))
    opened = renderer(narrow, scene)
    planned = {buffer.name: buffer.bytes for buffer in opened.plan.buffers}
    for name in ("nodes", "blocks"):
        assert 0.4 < planned[name] / opened.buffers[name].bytes < 2.5
    opened.close()


def test_plans_of_pairs_of_flags_hold_both_and_no_other(wants):
    for pair in pairs():
        scene, outputs = with_flags(*pair)
        plan = make_plan(scene, Settings(), outputs, wants(pair).traits)
        assert {n: f.value for n, f in plan.features.items() if f.value} == values_of(pair)
        assert {buffer.name for buffer in plan.buffers} == buffers_of(pair)


@pytest.mark.slow
@pytest.mark.parametrize("pair", pairs(), ids=" ".join)
def test_pairs_of_flags_build(narrow, wants, pair):
    scene, outputs = with_flags(*pair)
    plan = make_plan(scene, Settings(), outputs, wants(pair).traits)
    for stage in plan.stages:
        stack = {"STACK_SIZE": 16} if stage.traces else {}
        load_program(narrow, stage.source, plan.defines(stage) | stack)


def flags_read(text, names):
    """Return those of ``names`` that preprocessor conditions and macros of ``text`` name."""
    lines = [line for line in text.splitlines() if re.match(r"\s*#\s*(if|elif|define)", line)]
    return {name for name in names if any(re.search(rf"\b{name}\b", line) for line in lines)}


def test_stages_declare_the_flags_that_their_sources_read():
    scene, outputs = with_flags(*(flag for flag in CHOICES if flag != "ENVIRONMENT"))
    virtual = Settings(indirect_light="virtual_lights", light_sampling="photon")
    plan = make_plan(scene, Settings(), outputs)
    more = make_plan(scene, virtual, outputs).stages
    for stage in (*plan.stages, *(s for s in more if s.name in ("photons", "virtual_lights"))):
        own = (kernel_folder() / stage.source).read_text(encoding="utf-8")
        # An undeclared flag would be 0 whatever the scene needs.
        assert flags_read(own, plan.features) <= set(stage.flags), stage.name
        # One that nothing reads would build the same program anew.
        text = re.sub(r"#ifndef \w+", "", assemble(stage.source))
        assert set(stage.flags) <= flags_read(text, plan.features), stage.name


@pytest.mark.parametrize(
    ("kind", "size", "settings", "slots"),
    [
        ("cpu", (256, 256), Settings(), 1 << 15),
        ("cpu", (256, 256), Settings(integrator="metropolis", chains=1 << 15), 1 << 15),
        ("cpu", (256, 256), Settings(path_filter="hash_grid"), 1 << 15),
        ("cpu", (256, 256), Settings(guiding="learned"), 1 << 13),
        ("cpu", (100, 100), Settings(guiding="learned"), 1 << 12),
        ("cpu", (1000, 1000), Settings(guiding="learned"), 1 << 15),
        ("gpu", (256, 256), Settings(guiding="learned"), 1 << 16),
        ("gpu", (256, 256), Settings(), 1 << 18),
    ],
)
def test_a_pool_that_drains_between_passes_is_a_part_of_one(kind, size, settings, slots):
    scene = load_scene(ROOT / "scenes" / "cornell_box.toml", size=size)
    plan = make_plan(scene, settings, traits=DeviceTraits.of_kind(kind))
    assert plan.traits.slots == slots


def test_unused_materials_and_black_lights_bring_nothing():
    scene, _ = with_flags("AREA_LIGHTS")
    unused = Material(transmission=1.0, base_color_texture=0, emission=(1.0, 1.0, 1.0))
    scene = replace(
        scene,
        materials=(*scene.materials, unused),
        textures=(LEVELS,),
        lights=(Light("point", (0.0, 0.0, 0.0)),),
        environment=Environment((0.0, 0.0, 0.0), np.ones((2, 4, 3), np.float32)),
    )
    plan = make_plan(scene, Settings())
    assert {n for n, f in plan.features.items() if f.value} == {"AREA_LIGHTS", "CONNECT", "FEW"}


@pytest.mark.parametrize("crop", [(0, 0, 9, 8), (-1, 0, 4, 4), (0, 0, 0, 4), (7, 7, 2, 1)])
def test_crop_outside_the_film_is_refused(crop):
    with pytest.raises(InputError, match=r"--crop.*8x8"):
        make_plan(with_flags()[0], Settings(), crop=crop)


def test_unknown_output_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"unknown beauty; known: albedo"):
        make_plan(with_flags()[0], Settings(), ["beauty"])
