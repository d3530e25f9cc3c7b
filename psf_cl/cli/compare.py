"""``psf-cl compare``: error metrics against a reference, and a picture of the difference."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from psf_cl.cli.common import (
    check_distinct,
    file_argument,
    number_from_zero,
    positive_integer,
    show,
)
from psf_cl.errors import InputError

if TYPE_CHECKING:
    import numpy as np

# Where the difference picture has its full colour, as a share of the reference's luminance.
_FULL_COLOUR = 0.5


def add_parser(commands: Any) -> None:
    """Add the command to the subparsers of ``psf-cl``."""
    parser = commands.add_parser("compare", help="error metrics of one image against another")
    parser.add_argument("image", metavar="A.exr", type=file_argument, help="the image to judge")
    parser.add_argument("reference", metavar="B.exr", type=file_argument, help="the reference")
    parser.add_argument(
        "--difference",
        metavar="OUT.png",
        type=file_argument,
        help="write a picture: white where equal, red where A is brighter, blue where it is "
        "darker; full colour at 50 %% of B's luminance",
    )
    parser.add_argument(
        "--blocks",
        metavar="N",
        type=positive_integer,
        help="also compare the means of N blocks across; then sizes may differ",
    )
    parser.add_argument(
        "--max-relmse",
        metavar="E",
        type=number_from_zero,
        help="exit with 1 if the relMSE is above E",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print metrics; return 1 if A has pixels that are not finite or too large an error."""
    import numpy as np
    from rich.table import Table

    from psf_cl.files import check_writable
    from psf_cl.image import read_exr, write_png_pixels
    from psf_cl.measure import errors

    if args.difference:
        if not args.difference.lower().endswith(".png"):
            raise InputError(f"{args.difference}: expected a name that ends in .png")
        check_distinct([args.difference], [args.image, args.reference])
        check_writable(args.difference)
    image, reference = read_exr(args.image), read_exr(args.reference)
    table = Table("metric")
    table.add_column("value", justify="right")
    passed = True

    same_size = (image.width, image.height) == (reference.width, reference.height)
    by_pixel = {"--difference": args.difference, "--max-relmse": args.max_relmse}
    needing = [option for option, value in by_pixel.items() if value is not None]
    if same_size or needing or not args.blocks:
        try:
            reference = errors.matching_part(reference, image, args.reference)
        except InputError as error:
            because = args.blocks and needing and not same_size
            reason = f" ({needing[0]} needs equal sizes)" if because else ""
            raise InputError(f"{error}{reason}") from error
        metrics = errors.compare(image.rgb, reference.rgb, flip=True)
        for name, value in metrics.as_dict().items():
            table.add_row(name, f"{value:.6g}")
        passed = args.max_relmse is None or metrics.relmse <= args.max_relmse
    if args.blocks:
        blocks = errors.block_agreement(image.rgb, reference.rgb, args.blocks)
        table.add_row("block correlation", f"{blocks.correlation:.5f}")
        table.add_row("blocks within 15 %", f"{100.0 * blocks.share_within:.1f} %")
        table.add_row("mean / reference's", f"{blocks.mean_ratio:.5f}")
    finite = bool(np.isfinite(image.rgb).all())
    if args.difference:
        write_png_pixels(args.difference, difference_picture(image.rgb, reference.rgb))
    show(f"{args.image} against {args.reference}", table)
    if not finite:
        print("FAILED: the image has pixels that are not finite")
    elif not passed:
        print(f"FAILED: relMSE above {args.max_relmse:g}")
    return 0 if finite and passed else 1


def difference_picture(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return a picture of ``image - reference``, ``(h, w, 3)`` uint8.

    White where they are equal, red where ``image`` is brighter, blue where it is darker, green
    where it is not finite.  The difference of luminance is taken relative to
    ``sqrt(r^2 + 0.01 m^2)``, with m the reference's mean, as in relMSE.

    Raises:
        InputError: the sizes differ, or the reference is black or not finite.
    """
    import numpy as np

    from psf_cl.measure.errors import mean_luminance
    from psf_cl.scene.model import LUMINANCE

    if image.shape != reference.shape:
        raise InputError(f"sizes differ: {image.shape[:2]} and {reference.shape[:2]}")
    mean = mean_luminance(reference)
    finite = np.isfinite(image).all(axis=-1)
    x = np.where(finite[..., None], image, reference).astype(np.float64) @ LUMINANCE
    r = reference.astype(np.float64) @ LUMINANCE
    relative = (x - r) / np.sqrt(r**2 + 0.01 * mean**2)
    amount = np.clip(relative / _FULL_COLOUR, -1.0, 1.0)
    red = 1.0 - np.maximum(-amount, 0.0)
    blue = 1.0 - np.maximum(amount, 0.0)
    colour = np.stack([red, np.minimum(red, blue), blue], axis=-1)
    colour[~finite] = (0.0, 1.0, 0.0)
    return np.rint(colour * 255.0).astype(np.uint8)
