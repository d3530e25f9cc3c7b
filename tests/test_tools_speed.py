"""The speed tools: rounds, rates and generated scenes; what needs Mitsuba is skipped without."""

from __future__ import annotations

import itertools
import re
import time
from pathlib import Path

import measuring
import numpy as np
import pytest
import scaling
import statistics_cost

import psf_cl

ROOT = Path(__file__).resolve().parents[1]


def test_every_second_round_runs_in_reverse_order():
    calls = []
    numbers = itertools.count()

    def subject(name):
        def run():
            calls.append(name)
            return float(next(numbers))

        return run

    measured = measuring.interleaved({name: subject(name) for name in "abc"}, 3)
    assert "".join(calls) == "abccbaabc"
    assert measured.values == {"a": [0.0, 5.0, 6.0], "b": [1.0, 4.0, 7.0], "c": [2.0, 3.0, 8.0]}


def test_cores_tell_work_from_waiting():
    def work():
        end = time.process_time() + 0.05
        while time.process_time() < end:
            pass
        return 1.0

    def wait():
        time.sleep(0.05)
        return 1.0

    cores = measuring.interleaved({"work": work, "wait": wait}, 1).cores
    assert cores["wait"] < 0.5 * cores["work"]


def test_ratios_are_of_rounds_and_not_of_medians():
    quotients = measuring.ratio([2.0, 30.0, 8.0], [1.0, 10.0, 2.0])
    assert (quotients.median, quotients.low, quotients.high) == (3.0, 2.0, 4.0)
    assert quotients.text(1) == "3.0 (2.0-4.0)"
    with pytest.raises(ValueError, match="zip"):
        measuring.ratio([1.0, 2.0], [1.0])


def test_rate_counts_only_the_samples_of_its_own_time():
    class Pretended:
        """Makes 1000 samples in 10 ms, after 5000 in the past."""

        samples = 5000

        def stats(self):
            return {"rays": {"camera": self.samples}}

        def render(self, spp, progress):
            while True:
                time.sleep(0.01)
                self.samples += 1000
                if progress(None) is False:
                    return

    renderer = Pretended()
    start = time.perf_counter()
    rate = measuring.samples_per_second(renderer, 0.1)
    elapsed = time.perf_counter() - start
    assert elapsed >= 0.1
    assert rate >= (renderer.samples - 5000) / elapsed
    assert rate <= 1000 / 0.01


@pytest.mark.parametrize("count", [1000, 10000])
def test_terrains_of_any_fineness_are_one_surface(count):
    mesh, fine = scaling.terrain(count), scaling.terrain(4 * 10**4)
    assert abs(len(mesh.triangles) / count - 1.0) < 0.05
    corners = mesh.positions[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (across[:, 1] > 0.0).all()
    # The projection covers the square once.
    assert np.abs(across[:, 1]).sum() / 2.0 == pytest.approx(4.0, rel=1e-5)
    # Every vertex is on the surface of the fine one, to its own cells' size.
    for point in mesh.positions[:: len(mesh.positions) // 20]:
        near = fine.positions[np.linalg.norm((fine.positions - point)[:, [0, 2]], axis=1).argmin()]
        assert abs(near[1] - point[1]) < 0.02


@pytest.mark.parametrize("count", [1000, 20000])
def test_soups_have_one_area_for_any_number_of_triangles(count):
    mesh = scaling.soup(count)
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    edges = corners - np.roll(corners, 1, axis=1)
    lengths = np.linalg.norm(edges, axis=2)
    assert len(mesh.triangles) == count
    np.testing.assert_allclose(lengths, lengths[0, 0], rtol=1e-3)
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2.0
    # A face of the cube has area 4.
    assert area == pytest.approx(4.0 * scaling.SOUP_AREA, rel=1e-4)


def test_captured_rays_go_back_into_a_pool_and_hit_what_brute_force_hits(device):
    pytest.importorskip("mitsuba")
    import ray_speed

    scene = psf_cl.load_scene(ROOT / "scenes" / "cornell_box.toml", size=(32, 32))
    ours = ray_speed.Ours(scene, 1024)
    rays = {part.name: part for part in ours.capture()}
    assert {"camera", "bounce 1", "shadow 1", "bounce 2", "mixed", "mixed shadow"} <= set(rays)
    assert rays["camera"].count == 1024
    corners = psf_cl.tables.flatten(scene).positions.reshape(-1, 3, 3).astype(np.float64)
    for name in ("camera", "bounce 2", "shadow 1"):
        part = rays[name]
        ours.tracer(part)()
        found = ours.hits(part)
        t = _brute_force(corners, part.origins.astype(float), part.directions.astype(float))
        if part.shadow:
            sure = np.abs(t - 1.0) > 1e-4
            assert (found.blocked == (t < 1.0))[sure].mean() > 0.999
        else:
            hit = np.isfinite(t)
            assert ((found.triangle != 0xFFFFFFFF) == hit).mean() > 0.999
            np.testing.assert_allclose(found.t[hit], t[hit], rtol=1e-3)


def _brute_force(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the nearest distance along each ray, inf if none: Moeller and Trumbore's test."""
    p0, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    with np.errstate(all="ignore"):
        across = np.cross(directions[:, None], e2[None])
        scale = 1.0 / (across * e1).sum(-1)
        offset = origins[:, None] - p0[None]
        u = (offset * across).sum(-1) * scale
        other = np.cross(offset, e1[None])
        v = (directions[:, None] * other).sum(-1) * scale
        t = (e2 * other).sum(-1) * scale
        hit = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)
    return np.where(hit, t, np.inf).min(axis=1)


def test_what_statistics_cost_is_told_with_an_interval(capsys):
    scene = str(ROOT / "scenes" / "cornell_box.toml")
    assert statistics_cost.main([scene, "--size", "16x16", "--spp", "1", "--rounds", "3"]) == 0
    median, low, high = map(float, re.findall(r"\d+\.\d{4}", capsys.readouterr().out))
    assert 0.0 < low <= median <= high
