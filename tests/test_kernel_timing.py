"""The kernel timing tool: its sums, its trace, its baselines, and what kernels declare."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import kernel_timing as tool
import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, inside_out, lambertian

from psf_cl.device.device import Device, open_device
from psf_cl.device.layout import all_path_fields, path_fields
from psf_cl.device.program import assemble
from psf_cl.errors import InputError
from psf_cl.measure import timing
from psf_cl.measure.timing import TRANSFER, Change, Declared, Interval, Repetition, Tally, Typical
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Light
from psf_cl.settings import AOVS, Settings
from psf_cl.traits import DeviceTraits

ROOT = Path(__file__).resolve().parents[1]
MS = 1_000_000
CONDITIONS = {"scene": "box.toml", "size": [8, 8]}


def small_scene(lens_radius=0.0):
    """Return a lamp over a floor, flat and without textures."""
    lamp = (inside_out(primitives.quad()), transform.translation((0, 1, 0)), glowing(3.0))
    view = camera((0, 1.5, 3), (0, 0.3, 0), 40, lens_radius=lens_radius, focus_distance=3.0)
    return build([floor(2.0, lambertian(0.5)), lamp], view, (16, 16))


def narrow(device, profiling=False):
    """Return the device with a small pool of one lane: the quickest to build and to run."""
    traits = replace(device.traits, lanes=1, block=8, slots=64)
    return Device(device.context, traits, profiling)


def repetition(seconds=0.1, samples=1000, kernels=((0.05, 64),)):
    """Return a repetition of launches of `trace` of (seconds, work items) each, back to back."""
    tally, at = Tally(), 0
    for spent, items in kernels:
        end = at + round(spent * 1e9)
        tally.add([Interval("trace", "trace_rays", items, 0, at, end)])
        at = end
    return Repetition(seconds, samples, {"bounce": 5 * samples}, tally)


def test_time_is_divided_into_running_launching_and_the_host():
    tally = Tally()
    tally.add(
        [
            # Waits 1 ms in the queue.
            Interval("shade", "shade_paths", 64, queued=0, start=1 * MS, end=11 * MS),
            # Queued all along: 2 ms from the end of the last one on.
            Interval("shade", "shade_paths", 64, queued=0, start=13 * MS, end=20 * MS),
        ]
    )
    # Nothing is queued for 5 ms, and then it takes 3 ms to start.
    tally.add([Interval(TRANSFER, "read counters", 60, queued=25 * MS, start=28 * MS, end=30 * MS)])
    whole = Repetition(0.040, 1000, {}, tally)
    assert whole.kernels == pytest.approx(0.017)
    assert whole.transfers == pytest.approx(0.002)
    assert tally.launching == pytest.approx(0.006)
    # 5 ms before the last command and 10 ms after it.
    assert whole.host == pytest.approx(0.015)
    shade = tally.by_command["shade", "shade_paths"]
    assert (shade.launches, shade.items) == (2, 128)


def test_rates_are_of_the_time_in_which_the_kernel_ran():
    declared = {"trace_rays": Declared(16, 44, rays=("bounce",), hash_accesses=2)}
    (figures,) = timing.kernel_figures([repetition()], declared)
    assert (figures.stage, figures.name, figures.launches) == ("trace", "trace_rays", 1)
    assert figures.items == 64 * 16
    assert figures.share == pytest.approx(0.5)
    assert figures.ns_per_sample.median == pytest.approx(50_000)
    assert figures.items_per_second == pytest.approx(1024 / 0.05)
    assert figures.bytes_per_second == pytest.approx(44 * 1024 / 0.05)
    assert figures.rays_per_second == pytest.approx(5000 / 0.05)
    assert figures.hash_accesses_per_second == pytest.approx(2 * 1024 / 0.05)
    of_samples = {"trace_rays": Declared(bytes=10, per_sample=True)}
    (figures,) = timing.kernel_figures([repetition()], of_samples)
    assert figures.bytes_per_second == pytest.approx(10 * 1000 / 0.05)


def test_what_is_not_declared_has_no_rate():
    (figures,) = timing.kernel_figures([repetition()], {})
    assert figures.bytes_per_second is None
    assert figures.rays_per_second is None
    assert figures.hash_accesses_per_second is None


def test_figures_are_medians_that_one_disturbed_repetition_does_not_move():
    calm = [repetition(kernels=[(spent, 64)]) for spent in (0.050, 0.051, 0.052, 0.053)]
    disturbed = repetition(seconds=1.0, kernels=[(0.9, 64)])
    (figures,) = timing.kernel_figures([*calm, disturbed], {})
    assert figures.seconds == pytest.approx(0.052)
    assert figures.ns_per_sample.spread == pytest.approx(2000)


def test_the_longest_kernel_comes_first():
    tally = Tally()
    spans = {"short": (0, 1), "long": (1, 9), "middle": (9, 12)}
    tally.add(Interval("s", name, 1, 0, a * MS, b * MS) for name, (a, b) in spans.items())
    figures = timing.kernel_figures([Repetition(0.02, 1, {}, tally)], {})
    assert [figure.name for figure in figures] == ["long", "middle", "short"]


def check_trace(trace):
    """Check a trace against the Trace Event Format: keys, types, and slices one after another."""
    assert set(trace) == {"traceEvents", "displayTimeUnit"}
    assert trace["displayTimeUnit"] in ("ms", "ns")
    ends, named = {}, set()
    for event in trace["traceEvents"]:
        assert {"name", "ph", "pid", "tid", "args"} <= set(event)
        assert isinstance(event["name"], str) and event["name"]
        assert isinstance(event["args"], dict)
        track = event["pid"], event["tid"]
        assert all(type(part) is int for part in track)
        if event["ph"] == "M":
            assert event["name"] in ("process_name", "thread_name")
            assert isinstance(event["args"]["name"], str)
            named.add(track)
            continue
        assert event["ph"] == "X" and isinstance(event["cat"], str)
        assert track in named
        # Back in whole nanoseconds, so that rounding is no overlap.
        start, duration = round(1000 * event["ts"]), round(1000 * event["dur"])
        assert start >= ends.get(track, 0), "slices overlap or are out of order"
        assert duration >= 0
        ends[track] = start + duration
    return sum(event["ph"] == "X" for event in trace["traceEvents"])


def test_a_trace_keeps_times_and_order():
    base = 86_400_000_000_123  # A device that has been running for a day.
    intervals = [
        Interval("shade", "shade_paths", 64, base, base + 1001, base + 5003),
        Interval(TRANSFER, "read counters", 60, base, base + 5003, base + 6001),
    ]
    trace = json.loads(json.dumps(timing.chrome_trace(intervals, "queue")))
    assert check_trace(trace) == 2
    first, second = trace["traceEvents"][2:]
    assert (first["ts"], first["dur"], second["ts"]) == (0.0, 4.002, 4.002)
    assert first["args"] == {"work_items": 64, "queued_before_us": 1.001}
    assert second["args"]["bytes"] == 60


def test_the_check_of_traces_sees_an_overlap():
    intervals = [Interval("a", "a", 1, 0, 0, 10), Interval("b", "b", 1, 0, 9, 12)]
    with pytest.raises(AssertionError, match="overlap"):
        check_trace(timing.chrome_trace(intervals, "queue"))


def test_a_change_counts_beyond_the_spreads_of_both():
    before = Typical(100.0, 4.0)
    assert not Change("k", before, Typical(106.9, 3.0)).beyond_noise
    assert Change("k", before, Typical(107.1, 3.0)).beyond_noise
    assert Change("k", before, Typical(92.9, 3.0)).beyond_noise
    assert Change("k", None, before).beyond_noise


def test_a_baseline_comes_back_and_tells_what_changed(tmp_path):
    path = tmp_path / "baseline.json"
    calm = [repetition(kernels=[(spent, 64)]) for spent in (0.050, 0.051, 0.052)]
    now = timing.ns_by_name(calm)
    path.write_text(json.dumps(timing.baseline(CONDITIONS, [now])))
    before = timing.read_baseline(path, CONDITIONS)
    assert before == now
    assert not any(change.beyond_noise for change in timing.changes(before, now))
    faster = [repetition(kernels=[(spent, 64)]) for spent in (0.020, 0.021, 0.022)]
    changes = timing.changes(before, timing.ns_by_name(faster))
    assert [change.name for change in changes] == ["whole", "trace: trace_rays"]
    assert [change.beyond_noise for change in changes] == [False, True]
    gone = timing.changes(before | {"sort: sort_paths": [1.0]}, now)[-1]
    assert gone.name == "sort: sort_paths" and gone.now is None


def test_what_differs_between_the_runs_of_a_baseline_is_noise():
    slow, fast = (
        timing.ns_by_name([repetition(kernels=[(spent, 64)]) for spent in times])
        for times in ((0.050, 0.051, 0.052), (0.020, 0.021, 0.022))
    )
    both = timing.baseline(CONDITIONS, [slow, fast])["ns_per_sample"]
    assert both["trace: trace_rays"] == slow["trace: trace_rays"] + fast["trace: trace_rays"]
    assert timing.changes(slow, fast)[1].beyond_noise
    assert not timing.changes(both, fast)[1].beyond_noise


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "expected JSON"),
        ("[" * 100_000, "expected JSON"),
        ("[1]", "expected what --save wrote"),
        ('{"format": 2}', "expected what --save wrote"),
        ('{"format": 1}', "scene: expected 'box.toml', as now; got None"),
        ('{"format": 1, "conditions": 3}', "scene: expected"),
        ('{"format": 1, "conditions": {"scene": "box.toml", "size": [9, 8]}}', "size: expected"),
        (None, "ns_per_sample: expected a list of numbers"),
        ([1.0], "ns_per_sample: expected a list of numbers"),
        ({"k": []}, "ns_per_sample: expected a list of numbers"),
        ({"k": 1.0}, "ns_per_sample: expected a list of numbers"),
        ({"k": [1.0, "x"]}, "ns_per_sample: expected a list of numbers"),
        ({"k": [True]}, "ns_per_sample: expected a list of numbers"),
        ({"k": [float("nan")]}, "ns_per_sample: expected a list of numbers"),
        ({"k": [-1.0]}, "ns_per_sample: expected a list of numbers"),
        ({"k": [10**400]}, "ns_per_sample: expected a list of numbers"),
    ],
)
def test_a_bad_baseline_is_refused_in_one_line(tmp_path, text, message):
    path = tmp_path / "baseline.json"
    if not isinstance(text, str):
        text = json.dumps({"format": 1, "conditions": CONDITIONS, "ns_per_sample": text})
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        timing.read_baseline(path, CONDITIONS)
    assert message in str(caught.value) and str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def accesses(stage):
    """Return the fields of a path that a stage's source reads, and those that it writes."""
    text = re.sub(r"//[^\n]*", "", assemble(stage.source))
    text = re.sub(r"^\s*#\s*define PATH_.*$", "", text, flags=re.MULTILINE)
    stems = {name.upper(): name for name in all_path_fields()}
    reads, writes = set(), set()
    # Of the rays of a vertex the first one stands for all.
    text = re.sub(r"RAY_FIELD\(ray, (\w+)\)", r"PATH_\1", text)
    pattern = r"(\bget_[uv]|\bput_[uv]|\bFIELD)\(\s*path,\s*PATH_(\w+)( \+ c)?\s*([,)])(\s*=[^=])?"
    uses = list(re.finditer(pattern, text))
    for use in uses:
        function, field, more, _, assigned = use.groups()
        name = stems[field]
        # The first component stands for the vector.
        vector = function.endswith("_v") or more
        names = path_fields(name.rpartition("_")[0]) if vector else (name,)
        (writes if function.startswith("put") or assigned else reads).update(names)
    return reads, writes


