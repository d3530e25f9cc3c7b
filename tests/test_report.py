"""The report: a page that needs nothing else, the plots, the tables; seen by a real browser."""

import base64
import csv
import io
import re
import shutil
import subprocess
import xml.etree.ElementTree
from functools import partial

import numpy as np
import PIL.Image
import pytest

from psf_cl.image import tone_map
from psf_cl.measure import plot
from psf_cl.measure.curves import Reference, Run, Snapshot
from psf_cl.measure.report import Entry, Study, shared_exponent, write_report

HEIGHT, WIDTH = 40, 48
LEVEL = {"plain": 0.3, "bright": 0.75}


def make_study():
    """Two contestants whose pictures are of one colour plus noise, and one that failed."""
    reference = np.full((HEIGHT, WIDTH, 3), 0.25)
    entries = []
    for name, level in LEVEL.items():
        runs = []
        for seed in range(4):
            rng = np.random.default_rng(seed)
            snapshots = []
            for mark, seconds in enumerate((0.5, 1.0, 2.0)):
                noise = 0.01 / seconds * rng.standard_normal((HEIGHT, WIDTH, 1))
                image = np.float32(level + (noise if mark < 2 else 0.0 * noise)) * np.ones(3)
                load = partial(np.copy, image)
                snapshots.append(Snapshot(mark, seconds, seconds + 1.0, 4 * mark + 1, load))
            runs.append(Run(seed, tuple(snapshots)))
        entries.append(Entry(name, {"sampler": name, "seed": "0"}, runs))
    entries.append(Entry("<b>broken</b>", {}, [], ["seed 0: no & way", "seed 1: no & way"]))
    study = Study(
        "A <title>", "lead", ["first pass", "1 s", "2 s"], entries, Reference(reference),
        {"device": "of </script> some kind"}, ["a note"],
    )  # fmt: skip
    study.measure()
    return study


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_report(make_study(), folder)
    return folder


def test_the_page_needs_no_other_file_and_no_network(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    addresses = set(re.findall(r"https?://[^\"' <)]+", page))
    assert addresses == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert not re.search(r"<link|<script[^>]+src=|@import|url\(", page)
    # Names are text, whatever is in them.
    assert "<b>broken" not in page and "&lt;b&gt;broken" in page
    assert page.count("</script>") == 2
    assert "2 runs failed: no &amp; way" in page
    assert "{{" not in page


def test_the_tables_hold_every_point(folder):
    rows = list(csv.DictReader(io.StringIO((folder / "points.csv").read_text())))
    assert len(rows) == 2 * 4 * 3
    assert {row["contestant"] for row in rows} == set(LEVEL)
    last = rows[2]
    # One colour of 0.3 against 0.25, divided by the mean of 0.25.
    assert float(last["mse"]) == pytest.approx(0.2**2, rel=1e-6)
    assert float(last["relmse"]) == pytest.approx(0.2**2 / 1.01, rel=1e-6)
    assert (last["point"], last["spp"], last["process_seconds"]) == ("2 s", "9", "3")

    summary = list(csv.DictReader(io.StringIO((folder / "summary.csv").read_text())))
    assert [row["point"] for row in summary] == ["first pass", "1 s", "2 s"] * 2
    assert float(summary[2]["bias2"]) == pytest.approx(0.2**2, rel=1e-6)
    assert float(summary[2]["relative_variance"]) == pytest.approx(0.0, abs=1e-12)


def test_the_plot_is_one_svg_and_one_png_of_the_same_shape(folder):
    root = xml.etree.ElementTree.fromstring((folder / "error.svg").read_text(encoding="utf-8"))
    width, height = float(root.get("width")), float(root.get("height"))
    image = PIL.Image.open(folder / "error.png")
    assert image.size == (2 * width, 2 * height)
    colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 16)}
    assert tuple(bytes.fromhex(plot.COLOURS[0][1:])) in colours


def test_plots_say_nothing_that_the_font_of_the_png_lacks(folder):
    root = xml.etree.ElementTree.fromstring((folder / "error.svg").read_text(encoding="utf-8"))
    assert all(text.isascii() for text in root.itertext())


