"""Light that is shared per cell stays on its side of a thin wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_builder import build, camera, film_points, glowing, lambertian, render
from test_cells import FILTER, room

from psf_cl.device.device import open_device
from psf_cl.plan import make_plan
from psf_cl.scene import primitives, transform
from psf_cl.settings import Settings, preset_values

VIEW = camera((0.6, 1.0, 3.0), (0, 1.0, -1), 45)


def block(low, high):
    """Return a matrix that makes the unit box reach from one corner to the other."""
    low, high = np.array(low, float), np.array(high, float)
    return transform.translation((low + high) / 2) @ transform.scaling((high - low) / 2)


def two_rooms(size):
    """Return a lit and an unlit room, open to the viewer, with a wall of 1 cm between them.

    Floor, ceiling and the wall at the back run through.  No light at all reaches the unlit one.
    """
    grey = lambertian(0.6)
    blocks = [
        block((-2, -0.1, -2), (2, 0, 0)),
        block((-2, 2, -2), (2, 2.1, 0)),
        block((-2.1, -0.1, -2), (-2, 2.1, 0)),
        block((2, -0.1, -2), (2.1, 2.1, 0)),
        block((-2.1, -0.1, -2.1), (2.1, 2.1, -2)),
        block((-0.005, 0, -2), (0.005, 2, 0)),
    ]
    lamp = transform.translation((-1, 1.98, -1)) @ transform.rotation_xyz_degrees((180, 0, 0))
    parts = [(primitives.box(), matrix, grey) for matrix in blocks]
    parts.append((primitives.quad(), lamp @ transform.scaling(0.3), glowing(20.0)))
    return build(parts, VIEW, size)


def leak(device, size, spp, **settings):
    """Return what leaks into the unlit room, and into 5 cm at the wall, in mean lit radiance."""
    values = preset_values("psf") | settings
    image = render(device, two_rooms(size), spp, ["depth", "normal"], **values)
    origin, rays = film_points(VIEW, size, 1)
    seen = origin + rays[:, :, 0] * image.aovs["depth"]
    # The lit side of a pixel at the wall's edge is no leak.
    plain = render(device, two_rooms(size), spp).rgb.mean(axis=-1)
    inside = (np.abs(seen[..., 0]) < 1.99) & (seen[..., 2] < -0.01)
    unlit = inside & (seen[..., 0] > 0.006) & (plain == 0)
    strip = unlit & (seen[..., 0] < 0.055) & (np.abs(image.aovs["normal"][..., 0]) < 0.5)
    lit = inside & (seen[..., 0] < -0.006) & (plain < 5)
    assert unlit.mean() > 0.2 and strip.any() and lit.mean() > 0.1
    light = image.rgb.mean(axis=-1)
    return light[unlit].mean() / plain[lit].mean(), light[strip].mean() / plain[lit].mean()


def test_walls_cost_nothing_where_nobody_asks_for_them():
    def buffers(**settings):
        plan = make_plan(room(), Settings(**settings))
        assert bool(plan.features["WALLS"].value) == any(
            b.name == "near_cells" for b in plan.buffers
        )
        return {buffer.name for buffer in plan.buffers}

    assert "near_cells" in buffers(**FILTER)
    assert "near_cells" not in buffers(**FILTER, cell_walls=False) | buffers()


def test_a_thin_wall_keeps_light_out(device):
    """Cells are half a meter wide; without rays that look for the wall much leaks."""
    ways = {"cell_size": 8, "filter_fireflies": False}
    room_through, strip_through = leak(device, (96, 72), 1, cell_walls=False, **ways)
    room_leak, strip_leak = leak(device, (96, 72), 1, **ways)
    assert room_through > 2e-3 and strip_through > 0.02
    assert room_leak < 1e-3 and strip_leak < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 8])
def test_walls_are_the_same_for_every_lane_width(device, lanes):
    def image(lanes):
        traits = replace(device.traits, lanes=lanes, block=max(lanes, 8), slots=512)
        settings = preset_values("psf") | {"cell_size": 12, "filter_restore": False}
        return render(open_device(traits=traits), two_rooms((48, 32)), 2, **settings).rgb

    narrow, wide = image(lanes), image(16)
    # Rounding moves a few points into the next cell.
    assert np.isclose(wide, narrow, rtol=1e-4, atol=1e-6).all(axis=-1).mean() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("spp", [1, 4])
def test_the_preset_keeps_the_bounds_of_leaks(device, spp):
    room_leak, strip_leak = leak(device, (384, 288), spp)
    assert room_leak < 1e-3 and strip_leak < 0.02
