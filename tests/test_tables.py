"""Scene to tables: triangles in world space, materials, textures, the order of pixels."""

import math
from dataclasses import replace

import numpy as np
import pytest

from psf_cl import tables
from psf_cl.device import layout
from psf_cl.device.layout import CONSTANT
from psf_cl.errors import InputError
from psf_cl.scene.model import Camera, Material, Mesh, Scene, Shape, Texture
from psf_cl.scene.transform import rotation_xyz_degrees, scaling, translation


def make_mesh(seed=0, normals=True, uvs=True):
    rng = np.random.default_rng(seed)
    unit = rng.normal(size=(6, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return Mesh(
        "mesh",
        rng.normal(size=(6, 3)).astype(np.float32),
        np.array([[0, 1, 2], [3, 4, 5], [5, 0, 3]], np.uint32),
        unit.astype(np.float32) if normals else None,
        rng.random((6, 2)).astype(np.float32) if uvs else None,
    )


TRANSFORMS = {
    "identity": np.eye(4),
    "moved": translation((1, 2, 3)) @ rotation_xyz_degrees((10, 20, 30)),
    "stretched": rotation_xyz_degrees((40, 0, 70)) @ scaling((3.0, 0.5, 1.5)),
    "mirrored": translation((0, 0, 5)) @ scaling((-1.0, 1.0, 1.0)),
    "mirrored and sheared": np.array(
        [[1, 2, 0, 1], [0, -3, 0.5, 0], [0.2, 0, 1, 0], [0, 0, 0, 1.0]]
    ),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_triangles_and_normals_are_moved_to_the_world(name):
    mesh, matrix = make_mesh(), TRANSFORMS[name]
    geometry = tables.flatten(Scene("test", shapes=(Shape("s", mesh, matrix, 0),)))
    world = np.array([(matrix @ [*p, 1])[:3] for p in mesh.positions.astype(np.float64)])
    corners = world[mesh.triangles]
    np.testing.assert_allclose(geometry.positions.reshape(-1, 3, 3), corners, rtol=1e-5, atol=1e-6)
    surfaces = geometry.surfaces
    np.testing.assert_allclose(surfaces["p0"], corners[:, 0], rtol=1e-5, atol=1e-6)
    for edge, corner in (("e1", 1), ("e2", 2)):
        expected = corners[:, corner] - corners[:, 0]
        np.testing.assert_allclose(surfaces[edge], expected, rtol=1e-5, atol=2e-6)

    # Normals go by the inverse transpose: they stay perpendicular to what they were to.
    normals = mesh.normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for corner, field in enumerate(("n0", "n1", "n2")):
        expected = normals[mesh.triangles[:, corner]]
        np.testing.assert_allclose(geometry.normals[field], expected, atol=2e-6)

    # The front stays the front: the object's face normal, moved, is the world's.
    p = mesh.positions.astype(np.float64)[mesh.triangles]
    faces = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) @ np.linalg.inv(matrix[:3, :3])
    faces /= np.linalg.norm(faces, axis=1, keepdims=True)
    np.testing.assert_allclose(surfaces["ng"], faces, atol=2e-6)
    # Far enough off to clear eight roundings of what a point is made of.
    size = np.abs(corners).max(axis=(1, 2))
    assert (surfaces["offset"] >= 8 * 2.0**-24 * size).all()
    assert (surfaces["offset"] <= 64 * 2.0**-24 * size).all()
    for corner, field in enumerate(("uv0", "uv1", "uv2")):
        np.testing.assert_array_equal(geometry.uvs[field], mesh.uvs[mesh.triangles[:, corner]])


def test_singular_transforms_keep_finite_normals():
    flat = scaling((1.0, 1.0, 0.0))
    point = scaling((0.0, 0.0, 0.0))
    shapes = tuple(Shape("s", make_mesh(k), m, 0) for k, m in enumerate((flat, point)))
    geometry = tables.flatten(Scene("test", shapes=shapes))
    normals = np.stack([geometry.normals[f] for f in ("n0", "n1", "n2")], axis=1)
    assert np.isfinite(normals).all()
    # What is flattened along z faces along z; a point faces nowhere.
    np.testing.assert_allclose(abs(normals[:3]), np.broadcast_to([0, 0, 1], (3, 3, 3)), atol=1e-6)
    assert not normals[3:].any()
    assert np.isfinite(geometry.positions).all()


def test_shapes_without_normals_or_coordinates_get_zeros_beside_ones_that_have_them():
    bare, full = make_mesh(0, normals=False, uvs=False), make_mesh(1)
    shapes = (Shape("a", bare, np.eye(4), 0), Shape("b", full, np.eye(4), 1))
    scene = Scene("test", materials=(Material(), Material()), shapes=shapes)
    geometry = tables.flatten(scene)
    assert geometry.count == 6
    assert not geometry.normals["n0"][:3].any() and geometry.normals["n0"][3:].any()
    assert not geometry.uvs["uv1"][:3].any() and geometry.uvs["uv1"][3:].any()
    np.testing.assert_array_equal(geometry.surfaces["material"], [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(geometry.surfaces["light"], CONSTANT["NO_LIGHT"])

    geometry = tables.flatten(replace(scene, shapes=shapes[:1]))
    assert geometry.normals is None and geometry.uvs is None


def test_empty_scenes_and_broken_vertices_have_finite_bounds():
    geometry = tables.flatten(Scene("test"))
    assert geometry.count == 0 and geometry.radius == 0
    assert geometry.positions.shape == (0, 9)

    mesh = Mesh(
        "m",
        np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [np.nan, 0, 0], [np.inf, 1, 1]], np.float32),
        np.array([[0, 1, 2], [0, 1, 3], [0, 4, 2]], np.uint32),
    )
    geometry = tables.flatten(Scene("test", shapes=(Shape("s", mesh, np.eye(4), 0),)))
    assert geometry.count == 3
    assert geometry.radius == pytest.approx(math.sqrt(2))
    huge = tables.flatten(Scene("test", shapes=(Shape("s", mesh, scaling(1e39), 0),)))
    assert math.isfinite(huge.radius)


def test_materials_become_their_parameters():
    none = CONSTANT["NO_TEXTURE"]
    plain = Material(roughness=0.5, ior=1.5, specular=0.5, base_color=(0.1, 0.2, 0.3))
    lamp = Material(emission=(1.0, 2.0, 3.0), double_sided=True, emission_texture=1)
    cut = Material(
        base_color_texture=0, alpha_mode="mask", alpha=0.5, alpha_cutoff=0.25, transmission=1.0
    )
    air = Material(ior=1.0)
    gone = Material(base_color_texture=0, alpha_mode="mask", alpha=0.0)
    a, b, c, d, e = tables.material_table((plain, lamp, cut, air, gone))
    np.testing.assert_allclose(a["base_color"], (0.1, 0.2, 0.3), rtol=1e-6)
    assert a["roughness"] == np.float32(0.5)
    assert a["f0"] == np.float32(0.04) and a["specular"] == np.float32(0.5)
    assert a["base_color_texture"] == a["emission_texture"] == none and a["flags"] == 0
    np.testing.assert_array_equal(b["emission"], (1, 2, 3))
    assert b["emission_texture"] == 1 and b["flags"] == CONSTANT["MATERIAL_TWO_SIDED_EMISSION"]
    assert c["flags"] == CONSTANT["MATERIAL_ALPHA_MASK"] and c["base_color_texture"] == 0
    assert c["alpha_cutoff"] == 0.25 and c["alpha"] == 0.5 and c["transmission"] == 1
    assert d["f0"] == 0 and d["ior"] > 1
    assert e["alpha"] == 0 and e["flags"] == CONSTANT["MATERIAL_ALPHA_MASK"]


def test_only_masks_that_can_fail_are_cut_out():
    assert not tables.is_cut_out(Material(base_color_texture=0, alpha=0.1))
    assert not tables.is_cut_out(Material(alpha_mode="mask", alpha=0.5, alpha_cutoff=0.5))
    assert not tables.is_cut_out(Material(alpha_mode="mask", alpha=0.4, alpha_cutoff=0.5))
    assert tables.is_cut_out(Material(alpha_mode="mask", base_color_texture=0))


def test_textures_lie_one_after_the_other():
    rng = np.random.default_rng(4)
    first = Texture("a", rng.integers(0, 256, (2, 3, 4), np.uint8), False, ("clamp", "mirror"))
    second = Texture("b", rng.integers(0, 256, (4, 1, 4), np.uint8), filter="nearest")
    records, texels = tables.texture_tables((first, second))
    a, b = records
    assert (a["offset"], a["width"], a["height"]) == (0, 3, 2)
    assert (b["offset"], b["width"], b["height"]) == (6, 1, 4)
    assert a["flags"] == CONSTANT["TEXTURE_CLAMP_U"] | CONSTANT["TEXTURE_MIRROR_V"]
    assert b["flags"] == CONSTANT["TEXTURE_NEAREST"] | CONSTANT["TEXTURE_SRGB"]
    np.testing.assert_array_equal(texels[:6], first.pixels.reshape(-1, 4))
    np.testing.assert_array_equal(texels[6:], second.pixels.reshape(-1, 4))

    records, texels = tables.texture_tables(())
    assert len(records) == len(texels) == 1


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (7, 13), (1, 37), (6, 5)], ids=str)
def test_pixel_order_visits_every_pixel_once(size):
    order = tables.pixel_order(*size)
    np.testing.assert_array_equal(np.sort(order), np.arange(size[0] * size[1]))


