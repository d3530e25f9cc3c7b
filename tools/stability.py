"""A table of extremes: ``python tools/stability.py [-o FOLDER] [--presets a,b] [--cases TEXT]``.

Every case of ``stability_cases.py`` is rendered with every preset, and all pairs of values of the
settings with a small room.  A row fails if a pixel is not finite, a sample was rejected, the mean
is not what is known (0.2 % and three standard errors; 2 % where the estimator is biased) or too
noisy to tell, a pixel is far brighter than it can be, a sample takes more than twice the processor
time of the calm case (a ray, where the case asks for more of them), or if it was no case of what
its name says: lights were picked otherwise, a table was not as full.  A case or a number that is
missing, a refusal where none is due and an exception fail too.

``stability.csv`` and ``stability.html`` are written to the folder.  The exit code is 1 if anything
failed.  Presets come from ``psf_cl.settings``: new ones are in the table by themselves.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import dataclasses
import html
import io
import itertools
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from stability_cases import CASES, Case, room, tables_of

from psf_cl.cli.common import positive_integer
from psf_cl.device.device import Device, open_device
from psf_cl.errors import DeviceError, InputError
from psf_cl.files import write_whole
from psf_cl.image import Image
from psf_cl.plan import make_plan
from psf_cl.renderer import Renderer
from psf_cl.scene.model import LUMINANCE, Scene
from psf_cl.settings import PRESETS, Settings, resolve

EDGE = 48
SPP = 64

#: Of the mean, beside three standard errors.
UNBIASED, BIASED = 0.002, 0.02
#: Of the mean, with the standard errors: what is allowed more tells nothing.
MOST_ALLOWED = 0.03
#: Hash tables by their names in the statistics, and the buffers of their keys.
TABLES = {
    "cells": "cell_keys",
    "guide": "guide_keys",
    "cache": "cache_keys",
    "materials": "material_keys",
}
#: How far the part of a table that is full may be from what is wanted.
LOAD_SLACK = 0.005
#: Processor time, of that of the calm case.
MOST_TIME = 2.0
#: Of processor time, of a render; and of one that is not measured again three times but once.
MOST_SECONDS, LONG_SECONDS = 240.0, 10.0

#: Renders from whose means the error of an estimator is known whose samples belong to no pixel.
SEEDS = 8

#: Chains of them: as many mutations of each as in a picture of usual size.
CHAINS = 256

#: Settings whose values other than the default bias an image of finitely many samples.
BIASING = ("path_filter", "temporal", "screen_filter")
BIASING_VALUES = {"material_cache": ("hash_grid",), "termination": ("cache",)}

#: Counters of what is in the picture, only not shared: nothing is lost.
UNSHARED = {"cells rejected_cells"}

PAIRS = "pairs of settings"

COLUMNS = (
    "case",
    "preset",
    "verdict",
    "why",
    "not finite",
    "rejected",
    "mean",
    "truth",
    "error",
    "allowed",
    "largest",
    "most allowed",
    "ns a sample",
    "ns a ray",
    "of calm",
    "lights",
    "counters",
)
#: What is empty in rows that are whole.
MAY_BE_EMPTY = {"why"}


@dataclass(frozen=True)
class Picture:
    """What one render came to.

    Attributes:
        error: standard error of the mean.
        rejected: samples, and what tables or photons brought that was not finite or too large.
        rays: with photons.
        seconds: processor time of rendering, of all threads.
        lights: how they were picked.
        loads: part of the hash tables that was full, by their names in the statistics.
        otherwise: features of the plan that are not what the case is about, and why.
        pixels: luminance of the pixels, 0 where they are not finite: ``(height, width)``.
    """

    bad: int
    rejected: int
    mean: float
    error: float
    largest: float
    samples: int
    rays: int
    seconds: float
    lights: str
    counters: Mapping[str, Any]
    pixels: np.ndarray
    loads: Mapping[str, float] = dataclasses.field(default_factory=dict)
    otherwise: tuple[str, ...] = ()

    def ns(self, per: str) -> float:
        """Return the time of a ``"sample"`` or of a ``"ray"``."""
        return self.seconds / max(self.samples if per == "sample" else self.rays, 1) * 1e9


class TooSlowError(Exception):
    """A render took more than MOST_SECONDS of the processor."""


def is_biased(settings: Settings) -> bool:
    """Say whether the mean of an image may be off by more than noise."""
    default = Settings()
    changed = [getattr(settings, n, None) != getattr(default, n, None) for n in BIASING]
    return any(changed) or any(
        getattr(settings, name, None) in values for name, values in BIASING_VALUES.items()
    )


def picture(
    device: Device,
    scene: Scene,
    settings: Settings,
    spp: int,
    prepare: Callable[[Renderer], None] = lambda renderer: None,
    features: Mapping[str, int] | None = None,
) -> Picture:
    """Render and sum up; where samples belong to no pixel, in parts that differ by their noise.

    Args:
        features: values that those of the plan have to have.

    Raises:
        TooSlowError: it did not end in time.
        DeviceError, InputError: as the renderer does.
    """
    if settings.integrator != "metropolis":
        return part_of(device, scene, settings, spp, ("variance",), prepare, features)
    settings = dataclasses.replace(settings, chains=CHAINS)
    seeds = range(settings.seed, settings.seed + SEEDS)
    others = (prepare, features)
    part_spp = max(spp // SEEDS, 1)
    parts = [
        part_of(device, scene, dataclasses.replace(settings, seed=seed), part_spp, (), *others)
        for seed in (seed % 2**32 for seed in seeds)
    ]
    means = [part.mean for part in parts]
    return dataclasses.replace(
        parts[0],
        bad=sum(part.bad for part in parts),
        rejected=sum(part.rejected for part in parts),
        mean=float(np.mean(means)),
        error=float(np.std(means, ddof=1)) / math.sqrt(SEEDS),
        # That of the picture of all samples, as without parts.
        largest=float(np.mean([part.pixels for part in parts], axis=0).max()),
        samples=sum(part.samples for part in parts),
        rays=sum(part.rays for part in parts),
        seconds=sum(part.seconds for part in parts),
    )


def part_of(
    device: Device,
    scene: Scene,
    settings: Settings,
    spp: int,
    outputs: tuple[str, ...] = (),
    prepare: Callable[[Renderer], None] = lambda renderer: None,
    features: Mapping[str, int] | None = None,
) -> Picture:
    """Render once and sum up; errors are those of ``picture``."""
    with contextlib.closing(Renderer(scene, settings, device, outputs=outputs)) as renderer:
        prepare(renderer)
        # Trees are built meanwhile, which samples have no part in.
        device.wait()
        start = time.process_time()
        if not renderer.render(
            spp=spp, progress=lambda now: time.process_time() - start < MOST_SECONDS
        ):
            raise TooSlowError(f"not done after {MOST_SECONDS:.0f} s of the processor")
        device.wait()
        seconds = time.process_time() - start
        planned = renderer.plan.features
        keys = {buffer.name for buffer in renderer.plan.buffers}
        image = renderer.image()
        return dataclasses.replace(
            summed_up(image, seconds),
            # A planned table of which nothing is told is an error, not a table that is full.
            loads={name: image.stats[name]["load"] for name in TABLES if TABLES[name] in keys},
            lights=planned["LIGHT_SAMPLING"].reason,
            otherwise=tuple(
                f"{name} is {planned[name].value}, not {value}: {planned[name].reason}"
                for name, value in (features or {}).items()
                if planned[name].value != value
            ),
        )


def summed_up(image: Image, seconds: float) -> Picture:
    """Return what a row of the table tells of an image."""
    rgb = image.rgb.astype(np.float64)
    luminance = rgb @ LUMINANCE
    finite = np.isfinite(rgb).all(axis=-1)
    pixels = np.where(finite, luminance, 0.0)
    variance = (
        float(np.mean(image.aovs["variance"].astype(float))) if "variance" in image.aovs else 0.0
    )
    stats = image.stats
    counters = stats["counters"] | {
        f"{part} {name}": value
        for part in ("cells", "guide", "cache", "materials", "photons", "metropolis")
        for name, value in (stats[part] or {}).items()
    }
    return Picture(
        bad=int((~finite).sum()),
        rejected=sum(
            value for name, value in counters.items() if "rejected" in name and name not in UNSHARED
        ),
        mean=float(luminance[finite].mean()) if finite.any() else math.nan,
        error=math.sqrt(variance / luminance.size),
        largest=float(pixels.max()),
        samples=stats["spp"] * luminance.size,
        rays=sum(stats["rays"].values()) + (stats["photons"] or {}).get("emitted", 0),
        seconds=seconds,
        lights="",
        counters=counters,
        pixels=pixels,
    )


class Bench:
    """Renders cases with presets and compares them.

    Calm pictures are made once: those to look like with ``pt`` and four times the samples.
    """

    def __init__(self, device: Device, edge: int, spp: int, timed: bool) -> None:
        self.device = device
        self.edge = edge
        self.spp = spp
        self.timed = timed
        self.cases = {case.name: case for case in CASES}
        self.truths: dict[str, Picture] = {}
        self.calm: dict[tuple[str, str], Picture] = {}

    def scene(self, case: Case) -> Scene:
        scene = case.scene(self.edge)
        if case.size is not None:
            scene = dataclasses.replace(scene, width=case.size[0], height=case.size[1])
        return scene

    def settings(self, case: Case, preset: str) -> Settings:
        return resolve({}, case.name, preset, case.settings)

    def render(self, case: Case, preset: str, factor: float = 1.0) -> Picture:
        spp = case.own_spp or max(round(self.spp * case.spp * factor), 1)
        settings = self.settings(case, preset)
        with tables_of(case.slots):
            scene = self.scene(case)
            return picture(self.device, scene, settings, spp, case.prepare, case.features)

    def truth(self, case: Case) -> tuple[float, float, float]:
        """Return mean, its standard error and the largest pixel of what the case looks like."""
        if not isinstance(case.truth, str):
            return case.truth, 0.0, case.truth
        name, _, scale = case.truth.partition(" * ")
        if name not in self.truths:
            self.truths[name] = self.render(self.cases[name], "pt", 4.0)
        known, factor = self.truths[name], float(scale or 1.0)
        return known.mean * factor, known.error * factor, known.largest * factor

    def row(self, case: Case, preset: str) -> dict[str, Any]:
        """Return one row of the table."""
        names = {"case": case.name, "preset": preset}
        row: dict[str, Any] = dict.fromkeys(COLUMNS, "") | names
        if preset in case.refused:
            return dict.fromkeys(row, "refused") | names | self._refusal(case, preset)
        try:
            seen = self.render(case, preset)
            truth, error, largest = self.truth(case)
            ratio = self._time(case, preset, seen)
        except (TooSlowError, DeviceError, InputError) as failure:
            return row | {"verdict": "FAILED", "why": f"{type(failure).__name__}: {failure}"}
        share = BIASED if is_biased(self.settings(case, preset)) else UNBIASED
        allowed = max(share, case.tolerance) * abs(truth) + 3.0 * math.hypot(seen.error, error)
        most = math.inf if case.fireflies is None else case.fireflies * largest
        failures = {
            f"{seen.bad} pixels are not finite": seen.bad > 0,
            f"{seen.rejected} rejected": seen.rejected > 0,
            "the mean is off": not abs(seen.mean - truth) <= allowed,
            "a pixel is too bright": not seen.largest <= most + allowed,
            "too noisy to tell": not allowed <= MOST_ALLOWED * abs(truth),
            "it is too slow": not isinstance(ratio, str) and not ratio <= MOST_TIME,
        }
        failures |= {
            f"{load:.5g} of the {name} are full, not {case.loads[name]:.5g}": not abs(
                load - case.loads[name]
            )
            <= LOAD_SLACK
            for name, load in seen.loads.items()
            if name in case.loads
        }
        why = "; ".join([text for text, failed in failures.items() if failed] + [*seen.otherwise])
        return row | {
            "verdict": "FAILED" if why else "ok",
            "why": why,
            "not finite": seen.bad,
            "rejected": seen.rejected,
            "mean": seen.mean,
            "truth": truth,
            "error": seen.mean - truth,
            "allowed": allowed,
            "largest": seen.largest,
            "most allowed": most,
            "ns a sample": round(seen.ns("sample")),
            "ns a ray": round(seen.ns("ray")),
            "of calm": ratio,
            "lights": seen.lights,
            "counters": " ".join(f"{k}={_number(v)}" for k, v in seen.counters.items()),
        }

    def _refusal(self, case: Case, preset: str) -> dict[str, Any]:
        """Return the verdict on a case that has to be refused in one line."""
        try:
            make_plan(self.scene(case), self.settings(case, preset), traits=self.device.traits)
        except InputError as error:
            text = str(error)
            return {"verdict": "FAILED" if "\n" in text else "ok", "why": f"refused: {text}"}
        return {"verdict": "FAILED", "why": "it is not refused"}

    def _time(self, case: Case, preset: str, seen: Picture) -> float | str:
        """Return the time over that of the calm case, or why there is none.

        What looks too slow is measured again, in turn with the calm case.
        """
        if case.calm is None:
            return case.untimed
        if not self.timed:
            return "not measured"
        calm, key = self.cases[case.calm], (case.calm, preset)
        if key not in self.calm:
            # The second time nothing is compiled beside it.
            self.calm[key] = [self.render(calm, preset) for _ in range(2)][-1]
        ratio = seen.ns(case.per) / self.calm[key].ns(case.per)
        if ratio <= MOST_TIME:
            return ratio
        pairs = [
            (self.render(case, preset).ns(case.per), self.render(calm, preset).ns(case.per))
            for _ in range(1 if seen.seconds > LONG_SECONDS else 3)
        ]
        return float(np.median([ours / theirs for ours, theirs in pairs]))

    def pairs(self) -> dict[str, Any]:
        """Return the row of all pairs of values of the settings."""
        scene, failures, bad, rejected, largest = room(16), [], 0, 0, 0.0

        def refusal(values: Mapping[str, Any]) -> str | None:
            try:
                make_plan(scene, Settings().with_values(values), traits=self.device.traits)
            except InputError as error:
                return str(error)
            return None

        rows, refused = pairwise_rows(setting_values(), refusal)
        failures += [f"refused in more than a line: {text}" for text in refused if "\n" in text]
        for values in rows:
            try:
                seen = part_of(self.device, scene, Settings().with_values(values), 4)
            except (TooSlowError, DeviceError, InputError) as error:
                failures.append(f"{changed(values)}: {error}")
                continue
            if seen.bad or seen.rejected:
                what = f"{seen.bad} not finite, {seen.rejected} rejected"
                failures.append(f"{changed(values)}: {what}")
            bad, rejected = bad + seen.bad, rejected + seen.rejected
            largest = max(largest, seen.largest)
        return dict.fromkeys(COLUMNS, "not compared") | {
            "case": PAIRS,
            "preset": "all",
            "verdict": "FAILED" if failures else "ok",
            "why": "; ".join(failures),
            "not finite": bad,
            "rejected": rejected,
            "largest": largest,
            "counters": f"rows={len(rows)} refused={len(refused)}",
        }


def changed(values: Mapping[str, Any]) -> str:
    """Return settings that are not the default, as ``--set`` takes them."""
    default = Settings()
    return " ".join(f"{k}={v}" for k, v in values.items() if v != getattr(default, k))


#: Ends of ranges that would only take hours, or more memory than some devices give a buffer: a row
#: of the table has so many photons too.
ENOUGH = {"photons": 10_000_000, "chains": 1 << 20}


def setting_values() -> dict[str, list[Any]]:
    """Return values of every setting, the default first: choices, and the ends of ranges."""
    values: dict[str, list[Any]] = {}
    for item in dataclasses.fields(Settings):
        others: Sequence[Any] = item.metadata.get("choices") or item.metadata.get("range") or ()
        if item.metadata.get("switch"):
            others = (False, True)
        if item.name in ENOUGH:
            others = [min(value, ENOUGH[item.name]) for value in others]
        values[item.name] = list(dict.fromkeys([item.default, *others]))
    return values


def pairwise_rows(
    values: Mapping[str, Sequence[Any]],
    refusal: Callable[[Mapping[str, Any]], str | None] = lambda row: None,
    seed: int = 1,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return combinations such that any two values of two settings meet in one of them.

    Greedy: of some random candidates that contain a pair still missing, the one with most of them.
    Source: Cohen, Dalal, Fredman, Patton: The AETG System, IEEE Trans. Software Eng. 23 (7), 1997.

    Args:
        values: of each setting, the default first.
        refusal: why a combination is impossible, or None.

    Returns:
        the combinations; and why those pairs were refused that are impossible by themselves.
    """
    names = list(values)
    counts = [len(values[name]) for name in names]

    def row(pick: Sequence[int]) -> dict[str, Any]:
        return {name: values[name][k] for name, k in zip(names, pick, strict=True)}

    def pairs_of(pick: Sequence[int]) -> set[tuple[int, ...]]:
        places = itertools.combinations(range(len(names)), 2)
        return {(a, pick[a], b, pick[b]) for a, b in places}

    def alone(pair: tuple[int, ...]) -> list[int]:
        pick = [0] * len(names)
        pick[pair[0]], pick[pair[2]] = pair[1], pair[3]
        return pick

    missing = {
        (a, i, b, j)
        for a, b in itertools.combinations(range(len(names)), 2)
        for i in range(counts[a])
        for j in range(counts[b])
    }
    reasons = {pair: refusal(row(alone(pair))) for pair in missing}
    refused = [text for text in reasons.values() if text is not None]
    missing = {pair for pair in missing if reasons[pair] is None}
    chance, rows = np.random.default_rng(seed), []
    while missing:
        pair = min(missing)
        best = alone(pair)
        for _ in range(20):
            pick = [int(chance.integers(count)) for count in counts]
            pick[pair[0]], pick[pair[2]] = pair[1], pair[3]
            # What does not go together gives way to the default, one setting after another.
            for place in chance.permutation(len(names)):
                if refusal(row(pick)) is None:
                    break
                if place not in (pair[0], pair[2]):
                    pick[place] = 0
            if refusal(row(pick)) is None:
                best = max(best, pick, key=lambda one: len(pairs_of(one) & missing))
        missing -= pairs_of(best)
        rows.append(row(best))
    return rows, refused


