"""Read the material files of OBJ: each statement becomes what comes nearest to it here.

Sources: Wavefront, "Object Files" and "MTL Material Format", 1995; Pr, Pm and norm as widespread
extensions write them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import decoded_text, read_file
from psf_cl.scene.model import MAX_RADIANCE, Material, Texture, limited
from psf_cl.scene.texture import load_texture

#: Models of ``illum`` in which light goes through.
_GLASS = (4, 6, 7, 9)

#: Options before the name of a picture, and how many words may follow each.
_OPTIONS = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-bm": 1,
    "-cc": 1,
    "-clamp": 1,
    "-colorspace": 1,
    "-imfchan": 1,
    "-mm": 2,
    "-o": 3,
    "-s": 3,
    "-t": 3,
    "-texres": 1,
    "-type": 1,
}
#: Those whose words are numbers, of which the last ones may be left out.
_NUMBERS = ("-mm", "-o", "-s", "-t")
_LIKE_A_NUMBER = re.compile(r"[+-]?[\d.]+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class Picture:
    """A statement that names a picture.

    Attributes:
        options: words of the options, by their names.
    """

    name: str
    options: dict[str, list[str]]

    def numbers(self, option: str, default: float, count: int = 1) -> list[float]:
        """Return ``count`` finite numbers of an option."""
        words = [*self.options.get(option, []), *[""] * count][:count]
        found = [_number(word) for word in words]
        return [default if number is None else number for number in found]


@dataclass
class MaterialLibrary:
    """The materials that the libraries of an OBJ file define.

    Attributes:
        path: of the OBJ file: names are relative to its folder.
        lost: why textures are left out, one reason each.
    """

    path: Path
    materials: dict[str, Material] = field(default_factory=dict)
    textures: list[Texture] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    _pictures: dict[str, np.ndarray | None] = field(default_factory=dict)
    _uses: dict[tuple[object, ...], int] = field(default_factory=dict)

    def read(self, names: Iterable[str]) -> None:
        """Add the materials of some files; those that cannot be read are noted.

        If none can, the file of the OBJ's own name stands in: both get new names together.

        Raises:
            InputError: a colour is not finite.
        """
        lost = [reason for name in names if (reason := self._read(name))]
        if not lost:
            return
        note = f"materials are left out: {listed(lost)}"
        own = self.path.with_suffix(".mtl").name
        if not self.files and not self._read(own):
            note += f"; {own} is read instead"
        self.notes.append(note)

    def _read(self, name: str) -> str:
        """Add the materials of a file; return why it cannot be read, "" if it can."""
        try:
            place = self._place(name)
            text = decoded_text(read_file(place))
        except InputError as error:
            return str(error)
        self.files.append(str(place))
        for material_name, statements in _blocks(text):
            self.materials[material_name] = self._material(material_name, statements)
        return ""

    def texture(self, picture: Picture, srgb: bool = True) -> int:
        """Return the index of the texture of a picture, -1 if it cannot be read."""
        pixels = self.pixels(picture.name)
        return -1 if pixels is None else self._add(picture, pixels, srgb)

    def pixels(self, name: str) -> np.ndarray | None:
        """Return the texels of a picture, read once; None if that fails."""
        if name not in self._pictures:
            try:
                place = self._place(name)
                self._pictures[name] = load_texture(place).pixels
                self.files.append(str(place))
            except InputError as error:
                self.lost.append(str(error))
                self._pictures[name] = None
        return self._pictures[name]

    def _place(self, name: str) -> Path:
        """Return where in the folder of the OBJ file a name points to.

        Names from other machines often start with folders that are not here: what is not there, or
        elsewhere, is looked for beside the OBJ file.

        Raises:
            InputError: it would be outside of the folder.
        """
        name = name.replace("\\", "/")
        folder = self.path.parent
        try:
            inside = (folder / name).resolve().is_relative_to(folder.resolve())
            if inside and (folder / name).is_file():
                return folder / name
            beside = folder / name.rpartition("/")[2]
            if beside.is_file() and not beside.is_symlink():
                return beside
        except (OSError, ValueError, RuntimeError):  # names that no file can have; loops of links
            inside = True
        if not inside:
            raise InputError(f"{name}: expected a file inside the folder of {self.path.name}")
        return folder / name

    def _add(self, picture: Picture, pixels: np.ndarray, srgb: bool) -> int:
        scale, offset = picture.numbers("-s", 1.0, 2), picture.numbers("-o", 0.0, 2)
        clamp = picture.options.get("-clamp", ["off"])[:1] == ["on"]
        # v grows upwards in OBJ and downwards here.
        matrix = (scale[0], 0.0, offset[0], 0.0, scale[1], 1.0 - scale[1] - offset[1])
        key = (id(pixels), srgb, clamp, matrix)
        if key not in self._uses:
            self._uses[key] = len(self.textures)
            wrap = ("clamp", "clamp") if clamp else ("repeat", "repeat")
            self.textures.append(Texture(picture.name, pixels, srgb, wrap, transform=matrix))
        return self._uses[key]

    def _material(self, name: str, statements: dict[str, str]) -> Material:
        colors = {key: self._color(name, key, statements) for key in ("Kd", "Ks", "Ke", "Tf")}
        pictures = {
            key: _picture(statements[key])
            for key in ("map_Kd", "map_Ke", "map_d", "map_bump", "norm")
            if statements.get(key)
        }
        material = Material(name=name)
        if colors["Kd"] is not None:
            material = replace(material, base_color=_at_most_1(colors["Kd"]))
        material = _with_gloss(material, colors["Ks"], statements)
        if "map_Kd" in pictures:
            index = self.texture(pictures["map_Kd"])
            material = replace(material, base_color_texture=index)
        material = self._with_emission(material, colors["Ke"], pictures.get("map_Ke"))
        material = self._with_opacity(material, colors["Tf"], statements, pictures)
        return self._with_bumps(material, pictures)

    def _color(
        self, name: str, key: str, statements: dict[str, str]
    ) -> tuple[float, float, float] | None:
        """Return the RGB of ``r g b`` or ``r``; None if it is absent, malformed or negative."""
        words = statements.get(key, "").split()[:3]
        try:
            values = [float(word) for word in words]
        except ValueError:
            return None
        if len(values) == 1:
            values *= 3
        if len(values) != 3 or any(value < 0 for value in values):
            return None
        if not all(map(math.isfinite, values)):
            got = statements[key][:60]
            raise InputError(
                f"{self.path}: material {name}: {key}: expected finite numbers; got {got}"
            )
        return values[0], values[1], values[2]

    def _with_emission(
        self,
        material: Material,
        color: tuple[float, float, float] | None,
        picture: Picture | None,
    ) -> Material:
        index = -1 if picture is None else self.texture(picture)
        if color is None:
            color = (0.0, 0.0, 0.0) if index < 0 else (1.0, 1.0, 1.0)
        if max(color) > MAX_RADIANCE:
            note = f"{self.path}: Ke of {material.name} above {MAX_RADIANCE:g} is set to that"
            self.notes.append(note)
        return replace(material, emission=limited(color), emission_texture=index)

    def _with_opacity(
        self,
        material: Material,
        filter_color: tuple[float, float, float] | None,
        statements: dict[str, str],
        pictures: dict[str, Picture],
    ) -> Material:
        # Files with both mean d: some exporters write Tr with the same value.
        opacity = _number(statements.get("d", "").replace("-halo", "").strip())
        if opacity is None:
            opacity = 1.0 - (_number(statements.get("Tr", "")) or 0.0)
        opacity = min(max(opacity, 0.0), 1.0)
        if _number(statements.get("illum", "")) in _GLASS and opacity < 1.0:
            # Black is what many glasses have as their diffuse colour.
            color = material.base_color if max(material.base_color) > 0.0 else (1.0, 1.0, 1.0)
            if filter_color is not None and max(filter_color) > 0.0:
                color = _at_most_1(filter_color)
            roughness = material.roughness if "Ns" in statements or "Pr" in statements else 0.0
            return replace(
                material,
                base_color=color,
                transmission=1.0 - opacity,
                roughness=roughness,
                metallic=0.0,
            )
        if opacity < 1.0:
            material = replace(material, alpha=opacity, alpha_mode="blend")
        picture = pictures.get("map_d")
        mask = None if picture is None else self.pixels(picture.name)
        if picture is None or mask is None:
            return material
        shown = pictures.get("map_Kd", picture)
        base = self.pixels(shown.name) if material.base_color_texture >= 0 else None
        pixels = _with_alpha(base, _coverage(mask))
        smooth = bool(((pixels[..., 3] > 0) & (pixels[..., 3] < 255)).any()) or opacity < 1.0
        return replace(
            material,
            base_color_texture=self._add(shown, pixels, True),
            alpha_mode="blend" if smooth else "mask",
        )

    def _with_bumps(self, material: Material, pictures: dict[str, Picture]) -> Material:
        picture = pictures.get("norm") or pictures.get("map_bump")
        pixels = None if picture is None else self.pixels(picture.name)
        if picture is None or pixels is None:
            return material
        (strength,) = picture.numbers("-bm", 1.0)
        if "norm" not in pictures and not _is_normal_map(pixels):
            key = f"heights of {picture.name}"
            if key not in self._pictures:
                self._pictures[key] = normals_of_heights(pixels)
            pixels = self._pictures[key]
        index = self._add(picture, pixels, False)
        return replace(material, normal_texture=index, normal_scale=strength)


def listed(items: list[str]) -> str:
    """Return the first items in one line, and how many more there are."""
    more = f" and {len(items) - 3} more" if len(items) > 3 else ""
    return ", ".join(items[:3]) + more


def _blocks(text: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield each material's name and statements; of those that come twice the last one counts."""
    same = {"bump": "map_bump", "map_bump": "map_bump", "kn": "norm", "norm": "norm"}
    same |= {key.lower(): key for key in ("Kd", "Ks", "Ke", "Tf", "Ns", "Ni", "Pr", "Pm", "d")}
    same |= {key.lower(): key for key in ("Tr", "illum", "map_Kd", "map_Ke", "map_d")}
    name, statements = "", dict[str, str]()
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        keyword, _, rest = line.strip().replace("\t", " ").partition(" ")
        rest = rest.strip()
        if keyword == "newmtl" and rest:
            if name:
                yield name, statements
            name, statements = " ".join(rest.split()), {}
        elif keyword.lower() in same and not keyword.startswith("#"):
            statements[same[keyword.lower()]] = rest
    if name:
        yield name, statements


