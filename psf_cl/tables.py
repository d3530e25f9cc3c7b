"""Scene to the tables that the device reads: NumPy only."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psf_cl.device import layout
from psf_cl.device.alias import alias_chances, alias_table
from psf_cl.errors import InputError
from psf_cl.scene.model import (
    LUMINANCE,
    TEXTURE_FIELDS,
    Camera,
    Environment,
    Light,
    Material,
    Mesh,
    Scene,
    Shape,
    Texture,
    emits,
    has_environment,
    has_tangents,
    hides_back,
    is_cut_out,
    is_invisible,
    shines,
)
from psf_cl.scene.texture import decoded_srgb, level_sizes, mean_color, smaller_levels
from psf_cl.scene.transform import transform_points
from psf_cl.whole_lights import (
    MOST_IN_RECTANGLES,
    find_whole_lights,
    glows_evenly,
    is_round,
    lights_move,
)

#: Chance that the light table keeps for emitters of finite size where there is also light from
#: infinitely far: its flux through the scene says little about how much of it comes in.
NEAR_SHARE = 0.5

#: Triangles that are worked out at once.
RUN = 1 << 14

#: Of a light, in its record: more is no float32.
MOST_POWER = 1e38


#: The camera of the frame before, in layout.PARAMS, and what it is made of.
PREVIOUS_CAMERA = {
    "previous_origin": "camera_origin",
    "previous_right": "camera_right",
    "previous_up": "camera_up",
    "previous_forward": "camera_forward",
    "previous_scale_x": "film_scale_x",
    "previous_scale_y": "film_scale_y",
}


@dataclass(frozen=True)
class Geometry:
    """Every triangle of the scene in world space.

    Attributes:
        positions: ``(n, 9)`` float32, the three corners; m.
        surfaces: ``(n,)`` layout.SURFACE, ``light`` still NO_LIGHT.
        normals: ``(n,)`` layout.NORMALS, or None if every shape is flat.
        uvs: ``(n,)`` layout.UVS, or None if nothing has coordinates; ``(2 * n,)``, the second
            set behind the first, if a texture uses it.
        colors: ``(n,)`` layout.VERTEX_COLORS, or None if no mesh has colours.
        tangents: ``(n,)`` layout.TANGENTS, or None if no material asks for them.
        cut_out: ``(n,)`` bool, whether hits must look up their alpha.
        shapes: what ``shape`` of the surfaces counts.
        center, radius: of a sphere around all finite vertices; world, m.
    """

    positions: np.ndarray
    surfaces: np.ndarray
    normals: np.ndarray | None
    uvs: np.ndarray | None
    colors: np.ndarray | None
    tangents: np.ndarray | None
    cut_out: np.ndarray
    shapes: tuple[Shape, ...]
    center: np.ndarray
    radius: float

    @property
    def count(self) -> int:
        return len(self.surfaces)


def visible_shapes(scene: Scene) -> list[Shape]:
    """Return the shapes that a ray can hit."""
    return [shape for shape in scene.shapes if not is_invisible(scene.materials[shape.material])]


def flatten(scene: Scene, densities: bool = True) -> Geometry:
    """Return the triangles of all visible shapes, in the order of the shapes.

    Args:
        densities: whether levels of textures ask for ``density`` of the coordinates; else it is 0.
    """
    positions, surfaces, normals, cut_out = [], [], [], []
    uvs: tuple[list[np.ndarray], ...] = ([], [])
    colors, tangents = [], []
    shapes = visible_shapes(scene)
    smooth = any(shape.mesh.normals is not None for shape in shapes)
    mapped = any(shape.mesh.uvs is not None or shape.mesh.uvs1 is not None for shape in shapes)
    colored = any(shape.mesh.colors is not None for shape in shapes)
    directed = any(has_tangents(scene.materials[shape.material]) for shape in shapes)
    for number, shape in enumerate(shapes):
        mesh, material = shape.mesh, scene.materials[shape.material]
        linear = shape.transform[:3, :3]
        with np.errstate(
            all="ignore"
        ):  # What overflows here is dropped, and counted, as not finite.
            world = (mesh.positions @ linear.T + shape.transform[:3, 3]).astype(np.float32)
            mirrored = bool(np.linalg.det(linear) < 0)
        corners = np.empty((len(mesh.triangles), 3, 3), np.float32)
        surface = np.zeros(len(corners), layout.SURFACE.dtype)
        for rows in _runs(len(corners)):
            corners[rows] = world[mesh.triangles[rows]]
            _set_triangles(surface[rows], corners[rows], mirrored)
        surface["material"] = shape.material
        surface["shape"] = number
        surface["light"] = layout.CONSTANT["NO_LIGHT"]
        positions.append(corners.reshape(-1, 9))
        surfaces.append(surface)
        cut_out.append(np.full(len(corners), is_cut_out(material, mesh)))
        if smooth:
            world_normals = None
            if mesh.normals is not None:
                world_normals = _world_normals(mesh.normals, linear)
            normals.append(_corner_records(layout.NORMALS, "n", world_normals, mesh, 0.0))
        if mapped:
            for part, values in zip(uvs, (mesh.uvs, mesh.uvs1), strict=True):
                record = _corner_records(layout.UVS, "uv", values, mesh, 0.0)
                if densities and values is not None:
                    record["density"] = _density(record, surface)
                part.append(record)
        if colored:
            colors.append(_corner_records(layout.VERTEX_COLORS, "c", mesh.colors, mesh, 1.0))
        if directed:
            record = np.zeros(len(corners), layout.TANGENTS.dtype)
            if has_tangents(material):
                for name, values in zip(
                    ("t0", "t1", "t2"), _world_tangents(scene, shape), strict=True
                ):
                    record[name] = values
            tangents.append(record)

    def joined(parts: list[np.ndarray], dtype: np.dtype, width: tuple[int, ...] = ()) -> np.ndarray:
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.zeros((0, *width), dtype)

    second = any(texture.uv_set for texture in scene.textures)
    points = joined(positions, np.dtype(np.float32), (9,))
    low, high = _bounds(points)
    return Geometry(
        points,
        joined(surfaces, layout.SURFACE.dtype),
        joined(normals, layout.NORMALS.dtype) if smooth else None,
        joined([*uvs[0], *(uvs[1] if second else [])], layout.UVS.dtype) if mapped else None,
        joined(colors, layout.VERTEX_COLORS.dtype) if colored else None,
        joined(tangents, layout.TANGENTS.dtype) if directed else None,
        joined(cut_out, np.dtype(bool)),
        tuple(shapes),
        0.5 * low + 0.5 * high,
        float(np.linalg.norm(high - low)) / 2,
    )


def _corner_records(
    record: layout.Record, stem: str, values: np.ndarray | None, mesh: Mesh, otherwise: float
) -> np.ndarray:
    """Return the values of each triangle's vertices in the fields ``stem`` 0, 1, 2, ``(m,)``."""
    table = np.zeros(len(mesh.triangles), record.dtype)
    for corner in range(3):
        known = otherwise if values is None else values[mesh.triangles[:, corner]]
        table[f"{stem}{corner}"] = known
    return table


