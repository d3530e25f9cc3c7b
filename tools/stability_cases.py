"""The cases of ``tools/stability.py``: scenes that are stiff, extreme or degenerate.

A case knows its answer in one of two ways: a closed form, or the picture of a calm scene that has
to look the same.  It has a calm case, whose time it may take twice, or says why there is none.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np

from psf_cl.device.layout import CELL_HISTORY, COUNTER_INDEX, HISTORY
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.curve import Curve
from psf_cl.scene.far import moved
from psf_cl.scene.model import Camera, Environment, Material, Mesh, Node, Scene, Shape
from psf_cl.stages import cache, cell_history, cells, guide, material_cells, photons

#: Bounces of furnaces: enough that what is left out would show.
LONG = 1000

#: Of all that have cells.
TINY_CELLS = {"cell_size": 1e-3, "guide_cell_size": 1e-3, "photon_cell": 1e-6}
HUGE_CELLS = dict.fromkeys(TINY_CELLS, 1e6)

#: Paths of any preset end where a cache knows what a surface reflects.
CACHE = {"termination": "cache", "cache_trace": 0.0}

#: Hash tables that a case of one slot fills.
ALL_FULL = dict.fromkeys(("cells", "guide", "cache"), 1.0)

#: Why no time is compared of pictures of so few pixels.
FEW_PIXELS = "a pass of few samples takes as long as its launches"

#: What says how large hash tables and the map of photons are.
SIZES = (
    *((module, "slots_of") for module in (cells, cell_history, guide, cache, material_cells)),
    (photons, "cells_of"),
)

#: What metals lose of a white world at most; the bound is that of ``cl/common/albedo.h``.
METAL_LOSS = 0.004

Part = tuple[Mesh, np.ndarray, Material]


@dataclass(frozen=True)
class Case:
    """One extreme.

    Attributes:
        scene: makes the scene; the argument is the edge of the picture.
        truth: mean radiance of the picture, or the name of the case that looks the same.
        calm: the case whose time is compared with, or None.
        untimed: why there is none.
        per: of what time is compared: of a ``"sample"``, or of a ``"ray"`` (photons too) where the
            case asks for more of them.
        settings: over those of the preset.
        spp: samples a pixel, as a multiple of the usual number; or a number of their own.
        tolerance: of the mean, if the usual one is not fit: what the model itself loses.
        size: of the picture, if it is not to be the usual one.
        fireflies: largest pixel at most, as a multiple of that of the picture that looks the same;
            None if nothing is known about it.
        prepare: what is done with the renderer before it renders.
        refused: presets whose settings do not go with these.
        features: values that the plan has to have, that it is a case of what it says.
        slots: of every hash table, and cells of the map of photons, if not as many as usual.
        loads: part of tables that has to be full, by their names in the statistics, to 0.005;
            where a preset has them.
    """

    name: str
    scene: Callable[[int], Scene]
    truth: float | str
    calm: str | None
    untimed: str = ""
    per: str = "sample"
    settings: Mapping[str, Any] = field(default_factory=dict)
    spp: float = 1.0
    own_spp: int = 0
    tolerance: float = 0.0
    size: tuple[int, int] | None = None
    fireflies: float | None = 4.0
    prepare: Callable[[Renderer], None] = lambda renderer: None
    refused: tuple[str, ...] = ()
    features: Mapping[str, int] = field(default_factory=dict)
    slots: int | None = None
    loads: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if (self.calm is None) != bool(self.untimed):
            raise ValueError(f"{self.name}: expected a calm case, or why there is none")


@contextlib.contextmanager
def tables_of(slots: int | None) -> Iterator[None]:
    """Have renderers that are made and used meanwhile keep tables of so many slots."""
    with contextlib.ExitStack() as stack:
        for module, name in SIZES if slots is not None else ():
            stack.enter_context(mock.patch.object(module, name, lambda *sizes: slots))
        yield


def grey(value: float) -> tuple[float, float, float]:
    """Return three times the same number."""
    return (value, value, value)


def matt(albedo: float, **values: Any) -> Material:
    """Return a Lambertian material."""
    return Material(base_color=grey(albedo), specular=0.0, **values)


def scene_of(parts: Iterable[Part], view: Camera, edge: int, sky: float = 0.0) -> Scene:
    """Return a square picture of ``parts`` under a grey sky."""
    parts = list(parts)
    return Scene(
        "a case",
        edge,
        edge,
        cameras=(view,),
        materials=tuple(material for _, _, material in parts) or (Material(),),
        shapes=tuple(
            Shape(mesh.name, mesh, matrix, index) for index, (mesh, matrix, _) in enumerate(parts)
        ),
        environment=Environment(grey(sky)),
    )


def camera(
    position: Sequence[float], target: Sequence[float], degrees: float = 45.0, **values: Any
) -> Camera:
    """Return a camera that looks from a position at a target."""
    return Camera(
        transform.look_at(position, target, (0.0, 1.0, 0.0)), float(np.radians(degrees)), **values
    )


# The room: matt walls, a ball, a lamp; about 350 triangles and so a tree.


def room_parts(lamp: float = 0.5, radiance: float = 10.0) -> dict[str, Part]:
    """Return walls of a room of 2 m around the origin, a ball and a lamp of that edge."""
    down = transform.translation((0.0, 0.99, 0.0)) @ transform.rotation_xyz_degrees((180, 0, 0))
    inside = primitives.box()
    inside = dataclasses.replace(inside, triangles=inside.triangles[:, ::-1].copy(), normals=None)
    ball = transform.translation((0.3, -0.6, 0.1)) @ transform.scaling(0.4)
    return {
        "walls": (inside, np.eye(4), matt(0.6)),
        "ball": (primitives.sphere(20, 8), ball, matt(0.8)),
        "lamp": (
            primitives.quad(),
            down @ transform.scaling(lamp / 2),
            Material(base_color=grey(0.0), specular=0.0, emission=grey(radiance)),
        ),
    }


ROOM_VIEW = ((0.0, 0.0, 0.95), (0.0, -0.2, -1.0), 60.0)


def room(
    edge: int,
    change: Callable[[dict[str, Part]], dict[str, Part]] = lambda parts: parts,
    scale: float = 1.0,
    move: Sequence[float] = (0.0, 0.0, 0.0),
    **lamp: float,
) -> Scene:
    """Return the room with parts changed, then scaled about the origin, then moved."""
    place = transform.translation(move) @ transform.scaling(scale)
    parts = change(room_parts(**lamp))
    where, target, degrees = ROOM_VIEW
    points = [(place @ [*point, 1.0])[:3] for point in (where, target)]
    moved = [(mesh, place @ matrix, material) for mesh, matrix, material in parts.values()]
    return scene_of(moved, camera(*points, degrees), edge)


def room_case(name: str, calm: str | None = "room", **values: Any) -> Case:
    """Return a case of the room; ``values`` are those of ``Case``, the rest of ``room``."""
    known = {item.name for item in dataclasses.fields(Case)}
    own = {key: values.pop(key) for key in [*values] if key in known}
    own.setdefault("scene", lambda edge: room(edge, **values))
    return Case(name, truth=own.pop("truth", "room"), calm=calm, **own)


def sliced(mesh: Mesh, cuts: int = 40) -> Mesh:
    """Return the unit quad in strips whose widths span seven decades."""
    widths = np.logspace(-7, 0, cuts)
    edges = np.concatenate([[0.0], np.cumsum(widths)])
    x = edges / edges[-1] * 2.0 - 1.0
    low, high = mesh.positions[:, 2].min(), mesh.positions[:, 2].max()
    points = np.array([(a, 0.0, z) for a in x for z in (low, high)], np.float32)
    first = 2 * np.arange(cuts, dtype=np.uint32)[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([2, 1, 3])]).astype(
        np.uint32
    )
    return Mesh("slivers", points, triangles)


def subdivided(count: int) -> Mesh:
    """Return the unit quad, front up, in 2 * count^2 triangles."""
    axis = np.linspace(-1.0, 1.0, count + 1, dtype=np.float32)
    x, z = np.meshgrid(axis, axis)
    points = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
    row = np.arange(count)
    corner = (row[:, None] * (count + 1) + row).reshape(-1, 1)
    after = corner + count + 1
    triangles = np.concatenate(
        [np.hstack([corner, after, corner + 1]), np.hstack([corner + 1, after, after + 1])]
    )
    return Mesh("grid", points, triangles.astype(np.uint32))


def with_floor(parts: dict[str, Part], mesh: Mesh, matrix: np.ndarray | None = None) -> None:
    """Add a floor that lies in the plane of the room's own."""
    at = transform.translation((0.0, -1.0, 0.0))
    parts["floor"] = (mesh, at if matrix is None else matrix, parts["walls"][2])


