"""Scene and settings to a Plan: what is compiled, what runs, which buffers exist, and why."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.errors import DeviceError, InputError
from psf_cl.few import list_of
from psf_cl.image import AOVS
from psf_cl.instancing import Levels, split
from psf_cl.measure.timing import Declared
from psf_cl.motion import corner_labels, count_moving, lights_change
from psf_cl.scene.model import (
    TEXTURE_FIELDS,
    Material,
    Scene,
    emits,
    has_environment,
    has_layers,
    has_tangents,
    hides_back,
    is_cut_out,
    lets_through,
    shines,
)
from psf_cl.settings import Settings, check_together
from psf_cl.stages import (
    animate,
    cache,
    camera,
    cell_history,
    cells,
    connect,
    film,
    guide,
    intersect,
    material_cells,
    metropolis,
    photons,
    probes,
    range_search,
    restore,
    screen,
    seen,
    shade,
    splats,
    temporal,
    virtual_lights,
)
from psf_cl.stages.spec import BufferSpec, Context, Feature, StageSpec
from psf_cl.tables import (
    count_texels,
    count_whole_lights,
    flatten,
    leveled_textures,
    light_spread,
    visible_shapes,
)
from psf_cl.traits import DeviceTraits

#: Bytes that the passes in flight may take before the ring is made shorter.
RING_BYTES = 1 << 28

#: Pixels of a render at most: kernels count samples in flight and planes of the film with 32 bits.
MAX_PIXELS = 1 << 28

#: Bytes of a buffer at most, whatever the device allows: kernels count with 32 bits.
MAX_BUFFER_BYTES = (1 << 32) - 1

#: Bytes a triangle that building the tree takes for a while, beyond what is left of it.
BUILD_BYTES = 240

#: Lights (emitting triangles are one each) from which on ``light_sampling=auto`` asks photons.
#: At equal times, against a table: with 12,050 (``many_lights``) a quarter of the error; with 1,201
#: (a map of a game, 64 x 40) 1.7 times as much at 16 spp; other scenes here have at most 12.
MANY_LIGHTS = 4096

#: ``light_spread`` from which on they are many lights, not one that is made of many triangles: of
#: such a lamp all triangles are near or far together, and a table is as good for less.
SPREAD_LIGHTS = 0.5

#: The least of a pool, and how often it is halved on the way there.
MIN_SLOTS = 1 << 12
MAX_HALVINGS = 6

#: How often hash tables are halved where that does not do.
TABLE_HALVINGS = 4


@dataclass(frozen=True)
class Room:
    """Bytes that a render may take: in all, and in one buffer."""

    total: int
    largest: int = MAX_BUFFER_BYTES


@dataclass(frozen=True)
class Plan:
    """What a render consists of.

    Attributes:
        features: compile-time switches with their values and reasons.
        stages: those that run, in their order.
        left_out: (name, why) of what this scene and these settings do not need.
        scene_buffers: tables of the scene.
        crop: (x, y, width, height) of what is rendered.
        building: what building the tree needs for a while.
        table_halvings: how often the hash tables were halved, for want of room.
        levels: how the scene is split into two levels, or None.
    """

    features: dict[str, Feature]
    stages: tuple[StageSpec, ...]
    left_out: tuple[tuple[str, str], ...]
    scene_buffers: tuple[BufferSpec, ...]
    outputs: frozenset[str]
    crop: tuple[int, int, int, int]
    ring: int
    traits: DeviceTraits
    building: tuple[BufferSpec, ...] = ()
    levels: Levels | None = None
    table_halvings: int = 0

    @property
    def cell_buckets(self) -> int:
        """Return the buckets of the table of a pass."""
        return cells.buckets(self.pixel_count, self.table_halvings)

    @property
    def pixel_count(self) -> int:
        return self.crop[2] * self.crop[3]

    @property
    def buffers(self) -> tuple[BufferSpec, ...]:
        return self.scene_buffers + tuple(
            buffer for stage in self.stages for buffer in stage.buffers
        )

    @property
    def in_epochs(self) -> bool:
        """Return whether a stage works between passes, while no path is on its way."""
        return any(stage.between_passes for stage in self.stages)

    @property
    def shortest_epoch(self) -> int:
        """Return the fewest passes that go on without draining the pool."""
        if not self.features["METROPOLIS"].value:
            return 1
        return metropolis.shortest_epoch(self.traits.slots, self.pixel_count)

    @property
    def total_bytes(self) -> int:
        return sum(buffer.bytes for buffer in self.buffers)

    @property
    def peak_bytes(self) -> int:
        """Return the bytes while the tree is built."""
        return self.total_bytes + sum(buffer.bytes for buffer in self.building)

    def lacks(self, room: Room) -> str | None:
        """Return what does not fit into ``room``, in words, or None if everything does."""
        large = max((*self.buffers, *self.building), key=lambda buffer: buffer.bytes)
        largest = min(room.largest, MAX_BUFFER_BYTES)
        if large.bytes > largest:
            return (
                f"{large.name} ({large.what}) needs {_mib(large.bytes)} MiB in one buffer, "
                f"{_mib(largest)} are allowed"
            )
        if self.peak_bytes > room.total:
            return (
                f"the render needs {_mib(self.peak_bytes)} MiB, the most of it for {large.name} "
                f"({large.what}); {_mib(room.total)} are there"
            )
        return None

    @property
    def declared(self) -> dict[str, Declared]:
        """Return what each kernel declares of its items, by its name."""
        return {
            kernel.name: kernel.declared(self.traits)
            for stage in self.stages
            for kernel in stage.kernels
        }

    def without(self, name: str, stage: str, reason: str) -> Plan:
        """Return the plan with feature ``name`` off, without ``stage``; buffers stay fit."""
        features = self.features | {name: Feature(0, reason)}
        stages = tuple(other for other in self.stages if other.name != stage)
        return dataclasses.replace(self, features=features, stages=stages)

    def defines(self, stage: StageSpec) -> dict[str, int]:
        """Return the macros to build ``stage`` with: what it does not depend on is 0."""
        return {
            name: feature.value if name in stage.flags else 0
            for name, feature in self.features.items()
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain JSON values."""
        return {
            "features": {
                name: {"value": feature.value, "reason": feature.reason}
                for name, feature in self.features.items()
            },
            "stages": [
                {
                    "name": stage.name,
                    "reason": stage.reason,
                    "sources": list(stage.sources),
                    "kernels": list(stage.kernel_names),
                    "buffers": [
                        {"name": b.name, "bytes": b.bytes, "what": b.what} for b in stage.buffers
                    ],
                }
                for stage in self.stages
            ],
            "left_out": [{"name": name, "reason": reason} for name, reason in self.left_out],
            "scene_buffers": [
                {"name": b.name, "bytes": b.bytes, "what": b.what} for b in self.scene_buffers
            ],
            "outputs": sorted(self.outputs),
            "crop": list(self.crop),
            "total_bytes": self.total_bytes,
            "peak_bytes": self.peak_bytes,
        }


