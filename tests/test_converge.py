"""``psf-cl converge``: turns, failures, resuming, commands; and what it finds out."""

import csv
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import psf_cl
from psf_cl.cli.contestants import (
    Arena,
    Contestant,
    Mark,
    RunError,
    find_run,
    make_run,
    run_key,
    split_command,
    time_marks,
)
from psf_cl.cli.main import main
from psf_cl.image import Image, read_exr, write_exr
from psf_cl.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
BOX = str(ROOT / "scenes" / "cornell_box.toml")
WIDTH, HEIGHT = 32, 24

# A renderer of another maker: the reference, 2 % too bright, with noise that time takes away.
OTHER = """
import sys, numpy as np
from psf_cl.image import Image, read_exr, write_exr
reference, out, seconds, seed, factor = sys.argv[1:6]
rgb = read_exr(reference).rgb
noise = np.random.default_rng(int(seed)).standard_normal((*rgb.shape[:2], 1))
rgb = float(factor) * rgb * (1.0 + 0.01 / float(seconds) ** 0.5 * noise)
write_exr(out, Image({"rgb": rgb.astype(np.float32)}))
if len(sys.argv) > 6:
    open(sys.argv[6], "w").write('{"render_seconds": %s, "spp": 7}' % seconds)
"""


@pytest.fixture(scope="module")
def reference(device, tmp_path_factory):
    """A reference without noise of its own: few bounces of plain light sampling."""
    path = tmp_path_factory.mktemp("reference") / "ref.exr"
    scene = psf_cl.load_scene(BOX, size=(WIDTH, HEIGHT))
    image = psf_cl.render(scene, spp=256, device=device)
    variance = np.full_like(image.rgb, 1e-12)
    write_exr(path, Image({"rgb": image.rgb, "variance": variance}, {"seed": [0, 1]}))
    return path


@pytest.fixture
def other(tmp_path, reference):
    """Return the command line of a renderer with a planted factor."""
    script = tmp_path / "other.py"
    script.write_text(OTHER)
    return lambda factor, rest="{stats}": (
        f"{sys.executable} {script} {reference} {{out}} {{seconds}} {{seed}} {factor} {rest}"
    )


@pytest.fixture
def arena(device, tmp_path):
    scene = psf_cl.load_scene(BOX, size=(WIDTH, HEIGHT))
    return Arena(scene, device, (Mark(spp=1), Mark(spp=2)), tmp_path / "runs", 1.5)


def summary_of(folder):
    rows = list(csv.DictReader((folder / "summary.csv").open()))
    return {(row["contestant"], row["point"]): row for row in rows}


def converge(reference, folder, *arguments):
    return main(["converge", BOX, "--reference", str(reference), "-o", str(folder), *arguments])


def test_marks_are_the_first_pass_and_powers_of_two():
    labels = [mark.label for mark in time_marks(8.0)]
    assert labels == ["first pass", "1 s", "2 s", "4 s", "8 s"]
    assert [mark.label for mark in time_marks(5.0)][-2:] == ["4 s", "5 s"]
    assert [mark.label for mark in time_marks(0.5)] == ["first pass", "0.5 s"]
    assert Mark(spp=16).label == "16 spp"


def test_a_run_has_the_pictures_that_plain_renders_have(arena):
    contestant = Contestant("a", Settings(sampler="random"))
    run = make_run(arena, contestant, seed=5)
    assert [(s.mark, s.spp) for s in run.snapshots] == [(0, 1), (1, 2)]
    for snapshot in run.snapshots:
        renderer = psf_cl.Renderer(arena.scene, Settings(sampler="random", seed=5), arena.device)
        renderer.render(spp=snapshot.spp)
        np.testing.assert_array_equal(snapshot.load(), renderer.snapshot().rgb)
        renderer.close()
        # What every process has to do first, and the set-up, stand beside render time.
        assert snapshot.process_seconds > 1.5 + snapshot.seconds


def test_time_budgets_are_looked_at_on_the_way(arena):
    timed = replace(arena, marks=(Mark(spp=1), Mark(seconds=0.05), Mark(seconds=0.2)))
    run = make_run(timed, Contestant("a", Settings()), 0)
    seconds = [snapshot.seconds for snapshot in run.snapshots]
    counts = [snapshot.spp for snapshot in run.snapshots]
    assert run.snapshots[0].mark == 0
    assert seconds == sorted(seconds) and seconds[-1] >= 0.2
    assert counts == sorted(counts) and counts[0] >= 1
    for snapshot in run.snapshots[1:]:
        assert snapshot.seconds >= timed.marks[snapshot.mark].seconds
    # Same bits as a render of so many samples, in spite of the looks in between.
    renderer = psf_cl.Renderer(arena.scene, Settings(), arena.device)
    renderer.render(spp=counts[-1])
    np.testing.assert_array_equal(run.snapshots[-1].load(), renderer.snapshot().rgb)
    renderer.close()