def with_slivers(parts: dict[str, Part]) -> dict[str, Part]:
    """Cover the floor with slivers."""
    with_floor(parts, sliced(primitives.quad()), transform.translation((0.0, -0.9999, 0.0)))
    return parts


def with_overlaps(parts: dict[str, Part]) -> dict[str, Part]:
    """Lay more triangles into the plane of the floor."""
    with_floor(parts, primitives.quad())
    parts["more floor"] = (
        primitives.disk(),
        transform.translation((0.1, -1.0, 0.2)) @ transform.scaling(0.7),
        parts["walls"][2],
    )
    return parts


def with_duplicates(parts: dict[str, Part]) -> dict[str, Part]:
    """Have all triangles but those of the lamp twice."""
    return {**parts, "walls too": parts["walls"], "ball too": parts["ball"]}


def with_mixed_sizes(parts: dict[str, Part]) -> dict[str, Part]:
    """Add triangles of 1e-6 m on the floor, and a ground of 1e4 m below the room."""
    chance = np.random.default_rng(1)
    places = np.column_stack(
        [chance.uniform(-0.9, 0.9, 300), np.full(300, -0.99), chance.uniform(-0.9, 0.9, 300)]
    )
    points = places[:, None] + 1e-6 * chance.standard_normal((300, 3, 3))
    dust = Mesh("dust", points.reshape(-1, 3).astype(np.float32), np.arange(900).reshape(-1, 3))
    dust = dataclasses.replace(dust, triangles=dust.triangles.astype(np.uint32))
    ground = transform.translation((0.0, -2.0, 0.0)) @ transform.scaling(1e4)
    return {
        **parts,
        "dust": (dust, np.eye(4), parts["walls"][2]),
        "ground": (primitives.quad(), ground, parts["walls"][2]),
    }