def make_plan(
    scene: Scene,
    settings: Settings,
    outputs: Iterable[str] = (),
    traits: DeviceTraits | None = None,
    crop: tuple[int, int, int, int] | None = None,
    statistics: bool = False,
    full: bool = False,
    halves: bool = False,
    room: Room | None = None,
    halvings: int = 0,
) -> Plan:
    """Derive what a render needs; works without OpenCL.

    Args:
        outputs: AOVs to deliver besides the image.
        traits: of the device; a CPU if not given.
        crop: (x, y, width, height) in pixels; the whole film if not given.
        statistics: whether the paths of the pool are to be counted by depth.
        full: turn every feature on, with tables of nothing where the scene has none; the image
            stays the same, what it costs shows what leaving out gains.
        halves: whether half of the passes is to be summed apart, to estimate the error.
        room: bytes that there are; without it, as many as it takes.
        halvings: how often to halve the pool and what is in flight; where there is too little room
            it is done once more.  It changes no bit of the image; but the hash tables, which are
            halved from MAX_HALVINGS on, then share less light.

    Raises:
        InputError: an unknown AOV, a crop outside the film, or too many pixels.
        DeviceError: there is not enough room, however small pool and tables.
    """
    traits = traits or DeviceTraits.of_kind("cpu")
    outputs = frozenset(outputs)
    unknown = sorted(outputs - set(AOVS))
    if unknown:
        raise InputError(f"--aov: unknown {', '.join(unknown)}; known: {', '.join(AOVS)}")
    crop = crop or (0, 0, scene.width, scene.height)
    x, y, width, height = crop
    if (
        width < 1
        or height < 1
        or x < 0
        or y < 0
        or x + width > scene.width
        or y + height > scene.height
    ):
        raise InputError(
            f"--crop: {x},{y},{width},{height} is not inside the film of "
            f"{scene.width}x{scene.height}"
        )
    if width * height > MAX_PIXELS:
        raise InputError(
            f"--size: {width}x{height} is more than {MAX_PIXELS} pixels; render parts with --crop"
        )
    table_halvings = max(halvings - MAX_HALVINGS, 0)
    whole_traits, traits = traits, _smaller(traits, min(halvings, MAX_HALVINGS))

    check_together(settings)
    if halves and settings.splits > 1:
        raise InputError(
            f"--noise: samples of splits={settings.splits} begin alike, so that they cannot tell "
            "their error; expected splits=1, --spp or --seconds"
        )
    if halves and restores(settings).value:
        raise InputError(
            "--noise: the error of what filter_restore puts back cannot be told from the samples; "
            "expected filter_restore=false, --spp or --seconds"
        )
    if settings.integrator == "metropolis":
        _check_metropolis(outputs, halves)
        traits = dataclasses.replace(traits, slots=metropolis.chain_count(settings, traits))
    shapes = visible_shapes(scene)
    shown = sum(len(shape.mesh.triangles) for shape in shapes)
    levels = split(scene)
    triangles = shown if levels is None else levels.triangle_count
    corners, plates = _few_pieces(scene, shown, traits)
    features = _features(scene, settings, outputs)
    outputs = _without_light_aovs(outputs, features)
    features["AOV_LIGHTS"] = _aov_lights(outputs, features["LIGHT_SAMPLING"])
    features["FEW"] = _few(shown, corners, plates, traits)
    features["INSTANCES"] = _instances(levels, shown)
    features["TEMPORAL"] = _temporal(scene, settings, features)
    features["CELL_HISTORY"] = _cell_history(settings, features)
    if full:
        cell_history_alone = features["CELL_HISTORY"]
        features = _all_on(features)
        if settings.path_filter == "range_search":
            # There are no cells.
            features["CELL_HISTORY"] = cell_history_alone
    pixel_count = width * height
    image = scene.environment.image
    textures, texels = count_texels(scene, bool(features["TEXTURE_LEVELS"].value))
    context = Context(
        features,
        traits,
        pixel_count,
        _ring(pixel_count, traits, features, RING_BYTES >> halvings),
        crop_size=(width, height),
        statistics=statistics,
        halves=halves,
        max_depth=settings.max_depth,
        moving=count_moving(scene),
        range_search=settings.path_filter == "range_search",
        table_halvings=table_halvings,
        triangle_count=triangles,
        instance_count=0 if levels is None else levels.instance_count,
        corner_count=corners,
        material_count=len(scene.materials),
        texture_count=textures,
        texel_count=texels,
        environment_count=image.shape[0] * image.shape[1]
        if image is not None and features["ENVIRONMENT"].value == 2
        else 0,
    )
    stages = _stages(context)
    if settings.integrator == "path" and any(stage.between_passes for stage in stages):
        traits = _draining(traits, pixel_count)
        ring = _ring(pixel_count, traits, features, RING_BYTES >> halvings)
        context = dataclasses.replace(context, traits=traits, ring=ring)
        stages = _stages(context)
    left_out = [
        (name.lower(), feature.reason) for name, feature in features.items() if not feature.value
    ]
    if len(shapes) < len(scene.shapes):
        left_out.append(("shapes", f"{len(scene.shapes) - len(shapes)} are cut out whole"))
    if table_halvings:
        part = f"1 of {1 << table_halvings}"
        left_out.append(("slots", f"of large hash tables {part} is there: too little room"))
    plan = Plan(
        features,
        stages,
        tuple(left_out),
        _scene_buffers(context, scene),
        outputs,
        crop,
        context.ring,
        traits,
        () if context.on("FEW") else _building(context),
        levels,
        table_halvings,
    )
    lacking = plan.lacks(room) if room is not None else None
    if lacking is None:
        return plan
    if halvings == MAX_HALVINGS + TABLE_HALVINGS:
        raise DeviceError(f"{lacking}; a smaller --size or --crop, or fewer --aov, need less")
    return make_plan(
        scene,
        settings,
        outputs,
        whole_traits,
        crop,
        statistics,
        full,
        halves,
        room,
        halvings + 1,
    )


