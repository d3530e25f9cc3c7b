"""Scenes of psf_cl as scenes of Mitsuba 3, and where the two do not mean the same.

Set Mitsuba's variant before the first call.  Mitsuba is no dependency of psf_cl.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from psf_cl import tables
from psf_cl.scene import transform
from psf_cl.scene.model import (
    Environment,
    Light,
    Material,
    Scene,
    Shape,
    Texture,
    emits,
    has_layers,
    is_cut_out,
    lets_through,
    shines,
)

# Texels of a cut-out's mask along one of the texture: Mitsuba would blend what is cut off here.
MASK_OVERSAMPLING = 4

# Mitsuba's microfacets take no alpha of 0; psf_cl draws roughness 0 with this one.
SHARPEST_ALPHA = 1e-3

# Roughness up to which light between facets, which is lost in Mitsuba, is 3e-3 of it at most.
LITTLE_LOSS = 0.2


def set_variant(name: str | None = None) -> str:
    """Choose Mitsuba's variant: ``name``, or the fastest that can run; returns its name."""
    fast = "llvm_ad_rgb" if os.environ.get("DRJIT_LIBLLVM_PATH") else "scalar_rgb"
    mi.set_variant(name or fast)
    return mi.variant()


def lambertian(scene: Scene) -> Scene:
    """Return the scene with opaque Lambertian materials and without shading normals."""
    materials = tuple(
        replace(m, specular=0.0, metallic=0.0, transmission=0.0) for m in scene.materials
    )
    return flat(opaque(replace(scene, materials=materials)))


def opaque(scene: Scene) -> Scene:
    """Return the scene without cut-outs."""
    return replace(scene, materials=tuple(replace(m, alpha_mode="opaque") for m in scene.materials))


def plain(scene: Scene) -> Scene:
    """Return the scene with materials that Mitsuba's own plugins have too, and without cut-outs.

    These are matt ones without a coat, metals and clear glass.
    """
    materials = tuple(
        m if m.metallic == 1.0 or _is_clear(m) else replace(m, specular=0.0, metallic=0.0)
        for m in scene.materials
    )
    return opaque(replace(scene, materials=materials))


def flat(scene: Scene) -> Scene:
    """Return the scene without shading normals: what they mean near the horizon is a choice."""
    shapes = tuple(replace(s, mesh=replace(s.mesh, normals=None)) for s in scene.shapes)
    return replace(scene, shapes=shapes)


def differences(scene: Scene, own_materials: bool = False) -> list[str]:
    """Return what will not look the same in ``mitsuba_scene``, a few words each."""
    used = [scene.materials[i] for i in sorted({s.material for s in tables.visible_shapes(scene)})]
    textures = [
        scene.textures[i]
        for m in used
        for i in (m.base_color_texture, m.emission_texture)
        if i >= 0
    ]
    found = {
        "reflection other than Lambertian": own_materials and any(not _is_diffuse(m) for m in used),
        "rough metal or glass (Mitsuba loses light between facets)": any(map(_loses_light, used)),
        "clear coats, sheen, stretched or coloured highlights": any(map(has_layers, used)),
        "thin-walled glass": any(lets_through(m) and m.thin_walled for m in used),
        "normal maps": any(m.normal_texture >= 0 for m in used),
        "vertex colours": any(s.mesh.colors is not None for s in tables.visible_shapes(scene)),
        "alpha masks (Mitsuba's shadow rays do not see through them)": any(map(is_cut_out, used)),
        "emission on both sides": any(emits(m) and m.double_sided for m in used),
        "shading normals": any(s.mesh.normals is not None for s in tables.visible_shapes(scene)),
        "textures that wrap differently in u and v": any(len(set(t.wrap)) > 1 for t in textures),
        "spot lights or lights with a range": any(
            shines(x) and (x.kind == "spot" or x.range != math.inf) for x in scene.lights
        ),
    }
    return [what for what, there in found.items() if there]


