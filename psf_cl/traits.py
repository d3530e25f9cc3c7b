"""What kinds of devices want: one table, from measured facts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DeviceTraits:
    """Numbers that kernels and buffers are specialised to.

    Attributes:
        kind: ``"cpu"`` or ``"gpu"``.
        lanes: W, paths that one work item computes at once (1, 8 or 16).
        block: paths of one block of the pool; a multiple of ``lanes``.
        slots: paths in flight; a multiple of ``block``.
        group: work items of a work group.
        run: blocks of lanes that a work item takes one after the other where items would otherwise
            meet at a counter all the time.
        epoch_share: part of a pass that is in flight at most where the pool drains between passes.
        few_triangles, few_corners, few_plates: scenes up to this size are traced without a tree,
            all triangles in lanes, or the plates that they make; 0 for never.
    """

    kind: str
    lanes: int
    block: int
    slots: int
    group: int
    run: int = 1
    epoch_share: float = 1.0
    few_triangles: int = 0
    few_corners: int = 0
    few_plates: int = 0

    def __post_init__(self) -> None:
        if self.lanes not in (1, 8, 16) or self.block % self.lanes or self.slots % self.block:
            raise ValueError(
                f"lanes {self.lanes}, block {self.block}, slots {self.slots} do not nest"
            )

    @classmethod
    def of_kind(cls, kind: str, register_floats: int = 16) -> DeviceTraits:
        """Return the table's row for ``kind``, and for what floats a register of a CPU holds.

        CPU: PoCL vectorises only what is written as vectors, 16 lanes shade a vertex in 6 ns where
        scalar code takes 27 to 83; 16k to 64k slots and groups of 1 to 16 are equally fast, runs of
        1 cost intersect and connect a tenth (two cores meet at one counter).  Whole renders of a
        room without a tree take 0.87 of the time at 66 plates, 1.15 at 98, and triangles that move,
        looked at corner by corner, 0.4 of that of a tree at 36, about as much at 200.  With
        registers of 8 floats (AVX2), 8 lanes in blocks of 8 take 0.81 to 0.88 of the time of 16 in
        the Cornell box and 0.96 to 1.04 in larger rooms; 8k slots take less at 256x256 (0.75) but
        more at 1024x1024 (0.98), and in large scenes.  Where the pool drains between passes, an
        eighth of a pass in flight takes 0.80 to 1.03 of the time of 32k slots at 256x256 (learned,
        photon, game), 0.95 to 1.05 at 128x128.  To measure again, ``python tools/kernel_timing.py
        SCENE --save a.json``, change the row, ``--baseline a.json``; for cornell_box, ajar_door,
        glossy and a large scene of one's own.

        GPU: not measured; a path a work item, blocks of 32 so that neighbours read neighbouring
        words.
        """
        if kind == "cpu":
            lanes = 8 if register_floats == 8 else 16
            return cls(
                "cpu",
                lanes=lanes,
                block=lanes,
                slots=1 << 15,
                group=8,
                run=4,
                epoch_share=0.125,
                few_triangles=160,
                few_corners=128,
                few_plates=80,
            )
        return cls("gpu", lanes=1, block=32, slots=1 << 18, group=64)