def _picture(text: str) -> Picture:
    """Take the options and the name of a picture, which may contain spaces, apart."""
    words = text.split(" ")
    options: dict[str, list[str]] = {}
    at = 0
    while at < len(words):
        if not words[at]:
            at += 1
            continue
        option = words[at].lower()
        if option not in _OPTIONS:
            break
        end = at + 1
        while end < len(words) and end - at <= _OPTIONS[option]:
            if option in _NUMBERS and not _LIKE_A_NUMBER.fullmatch(words[end]):
                break
            end += 1
        options[option] = words[at + 1 : end]
        at = end
    # Some files have options behind the name.
    name, _, behind = " ".join(words[at:]).partition(" -")
    more = behind.split()
    if more and f"-{more[0].lower()}" in _OPTIONS:
        options[f"-{more[0].lower()}"] = more[1:]
    elif behind:
        name = f"{name} -{behind}"
    return Picture(name.strip().strip('"').replace("\\", "/"), options)


def _with_gloss(
    material: Material, specular: tuple[float, float, float] | None, statements: dict[str, str]
) -> Material:
    """Return ``material`` with Ks, Ns, Ni, Pr and Pm."""
    strength = 1.0 if specular is None else min(max(specular), 1.0)
    if specular is not None:
        tint = np.array(specular) / max(max(specular), 1e-30)
        if max(material.base_color) < 1e-3 and strength > 0.0 and "map_Kd" not in statements:
            # Black under a mirror: a metal.
            material = replace(material, base_color=_at_most_1(specular), metallic=1.0)
        elif strength > 0.0:
            material = replace(material, specular_color=tuple(tint.tolist()))
    material = replace(material, specular=strength)
    exponent, index = _number(statements.get("Ns", "")), _number(statements.get("Ni", ""))
    if exponent is not None and specular is not None:
        # Lobes as wide as Phong's: alpha^2 = 2 / (Ns + 2) (Walter et al., EGSR 2007, section 5.2).
        alpha = math.sqrt(2.0 / (max(exponent, 0.0) + 2.0))
        material = replace(material, roughness=math.sqrt(alpha))
    # Files without refraction say 1, too.
    if index is not None and index > 1.0:
        material = replace(material, ior=min(index, 100.0))
    for key, name in (("Pr", "roughness"), ("Pm", "metallic")):
        value = _number(statements.get(key, ""))
        if value is not None:
            material = replace(material, **{name: min(max(value, 0.0), 1.0)})
    return material


