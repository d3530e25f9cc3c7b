"""Small scenes as lists of triangles, and these as flat pieces that are quick to test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psf_cl.device import layout
from psf_cl.scene.model import Material, hides_back
from psf_cl.tables import Geometry

#: By how many roundings a place on a plate may be wrong: three times those on the way to it and to
#: what the corners say.
ROUNDINGS = 64

#: The same for the fourth corner of a parallelogram.
CORNER_ROUNDINGS = 8

#: Of numbers in a record, and of their inverse: products of two stay in the range of float32.
LARGEST = 1e18


@dataclass(frozen=True)
class Few:
    """All triangles of a small scene as a list.

    Attributes:
        corners: ``(n, 3)`` float32, no two equal; world, m.
        faces: ``(m, 4)`` uint32, three corners and the triangle's index (with ALPHA_BIT).
        dropped: triangles left out because a coordinate is not finite.
        vertices: ``(n,)`` int64, the label of each corner that moves, -1 for the others.
    """

    corners: np.ndarray
    faces: np.ndarray
    dropped: int
    vertices: np.ndarray


def few_triangles(
    positions: np.ndarray, cut_out: np.ndarray | None = None, labels: np.ndarray | None = None
) -> Few:
    """Return the triangles ``(n, 9)`` as indices into their distinct corners.

    Args:
        cut_out: ``(n,)`` bool, those whose alpha must be looked up; their index has ALPHA_BIT.
        labels: ``(n, 3)`` int64, numbers from 0 of corners that move, the same for those that stay
            together; -1 for the others.
    """
    finite = np.flatnonzero(np.isfinite(positions).all(axis=1))
    # Adding 0 makes -0 the same corner as 0.
    points = positions[finite].reshape(-1, 3) + np.float32(0.0)
    label = np.full(len(points), -1) if labels is None else labels[finite].reshape(-1)
    # Where corners are that move says nothing of which they are.
    known = np.where(label[:, None] >= 0, 0.0, points.astype(np.float64))
    _, first, index = np.unique(
        np.column_stack([label, known]), axis=0, return_index=True, return_inverse=True
    )
    faces = np.concatenate([index.reshape(-1, 3), finite[:, None]], axis=1).astype(np.uint32)
    if cut_out is not None:
        faces[cut_out[finite], 3] |= np.uint32(layout.CONSTANT["ALPHA_BIT"])
    dropped = len(positions) - len(finite)
    return Few(points[first].astype(np.float32), faces, dropped, label[first])


@dataclass(frozen=True)
class Plates:
    """The triangles of a list again, by pieces: parallelograms, then triangles that make none.

    Attributes:
        records: ``(n,)`` layout.PLATE.
        pairs: how many of them, at the start, are parallelograms.
    """

    records: np.ndarray
    pairs: int

    def padded(self, count: int) -> np.ndarray:
        """Return the records and empty ones behind them, ``(count,)``."""
        table = np.zeros(count, layout.PLATE.dtype)
        table[: len(self.records)] = self.records
        return table


NO_PLATES = Plates(np.zeros(0, layout.PLATE.dtype), 0)


def list_of(
    geometry: Geometry, materials: tuple[Material, ...], labels: np.ndarray | None
) -> tuple[Few, Plates]:
    """Return the triangles of a small scene and their flat pieces; ``labels`` as there."""
    few = few_triangles(geometry.positions, geometry.cut_out, labels)
    hiding = np.array([hides_back(material) for material in materials], bool)
    return few, flat_pieces(few, geometry.cut_out | hiding[geometry.surfaces["material"]])


def flat_pieces(few: Few, apart: np.ndarray) -> Plates:
    """Return the flat pieces of a list that stays as it is.

    None at all for a list that moves, or with a triangle too thin for a plane: all of its triangles
    are then looked at corner by corner.

    Args:
        apart: bool, of every triangle of the scene, whether a hit depends on which one is hit.
    """
    if (few.vertices >= 0).any():
        return NO_PLATES
    corners = few.corners.astype(np.float64)
    faces, index = few.faces[:, :3].astype(np.int64), few.faces[:, 3]
    alpha = np.uint32(layout.CONSTANT["ALPHA_BIT"])
    alone = apart[index & ~alpha]
    pairs = _parallelograms(corners, faces, alone)
    single = np.setdiff1d(np.arange(len(faces)), [face for pair in pairs for face in pair[:2]])
    count = len(pairs)
    records = np.zeros(count + len(single), layout.PLATE.dtype)
    apex = np.zeros((len(records), 3), np.int64)
    for row, points, (first, second, turn, other_turn) in zip(records, apex, pairs, strict=False):
        points[:] = np.roll(faces[first], -turn)
        row["first"] = index[first] | turn << layout.CONSTANT["PLATE_TURN"]
        row["second"] = index[second] | other_turn << layout.CONSTANT["PLATE_TURN"]
    apex[count:] = faces[single]
    records["first"][count:] = index[single]
    a, b, c = (corners[apex[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    normal = np.cross(e1, e2)
    # Exactly no area: never hit.  The record of zeros says the same.
    there = (normal != 0.0).any(axis=1)
    with np.errstate(all="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.cross(e2, normal), np.cross(normal, e1)
        rows = {
            "u": across[0] / (across[0] * e1).sum(axis=1, keepdims=True),
            "v": across[1] / (across[1] * e2).sum(axis=1, keepdims=True),
            "n": normal,
        }
        for name, row in rows.items():
            records[name][there] = np.column_stack([row, -(row * a).sum(axis=1)])[there]
        steepest = np.linalg.norm(np.stack([rows["u"], rows["v"]]), axis=2).max(axis=0)
        reach = np.abs(np.stack([a, e1, e2])).sum(axis=(0, 2))
        slack = ROUNDINGS * np.finfo(np.float32).epsneg * steepest
        records["slack"][there] = slack[there]
        records["slack_here"][there] = (slack * reach)[there]
    ranges = steepest, reach * steepest, 1.0 / steepest
    fits = all((values < LARGEST).all() for values in np.stack(ranges)[:, there])
    return Plates(records, count) if fits else NO_PLATES


def _parallelograms(
    corners: np.ndarray, faces: np.ndarray, alone: np.ndarray
) -> list[tuple[int, int, int, int]]:
    """Return pairs of triangles that make one: both, and the corner of each that is no other's.

    No triangle is in two, and the diagonal is an edge of just these two: what lies twice in one
    place stays apart, so that the first of the list is hit.
    """
    sides: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for face, points in enumerate(faces):
        for turn in range(3):
            b, c = int(points[turn - 2]), int(points[turn - 1])
            sides.setdefault((min(b, c), max(b, c)), []).append((face, turn))
    taken = alone.copy()
    pairs = []
    for owners in sides.values():
        if len(owners) != 2:
            continue
        (first, turn), (second, other_turn) = owners
        if taken[first] or taken[second]:
            continue
        a, b, c = np.roll(faces[first], -turn)
        d, across, _ = np.roll(faces[second], -other_turn)
        points = corners[[a, b, c, d]]
        gap = np.abs(points[1] + points[2] - points[0] - points[3]).max()
        rounding = np.finfo(np.float32).epsneg * np.abs(points).max()
        # The two wind alike where the second has the diagonal the other way round.
        if across == c and gap <= CORNER_ROUNDINGS * rounding:
            taken[first] = taken[second] = True
            pairs.append((first, second, turn, other_turn))
    return pairs