def object_tangents(scene: Scene, shape: Shape) -> list[np.ndarray]:
    """Return direction and sign at each triangle's corners, in the mesh's space, three ``(m, 4)``.

    Those of the mesh, or derived from the coordinates of the normal map: zero where there are none.
    """
    mesh, material = shape.mesh, scene.materials[shape.material]
    if mesh.tangents is not None:
        return [mesh.tangents[mesh.triangles[:, corner]] for corner in range(3)]
    index = max(material.normal_texture, material.anisotropy_texture)
    texture = scene.textures[index] if index >= 0 else None
    uvs = mesh.uvs1 if texture is not None and texture.uv_set else mesh.uvs
    if uvs is None:
        return [np.zeros((len(mesh.triangles), 4))] * 3
    if texture is not None:
        matrix = np.reshape(texture.transform, (2, 3))
        uvs = uvs @ matrix[:, :2].T
    return derived_tangents(mesh, uvs)


def _world_tangents(scene: Scene, shape: Shape) -> list[np.ndarray]:
    """Return direction and sign at each triangle's corners in the world, three ``(m, 4)``."""
    linear = shape.transform[:3, :3]
    at_corners = object_tangents(scene, shape)
    sign = -1.0 if np.linalg.det(linear) < 0 else 1.0
    world = []
    for values in at_corners:
        with np.errstate(all="ignore"):
            direction = values[:, :3] @ linear.T
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        direction[~np.isfinite(direction).all(axis=1)] = 0.0
        world.append(np.column_stack([direction, values[:, 3] * sign]))
    return world