def _smaller(traits: DeviceTraits, halvings: int) -> DeviceTraits:
    """Return ``traits`` with a pool that was halved so often, down to MIN_SLOTS."""
    slots = max(traits.slots >> halvings, min(MIN_SLOTS, traits.slots))
    return dataclasses.replace(traits, slots=slots - slots % traits.block)


def _draining(traits: DeviceTraits, pixel_count: int) -> DeviceTraits:
    """Return ``traits`` with a pool that drains between passes of so many pixels."""
    slots = min(max(int(traits.epoch_share * pixel_count), MIN_SLOTS), traits.slots)
    return dataclasses.replace(traits, slots=slots - slots % traits.block)


def _stages(context: Context) -> tuple[StageSpec, ...]:
    """Return the stages that are not left out, in the order in which they are shown."""
    modules = (
        animate,
        photons,
        virtual_lights,
        camera,
        metropolis,
        intersect,
        shade,
        connect,
        cells,
        cell_history,
        range_search,
        splats,
        seen,
        film,
        probes,
        temporal,
        screen,
        guide,
        cache,
        material_cells,
        restore,
    )
    planned = (module.plan(context) for module in modules)
    return tuple(stage for stage in planned if stage is not None)


def _building(context: Context) -> tuple[BufferSpec, ...]:
    triangles = context.triangle_count
    again = _tree(triangles) if context.on("MOTION") and not context.on("INSTANCES") else ()
    tree = BufferSpec("tree", layout.BINARY_NODE.dtype, 2 * triangles, "the tree while it is built")
    rest = max(BUILD_BYTES * triangles - tree.bytes, 0)
    boxes = BufferSpec("boxes", np.dtype(np.uint8), rest, "what building the tree needs")
    # A sequence builds its next tree beside the one before.
    return tree, boxes, *again


