"""What the user may choose: one frozen record, checked once, with presets as plain differences.

A setting exists only if something implements it.  Choices are strings, so that a scene file, the
command line and Python spell them alike.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from psf_cl.errors import InputError, shown

#: Environment variable that picks a device by a part of its name.
DEVICE_VARIABLE = "PSF_CL_DEVICE"

#: Images that can be asked for beside the colour, and what is in them.
AOVS = {
    "albedo": "reflectance of the first surface seen",
    "normal": "shading normal there, world space",
    "depth": "distance to it from the camera, meters",
    "direct": "light reflected there once, or emitted there",
    "indirect": "all other light: rgb = direct + indirect",
    "variance": "of the pixel's mean, estimated from its samples",
    "samples": "samples of the pixel",
    "motion": "pixels that what is seen has moved since the frame before: right, down",
    "history": "samples that the pixel is worth, with those of the frames before",
    "alpha": "weight of this frame in it",
    "cells": "a colour for each cell that samples of the first pass looked up",
    "occupancy": "part of the slots taken around the cells that samples looked up",
    "cell_count": "samples in these cells",
    "cell_variance": "of the luminance of these, with the surface's reflectance divided out",
    "filter_weight": "part of the samples that used the average of a cell",
    "bounces": "of the paths, on average",
    "guide": "mean direction that the guide draws at the first surface, world space",
    "guide_entropy": "bits of the part that it draws: 6 as without a guide, 0 for one part",
    "visits": "of paths that its cells there learned from",
    "light_pmf": "mean chance of the light that a shadow ray from the first surface was for",
    "photons": "photons in the cell that it asked, of light_sampling=photon",
    "lights": "groups of lights that these came from",
    "gradient": "change of the light since the frame before, 0 to 1, as probes found it",
}


def _choice(default: str, *others: str, doc: str) -> Any:
    return field(default=default, metadata={"choices": (default, *others), "doc": doc})


def _switch(default: bool, *, doc: str) -> Any:
    return field(default=default, metadata={"switch": True, "doc": doc})


def _number(default: Any, low: Any, high: Any, *, doc: str) -> Any:
    return field(default=default, metadata={"range": (low, high), "doc": doc})


@dataclass(frozen=True)
class Settings:
    """All that changes the estimator.  Anything else (output, device, budget) is not a setting."""

    integrator: str = _choice(
        "path",
        "metropolis",
        doc="independent paths, or chains of paths, each a mutation of the one before",
    )
    chains: int = _number(
        2048, 128, 1 << 22, doc="chains of metropolis, side by side, rounded up to whole blocks"
    )
    large_steps: float = _number(
        0.3, 0.01, 1.0, doc="share of the paths of metropolis that are independent of their chain"
    )
    light_sampling: str = _choice(
        "auto",
        "power",
        "uniform",
        "hierarchy",
        "photon",
        "photon_origin",
        doc="how next event estimation picks an emitter; hierarchy: a tree of lights asks for what "
        "each might bring to a surface; photon: photons tell which of them see it; photon_origin: "
        "and rays go to where these started, to compare: biased in soft shadows; auto: photon "
        "where there are many, else power",
    )
    photons: int = _number(
        0,
        0,
        1 << 28,
        doc="photons before each epoch of light_sampling=photon; 0: by photon_share",
    )
    photon_share: float = _number(
        0.025, 1e-6, 100.0, doc="photons for each ray that the epoch's paths are expected to take"
    )
    photon_cell: float = _number(
        0.1, 1e-6, 1e6, doc="edge of the smallest cells of photons, by the distance to the camera"
    )
    photon_floor: float = _number(
        0.2, 1e-3, 1.0, doc="least share of the shadow rays that go where no photon said so"
    )
    shadow_rays: str = _choice(
        "1",
        *(str(number) for number in range(2, 9)),
        "auto",
        doc="rays to lights from each vertex; auto: of the first as many as photons know groups of "
        "lights, up to 4, of others one",
    )
    indirect_light: str = _choice(
        "paths",
        "virtual_lights",
        doc="light reflected more than once by paths, or by photons that stand for it, to compare: "
        "biased, for they are dimmed where they are near, and lie on matt surfaces alone",
    )
    virtual_clearance: float = _number(
        0.05, 0.0, 1.0, doc="how near that is, radii of the scene; 0 for bright dots"
    )
    direct_sampling: str = _choice(
        "mis", "light", "bsdf", doc="direct light by both strategies, or by one of them alone"
    )
    area_sampling: str = _choice(
        "auto",
        "area",
        "solid_angle",
        doc="how points of lights are drawn: uniformly, or as balls, disks, rectangles are seen; "
        "auto: balls as they are seen",
    )
    texture_level: str = _choice(
        "full",
        "footprint",
        doc="texels behind the first surface: all, or as coarse as paths are apart (biased)",
    )
    material_cache: str = _choice(
        "off",
        "hash_grid",
        doc="what textures give behind the first surface: looked up each time, or once a cell of a "
        "hash grid (biased)",
    )
    material_cell_size: float = _number(
        16.0, 1e-3, 1e6, doc="edge of a cell of material_cache, pixels"
    )
    termination: str = _choice(
        "roulette",
        "off",
        "cache",
        doc="how paths end before max_depth; cache: where it is known what a surface reflects",
    )
    cache_trace: float = _number(
        0.0,
        0.0,
        1.0,
        doc="least chance that they go on all the same, to bring the difference: unbiased; "
        "0: the shortest paths, biased",
    )
    cache_cell_size: float = _number(
        8.0, 1e-3, 1e6, doc="edge of a cell of the radiance cache, pixels"
    )
    roulette_depth: int = _number(
        5, 0, 1 << 20, doc="bounces before Russian roulette may end a path"
    )
    back_faces: str = _choice(
        "hidden",
        "shown",
        doc="whether the camera looks through the backs of materials that are not double-sided",
    )
    max_depth: int = _number(16, 0, 1 << 20, doc="bounces; 0 is what the camera sees directly")
    splits: int = _number(
        1, 1, 1 << 16, doc="samples in a row that see the same point: splitting, to compare"
    )
    split_vertex: int = _number(1, 1, 8, doc="vertex where their paths part, 1 for that point")
    sampler: str = _choice(
        "sobol", "random", doc="Owen-scrambled Sobol' points, or independent numbers"
    )
    guiding: str = _choice(
        "off", "learned", doc="draw directions by what was learned of where light comes from"
    )
    guide_cell_size: float = _number(64.0, 1e-3, 1e6, doc="edge of a cell of the guide, pixels")
    guide_share: float = _number(
        0.75, 0.0, 0.99, doc="part of the directions of a diffuse lobe that the guide draws"
    )
    path_filter: str = _choice(
        "off",
        "hash_grid",
        "range_search",
        doc="share what paths carry beyond a vertex: averages per cell of a hash grid, or over all "
        "close vertices (slow, to compare)",
    )
    filter_vertex: str = _choice(
        "auto",
        *(str(number) for number in range(1, 9)),
        doc="that vertex, 1 for the first surface seen; auto for the first after a wide bounce",
    )
    filter_direct: bool = _switch(
        True, doc="share the light too that falls on that vertex directly"
    )
    filter_sky: bool = _switch(
        False, doc="share of that the light of the sky, but for its bright spots"
    )
    filter_restore: bool = _switch(
        False,
        doc="add what averages lost back where it stands out of the noise: consistent",
    )
    filter_fireflies: bool = _switch(
        False,
        doc="dim pixels that are brighter than their samples and neighbours speak for: consistent",
    )
    cell_size: float = _number(16.0, 1e-3, 1e6, doc="edge of a cell in the first pass, pixels")
    cell_min_count: int = _number(
        0, 0, 1 << 20, doc="samples of a pass below which a cell gives way to one twice as wide"
    )
    cell_jitter: bool = _switch(
        True, doc="move points at random before cells are told apart: no blocks show"
    )
    cell_near: bool = _switch(
        True, doc="tell light from within a cell apart from light from afar: contacts stay dark"
    )
    cell_walls: bool = _switch(
        True, doc="keep light apart that a wall inside a cell separates: short rays look for it"
    )
    cell_layers: bool = _switch(
        True, doc="share what coats and metals reflect too, where that is wider than a cell"
    )
    cell_directions: int = _number(
        0,
        0,
        16,
        doc="parts of the sphere, a side of its square, that tell apart where paths come from "
        "whose glossy light is shared; 0: from anywhere",
    )
    cell_shrink: bool = _switch(
        True, doc="make cells smaller from pass to pass: consistent; else the image stays blurred"
    )
    screen_filter: str = _choice(
        "off",
        "path_space",
        doc="average the picture over neighbouring pixels that see the same surface",
    )
    screen_radius: float = _number(
        12.0, 0.0, 1e4, doc="how far these are, pixels, for one sample; count^(-1/4) of it for more"
    )
    screen_neighbours: int = _number(24, 1, 256, doc="how many of them are asked")
    temporal: str = _choice(
        "off",
        "exponential",
        "cumulative",
        "adaptive",
        doc="share light between the frames of a sequence, and by which rule",
    )
    temporal_alpha: float = _number(
        0.2, 1e-6, 1.0, doc="weight of the newest frame by the exponential rule"
    )
    cell_history: float = _number(
        2.0,
        0.0,
        1e9,
        doc="with temporal and path_filter=hash_grid, seconds for which cells keep the light of "
        "earlier frames where nobody sees them; 0: cells begin anew with each frame",
    )
    seed: int = _number(0, 0, 0xFFFFFFFF, doc="start of every random sequence")

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = _checked(item, getattr(self, item.name), "settings: ")
            object.__setattr__(self, item.name, value)

    def with_values(self, values: Mapping[str, Any], prefix: str = "settings: ") -> Settings:
        """Return a copy with ``values`` applied; errors begin with ``prefix`` and the key.

        Strings are taken for numbers where the setting is a number (``--set max_depth=4``).

        Raises:
            InputError: unknown key, wrong type, or a value out of range.
        """
        known = {item.name: item for item in dataclasses.fields(self)}
        checked = {}
        for key, value in values.items():
            if key not in known:
                close = difflib.get_close_matches(key, known, n=1)
                hint = f"; did you mean {close[0]}?" if close else f"; known: {', '.join(known)}"
                raise InputError(f"{prefix}{key}: unknown setting{hint}")
            checked[key] = _checked(known[key], value, prefix)
        return dataclasses.replace(self, **checked)


def _checked(item: dataclasses.Field[Any], value: Any, prefix: str) -> Any:
    if item.metadata.get("switch"):
        known = {"true": True, "false": False}
        value = known.get(value, value) if isinstance(value, str) else value
        if not isinstance(value, bool):
            raise InputError(f"{prefix}{item.name} must be true or false; got {shown(value)}")
        return value
    choices = item.metadata.get("choices")
    if choices is not None:
        if isinstance(value, int) and not isinstance(value, bool):
            # Some choices are numbers, which files need not quote.
            value = str(value)
        if value not in choices:
            raise InputError(
                f"{prefix}{item.name} must be one of {', '.join(choices)}; got {shown(value)}"
            )
        return value
    low, high = item.metadata["range"]
    kind = type(item.default)
    wanted = "an integer" if kind is int else "a number"
    try:
        number = kind(value) if isinstance(value, str) else value
    except ValueError:
        number = None
    if isinstance(number, bool) or not isinstance(number, (int, float) if kind is float else int):
        raise InputError(
            f"{prefix}{item.name} must be {wanted} from {low} to {high}; got {shown(value)}"
        )
    # Comparing is exact for integers of any length; no infinity or NaN is in a range.
    if not low <= number <= high:
        raise InputError(f"{prefix}{item.name} must be from {low} to {high}; got {shown(value)}")
    return kind(number)


PRESETS: dict[str, dict[str, Any]] = {
    "pt": {},
    # Shadows of lamps and of the sun are sharper than any cell; all other light is shared where it
    # is seen.
    "psf": {
        "path_filter": "hash_grid",
        "filter_vertex": "1",
        "filter_direct": False,
        "filter_sky": True,
        # What large cells blur is put back (measured: less error at all times than smaller cells,
        # or cells that shrink, have).
        "filter_restore": True,
        "filter_fireflies": True,
        "cell_size": 24.0,
        "cell_shrink": False,
    },
    "learned": {"guiding": "learned"},
    "photon": {"light_sampling": "photon"},
    "mlt": {"integrator": "metropolis"},
    # Few samples for each of many frames: all that makes a picture calm, none of it for precision.
    "game": {
        "light_sampling": "photon",
        "guiding": "learned",
        "path_filter": "hash_grid",
        "filter_vertex": "1",
        "filter_direct": False,
        "filter_sky": True,
        "filter_fireflies": True,
        "temporal": "adaptive",
        "screen_filter": "path_space",
    },
}


#: What goes with ``integrator=metropolis``: it has no pixel's samples to share, guide or keep.
METROPOLIS_NEEDS = {
    "filter_fireflies": False,
    "guiding": "off",
    "indirect_light": "paths",
    "material_cache": "off",
    "path_filter": "off",
    "screen_filter": "off",
    "shadow_rays": "1",
    "splits": 1,
    "temporal": "off",
}


#: What goes with ``indirect_light=virtual_lights``: there are no paths to share or to learn from.
VIRTUAL_LIGHTS_NEED = {
    "guiding": "off",
    "path_filter": "off",
    "shadow_rays": "1",
    "termination": "roulette",
}


def check_together(settings: Settings) -> None:
    """Refuse settings that exclude one another.

    Raises:
        InputError: there are some.
    """
    if settings.termination == "cache" and settings.path_filter != "off" and settings.cache_trace:
        raise InputError(
            "settings: termination=cache with a path_filter needs cache_trace=0, for averages take "
            f"no negative light; got {settings.cache_trace}"
        )
    if settings.light_sampling == "photon_origin" and settings.area_sampling == "solid_angle":
        # Densities of points by solid angle are not those that photons start with.
        raise InputError(
            "settings: light_sampling=photon_origin goes with any area_sampling but solid_angle"
        )
    if settings.indirect_light == "virtual_lights":
        for key, value in VIRTUAL_LIGHTS_NEED.items():
            if getattr(settings, key) != value:
                raise InputError(
                    f"settings: indirect_light=virtual_lights needs {key}={value}; "
                    f"got {getattr(settings, key)}"
                )
    if settings.integrator != "metropolis":
        return
    for key, value in METROPOLIS_NEEDS.items():
        if getattr(settings, key) != value:
            raise InputError(
                f"settings: integrator=metropolis needs {key}={value}; got {getattr(settings, key)}"
            )
    if settings.termination == "cache":
        raise InputError("settings: integrator=metropolis goes with any termination but cache")
    if settings.light_sampling.startswith("photon"):
        raise InputError(
            "settings: integrator=metropolis goes with any light_sampling but "
            f"{settings.light_sampling}"
        )


def preset_values(name: str, prefix: str = "settings: ") -> dict[str, Any]:
    """Return what preset ``name`` changes.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"{prefix}preset must be one of {', '.join(PRESETS)}; got {shown(name)}")
    return PRESETS[name]


def resolve(
    scene_values: Mapping[str, Any],
    scene_source: str,
    preset: str | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Settings:
    """Combine defaults < scene preset < scene ``[render]`` < ``preset`` < ``overrides``.

    Args:
        scene_values: the scene file's ``[render]`` table; its key ``preset`` names a preset.
        scene_source: what to name in errors about ``scene_values``.
    """
    settings = Settings()
    place = f"{scene_source}: render."
    values = dict(scene_values)
    if "preset" in values:
        name = values.pop("preset")
        if not isinstance(name, str):
            raise InputError(f"{place}preset must be a string; got {shown(name)}")
        settings = settings.with_values(preset_values(name, place), place)
    settings = settings.with_values(values, place)
    if preset is not None:
        settings = settings.with_values(preset_values(preset, "--"), "--preset: ")
    return settings.with_values(overrides or {}, "--set ")