def derived_tangents(mesh: Mesh, uvs: np.ndarray) -> list[np.ndarray]:
    """Return tangent and sign at each triangle's corners, in the mesh's space, three ``(m, 4)``.

    As in Mikkelsen's MikkTSpace, which glTF asks for: the directions in which u grows over the
    triangles around a vertex, weighted by their angles; triangles whose coordinates are mirrored
    are averaged apart.

    Args:
        uvs: ``(n, 2)``, transformed.
    """
    points = mesh.positions.astype(np.float64)[mesh.triangles]
    at = uvs.astype(np.float64)[mesh.triangles]
    with np.errstate(all="ignore"):
        e1, e2 = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
        d1, d2 = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
        area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
        # glTF's v grows downwards: the bitangent is where it falls, so the sign turns.
        sign = np.where(area < 0, 1.0, -1.0)
        tangent = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * np.sign(area)[:, None]
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        tangent[~np.isfinite(tangent).all(axis=1)] = 0.0
        sums = np.zeros((2 * len(mesh.positions), 3))
        keys = 2 * mesh.triangles.astype(np.int64) + (sign < 0)[:, None]
        for corner in range(3):
            a = points[:, (corner + 1) % 3] - points[:, corner]
            b = points[:, (corner + 2) % 3] - points[:, corner]
            angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
            np.add.at(sums, keys[:, corner], tangent * np.nan_to_num(angle)[:, None])
    return [np.column_stack([sums[keys[:, corner]], sign]) for corner in range(3)]


def _runs(count: int) -> Iterator[slice]:
    """Yield slices of rows whose intermediate results stay in a processor's cache."""
    for start in range(0, count, RUN):
        yield slice(start, start + RUN)


def _set_triangles(surface: np.ndarray, corners: np.ndarray, mirrored: bool) -> None:
    """Set all of layout.SURFACE that follows from the corners, ``(n, 3, 3)``."""
    with np.errstate(all="ignore"):
        surface["p0"] = corners[:, 0]
        surface["e1"] = corners[:, 1] - corners[:, 0]
        surface["e2"] = corners[:, 2] - corners[:, 0]
    surface["ng"] = _front_normals(surface, mirrored)
    surface["offset"] = layout.OFFSET_EPSILON * _extent(surface)


def _bounds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the box of the triangles ``(n, 9)`` whose corners are finite; zeros without one."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in _runs(len(points)):
        finite = points[rows][_all_finite(points[rows])].reshape(-1, 3)
        if len(finite):
            low = np.minimum(low, finite.min(axis=0))
            high = np.maximum(high, finite.max(axis=0))
    return (low, high) if (low <= high).all() else (np.zeros(3), np.zeros(3))


def _front_normals(surface: np.ndarray, mirrored: bool) -> np.ndarray:
    """Return unit normals ``(n, 3)``; (0, 0, 1) for triangles without area."""
    with np.errstate(all="ignore"):
        normal = np.cross(surface["e1"].astype(np.float64), surface["e2"].astype(np.float64))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) * (-1.0 if mirrored else 1.0)
    normal[~_all_finite(normal)] = (0.0, 0.0, 1.0)
    return normal


def _all_finite(rows: np.ndarray) -> np.ndarray:
    """Return which rows of ``(n, c)`` are finite, ``(n,)``; NumPy is slow along a short axis."""
    finite = np.isfinite(rows[:, 0])
    for column in rows.T[1:]:
        finite &= np.isfinite(column)
    return finite


def _extent(surface: np.ndarray) -> np.ndarray:
    """Return the largest coordinate that a point of each triangle is made of, ``(n,)``."""
    parts = (np.abs(surface[name]).astype(np.float64) for name in ("p0", "e1", "e2"))
    with np.errstate(all="ignore"):
        x, y, z = sum(parts).T
        extent = np.maximum(np.maximum(x, y), z)
    return np.where(np.isfinite(extent), extent, 0.0)


