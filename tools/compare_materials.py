"""Compare materials with Mitsuba's plugins, on a sphere and a slab under a sky with a gradient.

    python tools/compare_materials.py [--only WORD] [--spp 64] [--seeds 8] [--size 128x128]

The same triangles, without shading normals, and the same sky; seeds are independent, so the noise
is measured.  Where a row says that the models coincide, the comparison passes or fails as
``tools/compare_mitsuba.py`` does; where they do not, it shows how far apart they are, and why.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from compare_mitsuba import MIN_SEEDS, agreement, render_mitsuba, render_ours
from mitsuba_scene import SHARPEST_ALPHA, flat, set_variant
from rich.console import Console
from rich.table import Table

from psf_cl.cli.common import positive_integer, size_argument
from psf_cl.errors import DeviceError, InputError
from psf_cl.scene.model import Camera, Environment, Material, Scene, Shape
from psf_cl.scene.primitives import box, sphere
from psf_cl.scene.transform import look_at, scaling
from psf_cl.settings import resolve

WHITE = (1.0, 1.0, 1.0)
GOLD = (1.0, 0.77, 0.34)
BLUE = (0.2, 0.4, 0.9)

#: Roughness up to which a facet's light meets no second one: 3e-4 are lost at 0.1, 3e-3 at 0.2.
LEAST_LOSS = 0.1


@dataclass(frozen=True)
class Case:
    """A material, its counterpart, and what of them is not the same; nothing if they coincide."""

    name: str
    material: Material
    plugin: dict[str, Any]
    differs: str = ""
    shapes: tuple[str, ...] = field(default=("sphere", "slab"))


def _microfacets(roughness: float) -> dict[str, Any]:
    return {"distribution": "ggx", "alpha": max(roughness**2, SHARPEST_ALPHA)}


def _rgb(color: Sequence[float]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(color)}


def cases() -> list[Case]:
    """Return what is compared."""
    found = []
    facets = "light that meets a second facet is lost there, and given back here"
    for roughness in (0.0, 0.1, 0.2, 0.5, 1.0):
        found.append(
            Case(
                f"roughconductor, white, {roughness}",
                Material(metallic=1.0, base_color=WHITE, roughness=roughness),
                _two_sided(
                    {"type": "roughconductor", "material": "none"} | _microfacets(roughness)
                ),
                facets if roughness > LEAST_LOSS else "",
            )
        )
    found.append(
        Case(
            "roughconductor, gold, 0.2",
            Material(metallic=1.0, base_color=GOLD, roughness=0.2),
            _two_sided(
                {
                    "type": "roughconductor",
                    "material": "none",
                    "specular_reflectance": _rgb(GOLD),
                    **_microfacets(0.2),
                }
            ),
            "its tint is the same at all angles; here it goes to white at the edge (Schlick)",
        )
    )
    for ior in (1.33, 1.5, 2.4):
        glass = Material(base_color=WHITE, transmission=1.0, roughness=0.0, ior=ior)
        clear = {"type": "dielectric", "int_ior": ior}
        found.append(Case(f"dielectric, {ior}", glass, clear, shapes=("sphere",)))
        sharp = f"facets of alpha {SHARPEST_ALPHA} turn what goes to and fro inside for 32 bounces"
        found.append(Case(f"dielectric, {ior}", glass, clear, sharp, ("slab",)))
        rough = {"type": "roughdielectric", "int_ior": ior} | _microfacets(0.0)
        found.append(Case(f"roughdielectric, {ior}, 0.0", glass, rough))
        found.append(
            Case(
                f"thindielectric, {ior}",
                replace(glass, thin_walled=True),
                {"type": "thindielectric", "int_ior": ior},
            )
        )
    for roughness in (0.1, 0.2, 0.5, 1.0):
        found.append(
            Case(
                f"roughdielectric, 1.5, {roughness}",
                Material(base_color=WHITE, transmission=1.0, roughness=roughness),
                {"type": "roughdielectric", "int_ior": 1.5} | _microfacets(roughness),
                facets if roughness > LEAST_LOSS else "",
            )
        )
    matt = Material(base_color=BLUE, specular=0.0)
    found.append(Case("diffuse", matt, _two_sided({"type": "diffuse", "reflectance": _rgb(BLUE)})))
    for roughness in (0.1, 0.3, 0.7):
        found.append(
            Case(
                f"principled, plastic, {roughness}",
                Material(base_color=BLUE, roughness=roughness),
                _two_sided(
                    {
                        "type": "principled",
                        "base_color": _rgb(BLUE),
                        "roughness": roughness,
                        "specular": 0.5,
                    }
                ),
                "its base is Disney's retro-reflective one and not coupled to its coat",
            )
        )
        found.append(
            Case(
                f"principled, metal, {roughness}",
                Material(base_color=GOLD, metallic=1.0, roughness=roughness),
                _two_sided(
                    {
                        "type": "principled",
                        "base_color": _rgb(GOLD),
                        "metallic": 1.0,
                        "roughness": roughness,
                    }
                ),
                facets if roughness > LEAST_LOSS else "",
            )
        )
    found.append(
        Case(
            "principled, clear coat",
            Material(base_color=BLUE, roughness=0.7, clearcoat=1.0, clearcoat_roughness=0.1),
            _two_sided(
                {
                    "type": "principled",
                    "base_color": _rgb(BLUE),
                    "roughness": 0.7,
                    "specular": 0.5,
                    "clearcoat": 1.0,
                    "clearcoat_gloss": 0.95,
                }
            ),
            "its coat has a quarter of a coat's strength, GTR1 facets, and takes no light away",
        )
    )
    found.append(
        Case(
            "principled, sheen",
            Material(base_color=BLUE, roughness=0.9, sheen_color=WHITE, sheen_roughness=0.5),
            _two_sided(
                {
                    "type": "principled",
                    "base_color": _rgb(BLUE),
                    "roughness": 0.9,
                    "specular": 0.5,
                    "sheen": 1.0,
                }
            ),
            "its sheen is Schlick's edge alone; here it is a fibre lobe with a roughness",
        )
    )
    return found


def _two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}


def scene_of(shape: str, material: Material, size: tuple[int, int]) -> Scene:
    """Return a sphere or a slab of ``material`` in front of the sky."""
    if shape == "sphere":
        mesh, placed = sphere(), np.eye(4)
    else:
        mesh, placed = box(), scaling((1.0, 1.0, 0.2))
    camera = Camera(
        look_at((1.2, 0.9, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), np.radians(36.0).item()
    )
    return flat(
        Scene(
            path=f"{shape} of {material.name}",
            cameras=(camera,),
            shapes=(Shape(shape, mesh, placed, 0),),
            materials=(material,),
            environment=Environment((1.0, 1.0, 1.0), sky()),
            width=size[0],
            height=size[1],
        )
    )


def sky(width: int = 1024, height: int = 512) -> np.ndarray:
    """Return a sky, ``(height, width, 3)``: brighter upwards, warmer on one side.

    It is fine, because Mitsuba has the first and last row of its texels at the poles.
    """
    v, u = np.meshgrid(
        (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij"
    )
    up = 0.5 + 0.5 * np.cos(np.pi * v)
    side = 0.5 + 0.5 * np.cos(2.0 * np.pi * u) * np.sin(np.pi * v)
    image = np.stack([0.2 + 0.8 * up * side, 0.2 + 0.7 * up, 0.3 + 0.6 * up * (1 - side)], axis=-1)
    return image.astype(np.float32)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare; return 1 if models that coincide do not agree."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", metavar="WORD", help="cases whose name has it")
    parser.add_argument("--spp", type=positive_integer, default=64, help="for each seed (64)")
    parser.add_argument("--seeds", type=positive_integer, default=MIN_SEEDS)
    parser.add_argument("--size", metavar="WxH", type=size_argument, default=(128, 128))
    args = parser.parse_args(arguments)
    if args.seeds < MIN_SEEDS:
        parser.error(f"--seeds: expected at least {MIN_SEEDS}: the noise is measured between seeds")
    set_variant()
    table = Table("material", "shape", "mean r g b", "+-", "blocks > 3 sigma", "", "what differs")
    passed = True
    for case in cases():
        if args.only not in case.name:
            continue
        for shape in case.shapes:
            scene = scene_of(shape, case.material, args.size)
            settings = resolve({}, scene.path, overrides={"max_depth": 32, "roulette_depth": 32})
            ours = render_ours(scene, settings, args.spp, args.seeds)
            result = agreement(
                ours, render_mitsuba(scene, settings, args.spp, args.seeds, case.plugin)
            )
            verdict = "differs" if case.differs else "pass" if result.passed else "FAIL"
            passed &= verdict != "FAIL"
            table.add_row(
                case.name,
                shape,
                " ".join(f"{value:.4f}" for value in result.ratio),
                f"{result.ratio_sigma:.4f}",
                f"{result.outside} of {result.z.size}",
                verdict,
                case.differs,
            )
            ratio = " ".join(f"{value:.4f}" for value in result.ratio)
            print(f"{case.name}, {shape}: {verdict}, {ratio}", file=sys.stderr)
    Console(width=max(140, Console().width)).print(table)
    return 0 if passed else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, DeviceError) as error:
        sys.exit(f"compare_materials: {error}")