def missing_rows(rows: Sequence[Mapping[str, Any]], wanted: Sequence[tuple[str, str]]) -> list[str]:
    """Return what a whole table would have and this one has not: cases, presets, columns."""
    have = {(row["case"], row["preset"]) for row in rows}
    missing = [f"{case} with {preset}" for case, preset in wanted if (case, preset) not in have]
    return missing + [
        f"{column} of {row['case']} with {row['preset']}"
        for row in rows
        for column in COLUMNS
        if row["verdict"] == "ok" and column not in MAY_BE_EMPTY and row.get(column, "") == ""
    ]


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_html(rows: Sequence[Mapping[str, Any]], title: str) -> str:
    """Return the table as a page that opens offline."""

    def line(tag: str, cells: Sequence[Any], kind: str = "") -> str:
        inner = "".join(f"<{tag}>{html.escape(_number(cell))}</{tag}>" for cell in cells)
        return f"<tr{kind}>{inner}</tr>"

    body = "\n".join(
        line("td", [row[c] for c in COLUMNS], "" if row["verdict"] == "ok" else " class=failed")
        for row in rows
    )
    style = (
        "body{font:14px system-ui}table{border-collapse:collapse}td,th{padding:2px 8px;"
        "border-bottom:1px solid #ddd;text-align:left}tr.failed{background:#fdd}"
    )
    return (
        f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title>"
        f"<style>{style}</style><h1>{html.escape(title)}</h1><table>"
        f"{line('th', COLUMNS)}\n{body}</table>\n"
    )