def test_a_run_is_found_again_only_if_nothing_that_matters_changed(arena, tmp_path):
    contestant = Contestant("a", Settings())
    assert find_run(arena, contestant, 0) is None
    made = make_run(arena, contestant, 0)
    found = find_run(arena, Contestant("another name", Settings()), 0)
    assert [s.seconds for s in found.snapshots] == [s.seconds for s in made.snapshots]
    np.testing.assert_array_equal(found.snapshots[1].load(), made.snapshots[1].load())

    assert find_run(arena, contestant, 1) is None
    assert find_run(arena, Contestant("a", Settings(max_depth=3)), 0) is None
    assert find_run(replace(arena, marks=(Mark(spp=1),)), contestant, 0) is None
    moved = replace(arena.scene, lights=(psf_cl.scene.model.Light("point", (1.0, 1.0, 1.0)),))
    assert find_run(replace(arena, scene=moved), contestant, 0) is None

    folder = arena.folder / run_key(arena, contestant, 0)
    (folder / "1.exr").unlink()
    assert find_run(arena, contestant, 0) is None
    (folder / "run.json").write_text("{")
    assert find_run(arena, contestant, 0) is None


def test_a_run_that_fails_leaves_nothing(arena):
    def failing(text):
        contestant = Contestant("bad", command=split_command(text, "{spp}"))
        with pytest.raises(RunError) as caught:
            make_run(arena, contestant, 0)
        assert not list(arena.folder.iterdir())
        assert "\n" not in str(caught.value)
        return str(caught.value)

    python = sys.executable
    assert "exit code 3: sorry" in failing(
        f"{python} -c 'import sys; print(\"sorry\"); sys.exit(3)' {{out}} {{spp}}"
    )
    assert "cannot be started" in failing("./no-such-program {out} {spp}")
    assert "got nothing" in failing(f"{python} -c pass {{out}} {{spp}}")
    small = "from psf_cl.image import *; import sys; write_exr(sys.argv[1], Image({'rgb': "
    small += "np.ones((2, 3, 3))}))"
    assert "expected 32x24 pixels; got 3x2" in failing(f'{python} -c "{small}" {{out}} {{spp}}')


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("prog {out}", "{seconds}"),
        ("prog {seconds}", "{out}"),
        ("prog '{out} {seconds}", "quotation"),
    ],
)
def test_commands_need_a_budget_and_an_output(text, message):
    with pytest.raises(ValueError, match=message):
        split_command(text, "{seconds}")
    assert split_command("a 'b c' {out} {seconds}", "{seconds}")[1] == "b c"