def _number(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    # On the device it is a float32.
    return value if abs(value) <= MAX_RADIANCE else None


def _at_most_1(color: tuple[float, float, float]) -> tuple[float, float, float]:
    red, green, blue = (min(channel, 1.0) for channel in color)
    return red, green, blue


def _coverage(pixels: np.ndarray) -> np.ndarray:
    """Return ``(h, w)`` uint8: the alpha of a picture that has one, else its grey."""
    if (pixels[..., 3] < 255).any():
        return pixels[..., 3]
    return pixels[..., :3].mean(axis=-1).astype(np.uint8)


def _with_alpha(base: np.ndarray | None, alpha: np.ndarray) -> np.ndarray:
    """Return ``base``, or white, with another alpha, as fine along each axis as the finer one."""
    if base is None:
        base = np.full((1, 1, 4), 255, np.uint8)
    height, width = (int(n) for n in np.maximum(base.shape[:2], alpha.shape))
    pixels = _stretched(base, height, width)
    pixels[..., 3] = _stretched(alpha, height, width)
    return pixels


def _stretched(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    rows = np.arange(height) * pixels.shape[0] // height
    columns = np.arange(width) * pixels.shape[1] // width
    return pixels[rows[:, None], columns[None, :]]


def _is_normal_map(pixels: np.ndarray) -> bool:
    """Return whether a picture that is said to hold heights holds normals: it is blue."""
    red, green, blue = pixels[..., :3].reshape(-1, 3).mean(axis=0)
    return bool(blue > red + 32 and blue > green + 32)


def normals_of_heights(pixels: np.ndarray) -> np.ndarray:
    """Return the normal map of a picture of heights, ``(h, w, 4)`` uint8.

    From black to white it rises by the width of one texel: formats name no unit.
    """
    heights = pixels[..., :3].mean(axis=-1).astype(np.float32) / 255.0
    slope_u = 0.5 * (np.roll(heights, -1, axis=1) - np.roll(heights, 1, axis=1))
    # Rows go downwards, the bitangent goes up.
    slope_v = 0.5 * (np.roll(heights, 1, axis=0) - np.roll(heights, -1, axis=0))
    length = np.sqrt(slope_u**2 + slope_v**2 + 1.0)
    normals = np.full((*heights.shape, 4), 255, np.uint8)
    for channel, part in enumerate((-slope_u, -slope_v, np.ones_like(heights))):
        normals[..., channel] = np.rint((part / length * 0.5 + 0.5) * 255.0)
    return normals