def full_plan():
    """Return a plan of everything but chains; what draws otherwise is on by its settings."""
    lights = (Light("point", (1.0, 1.0, 1.0)), Light("directional", (1.0, 1.0, 1.0)))
    scene = replace(small_scene(), lights=lights)
    settings = Settings(guiding="learned", light_sampling="photon_origin", termination="cache")
    return make_plan(scene, settings, AOVS, statistics=True, full=True, halves=True)


def virtual_stages():
    """Return the stages that go with virtual lights alone."""
    scene = replace(small_scene(), lights=(Light("point", (1.0, 1.0, 1.0)),))
    settings = Settings(indirect_light="virtual_lights")
    stages = make_plan(scene, settings, AOVS, full=True).stages
    return tuple(stage for stage in stages if stage.name == "virtual_lights")


def test_kernels_declare_the_fields_of_a_path_that_their_sources_use():
    checked = 0
    for stage in (*full_plan().stages, *virtual_stages()):
        reads, writes = accesses(stage)
        if stage.name == "film":
            # It finds the word itself, in a pool of any lanes.
            assert "PATH_STATUS) * BLOCK" in assemble(stage.source)
            reads = {"status"}
        if stage.name in ("probes", "cells"):
            # They have no paths, but see the macro for the seeds of theirs.
            assert reads == {"seed", "sample"}
            reads = set()
        if stage.name == "photons":
            # Photons write the seed themselves, and see that macro too.
            reads.remove("seed")
        declared = [set(), set()]
        for kernel in stage.kernels:
            declared[0].update(path_fields(*kernel.reads))
            declared[1].update(path_fields(*kernel.writes))
        assert declared == [reads, writes], stage.name
        checked += len(reads) + len(writes)
    assert checked > 50