def mitsuba_scene(
    scene: Scene,
    max_depth: int,
    roulette_depth: int,
    own_materials: bool = False,
    bsdf: dict[str, Any] | None = None,
) -> Any:
    """Return the scene in Mitsuba, its integrator the path tracer.

    Args:
        max_depth: bounces; Mitsuba's own counts the path's segments.
        roulette_depth: bounces before roulette, as psf_cl counts: Mitsuba's ``rr_depth`` less 1.
        own_materials: whether Mitsuba's own plugins are to come close to materials other than
            Lambertian, instead of psf_cl's BSDF written for Mitsuba.
        bsdf: a plugin for all surfaces, in place of their materials.
    """
    content: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "path",
            "max_depth": max_depth + 1,
            "rr_depth": roulette_depth + 1,
        },
        "sensor": _sensor(scene),
    }
    # psf_cl has one tree over all triangles; one mesh a material is the closest thing.
    groups: dict[tuple[int, bool], list[Shape]] = defaultdict(list)
    for shape in tables.visible_shapes(scene):
        groups[shape.material, shape.mesh.normals is not None].append(shape)
    for index, ((material, _), shapes) in enumerate(groups.items()):
        content[f"mesh_{index}"] = _mesh(
            shapes, scene.materials[material], scene.textures, own_materials, bsdf
        )
    for index, light in enumerate(filter(shines, scene.lights)):
        content[f"light_{index}"] = _light(light)
    if scene.environment.image is not None:
        content["sky"] = _image_sky(scene.environment)
    elif max(scene.environment.radiance) > 0.0:
        content["sky"] = {"type": "constant", "radiance": _rgb(scene.environment.radiance)}
    return mi.load_dict(content)


def _sensor(scene: Scene) -> dict[str, Any]:
    camera = scene.cameras[scene.camera]
    # Mitsuba's cameras look along +Z and have +X on their left.
    turned = camera.transform @ np.diag([-1.0, 1.0, -1.0, 1.0])
    sensor: dict[str, Any] = {
        "type": "thinlens" if camera.lens_radius > 0.0 else "perspective",
        "fov": math.degrees(camera.fov_y),
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f(turned),
        "film": {
            "type": "hdrfilm",
            "width": scene.width,
            "height": scene.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }
    if camera.lens_radius > 0.0:
        sensor |= {"aperture_radius": camera.lens_radius, "focus_distance": camera.focus_distance}
    return sensor


def _rgb(values: Sequence[float]) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) for value in values]}


def _light(light: Light) -> dict[str, Any]:
    if light.kind == "directional":
        return {
            "type": "directional",
            "direction": list(light.direction),
            "irradiance": _rgb(light.intensity),
        }
    if light.kind == "point":
        return {
            "type": "point",
            "position": list(light.position),
            "intensity": _rgb(light.intensity),
        }
    target = np.add(light.position, light.direction)
    up = np.eye(3)[np.argmin(np.abs(light.direction))]
    return {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at(list(light.position), list(target), list(up)),
        "intensity": _rgb(light.intensity),
        "cutoff_angle": math.degrees(light.outer_angle),
        "beam_width": math.degrees(light.inner_angle),
    }


def _image_sky(environment: Environment) -> dict[str, Any]:
    """Return the sky; both renderers have -Z in the middle of its first column.

    Mitsuba has the first and the last row at the poles, and not half a texel from them.
    """
    placed = np.eye(4)
    placed[:3, :3] = environment.rotation
    radiance = environment.image * np.asarray(environment.radiance, np.float32)
    rows = len(radiance)
    place = np.clip(np.linspace(-0.5, rows - 0.5, rows), 0.0, rows - 1.0)
    low = np.floor(place).astype(int)
    part = (place - low).astype(np.float32)[:, None, None]
    radiance = radiance[low] * (1.0 - part) + radiance[np.minimum(low + 1, rows - 1)] * part
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(radiance, np.float32)),
        "to_world": mi.ScalarTransform4f(placed),
    }


def _loses_light(material: Material) -> bool:
    return (material.metallic > 0.0 or lets_through(material)) and material.roughness > LITTLE_LOSS


def _is_clear(material: Material) -> bool:
    return material.metallic == 0.0 and material.transmission == material.specular == 1.0


def _is_diffuse(material: Material) -> bool:
    return material.specular == material.metallic == material.transmission == 0.0


def _bsdf(material: Material, textures: tuple[Texture, ...], own: bool) -> dict[str, Any]:
    bsdf = _own_bsdf(material, textures) if own or _is_diffuse(material) else None
    if bsdf is None:
        import mitsuba_bsdf  # Needs the variant, which is set by now.

        bsdf = {
            "type": mitsuba_bsdf.NAME,
            "base_color": _colour(material.base_color, material.base_color_texture, textures),
            "metallic": material.metallic,
            "specular": material.specular,
            "transmission": material.transmission,
            "ior": material.ior,
            "roughness": material.roughness,
        }
    if is_cut_out(material):
        bsdf = {"type": "mask", "opacity": _mask(material, textures), "bsdf": bsdf}
    return bsdf


