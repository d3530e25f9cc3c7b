"""Texture look-ups against a plain NumPy version, and cut-outs through a whole render."""

import itertools
import math
from dataclasses import replace

import numpy as np
import planes
import pytest

import psf_cl
from psf_cl import tables
from psf_cl.device import layout
from psf_cl.device.layout import CONSTANT
from psf_cl.scene.model import (
    Camera,
    Environment,
    Light,
    Material,
    Mesh,
    Scene,
    Shape,
    Texture,
)

WRAPS = ["repeat", "clamp", "mirror"]


def make_textures():
    """Return textures of every wrap, filter and encoding, of odd sizes."""
    rng = np.random.default_rng(0)
    textures = []
    kinds = itertools.product(WRAPS, WRAPS, ["linear", "nearest"], [True, False])
    for k, (wrap_u, wrap_v, kind, srgb) in enumerate(kinds):
        height, width = [(3, 5), (4, 4), (1, 7), (6, 1), (1, 1)][k % 5]
        pixels = rng.integers(0, 256, (height, width, 4), np.uint8)
        matrix = tuple(rng.uniform(-1.5, 1.5, 6))
        textures.append(Texture(f"{k}", pixels, srgb, (wrap_u, wrap_v), kind, k % 2, matrix))
    return tuple(textures)


TEXTURES = make_textures()


def decode(codes):
    """IEC 61966-2-1."""
    c = codes / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def wrapped(i, size, wrap):
    if wrap == "clamp":
        return min(max(i, 0), size - 1)
    if wrap == "repeat":
        return i % size
    # Reflected at the edges: ... 1 0 | 0 1 2 | 2 1 0 | 0 1 ...
    return [*range(size), *reversed(range(size))][i % (2 * size)]


def look_up(texture, u, v):
    """Return RGBA at (u, v) in double precision."""
    height, width = texture.pixels.shape[:2]
    rgba = texture.pixels / 255.0
    if texture.srgb:
        rgba[..., :3] = decode(texture.pixels[..., :3])

    def texel(i, j):
        return rgba[wrapped(j, height, texture.wrap[1]), wrapped(i, width, texture.wrap[0])]

    if texture.filter == "nearest":
        return texel(math.floor(u * width), math.floor(v * height))
    x, y = u * width - 0.5, v * height - 0.5
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    return (texel(i, j) * (1 - fx) + texel(i + 1, j) * fx) * (1 - fy) + (
        texel(i, j + 1) * (1 - fx) + texel(i + 1, j + 1) * fx
    ) * fy


@pytest.fixture
def textured(lane_device):
    """Return a function that runs a kernel over TEXTURES."""
    records, texels = tables.texture_tables(TEXTURES, triangle_count=50)
    buffers = {
        "textures": lane_device.upload("textures", records),
        "texels": lane_device.upload("texels", texels.reshape(-1)),
        "srgb_to_linear": lane_device.upload("srgb_to_linear", tables.srgb_to_linear()),
    }

    def run(kernel, inputs, planes_out, **more):
        outputs = {"colors": (np.float32, planes_out)}
        return planes.run(
            lane_device, "texture_test.cl", kernel, inputs, outputs, None, **buffers, **more
        )[0].T

    yield run
    lane_device.release(*buffers.values())


LOOK_UPS = pytest.mark.parametrize("kernel", ["look_up", "look_up_all"])


@LOOK_UPS
def test_look_ups_equal_numpy(textured, kernel):
    rng = np.random.default_rng(1)
    count = 12000
    # Lanes of one work item look into different textures.
    index = rng.integers(0, len(TEXTURES), count, np.uint32)
    uv = rng.uniform(-3, 4, (2, count)).astype(np.float32)
    uv[:, 8000:] *= 100
    # Eighths fall on edges and middles of texels, exactly.
    uv[:, :4000] = np.round(uv[:, :4000] * 8) / 8
    found = textured(kernel, {"index": index, "uv": uv}, 4)
    size = np.array([t.pixels.shape[1::-1] for t in TEXTURES])[index]
    place = uv.T.astype(np.float64) * size
    expected = np.array(
        [look_up(TEXTURES[k], *at) for k, at in zip(index, uv.T.astype(np.float64), strict=True)]
    )
    # Rounding moves a look-up by 6e-8 of the coordinate; nearest jumps at an edge.
    moved = abs(place).max(axis=1) * 2e-7
    nearest = np.array([t.filter == "nearest" for t in TEXTURES])[index]
    exact = np.arange(count) < 4000
    edge = (abs(place - np.round(place)).min(axis=1) <= moved) & ~exact & nearest
    assert edge.mean() < 0.01
    error = abs(found - expected).max(axis=1)
    tolerance = 1e-6 + np.where(nearest, 0, 4 * moved)
    assert (error <= tolerance)[~edge].all(), error[~edge].max()


@LOOK_UPS
def test_coordinates_without_meaning_read_a_texel_of_the_texture(textured, kernel):
    values = [np.nan, np.inf, -np.inf, 1e9, -1e9, 3e38, -3e38, 1e-40]
    pairs = np.array(list(itertools.product(values, values)), np.float32)
    index = np.arange(len(TEXTURES), dtype=np.uint32).repeat(len(pairs))
    uv = np.tile(pairs, (len(TEXTURES), 1)).T
    found = textured(kernel, {"index": index, "uv": np.ascontiguousarray(uv)}, 4)
    assert np.isfinite(found).all()
    low = np.array([colors_of(t).min(axis=0) for t in TEXTURES])[index]
    high = np.array([colors_of(t).max(axis=0) for t in TEXTURES])[index]
    assert (found >= low - 1e-6).all() and (found <= high + 1e-6).all()


