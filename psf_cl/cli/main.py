"""The command ``psf-cl``: arguments in, exit code out."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from psf_cl.errors import DeviceError, InputError

# The rest is imported by ``_parser``, when ``program`` already answers Ctrl-C.
if TYPE_CHECKING:
    import argparse


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done, 1 the device or the run failed (or a comparison did), 2 bad input or usage,
        130 interrupted.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # File names may be no text.
    try:
        args = _parser().parse_args(argv)
        code = args.run(args)
        sys.stdout.flush()
        return code
    except InputError as error:
        return _fail(str(error), 2)
    except DeviceError as error:
        return _fail(str(error), 1)
    except MemoryError:
        return _fail("out of memory; try a smaller --size or scene", 1)
    except KeyboardInterrupt:
        return _fail("interrupted", 130)
    except BrokenPipeError:
        # The reader has had enough.  Python flushes once more at exit: let that go nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def program() -> NoReturn:
    """Run one command and end the process with its exit code.

    At once: an interrupted command may leave a thread in a compiler, which cannot be stopped and
    crashes when the libraries are unloaded below it.
    """
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, _interrupt)
    _end(main())


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End the process if it is importing, else raise KeyboardInterrupt.

    A module that is being imported may swallow the exception or turn it into an ImportError; and
    no file is half written then.
    """
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            _end(_fail("interrupted", 130))
        frame = frame.f_back
    raise KeyboardInterrupt


def _end(code: int) -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError):
            stream.flush()
    os._exit(code)


def _parser() -> argparse.ArgumentParser:
    import psf_cl
    from psf_cl.cli import compare, converge, doctor, plan, render
    from psf_cl.cli.common import Parser

    parser = Parser(prog="psf-cl", description="Path tracing on any OpenCL device.")
    parser.add_argument("--version", action="version", version=f"psf-cl {psf_cl.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in (render, plan, doctor, converge, compare):
        command.add_parser(commands)
    return parser


def _fail(message: str, code: int) -> int:
    print(f"psf-cl: error: {' '.join(message.split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    program()