def with_a_million_in_a_point(parts: dict[str, Part]) -> dict[str, Part]:
    """Add a million triangles of the same three corners, 1e-5 m apart."""
    corners = np.array([[0, 0, 0], [1e-5, 0, 0], [0, 1e-5, 0]], np.float32) + np.array(
        [0.9, -0.9, -0.9]
    )
    triangles = np.tile(np.arange(3, dtype=np.uint32), (10**6, 1))
    heap = Mesh("heap", corners.astype(np.float32), triangles)
    return {**parts, "heap": (heap, np.eye(4), parts["walls"][2])}


def with_many_lights(parts: dict[str, Part], cuts: int = 256) -> dict[str, Part]:
    """Cut the lamp into 2 * cuts^2 triangles: 2^17."""
    _, matrix, material = parts["lamp"]
    return {**parts, "lamp": (subdivided(cuts), matrix, material)}


def with_lights(parts: dict[str, Part]) -> dict[str, Part]:
    """Cut the lamp into as many triangles as scenes of many lights have, 2^9."""
    return with_many_lights(parts, 16)


def with_dim_light(parts: dict[str, Part]) -> dict[str, Part]:
    """Add a lamp that is a million times darker."""
    mesh, matrix, material = parts["lamp"]
    dim = matt(0.6, emission=grey(1e-6 * material.emission[0]))
    shifted = transform.translation((0.6, -0.001, 0.0)) @ matrix
    return {**parts, "dim lamp": (mesh, shifted, dim)}


