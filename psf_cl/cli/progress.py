"""Progress of a render on standard error: a bar on a terminal, else a line every few seconds."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from psf_cl.renderer import Progress

LINE_SECONDS = 5.0


class ProgressDisplay:
    """Shows what ``Renderer.render`` reports; a context manager, because a bar must be closed."""

    def __init__(self, quiet: bool = False) -> None:
        self._bar: Any = None
        self._task: Any = None
        self._lines = not quiet and not sys.stderr.isatty()
        self._next_line = LINE_SECONDS
        if not quiet and sys.stderr.isatty():
            self._bar = _bar()

    def __enter__(self) -> ProgressDisplay:
        if self._bar is not None:
            self._bar.start()
            self._task = self._bar.add_task("", total=1.0, text="starting")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, progress: Progress) -> None:
        """Show ``progress``."""
        if self._bar is not None:
            self._bar.update(self._task, completed=_share(progress), text=describe(progress))
        elif self._lines and progress.seconds >= self._next_line:
            self._next_line = progress.seconds + LINE_SECONDS
            print(f"rendering: {describe(progress)}", file=sys.stderr, flush=True)


def describe(progress: Progress) -> str:
    """Return passes, time, rate and time left, in words."""
    goal = "" if progress.spp_target is None else f"/{progress.spp_target}"
    limit = "" if progress.seconds_target is None else f"/{progress.seconds_target:g}"
    text = f"{progress.passes}{goal} spp, {progress.seconds:.1f}{limit} s"
    text += f", {progress.samples_per_second / 1e6:.2f} Msamples/s"
    left = seconds_left(progress)
    return text if left is None else f"{text}, {_clock(left)} left"


def seconds_left(progress: Progress) -> float | None:
    """Return the time left, or None while it cannot be known."""
    if progress.seconds_target is not None:
        return max(progress.seconds_target - progress.seconds, 0.0)
    if progress.spp_target is None or progress.passes == 0:
        return None
    return (progress.spp_target - progress.passes) * progress.seconds / progress.passes


def _share(progress: Progress) -> float:
    if progress.seconds_target is not None:
        return min(progress.seconds / progress.seconds_target, 1.0)
    return min(progress.passes / progress.spp_target, 1.0) if progress.spp_target else 0.0


def _clock(seconds: float) -> str:
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02} h" if hours else f"{minutes}:{rest:02} min"


def _bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[text]}", markup=False)
    return Progress(*columns, console=Console(stderr=True))