def test_markers_lie_where_the_logarithms_are():
    ends = [(1.0, 1.0, 1.0, 1.0), (100.0, 0.01, 0.01, 0.01)]
    series = plot.Series("a", "#000000", "square", ends)
    middle = plot.Series("b", "#ff0000", "square", [(10.0, 0.1, 0.1, 0.1)])
    drawing = plot.panel("", "", [series, middle])
    centres = [
        np.mean(points, axis=0)
        for kind, points, values in drawing.items
        if kind == "area" and values["opacity"] == 1.0
    ]
    np.testing.assert_allclose(centres[2], (centres[0] + centres[1]) / 2.0, atol=1e-6)
    assert centres[1][0] > centres[0][0] and centres[1][1] > centres[0][1]


def test_an_interval_below_zero_goes_to_the_lower_edge_and_its_value_is_not_drawn():
    series = plot.Series("a", "#123456", "circle", [(1.0, 1.0, 0.5, 2.0), (2.0, -0.1, -0.3, 0.1)],
                         band=False)  # fmt: skip
    items = plot.panel("", "", [series]).items
    markers = [item for item in items if item[0] == "area"]
    assert len(markers) == 1
    lowest = max(y for kind, points, values in items for _, y in points
                 if kind == "line" and values["colour"] == "#123456")  # fmt: skip
    assert lowest == pytest.approx(330.0 - 42.0)


def test_a_panel_of_nothing_says_so():
    drawing = plot.panel("title", "x", [plot.Series("a", "#000000", "circle", [])])
    assert any(values.get("text") == "nothing to show" for _, _, values in drawing.items)


def test_ticks_are_few_and_labelled():
    for low, high in [(0.9, 1.3), (0.01, 40.0), (1e-9, 1.0), (1e-30, 1e30), (4.1, 4.4)]:
        values = plot.ticks(low, high)
        assert all(low <= value <= high for value, _ in values)
        assert sum(major for _, major in values) <= 70
    assert [value for value, major in plot.ticks(0.9, 40.0) if major] == [1, 2, 5, 10, 20]
    assert [plot.number_text(v) for v in (1e-6, 0.001, 0.5, 16.0)] == ["1e-6", "0.001", "0.5", "16"]


def test_shared_exponents_keep_8_bits_of_the_largest_channel():
    rng = np.random.default_rng(1)
    rgb = rng.random((8, 9, 3)) * 2.0 ** rng.integers(-30, 31, (8, 9, 1))
    rgb[0, 0] = 0.0
    rgb[0, 1] = np.nan
    rgb[0, 2] = 1.0
    stored = shared_exponent(rgb).astype(np.float64)
    mantissa, exponent = stored[:8], stored[8:, :, :1]
    decoded = mantissa / 255.0 * 2.0 ** (exponent - 128.0)
    assert exponent[0, 0, 0] == 0 and exponent[0, 1, 0] == 255
    good = np.isfinite(rgb).all(axis=-1)
    error = np.abs(decoded - rgb)[good].max(axis=-1)
    # Half a step of 1/255 of a power of two that is less than twice the largest channel.
    assert (error <= rgb[good].max(axis=-1) / 255.0 + 1e-30).all()


BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_the_pictures_as_the_png_would_be(folder, tmp_path):
    page = (folder / "report.html").as_uri()
    shot = tmp_path / "shot.png"
    options = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    options += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=10000"]
    done = subprocess.run([*options, "--dump-dom", page], capture_output=True, text=True,
                          timeout=120, check=True)  # fmt: skip
    # The reference, and of both contestants three points and the mean of the last.
    assert 'data-ready="9"' in done.stdout
    assert done.stdout.count("<canvas") == 1 + 9
    subprocess.run([*options, "--window-size=1300,3200", f"--screenshot={shot}", page],
                   capture_output=True, timeout=120, check=True)  # fmt: skip
    colours = PIL.Image.open(shot).convert("RGB").getcolors(1 << 22)
    counts = {colour: count for count, colour in colours}
    # The page's exposure is 0 for a mean of 0.25; noise is gone at the last point.
    for level in (0.25, *LEVEL.values()):
        # What the shared exponent makes of the level, then what the PNG of a render would show.
        stored = shared_exponent(np.full((1, 1, 3), level)).astype(np.float64)
        kept = stored[0] / 255.0 * 2.0 ** (stored[1] - 128.0)
        expected = tuple(int(v) for v in tone_map(kept[None])[0, 0])
        assert counts.get(expected, 0) > WIDTH * HEIGHT, (level, expected)


def test_pictures_in_the_page_are_pngs(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    sources = re.findall(r"data:image/png;base64,([^\"]+)", page)
    assert len(sources) == 9
    image = PIL.Image.open(io.BytesIO(base64.b64decode(sources[0])))
    assert image.size == (WIDTH, 2 * HEIGHT)