def without_light(parts: dict[str, Part]) -> dict[str, Part]:
    """Take the lamp away."""
    return {name: part for name, part in parts.items() if name != "lamp"}


def room_that_moves(edge: int, by: float = 0.0) -> Scene:
    """Return the room with a ball that comes to its place after a second, moved by a distance."""
    scene = room(edge)
    walls, ball, lamp = scene.shapes
    way = Curve(np.array([0.0, 1.0]), np.array([[-0.5, 0.2, 0.3], [0.0, 0.0, 0.0]]))
    nodes = (Node(curves={"translation": way}), Node(parent=0, matrix=ball.transform))
    shapes = (walls, lamp, dataclasses.replace(ball, node=1))
    away = np.array([by, -by, 0.7 * by])
    return moved(dataclasses.replace(scene, shapes=shapes, nodes=nodes), away)


def after_a_second(renderer: Renderer) -> None:
    """Render a frame, and begin the one a second later."""
    renderer.render(spp=1)
    renderer.set_frame(1.0)


def after_a_whole_frame(renderer: Renderer) -> None:
    """Render a frame of as many samples as are usual, and begin the next one."""
    renderer.render(spp=64)
    renderer.set_frame(1.0)


def after_many_frames(renderer: Renderer) -> None:
    """Begin a frame as if those before had been 2^26 samples."""
    after_a_whole_frame(renderer)
    records = {"history": HISTORY.dtype, "kept_cells": CELL_HISTORY.dtype}
    for name in records.keys() & renderer.buffers.keys():
        history = renderer.device.read(renderer.buffers[name]).view(records[name])
        history["count"] *= np.float32(2.0**20)
        renderer.device.write(renderer.buffers[name], history)


def after_passes(count: int) -> Callable[[Renderer], None]:
    """Return what begins a frame as if ``count`` passes had gone before."""

    def begin(renderer: Renderer) -> None:
        counted = np.array([count], np.uint32)
        renderer.device.write(renderer.buffers["counters"], counted, COUNTER_INDEX["film_pass"])
        renderer.set_frame(0.0)

    return begin


def sequence_case(
    name: str,
    rule: str,
    prepare: Callable[[Renderer], None] = after_a_whole_frame,
    **settings: Any,
) -> Case:
    """Return a case of the room in the second frame of a sequence in which nothing moves."""
    return room_case(
        name,
        settings={"temporal": rule, **settings},
        prepare=prepare,
        refused=("mlt",),
    )


# Furnaces: a closed room of one albedo whose walls glow such that all of it has the radiance 1.


def furnace(
    edge: int,
    albedo: float = 0.5,
    depth: int = LONG,
    view: tuple[Any, ...] = ROOM_VIEW,
    scale: float = 1.0,
) -> Scene:
    """Return a furnace; paths of ``depth`` bounces bring 1 exactly."""
    bounces = sum(albedo**k for k in range(depth + 1))
    inside, matrix, _ = room_parts()["walls"]
    glowing = matt(albedo, emission=grey(1.0 / bounces))
    where, target, degrees = view
    eye = camera(scale * np.asarray(where), scale * np.asarray(target), degrees)
    return scene_of([(inside, transform.scaling(scale) @ matrix, glowing)], eye, edge)