def test_pixel_order_keeps_neighbours_together():
    rows, columns = np.divmod(tables.pixel_order(64, 64).reshape(-1, 16), 64)
    assert (np.ptp(rows, axis=1) == 3).all() and (np.ptp(columns, axis=1) == 3).all()


def test_camera_axes_and_scales():
    pose = translation((1, 2, 3)) @ rotation_xyz_degrees((0, 90, 0))
    values = tables.camera_values(Camera(pose, math.radians(60)), 320, 160)
    np.testing.assert_allclose(values["camera_origin"], (1, 2, 3))
    # It looks along its local -Z; a quarter turn about Y makes that -X.
    np.testing.assert_allclose(values["camera_forward"], (-1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(values["camera_right"], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(values["camera_up"], (0, 1, 0), atol=1e-12)
    assert values["film_scale_y"] == pytest.approx(math.tan(math.radians(30)))
    assert values["film_scale_x"] == pytest.approx(2 * math.tan(math.radians(30)))


@pytest.mark.parametrize("fov,matrix", [(math.pi * 1.1, np.eye(4)), (1.0, np.full((4, 4), np.nan))])
def test_impossible_cameras_are_refused(fov, matrix):
    with pytest.raises(InputError, match="camera 'c': expected"):
        tables.camera_values(Camera(matrix, fov, "c"), 10, 10)


def test_empty_environments_have_a_cell():
    cells = tables.environment_cells(Scene("test").environment)
    assert cells.dtype == layout.ENVIRONMENT_CELL.dtype and len(cells) == 1