def colors_of(texture):
    rgba = texture.pixels.reshape(-1, 4) / 255.0
    if texture.srgb:
        rgba[:, :3] = decode(texture.pixels.reshape(-1, 4)[:, :3])
    return rgba


def test_every_srgb_code_is_decoded():
    np.testing.assert_allclose(tables.srgb_to_linear(), decode(np.arange(256)), rtol=1e-6)


def test_points_of_triangles_are_multiplied_by_their_texture(textured, lane_device):
    rng = np.random.default_rng(2)
    count = 4096
    # Fifty triangles with two sets of coordinates each.
    uvs = np.zeros(100, layout.UVS.dtype)
    for name in ("uv0", "uv1", "uv2"):
        uvs[name] = rng.uniform(0, 1, (100, 2))
    linear = [k for k, t in enumerate(TEXTURES) if t.filter == "linear"]
    index = rng.choice([*linear, CONSTANT["NO_TEXTURE"]], count).astype(np.uint32)
    triangle = rng.integers(0, 50, count, np.uint32)
    barycentrics = rng.dirichlet([1, 1, 1], count).T[1:].astype(np.float32)
    color = rng.random((3, count)).astype(np.float32)
    mask = (rng.random(count) < 0.6).astype(np.uint32)
    inputs = {
        "mask": mask,
        "index": index,
        "triangle": triangle,
        "barycentrics": np.ascontiguousarray(barycentrics),
        "color": color,
    }
    buffer = lane_device.upload("uvs", uvs)
    found = textured("color_points", inputs, 3, uvs=buffer)
    lane_device.release(buffer)
    u, v = barycentrics.astype(np.float64)[..., None]
    expected = color.T.astype(np.float64)
    for k in np.flatnonzero(mask & (index != CONSTANT["NO_TEXTURE"])):
        texture = TEXTURES[index[k]]
        at = uvs[triangle[k] + 50 * texture.uv_set]
        uv = (1 - u[k] - v[k]) * at["uv0"] + u[k] * at["uv1"] + v[k] * at["uv2"]
        place = np.reshape(texture.transform, (2, 3)) @ (*uv, 1.0)
        expected[k] *= look_up(texture, *place)[:3]
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)


def cut_out_scene(texels, wrap="repeat", uv_scale=1.0, **material):
    """Return a black quad that fills the view, its alpha by texels, before a white sky."""
    size = 16
    pixels = np.zeros((*np.shape(texels), 4), np.uint8)
    pixels[..., 3] = texels
    texture = Texture("holes", pixels, wrap=(wrap, wrap), filter="nearest")
    mesh = Mesh(
        "quad",
        np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.uint32),
        # Row 0 of the texture is at the top.
        uvs=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) * uv_scale,
    )
    black = Material(
        "black",
        base_color=(0.0, 0.0, 0.0),
        specular=0.0,
        base_color_texture=0,
        alpha_mode="mask",
        **material,
    )
    pose = np.eye(4)
    pose[2, 3] = 2.0
    return Scene(
        "test",
        width=size,
        height=size,
        cameras=(Camera(pose, 2 * math.atan(0.5)),),
        textures=(texture,),
        materials=(black,),
        shapes=(Shape("quad", mesh, np.eye(4), 0),),
        environment=Environment((1.0, 1.0, 1.0)),
    )


def holes(alpha, limit, repeats=1):
    """Return the image: 1 where the quad is not there."""
    there = np.tile(np.asarray(alpha) / 255.0 >= limit, (repeats, repeats))
    return np.where(np.kron(there, np.ones((16 // there.shape[0],) * 2)), 0.0, 1.0)


ALPHA = np.random.default_rng(3).integers(0, 256, (8, 8))
ALPHA[0, :4] = 0, 127, 128, 255


@pytest.mark.parametrize("cutoff,factor", [(0.5, 1.0), (0.25, 1.0), (0.5, 0.6), (0.0, 1.0)])
def test_quads_have_holes_where_alpha_is_below_the_cutoff(device, cutoff, factor):
    scene = cut_out_scene(ALPHA, alpha=factor, alpha_cutoff=cutoff)
    image = psf_cl.render(scene, spp=4, device=device, max_depth=2)
    expected = holes(ALPHA, cutoff / factor)
    np.testing.assert_allclose(image.aovs["rgb"], np.repeat(expected[..., None], 3, 2), atol=1e-6)


def test_holes_repeat_with_their_texture(device):
    image = psf_cl.render(cut_out_scene(ALPHA[:4, :4], uv_scale=2.0), spp=4, device=device)
    expected = holes(ALPHA[:4, :4], 0.5, repeats=2)
    np.testing.assert_allclose(image.aovs["rgb"][..., 0], expected, atol=1e-6)


def test_holes_let_light_through_to_other_surfaces(device):
    """Shadow rays too: a white floor behind the quad is lit where the quad is not."""
    scene = cut_out_scene(np.zeros((1, 1)))
    floor = Material("floor", base_color=(0.5, 0.5, 0.5), specular=0.0)
    behind = np.diag([2.0, 2.0, 1.0, 1.0])
    behind[2, 3] = -0.01
    mesh = scene.shapes[0].mesh
    light = Light("directional", (2.0, 2.0, 2.0), direction=(0.0, 0.0, -1.0))
    lit = {"materials": (*scene.materials, floor), "lights": (light,), "environment": Environment()}
    shapes = (*scene.shapes, Shape("floor", mesh, behind, 1))
    scene = replace(scene, shapes=shapes, **lit)
    image = psf_cl.render(scene, spp=2, device=device, max_depth=1)
    # Lambert: albedo / pi times lux times cosine 1.
    np.testing.assert_allclose(image.aovs["rgb"], 0.5 / np.pi * 2.0, rtol=1e-5)
