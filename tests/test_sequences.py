"""Errors, lag and flicker of sequences: planted numbers come back; the command end to end."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import plot_frames
import pytest
from make_references import main as make_references

from psf_cl.cli.main import main
from psf_cl.errors import InputError
from psf_cl.measure import sequences

ROOT = Path(__file__).resolve().parents[1]
LIGHT_OFF = str(ROOT / "scenes" / "moving" / "light_off.toml")
GREY = np.full((20, 30, 3), 0.5)


def steps(*values):
    """Return grey pictures of these values."""
    return [np.full_like(GREY, value) for value in values]


def test_the_change_is_found_and_errors_are_those_of_each_frame():
    truth = sequences.Truth.of(steps(2.0, 2.0, 1.0, 1.0))
    assert truth.largest_change() == 2
    # All frames are divided by their common mean, 1.5.
    errors = sequences.frame_errors(steps(2.0, 2.2, 1.0, 1.3), truth)
    expected = [0, (0.2 / 1.5) ** 2 / ((2 / 1.5) ** 2 + 0.01), 0, 0.3**2 / (1 + 0.01 * 1.5**2)]
    np.testing.assert_allclose(errors, expected, atol=1e-12)
    later = sequences.frame_errors(steps(1.3), truth, first=3)
    np.testing.assert_allclose(later, expected[3:], atol=1e-12)


def test_dark_frames_are_measured_and_dark_sequences_refused():
    truth = sequences.Truth.of(steps(1.0, 0.0))
    assert np.isfinite(sequences.frame_errors(steps(1.0, 0.1), truth)).all()
    with pytest.raises(InputError, match="black"):
        sequences.Truth.of(steps(0.0, 0.0))


def test_lag_is_the_frame_from_which_errors_stay_those_of_a_fresh_start():
    fresh = np.array((8.0, 4.0, 2.0, 1.0))
    assert sequences.lag(fresh, fresh) == 1
    assert sequences.lag(np.array((8.0, 5.0, 2.1, 1.0)), fresh) == 3
    assert sequences.lag(np.array((1.0, 5.0, 5.0, 1.09)), fresh) == 4
    assert sequences.lag(np.array((1.0, 1.0, 1.0, 1.2)), fresh) is None
    flat = np.ones(9)
    assert sequences.lag(np.array((1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.2, 1.2, 1.0)), flat) == 3


def test_flicker_is_the_variance_of_independent_frames_where_the_truth_rests():
    generator = np.random.default_rng(1)
    expected = np.repeat(GREY[None], 40, axis=0)
    # One half of the picture changes all the time: its noise does not count.
    expected[::2, :, 15:] *= 2.0
    noise = np.where(np.arange(30)[:, None] < 15, 0.05, 1.0)
    pictures = expected + noise * generator.standard_normal(expected.shape)
    truth = sequences.Truth.of(list(expected))
    resting = truth.frames[0, 0, 0, 0]
    planted = (0.05 * truth.scale) ** 2 / (resting**2 + 0.01)
    assert sequences.flicker(list(pictures), truth) == pytest.approx(planted, rel=0.05)
    # A drift by as much in all frames is none.
    drift = expected + np.linspace(0.0, 0.05, 40)[:, None, None, None]
    assert sequences.flicker(list(drift), truth) < 0.01 * planted
    moving = sequences.Truth.of(steps(1.0, 2.0))
    assert np.isnan(sequences.flicker(steps(1.0, 2.0), moving))


def test_references_of_frames_are_made_and_rules_compared(device, tmp_path, capsys):
    """A lamp goes out in frame 2 of the sequence: who never forgets has not caught up."""
    size = ("--size", "24x18")
    frames = ("--frames", "6:12")
    references = tmp_path / "####.exr"
    many = ("--spp", "32", "--seeds", "2")
    make_references([LIGHT_OFF, *size, *frames, *many, "-o", str(references)])
    assert sorted(path.name for path in tmp_path.glob("*.exr")) == [
        f"{frame:04}.exr" for frame in range(6, 12)
    ]
    out = tmp_path / "report"
    runs = [
        word
        for rule in ("adaptive", "cumulative")
        for word in ("--run", f"{rule}: preset=pt temporal={rule}")
    ]
    where = ("--reference", str(tmp_path), "-o", str(out))
    assert main(["converge", LIGHT_OFF, *frames, *where, *runs, "--seeds", "2"]) == 0
    assert "cumulative: relMSE summed" in capsys.readouterr().out
    with (out / "sequences.csv").open() as file:
        rows = {row["contestant"]: row for row in csv.DictReader(file)}
    assert rows["cumulative"]["lag"] == ""
    sums = {name: float(row["relmse_sum"]) for name, row in rows.items()}
    assert sums["adaptive"] < 0.7 * sums["cumulative"]
    assert float(rows["adaptive"]["flicker"]) > 0.0
    with (out / "frames.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["frame"] for line in lines[:6]] == ["6", "7", "8", "9", "10", "11"]
    # The fresh start begins where the lamp went out.
    assert [bool(line["fresh_relmse"]) for line in lines[:6]] == [False] * 2 + [True] * 4
    assert "never" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--spp", "1,2"], "--frames: expected one --spp"),
        (["--command", "a: b {out} {seconds}"], "--command: not with --frames"),
    ],
)
def test_what_does_not_go_with_frames_is_refused(tmp_path, capsys, more, message):
    arguments = ["--reference", "ref.exr", "--frames", "0:2", "-o", str(tmp_path), *more]
    assert main(["converge", LIGHT_OFF, *arguments]) == 2
    assert message in capsys.readouterr().err


def test_frames_get_as_many_seconds_each(device, tmp_path, capsys):
    """On average: a pass that takes longer takes from the next frames."""
    scene = (LIGHT_OFF, "--size", "24x18", "--frames", "0:3")
    make_references([*scene, "--spp", "8", "--seeds", "2", "-o", str(tmp_path / "####.exr")])
    out = tmp_path / "report"
    runs = ("--run", "alone: preset=pt", "--run", "screen: screen_filter=path_space")
    where = ("--reference", str(tmp_path), "-o", str(out), *runs, "--seeds", "2")
    assert main(["converge", *scene, *where, "--seconds", "0.1"]) == 0
    assert "; a frame: " in capsys.readouterr().out
    with (out / "sequences.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        assert float(row["spp_per_frame"]) >= 1.0
        assert float(row["seconds_per_frame"]) >= 0.1
    assert "frames 0 to 2 of 0.1 s" in (out / "report.html").read_text()


def test_references_need_a_run_of_marks_and_to_be_there(tmp_path, capsys):
    frames = ["--frames", "0:2", "-o", str(tmp_path / "out")]
    assert main(["converge", LIGHT_OFF, "--reference", "ref.exr", *frames]) == 2
    assert "--reference: expected one run of #" in capsys.readouterr().err
    missing = str(tmp_path / "##.exr")
    assert main(["converge", LIGHT_OFF, "--reference", missing, *frames]) == 2
    assert "00.exr" in capsys.readouterr().err


def test_reports_of_sequences_are_drawn_together(tmp_path):
    for name, errors in (("a", (4.0, 2.0, 1.0)), ("b", (0.5, 0.25))):
        (tmp_path / name).mkdir()
        lines = [f"pt,{k},{error}," for k, error in enumerate(errors)]
        lines = ["contestant,frame,relmse,fresh_relmse", *lines]
        (tmp_path / name / "frames.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "figure.svg"
    reports = [f"{title}={tmp_path / name}" for title, name in (("one", "a"), ("two", "b"))]
    assert plot_frames.main([*reports, "-o", str(out)]) == 0
    text = out.read_text()
    assert "relMSE, one" in text and "relMSE, two" in text
    # A marker for each point, and one in the legend.
    assert text.count("<polygon") == 5 + 1
    assert plot_frames.read_frames(tmp_path / "b") == {"pt": [(1.0, 0.5), (2.0, 0.25)]}
    with pytest.raises(InputError, match="expected frames"):
        plot_frames.read_frames(tmp_path)
