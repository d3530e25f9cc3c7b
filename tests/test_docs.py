"""The documents say what the program does: every key of a scene file, and examples that load."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import psf_cl
from psf_cl.scene import toml_file

ROOT = Path(__file__).resolve().parents[1]
SCENE_FILE = (ROOT / "docs" / "scene_file.md").read_text(encoding="utf-8")
TABLES = {
    "[film]": toml_file.FILM,
    "[camera], [[cameras]]": toml_file.CAMERA,
    "[environment]": toml_file.ENVIRONMENT,
    "[materials.NAME]": toml_file.MATERIAL | toml_file.TEXTURE,
    "[[shapes]]": toml_file.SHAPE | toml_file.STEP,
    "[[lights]]": toml_file.LIGHT,
}


@pytest.mark.parametrize("title", TABLES)
def test_every_key_of_a_scene_file_is_documented(title):
    section = SCENE_FILE.split(f"\n## {title}\n")[1].split("\n## ")[0]
    first_columns = re.findall(r"^\| (`.*?) \|", section, re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", " ".join(first_columns))) == set(TABLES[title])


def test_the_documented_scene_loads(tmp_path):
    (example,) = re.findall(r"```toml\n(.*?)```", SCENE_FILE, re.DOTALL)
    path = tmp_path / "example.toml"
    path.write_text(example)
    scene = psf_cl.load_scene(path)
    assert [shape.name for shape in scene.shapes] == ["quad", "sphere", "lamp"]
    lamp = scene.materials[scene.shapes[2].material]
    assert lamp.emission == (17.0, 12.0, 4.0)
    # The lamp hangs at the ceiling and shines down.
    assert scene.shapes[2].transform[:3, 1] == pytest.approx([0.0, -0.3, 0.0], abs=1e-12)


def test_the_python_example_of_the_readme_runs(device, tmp_path, monkeypatch, capsys):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    scene = ROOT / "scenes" / "cornell_box.toml"
    short = {'"scenes/cornell_box.toml"': repr(str(scene)), "seconds=10.0": "seconds=0.01"}
    for text, replacement in short.items():
        assert text in example
        example = example.replace(text, replacement)
    monkeypatch.chdir(tmp_path)
    exec(example, {})
    assert re.fullmatch(r"\(512, 512, 3\) [1-9]\d*\n", capsys.readouterr().out)
    assert (tmp_path / "box.exr").is_file()


def test_links_lead_somewhere():
    for document in [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", document.read_text(encoding="utf-8")):
            assert (document.parent / target).is_file(), f"{document.name} links to {target}"
