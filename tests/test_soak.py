"""``tools/soak.py`` notices what may go wrong with a render."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soak

from psf_cl.image import Image, write_exr

GREY = np.full((2, 3, 3), 0.5, np.float32)


@pytest.fixture
def play(monkeypatch, tmp_path):
    """Return a function that runs a round whose renders write and return what it is told."""

    def run(*parts, stops=(), frames=None, memory=None):
        now = soak.Round("a", "pt", (), (3, 2), 1, memory, stops, frames)
        left = list(parts)

        def render(arguments, stop="", seconds=0.0):
            code, text, images = left.pop(0)
            name = arguments[arguments.index("-o") + 1]
            for number, rgb in images.items():
                write_exr(Path(name.replace("##", f"{number:02d}")), Image({"rgb": rgb}, {}), False)
            return code, text

        monkeypatch.setattr(soak, "_render", render)
        outcome = soak.run_round(now, tmp_path)
        assert outcome.failure or outcome.refused or not left
        return outcome

    return run


def test_a_round_of_equal_images_is_sound(play):
    outcome = play((0, "", {0: GREY}), (130, "", {}), (0, "", {0: GREY}), stops=(("TERM", 1.0),))
    assert (outcome.failure, outcome.stops) == ("", 1)


def test_a_stop_that_came_too_late_does_not_count(play):
    parts = [(0, "", {0: GREY})] * 3
    assert play(*parts, stops=(("KILL", 1.0),)).stops == 0


def test_another_bit_is_a_failure(play):
    assert "different" in play((0, "", {0: GREY}), (0, "", {0: np.nextafter(GREY, 1)})).failure


def test_what_is_not_finite_is_a_failure(play):
    bad = GREY.copy()
    bad[1, 2, 0] = np.inf
    assert "finite" in play((0, "", {0: bad}), (0, "", {0: bad})).failure


@pytest.mark.parametrize("code", [1, 2, -11, -15])
def test_an_end_that_nobody_asked_for_is_a_failure(play, code):
    assert f"code {code}" in play((code, "why", {})).failure


@pytest.mark.parametrize(
    ("signal", "code"), [("TERM", -11), ("TERM", -15), ("INT", -2), ("INT", -9)]
)
def test_a_stop_that_is_not_handled_is_a_failure(play, signal, code):
    parts = [(0, "", {0: GREY}), (code, "", {0: GREY})]
    assert f"code {code}" in play(*parts, stops=((signal, 1.0),)).failure


@pytest.mark.parametrize(("handler", "known"), [("signal.SIG_DFL", False), ("print", True)])
def test_a_process_without_a_handler_is_told(handler, known):
    code = f"import signal, sys; signal.signal(signal.SIGTERM, {handler}); print(flush=True)"
    command = [sys.executable, "-c", f"{code}; sys.stdin.read()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        assert soak._handles(process.pid) == known
        process.stdin.close()


def test_a_traceback_is_a_failure(play):
    parts = [(0, "", {0: GREY}), (130, "Traceback", {})]
    assert "Traceback" in play(*parts, stops=(("INT", 1.0),)).failure


def test_what_a_stop_leaves_is_looked_at(play):
    bad = GREY.copy()
    bad[0, 0, 0] = np.nan
    parts = (0, "", {0: GREY}), (130, "", {0: bad})
    assert "finite" in play(*parts, stops=(("TERM", 1.0),)).failure


@pytest.mark.parametrize(
    ("sums", "growth", "bad"),
    [
        ({}, 0.0, False),
        ({"failures": ["seed 1"]}, 0.0, True),
        ({"resumed": 0}, 0.0, True),
        ({}, float("nan"), True),
        ({}, 1e5, True),
    ],
)
def test_sums_that_are_bad_are_told(sums, growth, bad):
    assert soak.is_bad({"failures": [], "stops": 100, "resumed": 50} | sums, growth) == bad


def test_a_frame_that_was_whole_has_to_stay(play):
    dark = 0.5 * GREY
    whole = (0, "", {3: GREY, 4: GREY, 5: GREY})
    stops, frames = (("INT", 1.0),), (3, 6)
    # The last one may have had fewer samples.
    assert not play(whole, (130, "", {3: GREY, 4: dark}), whole, stops=stops, frames=frames).failure
    part = (130, "", {3: dark, 4: GREY})
    assert "_03.exr" in play(whole, part, whole, stops=stops, frames=frames).failure


def test_a_missing_frame_is_a_failure(play):
    parts = (0, "", {3: GREY, 4: GREY}), (0, "", {3: GREY})
    assert "missing" in play(*parts, frames=(3, 5)).failure


def test_too_little_memory_is_no_failure_if_it_is_said(play):
    assert play((1, "error: 70 MiB of 64", {}), memory=64).refused
    assert play((1, "error: 70 MiB of 64", {})).failure


def test_a_seed_stands_for_one_round():
    assert soak.round_of(5) == soak.round_of(5)
    rounds = [soak.round_of(seed) for seed in range(40)]
    assert any(each.frames for each in rounds)
    assert any(not each.frames for each in rounds)
