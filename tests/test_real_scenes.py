"""Scenes that others made: they render, and some look as other renderers show them.

They are in the folder that $PSF_CL_SHARED_SCENES names.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psf_cl.image import read_exr
from psf_cl.measure.errors import LUMINANCE, block_agreement, block_means
from psf_cl.renderer import Renderer
from psf_cl.scene.environment import load_environment
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Environment
from psf_cl.settings import resolve

ROOT = os.environ.get("PSF_CL_SHARED_SCENES", "")
KINDS = ("interiors", "game", "geometry", "materials")
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not ROOT, reason="PSF_CL_SHARED_SCENES is not set"),
]


def files():
    found = [path for kind in KINDS for path in (Path(ROOT) / kind).glob("*")] if ROOT else []
    return sorted(path for path in found if path.suffix in SUFFIXES)


def rendered(device, scene, spp, outputs=(), **settings):
    settings = resolve(scene.render, scene.path, overrides=settings)
    renderer = Renderer(scene, settings, device, outputs)
    try:
        renderer.render(spp=spp)
        return renderer.image()
    finally:
        renderer.close()


def reference(name):
    return read_exr(Path(ROOT) / "interiors" / f"{name}-reference.exr").rgb


def test_the_folder_has_scenes():
    assert len(files()) >= 10


@pytest.mark.parametrize("path", files(), ids=lambda path: path.name)
def test_every_scene_gives_a_finite_picture_that_is_not_black(device, path):
    image = rendered(device, load_scene(path, size=(256, 256)), spp=8, outputs=("normal",))
    assert np.isfinite(image.rgb).all()
    assert image.stats["counters"]["rejected_samples"] == 0
    lit = image.rgb.max(axis=-1) > 0.0
    hit = np.abs(image.aovs["normal"]).max(axis=-1) > 0.0
    # A sky lights what it reaches, lamps in a level only some of it.
    assert hit.mean() > 0.05
    assert (lit & hit).sum() > 0.1 * hit.sum()


def test_cornell_box_looks_as_its_reference(device):
    scene = load_scene(Path(ROOT) / "interiors" / "cornell-box.glb", size=(256, 256))
    agreement = block_agreement(rendered(device, scene, spp=64).rgb, reference("cornell-box"))
    assert agreement.correlation >= 0.98
    assert agreement.share_within >= 0.9
    assert abs(agreement.mean_ratio - 1.0) <= 0.06


def test_veach_mis_looks_as_its_reference(device):
    """The reference has direct light only, so max_depth is 1.

    Its plates are Beckmann conductors, whose highlights end in black where those of the GGX metals
    of the .glb go on: blocks in which plates are seen count for correlation and mean only.
    """
    scene = load_scene(Path(ROOT) / "interiors" / "veach-mis.glb", size=(512, 288))
    image = rendered(device, scene, spp=64, outputs=("albedo",), max_depth=1)
    expected = reference("veach-mis")
    agreement = block_agreement(image.rgb, expected)
    assert agreement.correlation >= 0.98
    assert abs(agreement.mean_ratio - 1.0) <= 0.06

    # Only the plates are coloured.
    coloured = np.ptp(image.aovs["albedo"], axis=-1, keepdims=True) > 0.01
    plain = block_means(np.repeat(coloured, 3, axis=-1))[..., 0] == 0.0
    ours, theirs = (block_means(rgb) @ LUMINANCE for rgb in (image.rgb, expected))
    within = np.abs(ours - theirs) <= 0.15 * theirs
    assert plain.mean() > 0.6
    assert within[plain].mean() >= 0.98


def test_veach_bidir_looks_as_its_reference_glass_included(device):
    """Walls and table are Lambertian there; a glTF dielectric has a coat, which brightens rooms.

    So the coat is taken off; the noise of the caustics takes many samples.
    """
    scene = load_scene(Path(ROOT) / "interiors" / "veach-bidir.glb", size=(128, 128))
    materials = tuple(
        m if m.metallic or m.transmission else replace(m, specular=0.0) for m in scene.materials
    )
    image = rendered(device, replace(scene, materials=materials), spp=2048, max_depth=64)
    agreement = block_agreement(image.rgb, reference("veach-bidir"))
    assert agreement.correlation >= 0.98
    assert agreement.share_within >= 0.9
    assert abs(agreement.mean_ratio - 1.0) <= 0.06


#: Luminances of blocks of 16x16 pixels of the living-room at 64x36 as Mitsuba 3.9 shows it, to
#: 0.2 % where it is light and 1.4 % where it is dark: 2048 samples, ``mitsuba_scene.plain`` and
#: ``flat`` materials and shapes, ``own_materials`` (tools/compare_mitsuba.py).
LIVING_ROOM = [
    [0.2109, 0.0752, 0.1111, 0.0114],
    [0.0702, 0.0630, 0.0929, 0.0129],
    [0.0066, 0.0077, 0.0058, 0.0034],
]


def test_living_room_looks_as_mitsuba_shows_it_by_its_sky_glass_included(device):
    scene = load_scene(Path(ROOT) / "interiors" / "living-room.glb", size=(64, 36))
    materials = tuple(
        replace(m, alpha_mode="opaque", specular=float(m.metallic + m.transmission > 0.0))
        for m in scene.materials
    )
    shapes = tuple(replace(s, mesh=replace(s.mesh, normals=None)) for s in scene.shapes)
    scene = replace(scene, materials=materials, shapes=shapes)
    luminance = rendered(device, scene, spp=512).rgb.astype(np.float64) @ LUMINANCE
    rows, columns = np.arange(0, 36, 16), np.arange(0, 64, 16)

    def sums(values):
        return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1)

    pixels = sums(np.ones_like(luminance))
    blocks = sums(luminance) / pixels
    np.testing.assert_allclose(blocks, LIVING_ROOM, rtol=0.015, atol=3e-4)
    np.testing.assert_allclose(luminance.mean(), np.average(LIVING_ROOM, weights=pixels), rtol=0.01)


def test_environment_of_the_living_room_comes_through_its_windows(device):
    """Lit by its sky map, turned as the file's extras say, the room is not dark."""
    folder = Path(ROOT) / "interiors"
    scene = load_scene(folder / "living-room.glb", size=(128, 128))
    image, _ = load_environment(folder / "living-room-sky.exr")
    turned = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    with_sky = replace(scene, environment=Environment((1.0, 1.0, 1.0), image, turned))
    dark = replace(scene, environment=Environment())
    assert rendered(device, with_sky, spp=16).rgb.mean() > 0.1
    assert rendered(device, dark, spp=4).rgb.max() == 0.0