def test_every_kernel_of_a_source_is_declared_by_its_stage():
    for stage in full_plan().stages:
        found = re.findall(r"^kernel void (\w+)\(", assemble(stage.source), re.MULTILINE)
        assert set(found) == set(stage.kernel_names)


def test_declared_bytes_follow_the_features():
    def declared(**options):
        plan = make_plan(small_scene(), Settings(), **options)
        return {name: kernel.bytes for name, kernel in plan.declared.items()}

    own = declared()
    # Status, origin and direction in; triangle, t, u and v out.
    assert own["intersect_closest"] == 4 * (7 + 4)
    assert declared(outputs=["direct"])["connect_lights"] == own["connect_lights"] + 4 * 7
    assert all(declared(full=True)[name] >= size for name, size in own.items())
    assert make_plan(small_scene(), Settings()).declared["shade_paths"].items == 16
    gpu = make_plan(small_scene(), Settings(), traits=DeviceTraits.of_kind("gpu"))
    assert gpu.declared["shade_paths"].items == 1


def test_an_unknown_field_of_a_path_is_refused():
    assert path_fields("beta", "hit_t") == ("beta_r", "beta_g", "beta_b", "hit_t")
    with pytest.raises(ValueError, match="betta: no such field"):
        path_fields("betta")


@pytest.mark.slow
def test_the_full_build_has_every_feature_and_the_same_image(device):
    images = []
    for full in (False, True):
        opened = Renderer(small_scene(), Settings(), narrow(device), full=full)
        on = {name for name, feature in opened.plan.features.items() if feature.value}
        # In place of something, for what is not there, or with other random numbers.
        never = {"FEW", "METROPOLIS", "INSTANCES", "MOTION", "CACHE", "GUIDE", "LIGHT_SAMPLING"}
        never |= {"RECTANGLES", "TEXTURE_LEVELS", "SHADOW_RAYS", "VIRTUAL_LIGHTS", "AOV_GUIDE"}
        never |= {"CELL_LAYERS", "FIREFLIES", "MATERIAL_CELLS", "SPHERES"}
        assert (on == opened.plan.features.keys() - never) == full
        planned = {buffer.name: buffer.bytes for buffer in opened.plan.buffers}
        allocated = {name: buffer.bytes for name, buffer in opened.buffers.items()}
        for estimate in ("nodes", "blocks"):
            assert (planned.pop(estimate, None) is None) == (allocated.pop(estimate, None) is None)
        assert planned == allocated
        opened.render(spp=4)
        images.append(opened.image())
        opened.close()
    own, full = images
    assert full.aovs.keys() == own.aovs.keys()
    # The way of a camera ray over a lens of no size rounds otherwise, and so does a tree.
    different = np.abs(full.rgb - own.rgb) > 1e-4 * own.rgb + 1e-6
    assert own.rgb.any() and different.mean() < 0.02