@pytest.mark.slow
def test_the_report_shows_bias_failures_and_goes_on(reference, other, tmp_path, capsys):
    folder = tmp_path / "out"
    arguments = ["--presets", "pt", "--run", "shallow: max_depth=1 sampler=random"]
    arguments += ["--command", f"bright: {other(1.02)}", "--command", f"fair: {other(1.0)}"]
    arguments += ["--command", f"crash: {sys.executable} -S -c 1/0 {{out}} {{seconds}}"]
    arguments += ["--seconds", "0.1", "--seeds", "4"]
    assert converge(reference, folder, *arguments) == 1
    said = capsys.readouterr()
    assert "FAILED: crash, seed 2: " in said.err and "ZeroDivisionError" in said.err
    assert "turn 4 of 4: pt: " in said.out
    for name in ("report.html", "error.png", "error.svg", "points.csv", "summary.csv"):
        assert (folder / name).stat().st_size > 100
    rows = summary_of(folder)

    def bias2(name):
        row = rows[name, "0.1 s"]
        return [float(row[f"relative_bias2{end}"]) for end in ("", "_low", "_high")]

    # The planted 2 %, squared, is what stays; where nothing is planted, nothing is found.
    rgb = read_exr(reference).rgb.astype(np.float64)
    scaled = rgb / (rgb @ [0.2126, 0.7152, 0.0722]).mean()
    expected = float((0.02**2 * scaled**2 / (scaled**2 + 0.01)).mean())
    assert bias2("bright")[1] <= expected <= bias2("bright")[2] and bias2("bright")[1] > 0.0
    assert bias2("fair")[1] <= 0.0 <= bias2("fair")[2]
    # Light that only one reflection brought is too little.
    assert bias2("shallow")[1] > 0.0
    # What the command says of its own render time stands beside the time of its process.
    row = rows["fair", "0.1 s"]
    assert float(row["seconds"]) == pytest.approx(0.1) and float(row["process_seconds"]) > 0.1
    assert float(row["spp"]) == 7
    # None of the reference's seeds, 0 and 1, was used.
    points = list(csv.DictReader((folder / "points.csv").open()))
    assert {row["seed"] for row in points} == {"2", "3", "4", "5"}

    # Again: everything but what failed is there.
    before = {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    assert converge(reference, folder, *arguments) == 1
    said = capsys.readouterr()
    assert said.out.count("kept from before") == 4 * 4 + 1
    assert before == {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}


def test_path_tracing_on_a_budget_is_a_list_of_samples(reference, tmp_path):
    folder = tmp_path / "out"
    assert converge(reference, folder, "--spp", "1,4,16", "--seeds", "2", "--quiet") == 0
    rows = summary_of(folder)
    assert list(rows) == [("pt", "first pass"), ("pt", "4 spp"), ("pt", "16 spp")]
    errors = [float(row["relmse"]) for row in rows.values()]
    assert errors == sorted(errors, reverse=True) and errors[2] < errors[0] / 4.0


def test_a_command_without_a_seed_counts_once(reference, other, tmp_path, capsys):
    command = other(1.0).replace("{seed}", "7")
    folder = tmp_path / "out"
    assert converge(reference, folder, "--command", f"same: {command}", "--seconds", "0.01",
                    "--seeds", "2") == 0  # fmt: skip
    assert {row["runs"] for row in summary_of(folder).values()} == {"1"}
    assert "same: its runs are the same picture" in (folder / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--presets", "pt,none"], "expected presets of: pt"),
        (["--run", "pt max_depth=3"], "expected 'NAME: ...'"),
        (["--run", "a: depth=3"], "--run a: --set depth: unknown setting"),
        (["--run", "a: preset=none"], "--run a: --preset must be one of"),
        (["--run", "pt: max_depth=3", "--presets", "pt"], "different names; twice there: pt"),
        (["--command", "a: prog {out}"], "--command a: expected a command with {seconds}"),
        (["--spp", "4,1"], "expected increasing counts"),
        (["--spp", "4", "--seconds", "1"], "not allowed with"),
        (["--size", "16x16"], "expected 16x16 pixels; got 32x24"),
        (["--seed", "-1"], "seed must be from 0"),
    ],
)
def test_mistakes_are_told_in_one_line_before_anything_runs(
    reference, tmp_path, capsys, arguments, message
):
    assert converge(reference, tmp_path / "out", *arguments) == 2
    said = capsys.readouterr()
    assert message in said.err and said.err.count("\n") == 1
    assert not (tmp_path / "out" / "report.html").exists()


def test_notes_tell_what_spoils_a_comparison(device, tmp_path, capsys):
    path = tmp_path / "ref.exr"
    stats = {"scene_digest": "of another", "settings": {"max_depth": 3}, "seed": 9}
    write_exr(path, Image({"rgb": np.ones((8, 8, 3), np.float32)}, stats))
    arguments = ["--spp", "1", "--seeds", "1", "--seed", "9"]
    assert converge(path, tmp_path / "out", *arguments) == 0
    said = capsys.readouterr().err
    for part in ("does not say its variance", "another state", "max_depth is 3", "at least 4 seeds",
                 "some of the runs' seeds"):  # fmt: skip
        assert part in said


@pytest.mark.slow
def test_an_interrupted_study_keeps_its_finished_runs_and_goes_on(reference, tmp_path):
    folder = tmp_path / "out"
    command = [sys.executable, "-m", "psf_cl", "converge", BOX, "--reference", str(reference)]
    command += ["-o", str(folder), "--seconds", "2", "--seeds", "3"]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True, env=dict(os.environ, PYTHONPATH=str(ROOT)))  # fmt: skip
    for line in process.stdout:
        if line.startswith("turn 1"):
            process.send_signal(signal.SIGINT)
            break
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130 and "run it again to go on" in errors
    assert "interrupted" in (folder / "report.html").read_text()
    records = [json.loads(p.read_text()) for p in (folder / "runs").glob("*/run.json")]
    assert 1 <= len(records) < 3
    assert not list((folder / "runs").glob("*.part"))
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.count("kept from before") == 1 + len(records)


@pytest.mark.slow
def test_independent_numbers_converge_with_slope_minus_one(device, tmp_path):
    # Counted in samples, so that it holds on a busy machine too.
    reference = tmp_path / "ref.exr"
    scene = psf_cl.load_scene(BOX, size=(32, 32))
    image = psf_cl.render(scene, spp=1 << 13, device=device, seed=77)
    write_exr(reference, Image({"rgb": image.rgb}))
    arguments = ["--run", "random: sampler=random", "--spp", "4,16,64,256"]
    assert converge(reference, tmp_path / "out", *arguments) == 0
    rows = summary_of(tmp_path / "out").values()
    spp = [float(row["spp"]) for row in rows]
    slope = np.polyfit(np.log(spp), np.log([float(row["relmse"]) for row in rows]), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.1)