def show(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the columns that matter most."""
    table = Table(title="Stability", title_justify="left")
    shown = ("case", "preset", "verdict", "mean", "truth", "allowed", "largest", "of calm", "why")
    for column in shown:
        table.add_column(column, overflow="fold")
    for row in rows:
        style = None if row["verdict"] == "ok" else "bold red"
        table.add_row(*(_number(row[column]) for column in shown), style=style)
    Console(width=None if sys.stdout.isatty() else 160, markup=False).print(table)


def _number(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def chosen(args: argparse.Namespace) -> Iterator[tuple[Case, str]]:
    """Yield the cases and presets that were asked for."""
    for preset in args.presets.split(","):
        for case in CASES:
            if args.cases in case.name:
                yield case, preset


def main(argv: Sequence[str] | None = None) -> int:
    """Make the table; return 0 if nothing failed, 1 if something did, 2 for bad usage."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path)
    parser.add_argument("--presets", default=",".join(PRESETS), help="default: all")
    parser.add_argument("--cases", default="", metavar="TEXT", help="those whose name has it")
    parser.add_argument("--spp", type=positive_integer, default=SPP)
    parser.add_argument("--edge", type=positive_integer, default=EDGE, help="of pictures, pixels")
    parser.add_argument("--device", metavar="TEXT")
    parser.add_argument("--no-times", action="store_true", help="measure no times")
    args = parser.parse_args(argv)
    unknown = sorted(set(args.presets.split(",")) - set(PRESETS))
    if unknown:
        print(f"--presets: there is no {', '.join(unknown)}", file=sys.stderr)
        return 2
    bench = Bench(open_device(args.device), args.edge, args.spp, not args.no_times)
    rows = []
    wanted = [(case.name, preset) for case, preset in chosen(args)]
    for case, preset in chosen(args):
        rows.append(bench.row(case, preset))
        last = rows[-1]
        print(f"{preset}: {case.name}: {last['verdict']} {last['why']}", file=sys.stderr)
    if args.cases in PAIRS:
        wanted.append((PAIRS, "all"))
        rows.append(bench.pairs())
    show(rows)
    if args.output is not None:
        args.output.mkdir(parents=True, exist_ok=True)
        write_whole(args.output / "stability.csv", as_csv(rows).encode())
        title = f"Stability on {bench.device.name}, {args.spp} samples a pixel"
        write_whole(args.output / "stability.html", as_html(rows, title).encode())
    missing = missing_rows(rows, wanted)
    for what in missing:
        print(f"missing: {what}", file=sys.stderr)
    failed = sum(row["verdict"] != "ok" for row in rows)
    print(f"{len(rows)} rows, {failed} failed, {len(missing)} missing")
    return int(bool(failed or missing or not rows))


if __name__ == "__main__":
    sys.exit(main())
