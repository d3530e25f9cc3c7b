"""The tool that compares trees counts what each ray visits."""

import numpy as np
import pytest
import tree_quality as tool

from psf_cl.device.bvh import build_bvh


@pytest.mark.parametrize("any_hit", [False, True])
def test_a_ray_that_misses_the_only_box_visits_no_block(device, any_hit):
    corners = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32)
    positions = device.upload("positions", corners)
    bvh = build_bvh(device, positions, 1)
    origins = np.array([[0.2, 0.2, 1], [5, 5, 1], [0.9, 0.9, 1], [0.3, 0.3, 2]])
    rays = tool.Rays(
        "test", tool.make_rays(origins, np.tile([0.0, 0.0, -1.0], (4, 1)), 3.0), any_hit
    )

    triangles, _, visits, _ = tool.Tracer(device).trace(bvh, rays, counted=True)

    missed = tool.NO_HIT
    assert triangles.tolist() == [0, missed, missed, 0]
    assert visits.tolist() == [1.0, 0.75]
    device.release(positions, bvh.nodes, bvh.blocks)
