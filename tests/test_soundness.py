"""Forged checkpoints and caches: whole, signed, and of nothing that a render could have written."""

from __future__ import annotations

import contextlib
import hashlib
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scene_builder import build, camera, floor, glowing, renderer

from psf_cl.cli.main import main
from psf_cl.device import layout
from psf_cl.device.device import Device
from psf_cl.errors import InputError
from psf_cl.scene import primitives, transform
from psf_cl.scene.model import Material

TECHNIQUES = {
    "film": {},
    "tables": {
        "path_filter": "hash_grid",
        "guiding": "learned",
        "termination": "cache",
        "light_sampling": "photon",
    },
    "chains": {"integrator": "metropolis", "chains": 128},
}
OUTPUTS = {"tables": ("cell_count", "variance", "normal")}


def scene():
    shapes = [floor(3.0, Material(roughness=0.6))]
    for x in (-0.6, 0.0, 0.6):
        over = transform.translation((x, 2.0, 0)) @ transform.rotation_xyz_degrees((180, 0, 0))
        shapes.append((primitives.quad(), over @ transform.scaling(0.2), glowing((8.0, 6.0, 4.0))))
    return build(shapes, camera((0, 1.5, 3), (0, 0.5, 0), 45), (12, 8))


@pytest.fixture(scope="module")
def saved(device, tmp_path_factory):
    """Return, by technique: its renderer, the bytes of a checkpoint, the buffers in it."""
    small = Device(device.context, replace(device.traits, slots=512))
    folder = tmp_path_factory.mktemp("saved")
    with contextlib.ExitStack() as stack:
        made = {}

        def of(name):
            if name not in made:
                path = folder / name
                settings = TECHNIQUES[name]

                def fresh():
                    return stack.enter_context(
                        contextlib.closing(
                            renderer(small, scene(), OUTPUTS.get(name, ()), **settings)
                        )
                    )

                first, second = fresh(), fresh()
                first.render(spp=8)
                assert first.save(path)
                made[name] = second, path.read_bytes(), first._lasting()
            return made[name]

        yield of


def forged(saved, changes, header_change=None):
    """Return a file with changed buffers and description, signed anew."""
    second, whole, buffers = saved
    magic = whole[: whole.index(b"\n") + 1]
    (length,) = struct.unpack_from("<Q", whole, len(magic))
    start = len(magic) + 8
    header = json.loads(whole[start : start + length])
    at, parts = start + length, []
    for name, (dtype, count) in buffers.items():
        array = np.frombuffer(whole, dtype, count, at).copy()
        at += array.nbytes
        if name in changes:
            changes[name](array, second.plan.traits.block)
        parts.append(array.tobytes())
    header.update(header_change or {})
    text = json.dumps(header).encode()
    body = struct.pack("<Q", len(text)) + text + b"".join(parts)
    return magic + body + hashlib.sha256(body).digest()


def put(field, value, at=0):
    """Return a change of one item, or of a field of it."""

    def change(array, block):
        if field is None:
            array[at] = value
        else:
            array[field][at] = value

    return change


def put_chain(name, value):
    """Return a change of a field of the first chain."""

    def change(array, block):
        # Fields of a block of chains lie side by side; the first word is that of the first chain.
        per_chain = array.view(np.uint32).reshape(-1, len(layout.CHAIN_FIELDS), block)
        per_chain[0, layout.CHAIN_INDEX[name], 0] = value

    return change


def put_record(word, value):
    """Return a change of a word of every row of the photons' table that knows something."""

    def change(array, block):
        rows = array.reshape(-1, 4 + 2 * layout.CONSTANT["PARTICLE_KINDS"])
        known = rows[:, 1] > 0
        assert known.any()
        rows[known, word] = value

    return change


def put_words(array, block):
    assert array.any()
    array[array > 0] |= np.uint32(7)