def furnace_case(name: str, calm: str | None = "depth 1000", **values: Any) -> Case:
    """Return a case of a furnace; ``values`` are those of ``Case``, the rest of ``furnace``."""
    known = {item.name for item in dataclasses.fields(Case)}
    own = {key: values.pop(key) for key in [*values] if key in known}
    depth = values.setdefault("depth", LONG)
    own["settings"] = {"max_depth": depth} | dict(own.get("settings", {}))
    return Case(name, lambda edge: furnace(edge, **values), 1.0, calm, **own)


# A white world: what takes no light away is not to be seen before a sky of radiance 1.

BALL_VIEW = ((0.0, 0.3, 3.0), (0.0, 0.0, 0.0), 45.0)


def white_world(edge: int, parts: Sequence[Part], view: Camera | None = None) -> Scene:
    """Return ``parts`` before a sky of radiance 1."""
    return scene_of(parts, view or camera(*BALL_VIEW), edge, sky=1.0)


def ball_mesh() -> Mesh:
    """Return a ball of 1 m; flat, for shading normals alone let light get lost."""
    return dataclasses.replace(primitives.sphere(48, 24), normals=None)


def around_ball() -> float:
    """Return the part of the picture that is not before the ball: what is convex looks convex."""
    where, target, degrees = BALL_VIEW
    to_camera = np.linalg.inv(camera(where, target).transform)
    points = ball_mesh().positions @ to_camera[:3, :3].T + to_camera[:3, 3]
    seen = points[:, :2] / -points[:, 2:] / np.tan(np.radians(degrees) / 2.0)
    return 1.0 - convex_area(seen) / 4.0


def convex_area(points: np.ndarray) -> float:
    """Return the area of the convex hull of points ``(n, 2)``.

    Source: Andrew: Another efficient algorithm for convex hulls in two dimensions, 1979.
    """
    ordered = sorted(map(tuple, points.astype(np.float64)))
    hull: list[tuple[float, ...]] = []
    for way in (ordered, ordered[::-1]):
        first = len(hull)
        for x, y in way:
            while len(hull) - first >= 2:
                (a, b), (c, d) = hull[-2:]
                if (c - a) * (y - b) - (d - b) * (x - a) > 0.0:
                    break
                hull.pop()
            hull.append((x, y))
        hull.pop()
    x, y = np.transpose(hull)
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0)


def ball_case(name: str, material: Material, calm: str | None, **values: Any) -> Case:
    """Return a case of a ball in the white world, or of balls in each other (``radii``)."""
    known = {item.name for item in dataclasses.fields(Case)}
    own = {key: values.pop(key) for key in [*values] if key in known}
    own["settings"] = {"max_depth": LONG} | dict(own.get("settings", {}))
    radii = values.pop("radii", (1.0,))
    parts = [(ball_mesh(), transform.scaling(radius), material) for radius in radii]
    return Case(
        name, lambda edge: white_world(edge, parts, **values), own.pop("truth", 1.0), calm, **own
    )


def glass(ior: float = 1.5, roughness: float = 0.0) -> Material:
    """Return glass that takes no light away."""
    return Material(base_color=grey(1.0), transmission=1.0, ior=ior, roughness=roughness)


def metal(roughness: float) -> Material:
    """Return a metal that takes no light away."""
    return Material(base_color=grey(1.0), metallic=1.0, roughness=roughness)


def grazing(material: Material) -> Callable[[int], Scene]:
    """Return a plane that is seen at 89.9 degrees."""
    height = 100.0 * np.sin(np.radians(0.1))
    eye = camera((0.0, height, 100.0), (0.0, 0.0, 0.0), 0.02)
    parts = [(primitives.quad(), transform.scaling(1e4), material)]
    return lambda edge: white_world(edge, parts, eye)


def tiny_light(edge: float, radiance: float) -> Callable[[int], Scene]:
    """Return the floor below a lamp of ``edge`` m; the camera does not see the lamp."""
    parts = room_parts(edge, radiance)
    eye = camera((0.0, 0.9, 0.9), (0.0, -1.0, 0.0), 40.0)
    return lambda size: scene_of(parts.values(), eye, size)


