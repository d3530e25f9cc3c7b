"""Load, plan, schedule, return: the one place that knows the order of the stages."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from psf_cl import __version__, learned, motion, tables
from psf_cl.chains import Chains
from psf_cl.checkpoint import KIND, Checkpoint, read_checkpoint, write_checkpoint
from psf_cl.device import layout
from psf_cl.device.builders import Wanted, build_programs, builders_for
from psf_cl.device.bvh import MIN_STACK_SIZE, Bvh, Refit, build_bvh, warm_up_builder
from psf_cl.device.device import Buffer, Device, open_device
from psf_cl.device.hash_map import buckets_of
from psf_cl.device.light_tree import LightTree, warm_up_light_tree
from psf_cl.device.primitives import Primitives
from psf_cl.device.program import Launch, Program
from psf_cl.device.sources import source_digest
from psf_cl.device.two_levels import build_two_levels
from psf_cl.errors import DeviceError, InputError, NoRoomError
from psf_cl.features import whole_kinds
from psf_cl.few import NO_PLATES, Few, Plates, list_of
from psf_cl.image import Image
from psf_cl.instancing import Placed, place
from psf_cl.launches import CellLaunches, bind_cells, bind_pictures, run
from psf_cl.measure.errors import error_of_halves
from psf_cl.mover import Mover
from psf_cl.pictures import image_of
from psf_cl.plan import Plan, Room, make_plan
from psf_cl.scene import animation
from psf_cl.scene.digest import scene_digest
from psf_cl.scene.far import far_from_origin, moved
from psf_cl.scene.load import load_scene
from psf_cl.scene.model import Scene
from psf_cl.scheduler import MAX_PASSES, Hooks, Progress, Scheduler, doubling_epoch, longest_epoch
from psf_cl.settings import Settings, resolve
from psf_cl.soundness import fault_of_render
from psf_cl.stages import (
    cache,
    cell_history,
    cells,
    film,
    guide,
    material_cells,
    metropolis,
    photons,
    range_search,
    restore,
    screen,
    temporal,
    virtual_lights,
)
from psf_cl.state_file import refuse_fault
from psf_cl.stats import statistics_of

#: Looks of the host at the counters for each count of the paths by depth, which takes 0.4 ms on two
#: CPU cores; the first look, which is left out, is at a pool that is still empty.
LOOKS_PER_CENSUS = 8

#: Share of the bytes that a device had no room for with which the next attempt is made.
LESS_ROOM = 0.7

#: Cost of the tree, relative to when it was built, from which on another one is built.
REBUILD_RATIO = 1.15

#: Passes before the error is estimated for the first time, and the ratio from then on.
FIRST_ESTIMATE = 16
ESTIMATE_STEP = 1.25


class Renderer:
    """One scene on one device, rendered pass by pass.

    Args:
        outputs: AOVs to deliver besides the image (``psf_cl.plan.AOVS``).
        time: s, of the first frame of a scene that moves.
        statistics: whether to measure stages (if ``device`` profiles) and occupancy for ``stats``.
        halves: whether to sum half of the passes apart, which ``estimated_error`` needs.
        crop: (x, y, width, height) in pixels, or None for the whole film.
        full: build with every feature, to measure what leaving them out gains.
        room: bytes that may be taken; what the device has, if that is less or none is given.

    Raises:
        InputError: the settings or outputs do not fit the scene.
        DeviceError: the device failed or has no room.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings | None = None,
        device: Device | None = None,
        outputs: Iterable[str] = (),
        crop: tuple[int, int, int, int] | None = None,
        statistics: bool = False,
        full: bool = False,
        halves: bool = False,
        room: Room | None = None,
        time: float = 0.0,
    ) -> None:
        self.far = far_from_origin(scene)
        scene = scene if self.far is None else moved(scene, -self.far)
        self.moving = scene
        self.scene = animation.shaped(scene, time)
        self.time = time
        self.settings = settings or resolve(scene.render, scene.path)
        if not scene.cameras:
            raise InputError(f"{scene.path}: no camera")
        self.device = device or open_device(profiling=statistics)
        there = Room(self.device.memory_bytes, self.device.largest_buffer)
        if room is not None:
            there = Room(min(room.total, there.total), min(room.largest, there.largest))

        def plan_for(room: Room) -> Plan:
            traits = self.device.traits
            return make_plan(
                scene, self.settings, outputs, traits, crop, statistics, full, halves, room
            )

        self.plan: Plan = plan_for(there)
        self.running = self.plan
        self.guide_out: int | None = None
        self.loaded: str | None = None
        self.compile_seconds = 0.0
        self.technique_seconds = 0.0
        self.statistics = statistics
        self.other_device = ""
        self.looks = 0
        self.censuses = 0
        self.programs: dict[str, Program] = {}
        self.depth_counts = np.zeros(film.CENSUS_BINS)
        self.refit: Refit | None = None
        self.light_tree: LightTree | None = None
        self.range_search: range_search.RangeSearch | None = None
        self.rebuilds = self.unbuilt = 0
        self.changed = False
        # Lights have changed since the radiance cache was last asked for.
        self.relit = False
        self.buffers: dict[str, Buffer] = {}
        try:
            self._set_up(plan_for)
        except BaseException:
            self.close()
            raise
        self.scheduler = Scheduler(
            Hooks(self._bounce, self._film, self._counters, self._limit, self._between),
            self.plan.traits.slots,
            self._epoch_end if self.plan.in_epochs else None,
        )
        self.scheduler.clock.seconds += self.technique_seconds

    def _set_up(self, plan_for: Callable[[Room], Plan]) -> None:
        """Load and build while a second thread compiles."""
        background = ThreadPoolExecutor(1)
        try:
            # What is compiled does not depend on how much room there is.
            compiling = background.submit(self._compile, MIN_STACK_SIZE)
            while True:
                try:
                    self._fill_buffers()
                    break
                except NoRoomError as error:
                    # Only by failing do drivers tell how much is free.
                    self._release()
                    try:
                        self.plan = plan_for(Room(int(LESS_ROOM * self.plan.peak_bytes)))
                        self.running = self.plan
                    except DeviceError:
                        raise DeviceError(
                            f"{error}; a smaller --size or --crop, or fewer --aov, need less"
                        ) from error
            self.programs = compiling.result()
        finally:
            # An error or Ctrl-C is told now, not when the compiler has come to its end.
            background.shutdown(wait=False)
        if self.bvh is not None and self.bvh.stack_size != MIN_STACK_SIZE:
            self.programs = self._compile(self.bvh.stack_size)
        self._bind(self.programs)

    def _fill_buffers(self) -> None:
        start = time.perf_counter()
        self._allocate()
        geometry = self._upload_scene()
        self.load_seconds = time.perf_counter() - start
        self.build_seconds = 0.0
        self.bvh: Bvh | None = None
        self.mover: Mover | None = None
        if self.plan.features["MOTION"].value:
            self._set_moving(geometry, self.few)
        if not self.plan.features["FEW"].value:
            self.compile_seconds += warm_up_builder(self.device)
            start = time.perf_counter()
            self._build_bvh(geometry)
            self.build_seconds = time.perf_counter() - start
        if "light_pairs" in {spec.name for spec in self.plan.scene_buffers}:
            self._build_light_tree(geometry)

    # What happens each bounce, in its order.

    def _bounce(self) -> None:
        for launch, items in self.bounce_launches:
            launch(items)

    def _film(self) -> None:
        if self.range_search is not None:
            self.range_search.filter_passes(self.device.read(self.buffers["counters"]))
        if self.cells is not None:
            run(self.cells.share)
        for launch in self.splat_launches:
            launch(self.film_items(1), film.GROUP)
        for launch, planes in self.film_launches:
            launch(self.film_items(planes), film.GROUP)
        if self.half is not None:
            self.half(self.film_items(1), film.GROUP)
        if self.add_seen is not None:
            self.add_seen(self.film_items(1), film.GROUP)
        if self.cells is not None:
            self.cells.clear(self.plan.cell_buckets)
        self.advance(1)

    def film_items(self, planes: int) -> int:
        """Return the work items that add up ``planes`` of the film."""
        return -(-planes * self.plan.pixel_count // self.plan.traits.lanes)

    def _counters(self) -> np.ndarray:
        if self.statistics and self.looks % LOOKS_PER_CENSUS == 1:
            self.census(self.plan.traits.slots, film.GROUP)
            self.depth_counts += self.device.read(self.buffers["census"])
            self.device.fill(self.buffers["census"])
            self.censuses += 1
        self.looks += 1
        counters = self.device.read(self.buffers["counters"], layout.COUNTER_INDEX["finished"])
        self.device.collect_events()
        return counters

    def _limit(self, passes: int) -> None:
        value = np.array([passes], np.uint32)
        self.device.write(self.buffers["counters"], value, layout.COUNTER_INDEX["pass_limit"])

    def _between(self, start: int) -> None:
        """Do what the paths of an epoch need that begins with pass ``start``."""
        if "guide_cells" in self.buffers:
            self._teach(start)
        if self.freeze_cache is not None:
            self._freeze_cache(start)
        if "guide_cells" in self.buffers or self.freeze_cache is not None:
            self._limit_learning(start)
        if self.freeze_materials is not None:
            self._freeze_materials(start)
        if self.chains is not None:
            is_first = start == self.scheduler.first
            self.chains.start() if is_first else self.chains.measure()
        if self.photon_map is not None:
            if start == self.scheduler.first:
                self.photon_map.begin_frame(self.changed or start == 0)
            paths = len(self._epoch(start)) * self.plan.pixel_count
            count = photons.photons_for(
                self.settings, paths, self.scheduler.rays, self.photon_map.fewest
            )
            self.photon_map.add(count, self.scheduler.first)

    def _epoch_end(self, passes: int) -> int:
        """Return the pass of a frame before which the epoch ends that starts with ``passes``."""
        if not self.running.in_epochs:
            return MAX_PASSES
        longest = longest_epoch(self.plan.pixel_count)
        return doubling_epoch(passes, self.plan.shortest_epoch, longest)

    def _epoch(self, start: int) -> range:
        """Return the epoch that starts with pass ``start``, counted over all frames."""
        first = self.scheduler.first
        return range(start, first + self._epoch_end(start - first))

    # Frames.

    def set_frame(self, time: float) -> None:
        """Begin the frame at ``time``, seconds: an empty film, and everything where it is then.

        Random numbers go on where the frame before ended, so that frames of a still scene differ as
        passes do.  Counts and times begin anew.

        Raises:
            InputError: something has no place at that time.
        """
        self.device.wait()
        # Of the device: after an interrupt the host has not seen its last passes.
        first = int(self.device.read(self.buffers["counters"])[layout.COUNTER_INDEX["film_pass"]])
        whole = first > self.scheduler.first
        self.scheduler.begin_frame(first)
        self.scheduler.clock.start()
        try:
            if whole:
                self._keep_history()
            self._empty(first)
            self.time, self.scene = time, animation.posed(self.moving, time)
            values = self._camera_values()
            before = self.params[0].copy()
            values |= {new: before[name] for new, name in tables.PREVIOUS_CAMERA.items()}
            if self.mover is not None:
                self.mover.move(time)
                values["scene_radius"] = max(self.radius, self.mover.radius(self.center))
                if self.mover.moved:
                    self._fit_tree()
            if self.lights_change:
                self._change_lights()
            self.changed = self.lights_change or (self.mover is not None and self.mover.moved)
            values["history_flags"] = self._history_flags(before, values) if whole else 0
            values["frame_time"] = time
            self._set_params(values | {"first_pass": first})
            if whole:
                self._find_changes()
            self.device.wait()
        finally:
            self.scheduler.clock.stop()

    def _keep_history(self) -> None:
        """Keep the picture of the frame that ends for the next one, if that asks for it."""
        if self.pictures.keep:
            # Not what the screen filter makes of it: light would spread from frame to frame.
            run([*self.pictures.blend, *self.pictures.keep])
            if self.cells is not None and self.cells.keep is not None:
                self.cells.keep(self.plan.cell_buckets, film.GROUP)
            for launch, items in self.pictures.place:
                launch(items)

    def _find_changes(self) -> None:
        """Find where light has changed since the frame before, if that is asked for."""
        if self.changed:
            if "cell_changes" in self.buffers:
                self.device.fill(self.buffers["cell_changes"])
            for launch, items in self.pictures.compare:
                launch(items)
        elif "changes" in self.buffers:
            self.device.fill(self.buffers["changes"])

    def _history_flags(self, before: np.ndarray, values: Mapping[str, Any]) -> int:
        """Return what ``Params.history_flags`` say of the frame that begins."""
        constants = layout.CONSTANT
        same_view = all(
            np.array_equal(np.float32(values[name]), before[name])
            for name in tables.PREVIOUS_CAMERA.values()
        )
        flags = constants["HISTORY_THERE"]
        if same_view:
            flags |= constants["HISTORY_SAME_VIEW"]
            if self.mover is None or not self.mover.moved:
                flags |= constants["HISTORY_STILL"]
        if self.changed:
            flags |= constants["HISTORY_CHANGED"]
        return flags

    def _fit_tree(self) -> None:
        """Fit the tree to where triangles are now; build another if it has become too slow."""
        if self.bvh is None or self.refit is None:
            return
        self.refit.fit(self.buffers["positions"])
        if self.refit.cost_ratio() <= REBUILD_RATIO:
            return
        old, size = self.bvh, self.bvh.stack_size
        try:
            self._build_bvh(None)
        except NoRoomError:
            self.unbuilt += 1  # The tree that was fitted is as right, only slower.
            return
        self.rebuilds += 1
        if self.bvh.stack_size > size:
            self.programs = self._compile(self.bvh.stack_size)
        self._bind(self.programs)
        self.device.release(old.nodes, old.blocks)

    def _change_lights(self) -> None:
        """Write the light table and the materials anew, by what shines now and where."""
        before = self.lights, self.material_rows
        self.lights = motion.lights_at(
            self.moving, self.time, self.settings.light_sampling, self.radius, self.lights
        )
        self.material_rows = tables.material_table(self.scene.materials)
        now = self.lights, self.material_rows
        self.relit |= any(a.tobytes() != b.tobytes() for a, b in zip(before, now, strict=True))
        if "lights" in self.buffers and len(self.lights):
            self.device.write(self.buffers["lights"], self.lights)
        self.device.write(self.buffers["materials"], self.material_rows)
        if self.light_tree is not None:
            self.light_tree.launch.set(near_share=tables.near_share(self.lights))
            self.light_tree.fit(self.lights)

    def _empty(self, first: int) -> None:
        """Leave no path in the pool and no sample in the film; ``first`` is the next pass."""
        counters = np.zeros(self.buffers["counters"].count, np.uint32)
        for name in ("next_pass", "film_pass", "pass_limit"):
            counters[layout.COUNTER_INDEX[name]] = first
        self.device.write(self.buffers["counters"], counters)
        names = (name for ring, sums, _ in film.PLANES for name in (ring, sums))
        for name in (
            "pool",
            "splats",
            "film_cells",
            "film_half",
            "film_lost",
            "film_shared",
            "kept",
            "surfaces_seen",
            "shared_light",
            *names,
        ):
            if name in self.buffers:
                self.device.fill(self.buffers[name])

    def _set_params(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            self.params[0][name] = value
        self.device.write(self.buffers["params"], self.params)

    # Rendering.

    def step(self) -> None:
        """Add one pass: one sample for every pixel."""
        self.render(spp=self.scheduler.passes + 1)

    def render(
        self,
        spp: int | None = None,
        seconds: float | None = None,
        progress: Callable[[Progress], bool | None] | None = None,
    ) -> bool:
        """Add passes until there are ``spp``, or until ``seconds`` have been spent on rendering.

        Returns:
            False if ``progress`` stopped it by returning False.

        Raises:
            InputError: not exactly one of them, or a number that makes no sense.
        """
        check_budget(spp, seconds)
        return self.scheduler.run(spp, seconds, progress)

    def render_to(
        self, noise: float, progress: Callable[[Progress], bool | None] | None = None
    ) -> bool:
        """Add passes until ``estimated_error`` is at most ``noise``; as ``render`` otherwise.

        The error is looked at after 16 passes, and then whenever there are a quarter more.

        Raises:
            InputError: ``noise`` is not a positive number.
        """
        if not (math.isfinite(noise) and noise > 0.0):
            raise InputError(f"noise: expected a positive number, got {noise!r}")
        due, reached = FIRST_ESTIMATE, False

        def follow(now: Progress) -> bool | None:
            nonlocal due, reached
            if progress is not None and progress(now) is False:
                return False
            if now.passes >= due:
                with self.outside_time():
                    reached = self.estimated_error() <= noise
                due = math.ceil(now.passes * ESTIMATE_STEP)
            return not reached

        self.scheduler.run(None, None, follow)
        return reached

    def estimated_error(self) -> float:
        """Return the relMSE of the image, estimated from the image alone; infinite at the start.

        Only noise shows, not bias.  Sobol' points are better than the estimate knows, so that it
        tends to be too high.
        """
        both, half = (self.device.read(self.buffers[name]) for name in ("film", "film_half"))
        _, _, width, height = self.plan.crop
        sums = [(part["sum"] - part["lost"]).astype(np.float64) for part in (both, half)]
        counts = [part["count"].astype(np.float64)[:, None] for part in (both, half)]
        halves = []
        for total, count in ((sums[0] - sums[1], counts[0] - counts[1]), (sums[1], counts[1])):
            if not count.all():
                return math.inf
            image = np.zeros_like(total)
            image[self.order] = total / count
            halves.append(image.reshape(height, width, 3))
        share = float((counts[1] / counts[0]).mean())
        return error_of_halves(*halves, share)

    @contextlib.contextmanager
    def outside_time(self) -> Iterator[None]:
        """Do something in between that is not rendering: its time is not counted."""
        clock = self.scheduler.clock
        running = clock.started is not None
        self.device.wait()
        clock.stop()
        try:
            yield
        finally:
            if running:
                clock.start()

    def snapshot(self, names: Iterable[str] = ("rgb",)) -> Image:
        """Return the image as it is now, with only the AOVs in ``names``."""
        return image_of(self, set(names))

    def image(self) -> Image:
        """Return the image with every planned AOV and the statistics."""
        return image_of(self, {"rgb"} | self.plan.outputs)

    def settle(self) -> None:
        """Finish the passes that have begun, so that ``save`` can write a checkpoint."""
        if not self.scheduler.at_rest:
            self.scheduler.run(self.scheduler.begun, None)

    def save(self, path: str | os.PathLike[str]) -> bool:
        """Write a checkpoint, if this is a moment for one.

        While tables are being filled by the paths of an epoch it is not; passes then stop to begin
        until ``render``'s ``progress`` has seen a moment, at which this is to be called again.

        Returns:
            Whether it is written.

        Raises:
            InputError: the file cannot be written; an older one stays as it was.  Or this is no
                longer the first frame: what is kept between frames is in no checkpoint.
        """
        if self.scheduler.first:
            raise InputError(f"{path}: a checkpoint is of one image, not of a later frame")
        if not self.scheduler.at_rest:
            self.scheduler.rest()
            return False
        epoch = self.scheduler.epoch
        contents = {
            name: self.device.read(self.buffers[name], count)
            for name, (_, count) in self._lasting().items()
        }
        state = Checkpoint(
            self.identity,
            self.scheduler.passes,
            (epoch.start, epoch.stop),
            self.scheduler.clock.now(),
            self.device.name,
            contents,
        )
        write_checkpoint(path, state)
        return True

    def resume(self, path: str | os.PathLike[str]) -> None:
        """Go on from a checkpoint of the same render; only before the first pass.

        The budgets of ``render`` count what the checkpoint holds, and the image gets the bits of a
        render that never stopped (on the same device).

        Raises:
            InputError: the file is no checkpoint, is damaged or unsound, or is of another render.
        """
        state = read_checkpoint(path, self.identity, self._lasting())
        refuse_fault(path, KIND, self._fault_of(state))
        counters = state.buffers["counters"]
        index = layout.COUNTER_INDEX
        # What was on its way has to start again.
        for name in ("next_pixel", "pass_limit", "pending_camera", "pending_bounce"):
            counters[index[name]] = 0
        counters[index["pending_shadow"]] = 0
        counters[[index["next_pass"], index["film_pass"]]] = state.passes
        for name, array in state.buffers.items():
            self.device.write(self.buffers[name], array)
        self.scheduler.resume(state.passes, state.epoch, state.seconds)
        if counters[index["guide_off"]]:
            self._guide(False, state.passes)
        if state.device != self.device.name:
            self.other_device = state.device

    def _fault_of(self, state: Checkpoint) -> str | None:
        """Return why this render cannot go on from a checkpoint that claims to be its own."""
        start, end = state.epoch
        guide_off = state.buffers["counters"][layout.COUNTER_INDEX["guide_off"]] == 1
        if not self.plan.in_epochs or (guide_off and end == MAX_PASSES):
            ends = MAX_PASSES
        else:
            ends = self._epoch_end(start) if state.passes else 0
        if end != ends:
            return "its epoch is none of this render"
        groups = self.buffers.get("light_groups")
        nodes = None if groups is None else self.device.read(groups)["node"]
        return fault_of_render(
            state.buffers, self.params[0], self.plan.traits.block, state.passes, nodes
        )

    def save_cache(self, path: str | os.PathLike[str]) -> None:
        """Write what guide and radiance cache have learned, for renders from other places.

        Raises:
            InputError: nothing is learned, or the file cannot be written.
        """
        names = learned.table_names(self.settings, str(path))
        self.settle()
        tables = {name: self.device.read(self.buffers[name]) for name in names}
        learned.write_learned(path, self._learned_identity(), tables)

    def load_cache(self, path: str | os.PathLike[str]) -> None:
        """Begin with what another render has learned; only before the first pass.

        Raises:
            InputError: nothing is learned; or the file is missing, damaged, or of another scene,
                picture size, version, or settings of what learns.
        """
        names = learned.table_names(self.settings, str(path))
        buffers = {name: (self.buffers[name].dtype, self.buffers[name].count) for name in names}
        tables, self.loaded = learned.read_learned(path, self._learned_identity(), buffers)
        self.relit = False
        for name, table in tables.items():
            self.device.write(self.buffers[name], table)

    def _learned_identity(self) -> dict[str, Any]:
        """Return what tables of this render belong to: the scene, but not the cameras in it."""
        return {
            "version": f"{__version__} {source_digest()}",
            "scene": self._digest_but_cameras,
            "picture": {"size": [self.scene.width, self.scene.height]},
            "settings": {name: getattr(self.settings, name) for name in learned.SETTINGS},
            "tables": {
                f"{name}_slots": self.buffers[f"{name}_keys"].count
                for name in ("guide", "cache")
                if f"{name}_keys" in self.buffers
            },
        }

    @cached_property
    def _digest_but_cameras(self) -> str:
        """Return a digest of the scene at all times, from wherever it is seen."""
        scene = replace(self.moving, width=0, height=0, cameras=(), camera=0)
        if not (motion.moving_shapes(scene) or self.lights_change):
            # What only cameras move with is no part of it.
            scene = animation.baked(scene, None)
        return scene_digest(scene)

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Return what a checkpoint of this render belongs to, as plain JSON values."""
        return {
            "version": f"{__version__} {source_digest()}",
            "scene": scene_digest(self.scene),
            "settings": asdict(self.settings),
            "picture": {
                "size": [self.scene.width, self.scene.height],
                "crop": list(self.plan.crop),
                "aov": sorted(self.plan.outputs),
                "noise": "film_half" in self.buffers,
            },
            "loaded cache": self.loaded,
            "size of hash tables": self.plan.table_halvings,
        }

    def _lasting(self) -> dict[str, tuple[np.dtype[Any], int]]:
        """Return what a checkpoint holds: type and items of each buffer."""
        specs = (spec for stage in self.plan.stages for spec in stage.buffers if not spec.passing)
        lasting = {
            spec.name: (self.buffers[spec.name].dtype, self.buffers[spec.name].count)
            for spec in specs
        }
        # Behind them is what is on its way.
        lasting["counters"] = (lasting["counters"][0], layout.COUNTER_INDEX["finished"])
        return lasting

    def stats(self) -> dict[str, Any]:
        """Return what ``--stats`` writes, without errors against a reference."""
        return statistics_of(self)

    def _teach(self, start: int) -> None:
        """Draw the epoch of pass ``start`` by what was learned so far, if that pays."""
        new_frame = start == self.scheduler.first > 0
        if self.guide_out is not None and new_frame and self.changed:
            if start - self.guide_out >= guide.PASSES_WITHOUT:
                self._guide(True, start)
        if self.guide_out is None:
            slots = self.buffers["guide_keys"].count
            if new_frame:
                self.renew_guide(buckets_of(slots), film.GROUP)
            # What was learned from little fades, and what was true before something changed.
            fades = self._is_new(start) or (new_frame and self.changed)
            self.freeze_guide.set(fades=int(fades))
            self.freeze_guide(slots, film.GROUP)
            if start >= guide.FIRST_DECISION or self.loaded:
                cells = self.device.read(self.buffers["guide_cells"])
                if not guide.is_worth_it(cells, self.settings.guide_share):
                    self._guide(False, start)
                elif start == guide.FIRST_DECISION and not (self.scheduler.first or self.loaded):
                    halvings = guide.early_halvings(cells, self.settings.guide_share)
                    for launch, planes in self.fade_film:
                        launch.set(halvings=halvings)
                        launch(self.film_items(planes), film.GROUP)

    def _freeze_cache(self, start: int) -> None:
        """Let paths of the epoch of pass ``start`` end by what was gathered so far."""
        slots = self.buffers["cache_keys"].count
        new_frame = start == self.scheduler.first > 0
        if new_frame:
            self.renew_cache(buckets_of(slots), film.GROUP)
        if self.relit and start == self.scheduler.first:
            self.relit = False
            # Half of what a lamp lit that has gone out would outshine what is left for many frames.
            for name in cache.BUFFERS:
                self.device.fill(self.buffers[name])
        fades = self._is_new(start) or (new_frame and self.changed)
        self.freeze_cache.set(fades=int(fades))
        self.freeze_cache(slots, film.GROUP)

    def _freeze_materials(self, start: int) -> None:
        """Let later vertices of the epoch of pass ``start`` know what was looked up so far."""
        if start == self.scheduler.first > 0 and self.changed:
            # Textures have moved.
            for name in material_cells.BUFFERS:
                self.device.fill(self.buffers[name])
        self.freeze_materials(self.buffers["material_keys"].count, film.GROUP)

    def _is_new(self, start: int) -> bool:
        """Return whether what is known at pass ``start`` was learned from little."""
        return 0 < start <= guide.FADING_PASSES and not self.loaded

    def _limit_learning(self, start: int) -> None:
        """Say which passes of the epoch of pass ``start`` guide and cache learn from."""
        left_out = self.guide_out is not None
        learning = self.freeze_cache is not None or not left_out
        count = self.plan.pixel_count
        limit = guide.learn_limit(self._epoch(start), count) if learning else 0
        for name, value in (("guide_off", left_out), ("learn_limit", limit)):
            at = layout.COUNTER_INDEX[name]
            self.device.write(self.buffers["counters"], np.array([value], np.uint32), at)

    def _guide(self, on: bool, start: int) -> None:
        """Go on with or without the guide from pass ``start`` on; no path may be on its way.

        The programs without it are those of a render that has none: it costs nothing from then on.
        """
        self.guide_out = None if on else start
        self.running = self.plan
        if not on:
            self.running = self.plan.without("GUIDE", "guide", "the guide does not pay here")
        with self.outside_time():
            self.programs = self._compile(self.bvh.stack_size if self.bvh else MIN_STACK_SIZE)
            self._bind(self.programs)
            # Paths have other fields now; slots that waited for a later pass have lost it.
            self.device.fill(self.buffers["pool"])
            for name, value in (("next_pass", start), ("next_pixel", 0)):
                at = layout.COUNTER_INDEX[name]
                self.device.write(self.buffers["counters"], np.array([value], np.uint32), at)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know that only building the scene has shown, one sentence each."""
        notes = []
        if self.far is not None:
            notes.append(
                f"the scene lies {np.linalg.norm(self.far):.3g} m away from the origin: it is "
                "rendered as if it were there"
            )
        if self.dropped_triangles:
            notes.append(
                f"{self.dropped_triangles} triangles are left out: a coordinate is not finite"
            )
        if self.other_device:
            notes.append(
                f"the checkpoint is from {self.other_device}: the image will not be that of one "
                "device, bit for bit"
            )
        return tuple(notes)

    def close(self) -> None:
        """Give the device memory back."""
        self.device.wait()
        self._release()

    def _release(self) -> None:
        if self.refit is not None:
            self.refit.release()
            self.refit = None
        if self.range_search is not None:
            self.range_search.release()
            self.range_search = None
        self.device.release(*self.buffers.values())
        self.buffers.clear()

    # Set-up.

    def _allocate(self) -> None:
        for stage in self.plan.stages:
            for spec in stage.buffers:
                self.buffers[spec.name] = self.device.allocate(spec.name, spec.dtype, spec.count)
        # Where each pixel of the queue's order lies in the crop.
        self.order = tables.pixel_order(*self.plan.crop[2:])

    def _upload_scene(self) -> tables.Geometry:
        scene, planned = self.scene, {spec.name for spec in self.plan.scene_buffers}
        self.placed = place(scene, self.plan.levels) if self.plan.levels is not None else None
        if self.placed is not None:
            geometry = self.placed.geometry
        else:
            leveled = self.plan.features["TEXTURE_LEVELS"].value > 0
            geometry = tables.flatten(scene, densities=leveled)
        self.lights = lights = tables.light_table(
            scene,
            geometry,
            self.settings.light_sampling,
            whole_kinds(self.plan.features),
        )
        textures, texels = tables.texture_tables(
            scene.textures if "textures" in planned else (),
            geometry.count,
            tables.leveled_textures(scene) if self.plan.features["TEXTURE_LEVELS"].value else (),
        )
        few, plates = None, NO_PLATES
        if self.plan.features["FEW"].value:
            labels = motion.corner_labels(self.moving)
            few, plates = list_of(geometry, scene.materials, labels)
        self.dropped_triangles = few.dropped if few else 0
        self.few = few
        self.surfaces = geometry.surfaces
        if self.placed is not None:
            self.surfaces = self.surfaces[: self.placed.starts[1]]
        self.off_surfaces: tuple[np.ndarray, np.ndarray] | None = None
        self.params = self._params(geometry, few, plates, lights)
        self.center, self.radius = geometry.center, geometry.radius
        self.cut_out = geometry.cut_out
        self.lights_change = motion.lights_change(self.moving)
        self.material_rows = tables.material_table(scene.materials)

        def or_zeros(table: np.ndarray | None, record: layout.Record) -> np.ndarray:
            return np.zeros(geometry.count, record.dtype) if table is None else table

        contents = {
            "params": lambda: self.params,
            "corners": lambda: few.corners.reshape(-1),
            "faces": lambda: few.faces.reshape(-1),
            "plates": lambda: plates.padded(geometry.count),
            "surfaces": lambda: geometry.surfaces,
            "materials": lambda: self.material_rows,
            "normals": lambda: or_zeros(geometry.normals, layout.NORMALS),
            "uvs": lambda: or_zeros(geometry.uvs, layout.UVS),
            "colors": lambda: (
                np.ones(geometry.count, layout.VERTEX_COLORS.dtype)
                if geometry.colors is None
                else geometry.colors
            ),
            "tangents": lambda: or_zeros(geometry.tangents, layout.TANGENTS),
            "textures": lambda: textures,
            "texels": lambda: texels.reshape(-1),
            "srgb_to_linear": tables.srgb_to_linear,
            "lights": lambda: lights if len(lights) else np.zeros(1, layout.LIGHT.dtype),
            "environment": lambda: tables.environment_cells(scene.environment),
        }
        for name, content in contents.items():
            if name in planned:
                self.buffers[name] = self.device.upload(name, content())
        return geometry

    def _camera_values(self) -> dict[str, Any]:
        """Return where the camera is, off the surfaces of the first frame."""
        scene = self.scene
        camera = scene.cameras[scene.camera]
        values = tables.camera_values(camera, scene.width, scene.height)
        if self.off_surfaces is None or not np.array_equal(self.off_surfaces[0], camera.transform):
            origin = tables.off_surfaces(
                values["camera_origin"], values["camera_forward"], self.surfaces
            )
            self.off_surfaces = camera.transform, origin
        values["camera_origin"] = self.off_surfaces[1]
        return values

    def _params(
        self,
        geometry: tables.Geometry,
        few: Few | None,
        plates: Plates,
        lights: np.ndarray,
    ) -> np.ndarray:
        scene, settings = self.scene, self.settings
        params = np.zeros(1, layout.PARAMS.dtype)
        values: dict[str, Any] = self._camera_values()
        image = scene.environment.image
        values |= {
            "width": scene.width,
            "height": scene.height,
            "pixel_count": self.plan.pixel_count,
            "crop_x": self.plan.crop[0],
            "crop_y": self.plan.crop[1],
            "crop_width": self.plan.crop[2],
            "crop_height": self.plan.crop[3],
            "ring": self.plan.ring,
            "slots": self.plan.traits.slots,
            "seed": settings.seed,
            "max_depth": settings.max_depth,
            "splits": settings.splits,
            "split_vertex": settings.split_vertex,
            "roulette_depth": settings.roulette_depth
            if settings.termination != "off"
            else 0xFFFFFFFF,
            "light_count": len(lights),
            "environment_light": tables.environment_light(lights),
            "corner_count": len(few.corners) if few else 0,
            "face_count": len(few.faces) if few else 0,
            "plate_count": len(plates.records),
            "pair_count": plates.pairs,
            "environment_width": 1 if image is None else image.shape[1],
            "environment_height": 1 if image is None else image.shape[0],
            "environment_radiance": scene.environment.radiance,
            "sky_limit": cells.sky_limit(settings, tables.environment_mean(scene.environment)),
            "environment_rotation": np.asarray(scene.environment.rotation).T.reshape(9),
            "scene_radius": max(geometry.radius, float(np.finfo(np.float32).tiny)),
            "scene_center": geometry.center,
            "direct_sampling": layout.CONSTANT[f"DIRECT_{settings.direct_sampling.upper()}"],
            "sampler": layout.CONSTANT[f"SAMPLER_{settings.sampler.upper()}"],
        }
        moving = motion.count_moving(self.moving)
        values["first_moving"] = geometry.count - (moving.triangles if moving else 0)
        # There is no frame before the first: nothing has moved.
        values |= {new: values[name] for new, name in tables.PREVIOUS_CAMERA.items()}
        pixels, halvings = self.plan.pixel_count, self.plan.table_halvings
        values |= cells.parameters(scene, settings, pixels, halvings)
        values |= screen.parameters(settings)
        values |= metropolis.parameters(settings, self.plan.traits.slots, pixels)
        values |= temporal.parameters(settings)
        values |= cell_history.parameters(settings, self.time)
        values |= guide.parameters(scene, settings, pixels, values["scene_radius"], halvings)
        values |= cache.parameters(scene, settings, pixels, halvings)
        values |= material_cells.parameters(scene, settings, pixels, halvings)
        values |= photons.parameters(settings, len(lights), halvings)
        for name, value in values.items():
            params[0][name] = value
        return params

    def _set_moving(self, geometry: tables.Geometry, few: Few | None) -> None:
        """Put what moves where it is in the first frame."""
        if "positions" in self.buffers:
            self.device.write(self.buffers["positions"], geometry.positions.reshape(-1))
        stage = next(stage for stage in self.plan.stages if stage.per_frame)
        labels = few.vertices if few is not None else None
        self.mover = Mover(self.device, self.moving, self.buffers, self.plan.defines(stage), labels)
        self.mover.move(self.time)

    def _build_bvh(self, geometry: tables.Geometry | None) -> None:
        """Build the tree; without ``geometry`` over the positions that are on the device."""
        device = self.device
        if self.placed is not None:
            self._build_levels(self.placed)
            return
        inputs = []
        try:
            positions = self.buffers.get("positions")
            if positions is None:
                positions = device.upload("positions", geometry.positions.reshape(-1))
                inputs.append(positions)
            flags = None
            if self.plan.features["ALPHA"].value:
                flags = device.upload("alpha_flags", self.cut_out.astype(np.uint32))
                inputs.append(flags)
            self.bvh = bvh = build_bvh(device, positions, len(self.cut_out), flags)
        finally:
            device.release(*inputs)
        self.buffers |= {"nodes": bvh.nodes, "blocks": bvh.blocks}
        self.dropped_triangles = bvh.dropped
        if self.refit is not None:
            self.refit.release()
            self.refit = None
        if self.mover is not None:
            self.refit = Refit(device, bvh, self.mover.tables.first_triangle)

    def _build_levels(self, placed: Placed) -> None:
        """Build the trees of a scene of two levels, and tell its instances where theirs begin."""
        cuts = placed.starts[1:-1]
        cut_out = None
        if self.plan.features["ALPHA"].value:
            cut_out = np.split(placed.geometry.cut_out, cuts)
        bvh, roots = build_two_levels(
            self.device,
            np.split(placed.geometry.positions, cuts),
            placed.boxes,
            placed.first,
            cut_out,
        )
        self.buffers |= {"nodes": bvh.nodes, "blocks": bvh.blocks}
        placed.instances["root"] = roots[placed.part_of]
        self.buffers["instances"] = self.device.upload("instances", placed.instances)
        self.bvh, self.dropped_triangles = bvh, bvh.dropped

    def _build_light_tree(self, geometry: tables.Geometry) -> None:
        self.compile_seconds += warm_up_light_tree(self.device)
        start = time.perf_counter()
        share = tables.near_share(self.lights)
        apart = self.settings.light_sampling == "photon_origin"
        self.light_tree = LightTree(
            self.device, self.lights, self.buffers["lights"], share, geometry.radius, apart
        )
        self.buffers |= self.light_tree.buffers
        self.device.wait()
        self.technique_seconds = time.perf_counter() - start

    def _compile(self, stack_size: int) -> dict[str, Program]:
        """Build the stages' programs, down to machine code; runs beside the scene's loading."""
        start = time.perf_counter()
        wanted = {}
        for stage in self.running.stages:
            if stage.per_frame:
                continue
            defines = self.running.defines(stage)
            if stage.traces:
                defines |= {"STACK_SIZE": stack_size}
            wanted[stage.name] = Wanted(stage.source, defines, stage.kernel_names)
        built = build_programs(self.device, list(wanted.values()))
        programs = dict(zip(wanted, built, strict=True))
        self.compile_seconds += time.perf_counter() - start
        return programs

    def _bind(self, programs: dict[str, Program]) -> None:
        traits = self.plan.traits
        self.bounce_launches: list[tuple[Launch, int]] = [
            (
                programs[stage.name].bind_planned(kernel.name, self.buffers),
                -(-traits.slots // kernel.paths_per_item(traits)),
            )
            for stage in self.running.stages
            if not (stage.per_pass or stage.per_frame)
            for kernel in stage.kernels
        ]
        self.cells: CellLaunches | None = None
        self.add_unfiltered: Launch | None = None
        if "cells" in programs:
            self.cells = bind_cells(
                self.plan, programs["cells"], programs.get("cell_history"), self.buffers
            )
            self.add_unfiltered = programs["cells"].bind_planned("add_unfiltered", self.buffers)
        self._bind_range_search(programs.get("range_search"))
        self._bind_chains(programs.get("splats"))
        if "guide" in programs:
            self.freeze_guide = programs["guide"].bind_planned(
                "freeze_guide", self.buffers, fades=0
            )
            self.renew_guide = programs["guide"].bind_planned("renew_guide", self.buffers)
            shared = self.plan.features["CELLS"].value
            self.fade_film = [] if shared else self._bind_fading(programs["guide"])
            if "guide_views" in self.buffers:
                self.view_guide = programs["guide"].bind_planned("view_guide", self.buffers)
        self.freeze_cache: Launch | None = None
        if "cache" in programs:
            self.freeze_cache = programs["cache"].bind_planned(
                "freeze_cache", self.buffers, fades=0
            )
            self.renew_cache = programs["cache"].bind_planned("renew_cache", self.buffers)
        self.freeze_materials: Launch | None = None
        if "material_cells" in programs:
            self.freeze_materials = programs["material_cells"].bind_planned(
                "freeze_materials", self.buffers
            )
        self.photon_map = None
        if "photons" in programs:
            intersect = next(s for s in self.plan.stages if s.name == "intersect").kernels[0]
            paths = intersect.paths_per_item(traits)
            virtual = None
            if "virtual_lights" in programs:
                virtual = virtual_lights.VirtualLights(
                    self.device, programs["virtual_lights"], self.buffers, self.settings
                )
            self.photon_map = photons.PhotonMap(
                self.device, programs, self.buffers, traits, paths, virtual
            )
        self.film_program = programs["film"]
        self.film_launches = [
            (self.add_launch(ring, name, planes, partial=False), planes)
            for ring, name, planes in film.PLANES
            if name in self.buffers
        ]
        self.half = (
            self.film_program.bind_planned("add_half", self.buffers)
            if "film_half" in self.buffers
            else None
        )
        self.add_seen = (
            programs["seen"].bind_planned("add_seen", self.buffers) if "seen" in programs else None
        )
        self.pictures = bind_pictures(self.plan, programs, self.buffers)
        self.restore: restore.Restore | None = None
        if "restore" in programs:
            size = self.plan.crop[2:]
            self.restore = restore.Restore(programs["restore"], self.buffers, size)
        self.advance = self.film_program.bind_planned("advance_film", self.buffers)
        if self.statistics:
            self.census = self.film_program.bind(
                "count_depths",
                params=self.buffers["params"],
                pool=self.buffers["pool"],
                census=self.buffers["census"],
                bins=film.CENSUS_BINS,
            )

    def _bind_range_search(self, program: Program | None) -> None:
        if self.range_search is not None:
            self.range_search.release()
            self.range_search = None
        if program is None:
            return
        self.range_search = range_search.RangeSearch(
            self.device,
            program,
            self.buffers,
            Primitives(self.device),
            self.plan.pixel_count,
            self.plan.ring,
        )
        self.add_unfiltered = program.bind_planned("add_unfiltered", self.buffers)

    def _bind_chains(self, program: Program | None) -> None:
        self.splat_launches: list[Launch] = []
        self.chains: Chains | None = None
        if program is None:
            return
        self.splat_launches = [program.bind_planned("collect_splats", self.buffers)]
        self.chains = Chains(
            self.device,
            self.buffers,
            self.plan.traits.slots,
            self.plan.traits.block,
            self.settings.seed,
            self._bounce,
            self._counters,
        )

    def _bind_fading(self, program: Program) -> list[tuple[Launch, int]]:
        planes = [(name, count) for _, name, count in film.PLANES] + [("film_half", 1)]
        return [
            (
                program.bind(
                    "fade_film",
                    params=self.buffers["params"],
                    film=self.buffers[name],
                    planes=count,
                    halvings=0,
                ),
                count,
            )
            for name, count in planes
            if name in self.buffers
        ]

    def add_launch(self, ring: str, name: str, planes: int, partial: bool) -> Launch:
        """Return what adds ``ring`` to the film ``name``; ``partial``: of a pass not complete."""
        return self.film_program.bind(
            "add_samples",
            params=self.buffers["params"],
            samples=self.buffers[ring],
            counters=self.buffers["counters"],
            film=self.buffers[name],
            planes=planes,
            partial=int(partial),
        )


def prepare_device(
    text: str | None = None, profiling: bool = False, read: threading.Event | None = None
) -> Device:
    """Open a device and make its tree builder ready: what can be done while a scene is read.

    Args:
        text: as in ``open_device``.
        read: set when the scene is read.  If it is when the device is open, the scene is likely a
            small one that needs no tree, and the builder is left to the renderer.
    """
    device = open_device(text, profiling=profiling)
    device.builders = builders_for(device)
    if read is None or not read.is_set():
        warm_up_builder(device)
    return device


def check_budget(spp: int | None, seconds: float | None) -> None:
    """Refuse a budget that would never end.

    Raises:
        InputError: not exactly one of ``spp`` (an integer up to 2^31) and ``seconds`` (positive).
    """
    if (spp is None) == (seconds is None):
        raise InputError("give either spp or seconds")
    if spp is not None and not (isinstance(spp, (int, np.integer)) and 1 <= spp <= 1 << 31):
        raise InputError(f"spp: expected an integer from 1 to {1 << 31}, got {spp!r}")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"seconds: expected a positive number, got {seconds!r}")


def render(
    scene: Scene | str | Path,
    preset: str | None = None,
    *,
    spp: int | None = None,
    seconds: float | None = None,
    device: Device | None = None,
    outputs: Iterable[str] = (),
    **settings: Any,
) -> Image:
    """Render a scene, or the scene in a file, and return its image.

    Args:
        spp, seconds: the budget; 64 samples a pixel if neither is given.
        settings: any field of ``Settings``.
    """
    if spp is None and seconds is None:
        spp = 64
    check_budget(spp, seconds)
    if not isinstance(scene, Scene):
        with ThreadPoolExecutor(1) as background:
            read = threading.Event()
            preparing = background.submit(prepare_device, read=read) if device is None else None
            scene = load_scene(Path(scene))
            read.set()
            device = preparing.result() if preparing else device
    renderer = Renderer(scene, resolve(scene.render, scene.path, preset, settings), device, outputs)
    try:
        renderer.render(spp, seconds)
        return renderer.image()
    finally:
        renderer.close()
