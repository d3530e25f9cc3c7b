"""``psf-cl plan``: what will run, what is left out and why, and what it takes."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from psf_cl.cli.common import (
    add_frame_arguments,
    add_scene_arguments,
    load_with_settings,
    room_of,
    show,
    tell_notes,
)

if TYPE_CHECKING:
    from psf_cl.plan import Plan


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``psf-cl``."""
    parser = commands.add_parser(
        "plan", help="show what a render would run and leave out; needs no OpenCL"
    )
    add_scene_arguments(parser)
    add_frame_arguments(parser)
    parser.add_argument(
        "--kind", choices=("cpu", "gpu"), default="cpu", help="of device to plan for (default cpu)"
    )
    parser.add_argument("--json", action="store_true", help="print it as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the plan of a scene."""
    from psf_cl.image import json_text
    from psf_cl.plan import make_plan
    from psf_cl.traits import DeviceTraits

    scene, settings = load_with_settings(args)
    tell_notes(scene.notes)
    traits = DeviceTraits.of_kind(args.kind)
    plan = make_plan(scene, settings, args.aov, traits, args.crop, room=room_of(args))
    if args.json:
        print(json_text(plan.as_dict(), indent=2))
    else:
        _show_plan(plan)
    return 0


def _show_plan(plan: Plan) -> None:
    from rich.table import Table
    from rich.text import Text

    stages = Table("stage", "why", "kernels", title="Stages", title_justify="left")
    for stage in plan.stages:
        stages.add_row(stage.name, stage.reason, " ".join(stage.kernel_names))

    features = Table("macro", "value", "why", title="Compiled for", title_justify="left")
    for name, feature in plan.features.items():
        if feature.value:
            features.add_row(name, str(feature.value), feature.reason)
    # What is off among the features is here too.
    left_out = Table("left out", "why", title="Left out", title_justify="left")
    for name, reason in plan.left_out:
        left_out.add_row(name, reason)

    buffers = Table("buffer", "of", "what it holds", title="Buffers", title_justify="left")
    buffers.add_column("bytes", justify="right")
    owners = [("scene", plan.scene_buffers), *((s.name, s.buffers) for s in plan.stages)]
    for owner, specs in owners:
        for buffer in specs:
            buffers.add_row(buffer.name, owner, buffer.what, f"{buffer.bytes:,}")
    buffers.add_section()
    buffers.add_row("sum", "", f"{plan.total_bytes / 2**20:.1f} MiB", f"{plan.total_bytes:,}")

    if plan.building:
        buffers.add_row(
            "peak",
            "",
            f"{plan.peak_bytes / 2**20:.1f} MiB while the tree is built",
            f"{plan.peak_bytes:,}",
        )

    width, height = plan.crop[2:]
    traits = plan.traits
    pool = (
        f"{width}x{height} pixels; for a {traits.kind.upper()}: {traits.slots} paths in flight, "
        f"{traits.lanes} a work item, from at most {plan.ring} passes"
    )
    show(pool, Text(), stages, Text(), features, Text(), left_out, Text(), buffers)
