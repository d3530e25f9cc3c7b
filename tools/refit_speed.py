"""Measure what fitting a tree to a deforming mesh costs: ``refit_speed.py``.

A bumpy ball is twisted by its joints, frame by frame.  For each frame: the cost of the tree by
surfaces, relative to when it was built; processor seconds to move the vertices, to fit the tree,
and to build another one, those of a CPU device included; and what the rays of paths take, relative
to those of a renderer that has built its tree for the frame (medians of interleaved rounds).  It
ends where another tree falls due.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from psf_cl import renderer as renderer_module
from psf_cl.cli.common import positive_integer, positive_number
from psf_cl.device.bvh import build_bvh
from psf_cl.device.device import Device, open_device
from psf_cl.renderer import Renderer
from psf_cl.scene.animation import baked
from psf_cl.scene.curve import Curve
from psf_cl.scene.load import framing_camera
from psf_cl.scene.model import Environment, Material, Mesh, Node, Scene, Shape, Skin
from psf_cl.settings import Settings

JOINTS = 16


def ball(rows: int) -> Mesh:
    """Return a bumpy ball of ``2 * rows^2`` triangles, with joints from below to above."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, rows + 1), np.linspace(0, np.pi, rows + 1))
    radius = 1 + 0.1 * np.sin(9 * u) * np.sin(7 * v) + 0.02 * np.sin(61 * u) * np.sin(53 * v)
    points = radius[..., None] * np.stack(
        [np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)], axis=-1
    )
    points = points.reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rows), np.arange(rows), indexing="ij")
    corner = row * (rows + 1) + column
    below = corner + rows + 1
    faces = np.stack([corner, corner + 1, below + 1, corner, below + 1, below], axis=-1)
    place = np.clip((points[:, 1] + 1) / 2 * (JOINTS - 1), 0, JOINTS - 1.001)
    first = place.astype(np.uint32)
    share = place - first
    return Mesh(
        "ball",
        points.astype(np.float32),
        faces.reshape(-1, 3).astype(np.uint32),
        joints=np.stack([first, first + np.uint32(1)], axis=1),
        weights=np.stack([1 - share, share], axis=1).astype(np.float32),
    )


def twisting(rows: int, size: int, twist: float) -> Scene:
    """Return a scene of the ball, turned by ``twist`` degrees from end to end in a second."""
    times, last = np.array([0.0, 1000.0]), 1000.0 * twist
    turns = [np.array([[0, 0, 0], [0, last * joint / (JOINTS - 1), 0]]) for joint in range(JOINTS)]
    nodes = tuple(Node(curves={"rotation": Curve(times, turn)}) for turn in turns)
    skin = Skin(tuple(range(JOINTS)), np.tile(np.eye(4), (JOINTS, 1, 1)))
    scene = Scene(
        "ball",
        size,
        size,
        materials=(Material(specular=0.0),),
        shapes=(Shape("ball", ball(rows), np.eye(4), 0, skin=skin),),
        environment=Environment((1.0, 1.0, 1.0)),
        nodes=nodes,
    )
    return replace(scene, cameras=(framing_camera(baked(scene, 0.0)),))


def seconds_of(device: Device, work: Callable[[], object]) -> float:
    """Return the processor seconds that ``work`` takes, those of a CPU device included."""
    device.wait()
    start = time.process_time()
    work()
    device.wait()
    return time.process_time() - start


def trace_seconds(opened: Renderer, spp: int) -> float:
    """Return the processor seconds that rays take for ``spp`` more samples a pixel.

    Their share in the time of all kernels says how much of it they are.
    """

    def totals() -> np.ndarray:
        spent = opened.device.totals
        names = ("intersect_closest", "connect_lights")
        rays = sum(spent[name].seconds for name in names if name in spent)
        return np.array((rays, sum(one.seconds for one in spent.values())))

    # Trees that were fitted or built before are none of it.
    opened.device.wait()
    opened.device.collect_events()
    before, passes = totals(), opened.scheduler.passes
    seconds = seconds_of(opened.device, lambda: opened.render(spp=passes + spp))
    rays, everything = totals() - before
    return seconds * float(rays / everything)


def main(arguments: Sequence[str] | None = None) -> int:
    """Twist the ball and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", type=positive_integer, default=354, help="of quads (354)")
    parser.add_argument("--size", type=positive_integer, default=128, help="film, pixels (128)")
    parser.add_argument("--rounds", type=positive_integer, default=3, help="of timing (3)")
    parser.add_argument("--spp", type=positive_integer, default=64, help="of a round (64)")
    parser.add_argument("--twist", type=positive_number, default=20.0, help="degrees a frame (20)")
    parser.add_argument("--frames", type=positive_integer, default=99, help="at most (99)")
    args = parser.parse_args(arguments)
    due = renderer_module.REBUILD_RATIO
    # This loop decides when to end.
    renderer_module.REBUILD_RATIO = float("inf")
    scene = twisting(args.rows, args.size, args.twist)
    device = open_device(profiling=True)
    opened = Renderer(scene, Settings(), device, statistics=True)
    assert opened.refit is not None and opened.mover is not None
    refit, mover, positions = opened.refit, opened.mover, opened.buffers["positions"]
    count = len(scene.shapes[0].mesh.triangles)

    def build() -> None:
        tree = build_bvh(device, positions, count)
        device.release(tree.nodes, tree.blocks)

    columns = ("frame", "cost", "move s", "fit s", "build s", "fit / build", "rays slower by")
    table = Table(*columns, title=f"{count} triangles; a tree falls due at a cost of {due}")
    for frame in range(1, args.frames + 1):
        opened.set_frame(frame - 0.5)
        move = seconds_of(device, lambda time=float(frame): mover.move(time))
        opened.set_frame(float(frame))
        ratio = refit.cost_ratio()
        fresh = Renderer(baked(scene, float(frame)), Settings(), device, statistics=True)
        fit, built, slower = [], [], []
        for one in (opened, fresh):
            trace_seconds(one, args.spp)
        for _ in range(args.rounds):
            fit.append(seconds_of(device, lambda: refit.fit(positions)))
            built.append(seconds_of(device, build))
            own = trace_seconds(opened, args.spp)
            slower.append(own / trace_seconds(fresh, args.spp) - 1)
        fresh.close()
        table.add_row(
            str(frame),
            f"{ratio:.3f}",
            f"{move:.4f}",
            f"{statistics.median(fit):.4f}",
            f"{statistics.median(built):.4f}",
            f"{statistics.median(fit) / statistics.median(built):.1%}",
            f"{statistics.median(slower):.1%}",
        )
        if ratio > due:
            break
    Console(width=100).print(table)
    opened.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