NAN = np.uint32(0x7FC00000)
CASES = {
    "film that is not finite": ("film", "film", put("sum", np.inf), "film holds what is not"),
    "variance that is not": ("film", "film", put("squares", np.nan, 5), "film holds what is not"),
    "more samples than passes": ("film", "film", put("count", 9), "more samples than there were"),
    "no guide to leave out": (
        "film",
        "counters",
        put(None, 1, layout.COUNTER_INDEX["guide_off"]),
        "a guide that is not there",
    ),
    "densities": ("tables", "guide_cells", put("density", -1.0), "density of guide_cells is out"),
    "rows": ("tables", "guide_cells", put("rows", np.nan), "guide_cells holds what is not finite"),
    "sums": ("tables", "guide_sums", put("high", 1 << 31), "guide_sums holds sums that are too"),
    "ends": ("tables", "cache_cells", put("ends", 2.0), "ends of cache_cells is out of range"),
    "means": ("tables", "cache_cells", put("mean", np.inf), "cache_cells holds what is not finite"),
    "long lists": ("tables", "particle_table", put_record(1, 15), "lists that are too long"),
    "nodes": ("tables", "particle_table", put_record(4, 1 << 30), "table names lights"),
    "shares": ("tables", "particle_table", put_record(18, NAN), "what is no chance"),
    "chances": ("tables", "particle_table", put_record(2, NAN), "what is no chance"),
    "photons": ("tables", "particle_words", put_words, "words name lights that are not"),
    "radiance": ("chains", "chains", put_chain("radiance_g", NAN), "chains hold what is not"),
    "numbers": ("chains", "chains", put_chain("pairs", 1 << 20), "than there is room for"),
    "pixels": ("chains", "chains", put_chain("pixel", 96), "pixels that are not there"),
    "turns": ("chains", "chains", put_chain("pass", 1 << 30), "not at the end of a pass"),
    "places": ("chains", "chains", put_chain("place", 95), "not at the end of a pass"),
    "first states": ("chains", "starts", put(None, 1 << 31), "paths that are not there"),
    "no start": (
        "chains",
        "counters",
        put(None, 1, layout.COUNTER_INDEX["chain_limit"]),
        "have not started",
    ),
    "brightness": ("chains", "brightness", put(None, np.nan), "brightness holds what is not"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_signed_checkpoint_of_what_no_render_writes_is_refused(saved, tmp_path, case):
    technique, buffer, change, text = CASES[case]
    path = tmp_path / "state"
    path.write_bytes(forged(saved(technique), {buffer: change}))
    with pytest.raises(InputError, match=f"state: unsound checkpoint: .*{text}"):
        saved(technique)[0].resume(path)


@pytest.mark.parametrize("epoch", [(0, 1 << 31), (8, 9), (0, 8), (7, 8)])
def test_an_epoch_that_is_not_one_of_the_render_is_refused(saved, tmp_path, epoch):
    path = tmp_path / "state"
    path.write_bytes(forged(saved("tables"), {}, {"epoch": list(epoch)}))
    with pytest.raises(InputError, match="state: unsound checkpoint: its epoch is none of"):
        saved("tables")[0].resume(path)


@pytest.mark.parametrize("technique", TECHNIQUES)
def test_a_checkpoint_that_was_written_is_sound(saved, tmp_path, technique):
    """Signed anew without a change it is the same file, which the others would be without one."""
    second, whole, _ = saved(technique)
    path = tmp_path / "state"
    path.write_bytes(forged(saved(technique), {}))
    assert path.read_bytes() == whole
    second.resume(path)
    second.render(spp=9)
    assert np.isfinite(second.image().rgb).all()


def test_an_unsound_checkpoint_is_one_line_and_the_code_of_bad_input(tmp_path, capfd):
    path = tmp_path / "floor.toml"
    path.write_text(
        "[camera]\nposition = [0, 1, 2]\ntarget = [0, 0, 0]\n[environment]\nradiance = [1, 1, 1]\n"
        '[[shapes]]\nprimitive = "quad"\n'
    )
    state, out = tmp_path / "state", tmp_path / "out.exr"
    options = ["render", str(path), "--size", "8x8", "--quiet", "-o", str(out)]
    assert main([*options, "--spp", "2", "--checkpoint", str(state)]) == 0
    magic, _, signed = state.read_bytes()[:-32].partition(b"\n")
    body = bytearray(signed)
    # The film is the last of the buffers.
    at = len(body) - 64 * layout.FILM_SUM.dtype.itemsize
    assert struct.unpack_from("<f", body, at)[0] > 0.0
    struct.pack_into("<f", body, at, np.nan)
    state.write_bytes(magic + b"\n" + body + hashlib.sha256(body).digest())
    capfd.readouterr()
    assert main([*options, "--spp", "4", "--resume", str(state)]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1
    assert "state: unsound checkpoint: film holds what is not finite" in error


def test_the_brightest_light_that_a_scene_may_have_goes_on_from_its_checkpoint(device, tmp_path):
    small = Device(device.context, replace(device.traits, slots=512))
    # At the edges of the plate squares of differences are beyond float32.
    bright = build([floor(0.5, glowing((1e20,) * 3))], camera((0, 1.5, 3), (0, 0, 0), 45), (12, 8))
    with contextlib.ExitStack() as stack:
        whole, first, second = (
            stack.enter_context(contextlib.closing(renderer(small, bright))) for _ in range(3)
        )
        whole.render(spp=6)
        first.render(spp=3)
        assert first.save(tmp_path / "bright")
        second.resume(tmp_path / "bright")
        second.render(spp=6)
        assert second.image().rgb.max() > 1e19
        assert np.array_equal(second.image().rgb, whole.image().rgb)