def test_a_full_build_leaves_what_is_on_as_it_is():
    scene = small_scene(lens_radius=0.1)
    lit = replace(scene, environment=replace(scene.environment, radiance=(1.0, 1.0, 1.0)))
    features = make_plan(lit, Settings(), full=True).features
    # As an image, a constant sky would be sampled with other numbers.
    assert features["ENVIRONMENT"].value == 1
    assert make_plan(scene, Settings(), full=True).features["ENVIRONMENT"].value == 2
    assert features["LENS"].reason == make_plan(lit, Settings()).features["LENS"].reason


def test_repetitions_of_a_real_render_add_up(device):
    opened = Renderer(small_scene(), Settings(), narrow(device, profiling=True))
    watch = tool.Stopwatch(opened, keep_intervals=True)
    watch.warm_up(0.05)
    for _ in range(3):
        watch.repeat(0.05)
    planned = {kernel for stage in opened.plan.stages for kernel in stage.kernel_names}
    for one in watch.repetitions:
        kernels = {name for stage, name in one.tally.by_command if stage != TRANSFER}
        assert kernels == planned
        assert one.tally.by_command[TRANSFER, "read counters"].launches > 0
        bounced = one.tally.by_command["intersect", "intersect_closest"]
        paths = opened.plan.declared["intersect_closest"].items
        assert bounced.items * paths == bounced.launches * opened.plan.traits.slots
        # Clocks of device and host run alike: the parts cannot be more than the whole.
        assert min(one.kernels, one.transfers, one.tally.launching) >= 0.0
        assert one.host >= 0.0
        # Paths of one bounce or more on a lit floor; the pool does not run dry between.
        assert one.samples == one.rays["camera"] > 0
        assert one.rays["shadow"] > 0
    last = sum(spent.launches for spent in watch.repetitions[-1].tally.by_command.values())
    assert check_trace(timing.chrome_trace(watch.intervals, "queue")) == last
    assert watch.left_out == 0 and opened.device.on_intervals is None
    opened.close()