def _world_normals(normals: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Return unit normals under ``linear``; zero where they have no direction."""
    # The cofactor matrix is the inverse transpose up to scale; singular transforms have one too.
    cofactor = np.stack(
        [
            np.cross(linear[1], linear[2]),
            np.cross(linear[2], linear[0]),
            np.cross(linear[0], linear[1]),
        ]
    )
    if np.linalg.det(linear) < 0:
        cofactor = -cofactor
    with np.errstate(all="ignore"):
        world = normals @ cofactor.T
        length = np.linalg.norm(world, axis=1, keepdims=True)
        unit = world / length
    unit[~np.isfinite(unit).all(axis=1)] = 0.0
    return unit.astype(np.float32)


def material_table(materials: tuple[Material, ...]) -> np.ndarray:
    """Return ``(n,)`` layout.MATERIAL."""
    table = np.zeros(len(materials), layout.MATERIAL.dtype)
    for row, material in zip(table, materials, strict=True):
        for name in table.dtype.names or ():
            if name in TEXTURE_FIELDS:
                index = getattr(material, name)
                row[name] = index if index >= 0 else layout.CONSTANT["NO_TEXTURE"]
            elif hasattr(material, name):
                row[name] = getattr(material, name)
        row["f0"] = ((material.ior - 1) / (material.ior + 1)) ** 2
        # An index of exactly 1 has no boundary to bend at: the half vector would vanish.
        row["ior"] = material.ior if abs(material.ior - 1.0) > 1e-3 else 1.001
        row["absorption"] = absorption(material)
        angle = material.anisotropy_rotation
        row["anisotropy_direction"] = math.cos(angle), math.sin(angle)
        flags = {
            "MATERIAL_TWO_SIDED_EMISSION": material.double_sided or material.unlit,
            "MATERIAL_ALPHA_MASK": material.alpha_mode == "mask",
            "MATERIAL_ALPHA_BLEND": material.alpha_mode == "blend",
            "MATERIAL_UNLIT": material.unlit,
            "MATERIAL_THIN": material.thin_walled,
            "MATERIAL_HIDES_BACK": hides_back(material),
        }
        row["flags"] = sum(layout.CONSTANT[name] for name, value in flags.items() if value)
        if material.unlit:
            # A black surface that glows in its colour; the texture stays, for its alpha.
            row["emission"] = material.base_color
            row["emission_texture"] = row["base_color_texture"]
            for name in ("base_color", "metallic", "f0", "specular", "transmission", "clearcoat"):
                row[name] = 0.0
            row["sheen_color"] = 0.0
    return table


def absorption(material: Material) -> np.ndarray:
    """Return how much of the light inside is lost per meter, ``(3,)``: Beer's law.

    A colour of 0 takes all but e^-30 over the distance.
    """
    left = np.maximum(material.attenuation_color, 1e-13)
    return np.minimum(-np.log(left) / material.attenuation_distance, 1e30)


def srgb_to_linear() -> np.ndarray:
    """Return ``(256,)`` float32: the linear value of each 8-bit sRGB code (IEC 61966-2-1)."""
    return decoded_srgb(np.arange(256) / 255.0).astype(np.float32)


def _density(uvs: np.ndarray, surfaces: np.ndarray) -> np.ndarray:
    """Return the area of triangles in coordinates over that in the scene, 0 where it is no number.

    Args:
        uvs, surfaces: ``(n,)`` layout.UVS and layout.SURFACE.
    """
    with np.errstate(all="ignore"):
        a, b = (uvs[name].astype(np.float64) - uvs["uv0"] for name in ("uv1", "uv2"))
        e1, e2 = (surfaces[name].astype(np.float64) for name in ("e1", "e2"))
        covered = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        density = covered / np.linalg.norm(np.cross(e1, e2), axis=1)
        return np.where((density > 1e-30) & (density < 1e30), density, 0.0)


#: What of a material may be averaged over texels: no directions, nothing that lights are drawn by.
_LEVELED = tuple(
    name
    for name in TEXTURE_FIELDS
    if name not in ("normal_texture", "anisotropy_texture", "emission_texture")
)


def leveled_textures(scene: Scene) -> list[int]:
    """Return which textures have levels: those of numbers and colours, if larger than a texel."""
    used = {getattr(material, name) for material in scene.materials for name in _LEVELED}
    return [
        index
        for index in sorted(used - {-1})
        if scene.textures[index].filter != "nearest"
        and max(scene.textures[index].pixels.shape[:2]) > 1
    ]


def count_texels(scene: Scene, leveled: bool) -> tuple[int, int]:
    """Return the rows of the table of textures and the texels, with their levels or without."""
    rows = len(scene.textures)
    texels = sum(image.size // 4 for image in distinct_images(scene.textures))
    for index in leveled_textures(scene) if leveled else []:
        height, width = scene.textures[index].pixels.shape[:2]
        sizes = level_sizes(width, height)
        rows += len(sizes)
        texels += sum(w * h for w, h in sizes)
    return rows, texels


def texture_tables(
    textures: tuple[Texture, ...], triangle_count: int = 0, leveled: Sequence[int] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``(n,)`` layout.TEXTURE and all texels, ``(m, 4)`` uint8; an image lies there once.

    Behind the textures are the levels of those that have them, each half as large as the last.

    Args:
        triangle_count: of the scene: where the second set of coordinates begins.
        leveled: indices of the textures that have levels.
    """
    table = np.zeros(max(len(textures), 1), layout.TEXTURE.dtype)
    table["width"] = table["height"] = 1
    bits = {
        "clamp": ("TEXTURE_CLAMP_U", "TEXTURE_CLAMP_V"),
        "mirror": ("TEXTURE_MIRROR_U", "TEXTURE_MIRROR_V"),
    }
    images = distinct_images(textures)
    starts = np.cumsum([0, *(image.size // 4 for image in images)])
    offsets = {id(image): start for image, start in zip(images, starts, strict=False)}
    for row, texture in zip(table, textures, strict=False):
        flags = 0
        for axis, wrap in enumerate(texture.wrap):
            if wrap in bits:
                flags |= layout.CONSTANT[bits[wrap][axis]]
        if texture.filter == "nearest":
            flags |= layout.CONSTANT["TEXTURE_NEAREST"]
        if texture.srgb:
            flags |= layout.CONSTANT["TEXTURE_SRGB"]
        row["height"], row["width"] = texture.pixels.shape[:2]
        row["offset"], row["flags"] = offsets[id(texture.pixels)], flags
        row["matrix"] = texture.transform
        row["uv_offset"] = triangle_count * texture.uv_set
    texels = [image.reshape(-1, 4) for image in images]
    rows = [table]
    for index in leveled:
        row, texture = table[index], textures[index]
        row["smaller"] = sum(len(part) for part in rows)
        levels = smaller_levels(texture)
        part = np.repeat(row[None], len(levels))
        part["smaller"] = 0
        for record, level in zip(part, levels, strict=True):
            record["height"], record["width"] = level.shape[:2]
            record["offset"] = sum(len(image) for image in texels)
            texels.append(level.reshape(-1, 4))
        rows.append(part)
    table = np.concatenate(rows)
    return table, np.concatenate(texels) if texels else np.full((1, 4), 255, np.uint8)


def distinct_images(textures: tuple[Texture, ...]) -> list[np.ndarray]:
    """Return the pixels of all textures, each array once."""
    return list({id(texture.pixels): texture.pixels for texture in textures}.values())


def count_whole_lights(scene: Scene, kind: str) -> tuple[int, int]:
    """Return how many lights are of ``kind`` if the table has these, and of how many triangles."""
    shapes = tuple(
        shape for shape in visible_shapes(scene) if glows_evenly(scene.materials[shape.material])
    )
    if kind == "spheres":
        shapes = tuple(shape for shape in shapes if is_round(scene, shape))
    elif sum(len(shape.mesh.triangles) for shape in shapes if not is_round(scene, shape)) > (
        MOST_IN_RECTANGLES
    ):
        return 0, 0
    if not shapes or lights_move(scene):
        return 0, 0
    surfaces = flatten(replace(scene, shapes=shapes)).surfaces
    every = np.arange(len(surfaces))
    found = find_whole_lights(scene, shapes, surfaces, every, {kind})
    return len(found), sum(light.count for light in found)


def light_spread(scene: Scene) -> float:
    """Return the longest side of the box around all lights over that of the box around everything.

    What moves counts where it is at rest.  0 where there is no light, or nothing has an extent.
    """
    boxes, lit = [], []
    for shape in scene.shapes:
        points = shape.mesh.positions[np.isfinite(shape.mesh.positions).all(axis=1)]
        if len(points):
            # The box of a turned box is somewhat large: it is quick, for meshes of any size.
            corners = np.stack([points.min(axis=0), points.max(axis=0)]).astype(np.float64)
            corners = np.array(list(itertools.product(*corners.T)))
            boxes.append(transform_points(shape.transform, corners))
            lit.append(emits(scene.materials[shape.material]))
    for light in filter(shines, scene.lights):
        if light.kind != "directional":
            boxes.append(np.array([light.position], np.float64))
            lit.append(True)
    if not any(lit):
        return 0.0
    glowing = [box for box, is_light in zip(boxes, lit, strict=True) if is_light]
    lights = np.ptp(np.concatenate(glowing), axis=0).max()
    everything = np.ptp(np.concatenate(boxes), axis=0).max()
    return float(lights / everything) if everything > 0.0 else 0.0


def light_table(
    scene: Scene, geometry: Geometry, sampling: str, kinds: Collection[str] = ()
) -> np.ndarray:
    """Return ``(n,)`` layout.LIGHT; sets the surfaces' ``light``.

    Entries are the emitting triangles (those with an area), the environment, the punctual lights.

    Args:
        sampling: what the chances follow: ``"uniform"``, or else the power.
        kinds: of what triangles make one light together, as for `find_whole_lights`.
    """
    glow = np.array([emits(material) for material in scene.materials], bool)
    sided = np.array([2.0 if material.double_sided else 1.0 for material in scene.materials])
    radiance = np.array(
        [_mean_emission(scene, material) @ LUMINANCE for material in scene.materials]
    )
    material = geometry.surfaces["material"]
    triangles = np.flatnonzero(glow[material])
    with np.errstate(all="ignore"):
        cross = np.cross(
            geometry.surfaces["e1"][triangles].astype(np.float64),
            geometry.surfaces["e2"][triangles].astype(np.float64),
        )
        area = 0.5 * np.linalg.norm(cross, axis=1)
    # float32 tells the areas of these on the device; smaller and larger ones have none there.
    sound = (area > 1e-30) & (area < 1e30) & np.isfinite(geometry.positions[triangles]).all(axis=1)
    if scene.nodes:
        # What moves keeps its place in the table, though it gives no light while it has no area.
        area = np.where(sound, area, 0.0)
        sound[:] = True
    triangles, area = triangles[sound], area[sound]
    emitting = triangles
    whole = find_whole_lights(scene, geometry.shapes, geometry.surfaces, emitting, kinds)
    own = np.ones(len(emitting), bool)
    for light in whole:
        rest = slice(light.first + 1, light.first + light.count)
        area[light.first] += area[rest].sum()
        own[rest] = False
    triangles, area = emitting[own], area[own]
    # The light of each triangle that emits: its own, or the one that it is a part of.
    light_of = np.cumsum(own) - 1

    sky = has_environment(scene.environment)
    punctual = [light for light in scene.lights if shines(light)]
    table = np.zeros(len(triangles) + sky + len(punctual), layout.LIGHT.dtype)
    power = np.zeros(len(table))
    far = np.zeros(len(table), bool)
    table["kind"][: len(triangles)] = layout.CONSTANT["LIGHT_TRIANGLE"]
    table["triangle"][: len(triangles)] = triangles
    table["area"][: len(triangles)] = area
    _fill_triangles(table[: len(triangles)], geometry.surfaces[triangles], scene.materials)
    geometry.surfaces["light"][emitting] = light_of
    brightest = np.ones(len(triangles))
    for light in whole:
        row = table[light_of[light.first]]
        parts = geometry.surfaces[emitting[light.first : light.first + light.count]]
        for name in ("position", "e1", "e2", "direction"):
            row[name] = getattr(light, name)
        row["offset"] = parts["offset"].max()
        row["flags"] |= light.flag
        brightest[light_of[light.first]] = light.brightest
    of = material[triangles]
    power[: len(triangles)] = area * radiance[of] * sided[of] * math.pi
    # A texture may be black on average and still glow somewhere.
    power[: len(triangles)] = np.maximum(power[: len(triangles)], power.max(initial=0.0) * 1e-6)
    table["power"][: len(triangles)] = np.minimum(
        power[: len(triangles)] * brightest / (sided[of] * math.pi), MOST_POWER
    )

    at = len(triangles)
    radius = max(geometry.radius, 1e-30)
    if sky:
        table["kind"][at] = layout.CONSTANT["LIGHT_ENVIRONMENT"]
        mean = environment_mean(scene.environment) @ LUMINANCE
        power[at] = 4.0 * math.pi * mean * math.pi * radius**2
        table["power"][at] = math.pi * mean
        far[at] = True
        at += 1
    for light in punctual:
        _fill_punctual(table[at], light)
        table["power"][at] = strength = float(np.asarray(light.intensity) @ LUMINANCE)
        if light.kind == "directional":
            power[at] = strength * math.pi * radius**2
            far[at] = True
        elif light.kind == "point":
            power[at] = strength * 4.0 * math.pi
        else:
            power[at] = strength * 2.0 * math.pi * (1.0 - math.cos(light.outer_angle))
        at += 1

    if not len(table):
        return table
    if sampling == "uniform" or not power.sum() > 0.0:
        chance = np.full(len(table), 1.0 / len(table))
    else:
        chance = power / power.sum()
        share = chance[far].sum()
        if 1.0 - NEAR_SHARE < share < 1.0:
            chance[far] *= (1.0 - NEAR_SHARE) / share
            chance[~far] *= NEAR_SHARE / (1.0 - share)
    table["keep"], table["other"] = alias_table(chance)
    table["pmf"] = alias_chances(table["keep"], table["other"])
    return table


def environment_light(lights: np.ndarray) -> int:
    """Return the index of the environment in a light table, 0 if it is not there."""
    found = np.flatnonzero(lights["kind"] == layout.CONSTANT["LIGHT_ENVIRONMENT"])
    return int(found[0]) if len(found) else 0


def near_share(lights: np.ndarray) -> float:
    """Return the chance of a light table that is not for lights infinitely far."""
    far = [layout.CONSTANT[f"LIGHT_{kind}"] for kind in ("ENVIRONMENT", "DIRECTIONAL")]
    return float(lights["pmf"][~np.isin(lights["kind"], far)].sum())


def _fill_triangles(
    rows: np.ndarray, surfaces: np.ndarray, materials: tuple[Material, ...]
) -> None:
    records = material_table(materials)[surfaces["material"]]
    rows["position"], rows["e1"], rows["e2"] = surfaces["p0"], surfaces["e1"], surfaces["e2"]
    rows["direction"], rows["offset"] = surfaces["ng"], surfaces["offset"]
    rows["intensity"] = records["emission"]
    rows["emission_texture"], rows["flags"] = records["emission_texture"], records["flags"]


def _fill_punctual(row: np.void, light: Light) -> None:
    kinds = {"point": "LIGHT_POINT", "spot": "LIGHT_SPOT", "directional": "LIGHT_DIRECTIONAL"}
    row["kind"] = layout.CONSTANT[kinds[light.kind]]
    row["position"] = light.position
    row["direction"] = light.direction
    row["range"] = light.range
    row["intensity"] = light.intensity
    row["cos_outer"] = math.cos(light.outer_angle)
    row["spot_scale"] = 1.0 / max(math.cos(light.inner_angle) - math.cos(light.outer_angle), 1e-3)


def _mean_emission(scene: Scene, material: Material) -> np.ndarray:
    emission = np.asarray(material.emission, np.float64)
    if not emits(material) or material.emission_texture < 0:
        return emission
    return emission * mean_color(scene.textures[material.emission_texture])


def _environment_weights(image: np.ndarray) -> np.ndarray:
    """Return the solid angle of a texel in each row of a lat-long image, ``(h, 1)``."""
    height, width = image.shape[:2]
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return ((edges[:-1] - edges[1:]) * (2.0 * np.pi / width))[:, None]


def environment_mean(environment: Environment) -> np.ndarray:
    """Return the radiance of the sky on average over all directions, ``(3,)``."""
    factor = np.asarray(environment.radiance, np.float64)
    if environment.image is None:
        return factor
    weights = _environment_weights(environment.image)[..., None]
    return factor * (environment.image * weights).sum(axis=(0, 1)) / (4.0 * np.pi)


def environment_cells(environment: Environment) -> np.ndarray:
    """Return ``(h * w,)`` layout.ENVIRONMENT_CELL.

    Chances follow what bilinear look-ups return in a cell: its texel and parts of its neighbours,
    so that no direction with light has none.
    """
    image = environment.image
    if image is None:
        return np.zeros(1, layout.ENVIRONMENT_CELL.dtype)
    height, width = image.shape[:2]
    cells = np.zeros(height * width, layout.ENVIRONMENT_CELL.dtype)
    cells["radiance"] = image.reshape(-1, 3)
    level = image.astype(np.float64) @ LUMINANCE
    columns = (np.roll(level, 1, axis=1) + 6.0 * level + np.roll(level, -1, axis=1)) / 8.0
    padded = np.concatenate([columns[:1], columns, columns[-1:]])
    smooth = (padded[:-2] + 6.0 * padded[1:-1] + padded[2:]) / 8.0
    weights = (smooth * _environment_weights(image)).ravel()
    cells["keep"], cells["other"] = alias_table(weights)
    cells["pmf"] = alias_chances(cells["keep"], cells["other"])
    return cells


def pixel_order(width: int, height: int) -> np.ndarray:
    """Return the pixels of a crop, ``row * width + column``, in the order of the queue.

    Strips of layout.STRIP_ROWS rows, each column by column, as regenerate_paths counts them: the
    lanes of a block see neighbours.

    Returns:
        ``(width * height,)`` int64.
    """
    pixels = np.arange(width * height).reshape(height, width)
    rows = layout.CONSTANT["STRIP_ROWS"]
    strips = [pixels[top : top + rows].T.ravel() for top in range(0, height, rows)]
    return np.concatenate(strips)


def off_surfaces(origin: np.ndarray, forward: np.ndarray, surfaces: np.ndarray) -> np.ndarray:
    """Return a camera's place, moved off the triangles that it lies on.

    A ray that starts on a triangle may meet it or not, as rounding has it.  Like rays that leave a
    surface it is to start on the side that it goes to: here the side that the camera looks to.

    Args:
        origin, forward: ``(3,)``, world; m and unit.
        surfaces: ``(n,)`` layout.SURFACE.
    """
    place = np.asarray(origin, np.float64)
    normals = surfaces["ng"].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        away = ((place - surfaces["p0"]) * normals).sum(axis=1)
        near = np.flatnonzero(np.abs(away) <= surfaces["offset"])
    for triangle in near:
        surface, normal = surfaces[triangle], normals[triangle]
        edges = np.stack([surface["e1"], surface["e2"], normal]).astype(np.float64)
        if np.linalg.matrix_rank(edges) < 3:
            continue
        u, v, _ = np.linalg.solve(edges.T, place - surface["p0"])
        if min(u, v, 1.0 - u - v) < -1e-4:
            continue
        side = 1.0 if normal @ np.asarray(forward, np.float64) >= 0.0 else -1.0
        distance = (place - surface["p0"]) @ normal
        place = place + normal * (2.0 * side * float(surface["offset"]) - distance)
    return place


def camera_values(camera: Camera, width: int, height: int) -> dict[str, object]:
    """Return the camera's fields of layout.PARAMS."""
    matrix = camera.transform
    scale_y = camera.height / 2 or math.tan(camera.fov_y / 2)
    if not (np.isfinite(matrix).all() and math.isfinite(scale_y) and scale_y > 0):
        raise InputError(
            f"camera {camera.name!r}: expected a finite position and a field of view below 180"
        )
    return {
        "camera_origin": matrix[:3, 3],
        "camera_right": matrix[:3, 0],
        "camera_up": matrix[:3, 1],
        "camera_forward": -matrix[:3, 2],
        "lens_radius": camera.lens_radius,
        "focus_distance": camera.focus_distance,
        "film_scale_x": scale_y * width / height,
        "film_scale_y": scale_y,
    }