def _tree(triangles: int) -> tuple[BufferSpec, ...]:
    block, node = layout.TRIANGLE_BLOCK.dtype, layout.BVH_NODE.dtype
    return (
        BufferSpec("blocks", block, -(-triangles // 2), "leaves (estimate)"),
        BufferSpec("nodes", node, -(-triangles // 12), "inner nodes (estimate)"),
    )


def _mib(count: int) -> str:
    mib = count / 2**20
    return f"{mib:.0f}" if mib >= 10.0 else f"{mib:.2g}"


def _check_metropolis(outputs: frozenset[str], halves: bool) -> None:
    """Refuse what takes the samples of each pixel.

    Raises:
        InputError: something does.
    """
    if outputs:
        raise InputError(
            "--aov: integrator=metropolis has no further images, for its samples belong to no "
            f"pixel; got {', '.join(sorted(outputs))}"
        )
    if halves:
        raise InputError(
            "--noise: integrator=metropolis cannot tell its error, for its samples depend on one "
            "another; expected --spp or --seconds"
        )


def _ring(
    pixel_count: int, traits: DeviceTraits, features: dict[str, Feature], ring_bytes: int
) -> int:
    """Return how many passes may be in flight, a power of two.

    Long paths of an early pass must not stop the slots: a few times the pool in samples goes on
    behind them, at least two passes, as far as memory goes.
    """
    planes = 1 + features["AOV_DIRECT"].value + features["AOV_BOUNCES"].value
    planes += 3 * features["AOV_FEATURES"].value
    planes += bool(features["AOV_LIGHTS"].value)
    planes += 4 * bool(features["SEEN"].value) + bool(features["BASE"].value)
    # With a vertex, what lies behind it, and about one cell: its sums and its key.
    cell_bytes = 16 + 32 + 36 if features["CELLS"].value else 0
    sample_bytes = 16 * planes + cell_bytes
    wanted = max(8 * traits.slots / pixel_count, 2)
    if features["METROPOLIS"].value:
        sample_bytes += layout.SPLAT_SUM.dtype.itemsize
        wanted = max(metropolis.MUTATIONS_IN_FLIGHT * traits.slots / pixel_count, 2)
    affordable = max(ring_bytes / (sample_bytes * pixel_count), 2)
    ring = 2
    while ring < wanted and ring * 2 <= affordable:
        ring *= 2
    return ring


def _instances(levels: Levels | None, shown: int) -> Feature:
    """Return whether meshes have trees of their own, with the bits of an index in them."""
    if levels is None:
        return Feature(0, "few triangles would be saved by placing meshes more than once")
    places = f"{levels.place_count} places of {len(levels.parts)} meshes"
    kept = f"{levels.triangle_count} triangles in place of {shown}"
    return Feature(levels.index_bits, f"{places}: {kept}")


def _few_pieces(scene: Scene, triangles: int, traits: DeviceTraits) -> tuple[int, int]:
    """Return the distinct corners and the plates of a small scene, 0 of one too large to ask."""
    if triangles > traits.few_triangles:
        return 0, 0
    geometry = flatten(scene, densities=False)
    few, plates = list_of(geometry, scene.materials, corner_labels(scene))
    return len(few.corners), len(plates.records)


def _few(triangles: int, corners: int, plates: int, traits: DeviceTraits) -> Feature:
    """Return whether all triangles are tested, with the room for their corners."""
    if triangles > traits.few_triangles:
        return Feature(0, f"a tree: {triangles} triangles")
    if corners > traits.few_corners:
        return Feature(0, f"a tree: {corners} corners")
    if plates > traits.few_plates:
        return Feature(0, f"a tree: {triangles} triangles, {plates} plates")
    # In steps, so that scenes of about the same size share their programs.
    room = max(32 * -(-corners // 32), 32)
    return Feature(room, f"no tree: {triangles} triangles, {plates} plates, {corners} corners")


def _features(scene: Scene, settings: Settings, outputs: frozenset[str]) -> dict[str, Feature]:
    shapes = visible_shapes(scene)
    materials = [scene.materials[i] for i in sorted({shape.material for shape in shapes})]
    lights = [light for light in scene.lights if shines(light)]
    sky = has_environment(scene.environment)
    image = scene.environment.image is not None

    def switch(value: bool, yes: str, no: str) -> Feature:
        return Feature(int(value), yes if value else no)

    textured = any(getattr(m, name) >= 0 for m in materials for name in TEXTURE_FIELDS)
    cut_out = any(is_cut_out(scene.materials[shape.material], shape.mesh) for shape in shapes)
    blended = cut_out and any(m.alpha_mode == "blend" for m in materials)
    glows = any(emits(m) or m.unlit for m in materials)
    glossy = any(
        (m.metallic > 0.0 or m.specular > 0.0 or m.transmission > 0.0 or has_layers(m))
        and not m.unlit
        for m in materials
    )
    connected = _connect(settings, any(emits(m) for m in materials) or sky, bool(lights))
    rectangles = _rectangles(scene, settings, bool(connected.value))
    spheres = _spheres(scene, settings, bool(connected.value))
    kinds = whole_kinds({"RECTANGLES": rectangles, "SPHERES": spheres})
    chosen = _light_sampling(settings, bool(connected.value), _light_count(scene, kinds), scene)
    feature_aovs = outputs & {"albedo", "normal", "depth"}
    return {
        "TEXTURES": switch(
            textured or cut_out,
            "a material has a texture" if textured else "alpha is looked up as a texture's",
            "no material has a texture",
        ),
        "TEXTURE_LEVELS": _texture_levels(scene, settings),
        "MATERIAL_CELLS": _material_cells(settings, materials),
        "ALPHA": Feature(
            (2 if blended else 1) if cut_out else 0,
            ("a material blends" if blended else "a material is cut out by its alpha")
            if cut_out
            else "no material is cut out",
        ),
        "BACK_FACES": _back_faces(settings, materials),
        "VERTEX_COLORS": switch(
            any(shape.mesh.colors is not None for shape in shapes),
            "a mesh has colours",
            "no mesh has colours",
        ),
        "TANGENTS": switch(
            any(has_tangents(m) for m in materials),
            "a material has a normal map or is anisotropic",
            "no material has a normal map or is anisotropic",
        ),
        "SMOOTH": switch(
            any(shape.mesh.normals is not None for shape in shapes),
            "a mesh has shading normals",
            "no mesh has shading normals",
        ),
        "GLOSSY": switch(
            glossy,
            "a material has a coat or is a metal",
            "every material is matt",
        ),
        "TRANSMISSION": switch(
            any(lets_through(m) for m in materials),
            "a material lets light through",
            "no material lets light through",
        ),
        "LAYERS": switch(
            any(has_layers(m) for m in materials),
            "a material has a clear coat, sheen, anisotropy or a coloured reflection",
            "no material has a clear coat, sheen, anisotropy or a coloured reflection",
        ),
        "AREA_LIGHTS": switch(glows, "a shape emits", "no shape emits"),
        "RECTANGLES": rectangles,
        "SPHERES": spheres,
        "PUNCTUAL_LIGHTS": switch(
            bool(lights),
            f"{len(lights)} lights without extent",
            "no point, spot or directional light",
        ),
        "ENVIRONMENT": Feature(
            (2 if image else 1) if sky else 0,
            ("an environment image" if image else "a constant sky")
            if sky
            else "the environment is black",
        ),
        "CONNECT": connected,
        "LIGHT_SAMPLING": chosen,
        "VIRTUAL_LIGHTS": _virtual_lights(settings, connected),
        "SHADOW_RAYS": _shadow_rays(settings, connected, chosen),
        "LENS": _lens(scene),
        "MOTION": _motion(scene),
        "AOV_DIRECT": switch(
            bool(outputs & {"direct", "indirect"}),
            "direct or indirect was asked for",
            "neither direct nor indirect was asked for",
        ),
        "AOV_FEATURES": switch(
            bool(feature_aovs),
            f"{', '.join(sorted(feature_aovs))} asked for",
            "no albedo, normal or depth was asked for",
        ),
        "AOV_BOUNCES": switch(
            "bounces" in outputs, "bounces asked for", "bounces were not asked for"
        ),
        "AOV_GUIDE": _aov_guide(settings, outputs),
        "GUIDE": switch(
            settings.guiding == "learned",
            "guiding is learned",
            "guiding is off",
        ),
        "CACHE": switch(
            settings.termination == "cache",
            "termination is cache",
            f"termination is {settings.termination}",
        ),
        "CELLS": _cells(settings, glossy),
        "CELL_LAYERS": _cell_layers(settings, glossy),
        "SPARSE": _sparse(settings),
        "WALLS": _walls(settings),
        "AOV_CELLS": _aov_cells(settings, outputs),
        "RESTORE": restores(settings),
        "SEEN": _seen(settings, outputs),
        "BASE": _base(settings, glossy),
        "METROPOLIS": switch(
            settings.integrator == "metropolis",
            "integrator is metropolis",
            "integrator is path",
        ),
    }


def _texture_levels(scene: Scene, settings: Settings) -> Feature:
    """Return whether later vertices look up smaller textures, and why."""
    if settings.texture_level == "full":
        return Feature(0, "texture_level is full")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: there are no later vertices")
    count = len(leveled_textures(scene))
    if not count:
        return Feature(0, "no material has a texture of more than a texel that may be blurred")
    return Feature(1, f"later vertices see {count} textures as coarsely as paths are apart")


def _material_cells(settings: Settings, materials: list[Material]) -> Feature:
    """Return whether later vertices fetch what textures give once a cell, and why."""
    if settings.material_cache == "off":
        return Feature(0, "material_cache is off")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: there are no later vertices")
    if not any(m.base_color_texture >= 0 or m.metallic_roughness_texture >= 0 for m in materials):
        return Feature(0, "no material has a texture of its base colour, or of roughness and metal")
    return Feature(1, "later vertices fetch what textures give once a cell")


def _rectangles(scene: Scene, settings: Settings, connected: bool) -> Feature:
    """Return whether there are lights that are sampled by the solid angle that they fill."""
    if not connected:
        return Feature(0, "no light is sampled")
    if settings.area_sampling != "solid_angle":
        return Feature(0, f"area_sampling is {settings.area_sampling}")
    count, _ = count_whole_lights(scene, "rectangles")
    if not count:
        return Feature(0, "no rectangle or disk that stands still and glows evenly")
    return Feature(1, f"{count} lights are flat, sampled by the solid angle that they fill")


def _spheres(scene: Scene, settings: Settings, connected: bool) -> Feature:
    """Return whether there are spheres that are sampled by what is seen of them."""
    if not connected:
        return Feature(0, "no light is sampled")
    if settings.area_sampling == "area":
        return Feature(0, "area_sampling is area")
    count, triangles = count_whole_lights(scene, "spheres")
    if not count:
        return Feature(0, "no sphere that stands still and glows evenly")
    return Feature(
        1, f"{count} lights are spheres ({triangles} triangles), sampled as they are seen"
    )


def whole_kinds(features: Mapping[str, Feature]) -> set[str]:
    """Return which kinds of lights are more than a triangle, as `find_whole_lights` names them."""
    names = {"RECTANGLES": "rectangles", "SPHERES": "spheres"}
    return {kind for name, kind in names.items() if features[name].value}


def _back_faces(settings: Settings, materials: list[Material]) -> Feature:
    """Return whether the camera looks through backs."""
    if settings.back_faces == "shown":
        return Feature(0, "back_faces is shown")
    if not any(hides_back(material) for material in materials):
        return Feature(0, "no material is said to be single-sided, or only glass")
    return Feature(1, "the camera looks through the backs of single-sided materials")


def _motion(scene: Scene) -> Feature:
    """Return whether triangles move between frames."""
    moving = count_moving(scene)
    if moving is None:
        return Feature(0, "no triangle moves")
    return Feature(1, f"{moving.triangles} triangles move between frames")


def restores(settings: Settings) -> Feature:
    """Return whether what averages per cell lost is added back to the picture."""
    if settings.path_filter == "off":
        return Feature(0, "path_filter is off")
    if settings.path_filter != "hash_grid":
        return Feature(0, "what averages over balls lost is not put back")
    if not settings.filter_restore:
        return Feature(0, "filter_restore is false: averages stay as they are")
    if settings.screen_filter != "off" or settings.temporal != "off":
        return Feature(0, "screen_filter or temporal is on, and goes on with the averages")
    return Feature(1, "filter_restore puts back what averages per cell lost")


def _aov_cells(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether pixels keep what they saw of cells."""
    asked = sorted(outputs & set(cells.VIEWS))
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not asked:
        return Feature(0, "no image of cells was asked for")
    return Feature(1, f"{', '.join(asked)} asked for")


def _aov_guide(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether the guide is shown.

    Raises:
        InputError: it is asked for, but not among all images, and there is none.
    """
    asked = sorted(outputs & set(guide.VIEWS))
    if settings.guiding == "off":
        if asked and outputs != set(AOVS):
            raise InputError(f"--aov: {', '.join(asked)} needs guiding=learned; got guiding=off")
        return Feature(0, "guiding is off")
    if not asked:
        return Feature(0, "no image of the guide was asked for")
    return Feature(1, f"{', '.join(asked)} asked for")


def _aov_lights(outputs: frozenset[str], chosen: Feature) -> Feature:
    """Return whether pixels keep how their lights were chosen: 2 with what photons say."""
    asked = sorted(outputs & {"light_pmf", *photons.VIEWS})
    if not asked:
        return Feature(0, "no image of the choice of lights was asked for")
    return Feature(2 if chosen.value >= 2 else 1, f"{', '.join(asked)} asked for")


def _without_light_aovs(outputs: frozenset[str], features: dict[str, Feature]) -> frozenset[str]:
    """Return ``outputs`` without those of choices not made, if all are asked for.

    Raises:
        InputError: some, not all, are asked for, and one of them is of such a choice.
    """
    missing = {}
    if not features["CONNECT"].value:
        missing["light_pmf"] = f"a light to choose; {features['CONNECT'].reason}"
    chosen = features["LIGHT_SAMPLING"]
    if chosen.value < 2:
        missing |= dict.fromkeys(photons.VIEWS, f"light_sampling=photon; {chosen.reason}")
    if outputs >= set(AOVS):
        return outputs - missing.keys()
    for name in sorted(outputs & missing.keys()):
        raise InputError(f"--aov: {name} needs {missing[name]}")
    return outputs


def _sparse(settings: Settings) -> Feature:
    """Return whether cells with few samples give way to wider ones."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if settings.cell_min_count <= 1:
        return Feature(0, "cell_min_count asks for no samples beside the own one")
    return Feature(1, f"cell_min_count asks for {settings.cell_min_count} samples in a cell")


def _cell_layers(settings: Settings, glossy: bool) -> Feature:
    """Return whether what coats and metals reflect has cells of its own."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not settings.cell_layers:
        return Feature(0, "cell_layers is false: what coats and metals reflect is not shared")
    if not glossy:
        return Feature(0, "every material is matt")
    if settings.screen_filter != "off":
        return Feature(0, "screen_filter averages diffuse light alone")
    return Feature(1, "cell_layers shares what coats and metals reflect, apart from diffuse light")


def _walls(settings: Settings) -> Feature:
    """Return whether walls inside cells keep light apart."""
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if not settings.cell_walls:
        return Feature(0, "cell_walls is false: light leaks through thin walls")
    return Feature(1, "cell_walls keeps light apart that a wall inside a cell separates")


def _lens(scene: Scene) -> Feature:
    """Return how rays leave the camera."""
    camera = scene.cameras[scene.camera] if scene.cameras else None
    if camera is not None and camera.height > 0.0:
        return Feature(2, "the camera is orthographic")
    if camera is not None and camera.lens_radius > 0.0:
        return Feature(1, "the camera has a lens")
    return Feature(0, "the camera is a pinhole")


def _cells(settings: Settings, glossy: bool) -> Feature:
    """Return whether light is shared per cell, and if so how much of it."""
    if settings.path_filter == "off":
        return Feature(0, "path_filter is off")
    name = f"path_filter is {settings.path_filter}"
    if glossy:
        return Feature(2, f"{name}; the light of diffuse bases is shared")
    return Feature(1, f"{name}; every material is matt")


def _temporal(scene: Scene, settings: Settings, features: dict[str, Feature]) -> Feature:
    """Return whether frames share light: 2 if they also look for where it changes."""
    if settings.temporal == "off":
        return Feature(0, "temporal is off")
    if settings.temporal != "adaptive":
        return Feature(1, f"temporal is {settings.temporal}")
    if not features["CONNECT"].value:
        return Feature(1, "temporal is adaptive, but no light is sampled whose changes probes see")
    if count_moving(scene) is None and not lights_change(scene):
        return Feature(1, "temporal is adaptive, but nothing changes the light")
    return Feature(2, "temporal is adaptive: probes look for changes of light")


def _cell_history(settings: Settings, features: dict[str, Feature]) -> Feature:
    """Return whether cells keep what they know: 2 if they ask for changes of the light."""
    if settings.temporal == "off":
        return Feature(0, "temporal is off")
    if settings.path_filter != "hash_grid":
        return Feature(0, f"path_filter is {settings.path_filter}")
    if settings.cell_history == 0.0:
        return Feature(0, "cell_history is 0: cells begin anew with each frame")
    value = features["TEMPORAL"].value
    return Feature(value, f"cells keep their light for {settings.cell_history:g} s unseen")


def _seen(settings: Settings, outputs: frozenset[str]) -> Feature:
    """Return whether the first surfaces are kept: 2 with where they were in the frame before."""
    if settings.temporal != "off":
        return Feature(2, "frames share light where they see the same")
    if "motion" in outputs:
        return Feature(2, "motion was asked for")
    if settings.screen_filter != "off":
        return Feature(1, "screen_filter compares what pixels see")
    if settings.guiding != "off" and outputs & set(guide.VIEWS):
        return Feature(1, "the guide is shown at what pixels see")
    return Feature(0, "neither screen_filter nor temporal is on, nor motion or guide asked for")


def _base(settings: Settings, glossy: bool) -> Feature:
    """Return whether what first surfaces reflect is kept apart, and if so how much of it."""
    if settings.screen_filter == "off":
        return Feature(0, "screen_filter is off")
    if glossy:
        return Feature(2, "screen_filter averages the light of diffuse bases")
    return Feature(1, "screen_filter averages all light that is reflected; every material is matt")


def _all_on(features: dict[str, Feature]) -> dict[str, Feature]:
    """Return the features with those that are off turned on.

    What is on keeps its value: as an image of one texel a constant sky would be sampled otherwise.
    """
    twos = ("ALPHA", "ENVIRONMENT", "CELLS", "CELL_HISTORY", "BASE", "SEEN", "TEMPORAL")
    most = dict.fromkeys(twos, 2)
    full = {
        name: feature
        if feature.value
        else Feature(most.get(name, 1), f"on for measuring, though {feature.reason}")
        for name, feature in features.items()
    }
    # A list of triangles is what small scenes have in place of something.
    full["FEW"] = Feature(0, f"a tree for measuring, though {features['FEW'].reason}")
    # Neither are there places of what is there once.
    full["INSTANCES"] = features["INSTANCES"]
    # Other lights would be drawn, or other points of them: another image.
    full["LIGHT_SAMPLING"] = features["LIGHT_SAMPLING"]
    full["RECTANGLES"] = features["RECTANGLES"]
    full["SPHERES"] = features["SPHERES"]
    full["SHADOW_RAYS"] = features["SHADOW_RAYS"]
    # Photons would stand for what paths bring.
    full["VIRTUAL_LIGHTS"] = features["VIRTUAL_LIGHTS"]
    # Other texels would be read.
    full["TEXTURE_LEVELS"] = features["TEXTURE_LEVELS"]
    # Chains are another integrator, which has no images beside the one.
    full["METROPOLIS"] = features["METROPOLIS"]
    # Directions would be drawn otherwise: the image would have other noise.
    full["GUIDE"] = features["GUIDE"]
    full["AOV_GUIDE"] = features["AOV_GUIDE"]
    # Paths would end elsewhere.
    full["CACHE"] = features["CACHE"]
    # Other light would be shared.
    full["CELL_LAYERS"] = features["CELL_LAYERS"]
    # Means of texels would be read.
    full["MATERIAL_CELLS"] = features["MATERIAL_CELLS"]
    if features["METROPOLIS"].value:
        names = (
            "AOV_BOUNCES",
            "AOV_CELLS",
            "AOV_DIRECT",
            "AOV_FEATURES",
            "AOV_LIGHTS",
            "BASE",
            "CELLS",
            "CELL_HISTORY",
            "RESTORE",
            "SEEN",
            "SPARSE",
            "WALLS",
        )
        full |= {name: features[name] for name in names}
    # Without anything to move there is nothing to hold.
    full["MOTION"] = features["MOTION"]
    return full


def _connect(settings: Settings, extended: bool, punctual: bool) -> Feature:
    """Return whether lights are sampled, and why."""
    if not (extended or punctual):
        return Feature(0, "the scene has no light")
    if settings.max_depth == 0:
        return Feature(0, "max_depth is 0: nothing is lit, only seen")
    if settings.direct_sampling == "bsdf" and not punctual:
        return Feature(0, "direct_sampling is bsdf, and every light has an extent")
    return Feature(1, "lights are sampled at every vertex")


def _light_sampling(settings: Settings, connected: bool, lights: int, scene: Scene) -> Feature:
    """Return how lights are drawn, and why."""
    if settings.light_sampling in ("power", "uniform"):
        return Feature(0, f"light_sampling is {settings.light_sampling}: a table of chances")
    if not connected:
        return Feature(0, "no light is sampled")
    if lights == 1:
        return Feature(0, "there is one light: nothing to choose")
    if settings.light_sampling == "auto":
        if lights < MANY_LIGHTS:
            return Feature(0, f"light_sampling is auto: a table of {lights} lights is fast")
        if (spread := light_spread(scene)) < SPREAD_LIGHTS:
            why = f"{lights} lights are together in {spread:.2g} of the scene's length"
            return Feature(0, f"light_sampling is auto: {why}")
        if settings.integrator == "metropolis":
            return Feature(1, f"light_sampling is auto, without photons: a tree of {lights} lights")
        return Feature(2, f"light_sampling is auto: photons of {lights} lights say which are seen")
    if settings.light_sampling == "hierarchy":
        return Feature(1, f"light_sampling is hierarchy: a tree of {lights} lights")
    if settings.light_sampling == "photon_origin":
        return Feature(
            3, f"light_sampling is photon_origin: rays go where photons of {lights} lights began"
        )
    return Feature(2, f"light_sampling is photon: photons of {lights} lights say which are seen")


def _virtual_lights(settings: Settings, connected: Feature) -> Feature:
    """Return whether photons stand for light that is reflected more than once."""
    if settings.indirect_light == "paths":
        return Feature(0, "indirect_light is paths")
    if not connected.value:
        return Feature(0, connected.reason)
    if settings.max_depth < 2:
        return Feature(0, f"max_depth is {settings.max_depth}: light is reflected once at most")
    return Feature(1, "indirect_light is virtual_lights: photons stand for reflected light")


def _shadow_rays(settings: Settings, connected: Feature, chosen: Feature) -> Feature:
    """Return how many rays to lights a vertex has at most, 0 for one."""
    if not connected.value:
        return Feature(0, connected.reason)
    if _virtual_lights(settings, connected).value:
        return Feature(2, "indirect_light is virtual_lights: one more ray goes to one of these")
    if settings.shadow_rays == "1":
        return Feature(0, "shadow_rays is 1")
    if settings.shadow_rays != "auto":
        return Feature(int(settings.shadow_rays), f"shadow_rays is {settings.shadow_rays}")
    if chosen.value < 2:
        return Feature(0, "shadow_rays is auto: one, without photons that say how many lights")
    return Feature(
        photons.MOST_RAYS,
        "shadow_rays is auto: from what is seen, one for each light that is known",
    )


def _light_count(scene: Scene, kinds: Collection[str]) -> int:
    """Return the entries of the light table, or a few more; one for each light of ``kinds``."""
    emitting = sum(
        len(shape.mesh.triangles)
        for shape in scene.shapes
        if emits(scene.materials[shape.material])
    )
    for kind in kinds:
        count, triangles = count_whole_lights(scene, kind)
        emitting -= triangles - count
    return emitting + sum(map(shines, scene.lights)) + has_environment(scene.environment)


def _scene_buffers(context: Context, scene: Scene) -> tuple[BufferSpec, ...]:
    triangles = context.triangle_count
    lights = _light_count(scene, whole_kinds(context.features))
    float32, uint8 = np.dtype(np.float32), np.dtype(np.uint8)
    buffers = [
        BufferSpec("params", layout.PARAMS.dtype, 1, "camera and settings"),
        BufferSpec("surfaces", layout.SURFACE.dtype, triangles, "triangles for shading"),
        BufferSpec("materials", layout.MATERIAL.dtype, context.material_count, "materials"),
    ]
    if context.on("FEW"):
        buffers += [
            BufferSpec("corners", float32, 3 * context.corner_count, "corners of all triangles"),
            BufferSpec("faces", np.dtype(np.uint32), 4 * triangles, "triangles between them"),
            BufferSpec("plates", layout.PLATE.dtype, triangles, "these by flat pieces"),
        ]
    else:
        buffers += _tree(triangles)
    if context.on("INSTANCES"):
        buffers.append(
            BufferSpec("instances", layout.INSTANCE.dtype, context.instance_count, "places")
        )
    if context.on("SMOOTH"):
        buffers.append(BufferSpec("normals", layout.NORMALS.dtype, triangles, "shading normals"))
    if context.on("TEXTURES"):
        buffers += [
            BufferSpec(
                "uvs",
                layout.UVS.dtype,
                triangles * (1 + any(texture.uv_set for texture in scene.textures)),
                "texture coordinates",
            ),
            BufferSpec(
                "textures", layout.TEXTURE.dtype, context.texture_count, "where textures lie"
            ),
            BufferSpec("texels", uint8, 4 * max(context.texel_count, 1), "texels of all textures"),
            BufferSpec("srgb_to_linear", float32, 256, "decoding table"),
        ]
    if context.on("VERTEX_COLORS"):
        buffers.append(
            BufferSpec("colors", layout.VERTEX_COLORS.dtype, triangles, "colours of the corners")
        )
    if context.on("TANGENTS"):
        buffers.append(
            BufferSpec("tangents", layout.TANGENTS.dtype, triangles, "where u grows on the surface")
        )
    if context.on("CONNECT"):
        buffers.append(BufferSpec("lights", layout.LIGHT.dtype, lights, "light table"))
    if context.on("LIGHT_SAMPLING"):
        uint32 = np.dtype(np.uint32)
        buffers += [
            BufferSpec("light_pairs", layout.LIGHT_PAIR.dtype, lights, "tree of lights"),
            BufferSpec("light_bounds", layout.LIGHT_BOUNDS.dtype, lights, "to fit the tree"),
            BufferSpec("light_order", uint32, lights, "levels of the tree"),
            BufferSpec("light_places", uint32, 2 * lights, "where each light is in the tree"),
            BufferSpec(
                "light_clusters",
                uint32,
                layout.CONSTANT["CLUSTER_PARTS"] * lights,
                "small subtrees, from which a point far away draws by power",
            ),
            BufferSpec(
                "light_groups",
                layout.LIGHT_GROUP.dtype,
                lights,
                "small subtrees, which photons tell apart",
            ),
        ]
    if context.features["ENVIRONMENT"].value == 2:
        buffers.append(
            BufferSpec(
                "environment",
                layout.ENVIRONMENT_CELL.dtype,
                context.environment_count,
                "environment image",
            )
        )
    return tuple(buffers)