def test_a_trace_has_a_limit_and_counts_what_is_beyond(monkeypatch):
    monkeypatch.setattr(tool, "TRACE_LIMIT", 3)
    watch = tool.Stopwatch(None, keep_intervals=True)
    for at in range(0, 4, 2):
        watch._take([Interval("a", "a", 1, 0, k * MS, (k + 1) * MS) for k in (at, at + 1)])
    assert len(watch.intervals) == 3 and watch.left_out == 1
    assert watch.tally.by_command["a", "a"].launches == 4


def test_the_device_tells_how_fast_it_copies():
    opened = open_device(profiling=True)
    before = opened.allocated_bytes
    assert 1e8 < opened.copy_bandwidth(1 << 22, 3) < 1e14
    assert opened.allocated_bytes == before


def test_the_tool_shows_kernels_saves_and_compares(device, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(tool.Device, "copy_bandwidth", lambda self: 1e10)
    traits = replace(device.traits, lanes=1, block=8, slots=64)
    monkeypatch.setattr(
        tool, "open_device", lambda text, profiling: Device(device.context, traits, profiling)
    )
    baseline, trace = str(tmp_path / "baseline.json"), str(tmp_path / "trace.json")
    scene = str(ROOT / "scenes" / "cornell_box.toml")
    common = [scene, "--size", "16x16", "--seconds", "0.02", "--warm-up", "0.02"]
    common += ["--repetitions", "3"]
    # 1 says that the host took more than 5 %, which a small image on a busy machine may do.
    assert tool.main([*common, "--save", baseline, "--trace", trace]) in (0, 1)
    text = capsys.readouterr().out
    for word in ("intersect: intersect_closest", "of copy", "host: nothing queued", "us a command"):
        assert word in text
    assert "accesses" not in text
    assert re.search(r"^next: \w+, \d+% of the time", text, re.MULTILINE)
    assert check_trace(json.loads(Path(trace).read_text())) > 0
    assert tool.main([*common, "--add", baseline]) in (0, 1)
    capsys.readouterr()
    assert len(json.loads(Path(baseline).read_text())["ns_per_sample"]["whole"]) == 6
    assert tool.main([*common, "--baseline", baseline, "--full"]) in (0, 1)
    text = capsys.readouterr().out
    assert re.search(r"^whole .*(within noise|FASTER|SLOWER)", text, re.MULTILINE)
    only = r"only the full build has .*TEXTURES, ALPHA, .*VERTEX_COLORS"
    assert re.search(only, re.sub(r"\s+", " ", text))
    with pytest.raises(InputError, match=r"size: expected \[8, 8\], as now; got \[16, 16\]"):
        tool.main([*common, "--size", "8x8", "--baseline", baseline])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--repetitions", "2"], "--repetitions: expected at least 3"),
        (["--save", "a.json", "--trace", "./a.json"], "another input or output"),
        (["--baseline", "a.json", "--save", "a.json"], "another input or output"),
        (["--trace", "nowhere/a.json"], "there is no folder"),
    ],
)
def test_bad_arguments_are_refused(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=re.escape(message)):
        tool.main([str(ROOT / "scenes" / "cornell_box.toml"), *arguments])