def _own_bsdf(material: Material, textures: tuple[Texture, ...]) -> dict[str, Any]:
    """Return the plugin of Mitsuba that comes closest, and of those the fastest.

    Its ``roughplastic`` is not among them: it gives back a third of what a rough white coat should.
    """
    color = _colour(material.base_color, material.base_color_texture, textures)
    alpha = max(material.roughness**2, SHARPEST_ALPHA)
    microfacets = {"distribution": "ggx", "alpha": alpha}
    if _is_clear(material):
        glass = {"int_ior": material.ior, "specular_transmittance": color}
        if material.roughness > 0.0:
            glass |= {"type": "roughdielectric", **microfacets}
        else:
            glass |= {"type": "dielectric"}
        bsdf: dict[str, Any] = glass
    elif _is_diffuse(material):
        bsdf = {"type": "diffuse", "reflectance": color}
    elif (
        material.metallic == 1.0
        and min(material.base_color) == 1.0
        and material.base_color_texture < 0
    ):
        bsdf = {"type": "roughconductor", "material": "none", "specular_reflectance": color}
        bsdf |= microfacets
    else:
        bsdf = {
            "type": "principled",
            "base_color": color,
            "metallic": material.metallic,
            "roughness": material.roughness,
            "spec_trans": material.transmission,
            "eta": material.ior,
        }
    if material.transmission == 0.0 or material.metallic == 1.0:
        bsdf = {"type": "twosided", "bsdf": bsdf}
    return bsdf


def _colour(factor: Sequence[float], texture: int, textures: tuple[Texture, ...]) -> dict[str, Any]:
    if texture < 0:
        return _rgb(factor)
    image = textures[texture]
    linear = image.pixels[..., :3].astype(np.float32) / 255.0
    if image.srgb:
        linear = tables.srgb_to_linear()[image.pixels[..., :3]]
    return _bitmap((linear * np.float32(factor)).astype(np.float32), image)


def _bitmap(pixels: np.ndarray, texture: Texture, filter_type: str | None = None) -> dict[str, Any]:
    nearest = {"linear": "bilinear", "nearest": "nearest"}[texture.filter]
    return {
        "type": "bitmap",
        # Its v grows upwards, that of psf_cl downwards.
        "bitmap": mi.Bitmap(np.ascontiguousarray(pixels)),
        "raw": True,
        "filter_type": filter_type or nearest,
        "wrap_mode": texture.wrap[0],
    }


def _mask(material: Material, textures: tuple[Texture, ...]) -> dict[str, Any]:
    """Return where the interpolated alpha reaches the cutoff, as 0 and 1."""
    texture = textures[material.base_color_texture]
    alpha = texture.pixels[..., 3].astype(np.float32) / 255.0 * material.alpha
    if texture.filter == "linear":
        alpha = _enlarged(_enlarged(alpha, 0), 1)
    there = (alpha >= material.alpha_cutoff).astype(np.float32)
    return _bitmap(there[..., None], texture, "nearest")


def _enlarged(values: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate ``values`` linearly at MASK_OVERSAMPLING times as many texel centres."""
    count = values.shape[axis]
    at = (np.arange(count * MASK_OVERSAMPLING) + 0.5) / MASK_OVERSAMPLING - 0.5
    low = np.floor(at).astype(int)
    share = (at - low).reshape([-1 if k == axis else 1 for k in range(2)])
    first = np.take(values, low, axis, mode="wrap")
    second = np.take(values, low + 1, axis, mode="wrap")
    return first + (second - first) * share


def _mesh(
    shapes: list[Shape],
    material: Material,
    textures: tuple[Texture, ...],
    own_materials: bool,
    bsdf: dict[str, Any] | None,
) -> Any:
    """Return shapes of one material as one mesh, all with shading normals or all without."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf or _bsdf(material, textures, own_materials))
    if emits(material):
        radiance = _colour(material.emission, material.emission_texture, textures)
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": radiance})
    positions, normals, uvs, faces, count = [], [], [], [], 0
    for shape in shapes:
        mesh, linear = shape.mesh, shape.transform[:3, :3]
        triangles = mesh.triangles
        if np.linalg.det(linear) < 0.0:
            triangles = triangles[:, ::-1]
        positions.append(transform.transform_points(shape.transform, mesh.positions))
        if mesh.normals is not None:
            turned = mesh.normals @ np.linalg.inv(linear)
            normals.append(turned / np.linalg.norm(turned, axis=1, keepdims=True))
        uvs.append(np.zeros((len(mesh.positions), 2)) if mesh.uvs is None else mesh.uvs)
        faces.append(triangles.astype(np.int64) + count)
        count += len(mesh.positions)
    all_faces = np.concatenate(faces)
    mesh = mi.Mesh(
        material.name or "mesh",
        count,
        len(all_faces),
        props=properties,
        has_vertex_normals=bool(normals),
        has_vertex_texcoords=True,
    )
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.concatenate(positions).astype(np.float32).ravel()
    values["vertex_texcoords"] = np.concatenate(uvs).astype(np.float32).ravel()
    if normals:
        values["vertex_normals"] = np.concatenate(normals).astype(np.float32).ravel()
    values["faces"] = all_faces.astype(np.uint32).ravel()
    values.update()
    return mesh
