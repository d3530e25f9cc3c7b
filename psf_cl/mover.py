"""What a frame changes on the device: vertices, triangles, and the tree around them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from psf_cl import motion
from psf_cl.device.device import Buffer, Device
from psf_cl.device.program import load_program
from psf_cl.scene.model import Scene


class Mover:
    """Moves the triangles of a scene from frame to frame.

    Nothing is enqueued while nothing moves.

    Args:
        buffers: of the plan and the scene, by their names.
        defines: of the plan, for the stage ``animate``.
        labels: ``Few.vertices`` of a small scene, None for one with a tree.

    Attributes:
        moved: whether the last ``move`` changed anything.
    """

    def __init__(
        self,
        device: Device,
        scene: Scene,
        buffers: Mapping[str, Buffer],
        defines: dict[str, int],
        labels: np.ndarray | None,
    ) -> None:
        self.device = device
        self.scene = scene
        self.buffers = buffers
        self.reach = motion.Reach(scene)
        tables = motion.moving_tables(scene)
        self.tables = tables
        contents = {
            "rest": tables.rest,
            "influences": tables.influences.reshape(-1),
            "deltas": tables.deltas,
            "moving_faces": tables.faces.reshape(-1),
        }
        if labels is not None:
            contents["corner_vertices"] = labels.astype(np.uint32)
        for name, content in contents.items():
            device.write(buffers[name], content)
        program = load_program(device, "animate.cl", defines)

        self.move_vertices = program.bind_planned(
            "move_vertices",
            buffers,
            influence_count=tables.influence_count,
            vertex_count=len(tables.rest),
        )
        self.move_triangles = program.bind_planned(
            "move_triangles",
            buffers,
            first_triangle=tables.first_triangle,
            moving_count=len(tables.faces),
            is_first_frame=1,
        )
        self.corner_count = 0 if labels is None else len(labels)
        if labels is not None:
            count = len(labels)
            self.move_corners = program.bind_planned("move_corners", buffers, corner_count=count)
        self.pose: tuple[np.ndarray, np.ndarray] | None = None
        self.moved = False

    def move(self, time: float) -> None:
        """Enqueue putting everything where it is at ``time``.

        Raises:
            InputError: something has no place then.
        """
        pose = motion.pose(self.scene, time)
        before, self.pose = self.pose, pose
        rested = not self.moved
        self.moved = before is None or any(
            not np.array_equal(new, old) for new, old in zip(pose, before, strict=True)
        )
        if not self.moved and (rested or before is None):
            return
        # A frame that stands still after one that moved has still to become the frame before.
        matrices, weights = pose
        self.device.write(self.buffers["matrices"], matrices.reshape(-1))
        self.device.write(self.buffers["morph_weights"], weights)
        self.move_vertices(len(self.tables.rest))
        self.move_triangles.set(is_first_frame=int(before is None))(len(self.tables.faces))
        if self.corner_count:
            self.move_corners(self.corner_count)

    def radius(self, center: np.ndarray) -> float:
        """Return how far from ``center`` what moves may be in this frame, m."""
        assert self.pose is not None
        return self.reach.at(center, *self.pose)
