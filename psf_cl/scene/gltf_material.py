"""Read the materials and textures of a glTF file, each at its first use.

Source: Khronos Group, "glTF 2.0 Specification", section 3.9, and the extensions of materials.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from psf_cl.scene.gltf_file import GltfFile, Item, MissingData
from psf_cl.scene.model import MAX_RADIANCE, Material, Texture, limited
from psf_cl.scene.specular_glossiness import convert_pictures, to_metallic
from psf_cl.scene.texture import decode_pixels
from psf_cl.scene.transform import uv_rows

_WRAP = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_FILTER = {9728: "nearest", 9729: "linear"}


@dataclass
class MaterialReader:
    """The materials in use so far, by first use, and their textures.

    Attributes:
        notes: what was assumed or left out, and how often.
        extensions: names of those that were met; shared with the reader of the scene, as the notes.
    """

    gltf: GltfFile
    notes: Counter[str]
    extensions: set[str]
    materials: list[Material] = field(default_factory=list)
    textures: list[Texture] = field(default_factory=list)
    indices: dict[int | None, int] = field(default_factory=dict)
    uses: dict[tuple[Any, ...], int] = field(default_factory=dict)
    pixels: dict[int, np.ndarray] = field(default_factory=dict)

    def limited(self, radiance: Iterable[float]) -> tuple[float, float, float]:
        """Return an RGB triple with no component above ``MAX_RADIANCE``; that it was is noted."""
        radiance = tuple(radiance)
        if max(radiance) > MAX_RADIANCE:
            self.notes[f"radiance and intensity above {MAX_RADIANCE:g} are set to that"] += 1
        return limited(radiance)

    def index_of(self, index: int | None) -> int:
        """Return the index in the scene of a material of the file; None is glTF's default."""
        if index not in self.indices:
            item = Item(self.gltf.root.file, "material", {})
            if index is not None:
                item = self.gltf.root.element("materials", index)
            material = self._read(item)
            self.indices[index] = len(self.materials)
            self.materials.append(material)
        return self.indices[index]

    def _read(self, item: Item) -> Material:
        empty = Item(item.file, "", {})
        self.extensions.update(item.extension_names())
        surface = item.item("pbrMetallicRoughness")

        def extension(name: str) -> Item:
            return item.extension(f"KHR_materials_{name}") or empty

        emissive, refraction = extension("emissive_strength"), extension("ior")
        transmission, volume = extension("transmission"), extension("volume")
        specular, coat = extension("specular"), extension("clearcoat")
        sheen, anisotropy = extension("sheen"), extension("anisotropy")

        base = surface.numbers("baseColorFactor", (1.0, 1.0, 1.0, 1.0), 0.0, 1.0)
        emission = item.numbers("emissiveFactor", (0.0, 0.0, 0.0), 0.0, 1.0)
        strength = emissive.number("emissiveStrength", 1.0, 0.0)
        alpha_mode = item.text("alphaMode", "OPAQUE")
        if alpha_mode not in ("OPAQUE", "MASK", "BLEND"):
            item.fail("alphaMode", "OPAQUE, MASK or BLEND")
        ior = refraction.number("ior", 1.5, 0.0)
        if 0.0 < ior < 1.0:
            refraction.fail("ior", "0, or a number of at least 1")
        if ior == 0.0:
            self.notes["an ior of 0 is taken as 1.5"] += 1
            ior = 1.5
        distance = math.inf
        if "attenuationDistance" in volume:
            distance = volume.number("attenuationDistance", low=0.0)
            if distance == 0.0:
                volume.fail("attenuationDistance", "a number above 0")
        self._note_ignored(
            (item, "occlusionTexture"),
            (coat, "clearcoatNormalTexture"),
            (volume, "thicknessTexture"),
        )
        normal = item.item("normalTexture")
        material = Material(
            item.text("name", "") or item.place,
            base_color=base[:3],
            base_color_texture=self._texture(surface, "baseColorTexture"),
            alpha=base[3],
            alpha_mode=alpha_mode.lower(),
            alpha_cutoff=item.number("alphaCutoff", 0.5, 0.0),
            metallic=surface.number("metallicFactor", 1.0, 0.0, 1.0),
            roughness=surface.number("roughnessFactor", 1.0, 0.0, 1.0),
            metallic_roughness_texture=self._texture(
                surface, "metallicRoughnessTexture", srgb=False
            ),
            specular=specular.number("specularFactor", 1.0, 0.0, 1.0),
            specular_texture=self._texture(specular, "specularTexture", srgb=False),
            specular_color=self._specular_color(specular),
            specular_color_texture=self._texture(specular, "specularColorTexture"),
            ior=ior,
            transmission=transmission.number("transmissionFactor", 0.0, 0.0, 1.0),
            transmission_texture=self._texture(transmission, "transmissionTexture", srgb=False),
            thin_walled=volume.number("thicknessFactor", 0.0, 0.0) == 0.0,
            attenuation_color=volume.numbers("attenuationColor", (1.0, 1.0, 1.0), 0.0, 1.0),
            attenuation_distance=distance,
            clearcoat=coat.number("clearcoatFactor", 0.0, 0.0, 1.0),
            clearcoat_texture=self._texture(coat, "clearcoatTexture", srgb=False),
            clearcoat_roughness=coat.number("clearcoatRoughnessFactor", 0.0, 0.0, 1.0),
            clearcoat_roughness_texture=self._texture(
                coat, "clearcoatRoughnessTexture", srgb=False
            ),
            sheen_color=sheen.numbers("sheenColorFactor", (0.0, 0.0, 0.0), 0.0, 1.0),
            sheen_color_texture=self._texture(sheen, "sheenColorTexture"),
            sheen_roughness=sheen.number("sheenRoughnessFactor", 0.0, 0.0, 1.0),
            sheen_roughness_texture=self._texture(sheen, "sheenRoughnessTexture", srgb=False),
            anisotropy=anisotropy.number("anisotropyStrength", 0.0, 0.0, 1.0),
            anisotropy_rotation=anisotropy.number("anisotropyRotation", 0.0),
            anisotropy_texture=self._texture(anisotropy, "anisotropyTexture", srgb=False),
            normal_texture=self._texture(item, "normalTexture", srgb=False),
            normal_scale=normal.number("scale", 1.0),
            emission=self.limited(channel * strength for channel in emission),
            emission_texture=self._texture(item, "emissiveTexture") if any(emission) else -1,
            double_sided=item.flag("doubleSided"),
            back_hidden=not item.flag("doubleSided"),
            unlit=item.extension("KHR_materials_unlit") is not None,
        )
        return self._with_approximations(item, material)

    def _with_approximations(self, item: Item, material: Material) -> Material:
        """Return ``material`` with what it has no parameters for put into others, and say so."""
        glossy = item.extension("KHR_materials_pbrSpecularGlossiness")
        if glossy is not None:
            material = self._from_glossiness(glossy, material)
        film = item.extension("KHR_materials_iridescence")
        if film is not None:
            material = self._with_film(film, material)
        through = item.extension("KHR_materials_diffuse_transmission")
        share = 0.0 if through is None else through.number("diffuseTransmissionFactor", 0, 0, 1)
        if share > 0.0 and material.transmission == 0.0:
            self.notes["diffuse transmission is approximated by a rough sheet"] += 1
            color = through.numbers("diffuseTransmissionColorFactor", (1.0, 1.0, 1.0), 0.0, 1.0)
            mixed = (b + (c - b) * share for b, c in zip(material.base_color, color, strict=True))
            material = replace(
                material,
                base_color=tuple(mixed),
                transmission=share,
                thin_walled=True,
                roughness=1.0,
                metallic_roughness_texture=-1,
            )
        dispersion = item.extension("KHR_materials_dispersion")
        if dispersion is not None and dispersion.number("dispersion", 0.0, 0.0) > 0.0:
            self.notes["dispersion is left out: glass bends all colours alike"] += 1
        return material

    def _from_glossiness(self, item: Item, material: Material) -> Material:
        """Return the metallic material of KHR_materials_pbrSpecularGlossiness."""
        self.notes["specular-glossiness materials are turned into metallic ones"] += 1
        diffuse = item.numbers("diffuseFactor", (1.0, 1.0, 1.0, 1.0), 0.0, 1.0)
        specular = item.numbers("specularFactor", (1.0, 1.0, 1.0), 0.0, 1.0)
        glossiness = item.number("glossinessFactor", 1.0, 0.0, 1.0)
        pictures = [
            self._texture(item, key) for key in ("diffuseTexture", "specularGlossinessTexture")
        ]
        if max(pictures) < 0:
            base, metallic = to_metallic(np.array(diffuse[:3]), np.array(specular))
            return replace(
                material,
                base_color=tuple(base.tolist()),
                alpha=diffuse[3],
                metallic=float(metallic),
                roughness=1.0 - glossiness,
            )
        known = [self.textures[index] for index in pictures if index >= 0]
        white = np.full((1, 1, 4), 255, np.uint8)
        colors = [self.textures[index].pixels if index >= 0 else white for index in pictures]
        base_pixels, rough_pixels = convert_pictures(
            colors[0], np.array(diffuse[:3]), colors[1], np.array([*specular, glossiness])
        )
        # Where the two lie otherwise on the surface, that of the diffuse colour holds for both.
        first = len(self.textures)
        self.textures += [
            replace(known[0], pixels=base_pixels),
            replace(known[0], pixels=rough_pixels, srgb=False),
        ]
        return replace(
            material,
            base_color=(1.0, 1.0, 1.0),
            base_color_texture=first,
            alpha=diffuse[3],
            metallic=1.0,
            roughness=1.0,
            metallic_roughness_texture=first + 1,
        )

    def _with_film(self, film: Item, material: Material) -> Material:
        """Return ``material`` in the colour of a thin film as seen from straight above."""
        strength = film.number("iridescenceFactor", 0.0, 0.0, 1.0)
        index = film.number("iridescenceIor", 1.3, 1.0)
        thickness = film.number("iridescenceThicknessMaximum", 400.0, 0.0)
        if strength == 0.0:
            return material
        self.notes["iridescence is approximated: its colour does not change with the angle"] += 1
        bare = np.full(3, ((material.ior - 1.0) / (material.ior + 1.0)) ** 2)
        tint = film_reflectance(bare, index, thickness) / np.maximum(bare, 1e-6)
        tint = 1.0 + (np.minimum(tint, 1.0) - 1.0) * strength
        metal = film_reflectance(np.array(material.base_color), index, thickness)
        share = strength * material.metallic
        base = np.array(material.base_color) * (1.0 - share) + metal * share
        return replace(
            material,
            base_color=tuple(np.clip(base, 0.0, 1.0).tolist()),
            specular_color=tuple((tint * material.specular_color).tolist()),
        )

    def _specular_color(self, specular: Item) -> tuple[float, ...]:
        color = specular.numbers("specularColorFactor", (1.0, 1.0, 1.0), 0.0)
        if max(color) > 1.0:
            self.notes["specularColorFactor above 1 is taken as 1"] += 1
        return tuple(min(channel, 1.0) for channel in color)

    def _note_ignored(self, *keys: tuple[Item, str]) -> None:
        for item, key in keys:
            if key in item:
                self.notes[f"the material property {key} is ignored"] += 1

    def _texture(self, owner: Item, key: str, srgb: bool = True) -> int:
        """Return the index in the scene of the texture that ``owner[key]`` uses, or -1 for none."""
        if key not in owner:
            return -1
        info = owner.item(key)
        self.extensions.update(info.extension_names())
        uv_set = info.integer("texCoord", 0)
        matrix = Texture.transform
        change = info.extension("KHR_texture_transform")
        if change is not None:
            uv_set = change.integer("texCoord", uv_set)
            matrix = _texture_transform(change)
        if uv_set > 1:
            self.notes["textures with texture coordinates beyond TEXCOORD_1 are ignored"] += 1
            return -1
        texture_index = self.gltf.index(info, "index", "textures")
        if texture_index is None:
            info.fail("index", "an index of textures")
        texture = self.gltf.root.element("textures", texture_index)
        image_index = self.gltf.index(texture, "source", "images")
        webp = texture.extension("EXT_texture_webp")
        if webp is not None:
            image_index = self.gltf.index(webp, "source", "images")
        if image_index is None:
            self.notes["textures without an image are ignored"] += 1
            return -1
        wrap, magnification = self._sampler(texture)
        used = (image_index, srgb, wrap, magnification, uv_set, matrix)
        if used not in self.uses:
            image = self.gltf.root.element("images", image_index)
            name = image.text("name", "") or image.place
            try:
                pixels = self._pixels(image_index, image)
            except MissingData:
                self.notes["textures whose buffer has no data are ignored"] += 1
                return -1
            self.uses[used] = len(self.textures)
            self.textures.append(Texture(name, pixels, srgb, wrap, magnification, uv_set, matrix))
        return self.uses[used]

    def _sampler(self, texture: Item) -> tuple[tuple[str, str], str]:
        """Return the wrap modes of u and v, and the filter."""
        index = self.gltf.index(texture, "sampler", "samplers")
        if index is None:
            return ("repeat", "repeat"), "linear"
        sampler = self.gltf.root.element("samplers", index)
        wrap = []
        for key in ("wrapS", "wrapT"):
            number = sampler.integer(key, 10497)
            if number not in _WRAP:
                sampler.fail(key, f"one of {', '.join(str(known) for known in _WRAP)}")
            wrap.append(_WRAP[number])
        number = sampler.integer("magFilter", 9729)
        if number not in _FILTER:
            sampler.fail("magFilter", f"one of {', '.join(str(known) for known in _FILTER)}")
        return (wrap[0], wrap[1]), _FILTER[number]

    def _pixels(self, index: int, image: Item) -> np.ndarray:
        if index not in self.pixels:
            if "uri" in image:
                data = self.gltf.resource(image)
            else:
                view_index = self.gltf.index(image, "bufferView", "bufferViews")
                if view_index is None:
                    image.fail("bufferView", "an index of bufferViews, or a uri")
                data = bytes(self.gltf.view_data(view_index))
            self.pixels[index] = decode_pixels(data, f"{image.file}: {image.place}")
        return self.pixels[index]