CASES: tuple[Case, ...] = (
    room_case("room", truth="room"),
    # What the others are compared with, by an estimator that has no part of it.
    room_case("room without shadow rays", settings={"direct_sampling": "bsdf"}, spp=16),
    *(room_case(f"scaled by {scale:g}", scale=scale) for scale in (1e-6, 1e-4, 1e-2, 1e2, 1e5)),
    *(room_case(f"moved by {by:g}", move=(by, -by, 0.7 * by)) for by in (1e3, 1e4, 1e5, 1e6)),
    room_case("1e-6 and 1e4 m together", change=with_mixed_sizes),
    room_case("slivers", change=with_slivers),
    room_case("duplicates", change=with_duplicates),
    room_case("coplanar overlaps", change=with_overlaps),
    room_case("a million triangles in a point", change=with_a_million_in_a_point),
    # What finds one of them goes down a level of a tree for each power of two.
    *(
        room_case(
            f"{count} lights{how}",
            f"2^9 lights{how}",
            change=change,
            settings=settings,
            features=features,
            refused=refused,
        )
        for how, settings, features, refused in (
            ("", {}, {}, ()),
            (", a tree of them", {"light_sampling": "hierarchy"}, {"LIGHT_SAMPLING": 1}, ()),
            (", photons of them", {"light_sampling": "photon"}, {"LIGHT_SAMPLING": 2}, ("mlt",)),
        )
        for count, change in (("2^9", with_lights), ("2^17", with_many_lights))
    ),
    room_case("lights 1e6 : 1", change=with_dim_light),
    Case("no light", lambda edge: room(edge, without_light), 0.0, "room"),
    room_case("radiance 1e-12", radiance=1e-12, truth="room * 1e-13"),
    room_case("radiance 1e12", radiance=1e12, truth="room * 1e11"),
    Case("small light", tiny_light(2e-2, 2.5e3), "small light", "small light"),
    Case("light of 1e-4 m at 1e8", tiny_light(1e-4, 1e8), "small light", "small light"),
    furnace_case("depth 1000"),
    furnace_case("furnace of albedo 0.99", albedo=0.99, per="ray"),
    furnace_case("furnace of albedo 0.999", albedo=0.999, per="ray"),
    furnace_case("furnace of albedo 1", albedo=1.0, per="ray"),
    furnace_case(
        "furnace of albedo 1 without roulette",
        albedo=1.0,
        settings={"termination": "off"},
        spp=0.25,
        per="ray",
    ),
    furnace_case("furnace of 1e-6 m", scale=1e-6),
    furnace_case("depth 0", "depth 3", depth=0),
    furnace_case("depth 1", "depth 3", depth=1),
    furnace_case("depth 3", "depth 3", depth=3),
    furnace_case("camera on a wall", view=((0.2, -1.0, 0.3), (0.0, 0.0, -1.0), 60.0)),
    furnace_case("camera in a corner", view=((-1.0, -1.0, -1.0), (0.0, 0.0, 0.0), 60.0)),
    furnace_case("field of view 0.1", view=(*ROOM_VIEW[:2], 0.1)),
    furnace_case("field of view 179", view=(*ROOM_VIEW[:2], 179.0)),
    furnace_case(
        "1x1 pixel",
        None,
        depth=3,
        size=(1, 1),
        own_spp=1 << 16,
        untimed=FEW_PIXELS,
    ),
    furnace_case("8192x64 pixels", "depth 3", depth=3, size=(8192, 64), spp=0.05),
    furnace_case(
        "1e6 samples of a pixel",
        None,
        depth=1,
        size=(1, 1),
        own_spp=10**6,
        untimed=FEW_PIXELS,
    ),
    # Samples are counted from pass to pass and from frame to frame.
    room_case("beyond 2^24 passes", prepare=after_passes(2**24 - 8)),
    room_case("a frame later", scene=room_that_moves, prepare=after_a_second),
    room_case(
        "a frame later, 1e5 m away",
        scene=lambda edge: room_that_moves(edge, 1e5),
        prepare=after_a_second,
    ),
    *(
        sequence_case(f"newest frame weighs {alpha:g}", "exponential", temporal_alpha=alpha)
        for alpha in (1e-6, 1.0)
    ),
    sequence_case("after 2^26 samples", "cumulative", prepare=after_many_frames),
    furnace_case("tiny cells", "depth 3", depth=3, settings=TINY_CELLS),
    furnace_case("huge cells", "depth 3", depth=3, settings=HUGE_CELLS),
    room_case("tiny cells in the room", settings=TINY_CELLS),
    room_case("huge cells in the room", settings=HUGE_CELLS),
    # Every sample wants a slot.  A bucket that overflows is given up, and its slots stay full.
    furnace_case(
        "a table with one slot left",
        None,
        depth=3,
        size=(9, 7),
        spp=16,
        settings=TINY_CELLS,
        loads={"cells": 63 / 64},
        untimed=FEW_PIXELS,
    ),
    furnace_case(
        "a table 99 % full",
        "depth 3",
        depth=3,
        size=(80, 60),
        settings=TINY_CELLS,
        slots=4096,
        loads={"cells": 0.99},
    ),
    furnace_case("tables of one slot", "depth 3", depth=3, slots=1, loads=ALL_FULL),
    room_case("tables of one slot in the room", slots=1, loads=ALL_FULL),
    *(
        room_case(name, "a cache", settings=CACHE, refused=("mlt",), **values)
        for name, values in (
            ("a cache", {}),
            ("a cache of one slot", {"slots": 1, "loads": ALL_FULL}),
        )
    ),
    # The guide learns by means, which have no rate: what it may decide goes from nothing to 99 %,
    # the most that leaves every direction possible.
    room_case("what was learned decides nothing", settings={"guide_share": 0.0}),
    room_case("what was learned decides 99 %", settings={"guide_share": 0.99}),
    room_case("1 photon", settings={"photons": 1}),
    room_case("1e7 photons", settings={"photons": 10**7}, spp=0.5, per="ray"),
    ball_case("matt ball", matt(1.0), "matt ball"),
    ball_case("glass", glass(), "glass"),
    ball_case("glass of index 1", glass(1.0), "glass"),
    ball_case("glass of index 1.0001", glass(1.0001), "glass"),
    # A 400th of its light has gone farther than a thousand bounces.
    ball_case("glass of index 5", glass(5.0), "glass", settings={"max_depth": 8 * LONG}, per="ray"),
    ball_case("glass of roughness 1e-4", glass(1.5, 1e-4), "glass"),
    ball_case("nested glass", glass(), "glass", radii=(1.0, 0.7, 0.4), per="ray"),
    # Radiance is denser there by the square of the index.
    ball_case(
        "camera inside of glass",
        glass(),
        "glass",
        truth=2.25,
        view=camera((0.5, 0, 0), (0, 0, 0)),
        per="ray",
    ),
    ball_case("metal", metal(0.3), "metal", tolerance=METAL_LOSS),
    ball_case("metal of roughness 0", metal(0.0), "metal"),
    ball_case("metal of roughness 1e-4", metal(1e-4), "metal"),
    ball_case("metal of roughness 1", metal(1.0), "metal", tolerance=METAL_LOSS),
    Case("plane at 89.9 degrees", grazing(matt(1.0)), 1.0, "matt ball"),
    Case("metal at 89.9 degrees", grazing(metal(0.3)), 1.0, "metal", tolerance=METAL_LOSS),
    ball_case(
        "alpha 1", matt(0.0, alpha=1.0, alpha_mode="blend"), "matt ball", truth=around_ball()
    ),
    ball_case("alpha 0", matt(0.0, alpha=0.0, alpha_mode="blend"), "matt ball"),
    ball_case("black ball", matt(0.0), "matt ball", truth=around_ball()),
)
