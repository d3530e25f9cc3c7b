"""Scene and settings to a Plan: what is compiled, what runs, which buffers exist, and why."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from psf_cl.device import layout
from psf_cl.errors import DeviceError, InputError
from psf_cl.features import (
    all_on,
    few_feature,
    few_pieces,
    find_features,
    instances_feature,
    light_count,
    restores,
    whole_kinds,
)
from psf_cl.image import AOVS
from psf_cl.instancing import Levels, split
from psf_cl.measure.timing import Declared
from psf_cl.motion import count_moving
from psf_cl.scene.model import Scene
from psf_cl.settings import Settings, check_together
from psf_cl.stages import (
    animate,
    cache,
    camera,
    cell_history,
    cells,
    connect,
    film,
    fireflies,
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
from psf_cl.tables import count_texels, visible_shapes
from psf_cl.traits import DeviceTraits

#: Bytes that the passes in flight may take before the ring is made shorter.
RING_BYTES = 1 << 28

#: Pixels of a render at most: kernels count samples in flight and planes of the film with 32 bits.
MAX_PIXELS = 1 << 28

#: Bytes of a buffer at most, whatever the device allows: kernels count with 32 bits.
MAX_BUFFER_BYTES = (1 << 32) - 1

#: Bytes a triangle that building the tree takes for a while, beyond what is left of it.
BUILD_BYTES = 240

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
    biased = ["filter_restore"] * restores(settings).value
    biased += ["filter_fireflies"] * settings.filter_fireflies
    if halves and biased:
        raise InputError(
            f"--noise: what {' and '.join(biased)} do to the error cannot be told from the "
            f"samples; expected {', '.join(f'{name}=false' for name in biased)}, --spp or --seconds"
        )
    if settings.integrator == "metropolis":
        _check_metropolis(outputs, halves)
        traits = dataclasses.replace(traits, slots=metropolis.chain_count(settings, traits))
    shapes = visible_shapes(scene)
    shown = sum(len(shape.mesh.triangles) for shape in shapes)
    levels = split(scene)
    triangles = shown if levels is None else levels.triangle_count
    corners, plates = few_pieces(scene, shown, traits)
    features, outputs = find_features(scene, settings, outputs)
    features["FEW"] = few_feature(shown, corners, plates, traits)
    features["INSTANCES"] = instances_feature(levels, shown)
    if full:
        features = all_on(features, settings)
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
        fireflies,
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


def _scene_buffers(context: Context, scene: Scene) -> tuple[BufferSpec, ...]:
    triangles = context.triangle_count
    lights = light_count(scene, whole_kinds(context.features))
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