def _texture_transform(change: Item) -> tuple[float, ...]:
    """Return the rows of the matrix that KHR_texture_transform describes."""
    offset = change.numbers("offset", (0.0, 0.0))
    scale = change.numbers("scale", (1.0, 1.0))
    return uv_rows(offset, change.number("rotation", 0.0), scale)


def film_reflectance(bare: np.ndarray, index: float, thickness: float) -> np.ndarray:
    """Return what a surface under a thin film in air reflects of light along its normal, ``(3,)``.

    Args:
        bare: ``(3,)``, what the surface reflects without a film.
        index: of refraction, of the film.
        thickness: nm.

    Source: Airy's sum of the light that goes back and forth in the film (Born, Wolf, "Principles of
    Optics", section 7.6.1), at the main wavelengths of the Rec.709 primaries.  Only the reflectance
    of the surface is known: its amplitude is taken as if it were denser than the film.
    """
    wavelengths = np.array([611.0, 549.0, 464.0])
    top = (1.0 - index) / (1.0 + index)
    root = np.sqrt(np.clip(bare, 0.0, 0.9999))
    # The index of the surface in air, and from it the amplitude below the film.
    below_index = (1.0 + root) / (1.0 - root)
    below = (index - below_index) / (index + below_index)
    phase = np.cos(4.0 * np.pi * index * thickness / wavelengths)
    both = top * top + below * below + 2.0 * top * below * phase
    return both / (1.0 + top * top * below * below + 2.0 * top * below * phase)
