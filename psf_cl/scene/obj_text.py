"""OBJ text, put into the one form that trimesh's reader takes without mistakes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from psf_cl.errors import InputError
from psf_cl.scene.concave import ears, folded


def plain_obj(path: Path, text: str) -> str:
    """Return OBJ text in the one form that trimesh reads without mistakes.

    No comments, continuations, tabs and indents.  No negative indices: trimesh counts them from the
    end of the file, not from the line that they stand on.  Every corner of the form of the first
    one: where some corners lack a texture coordinate or a normal, they get (0, 0) and a normal of
    no length, which ``_unit_normals`` refuses.
    """
    text = re.sub(r"\r\n?", "\n", text).replace("\\\n", " ")
    text = re.sub(r"[ \t]+", " ", text)
    text = re.sub(r"^ ?#.*| #.*$|^ | $", "", text, flags=re.MULTILINE)
    # What is no number, as Windows used to print it.
    text = re.sub(r"(?<=[ -])1\.#\w+", "nan", text)
    if re.search(r"^f (?:.*[ /])?0(?:[ /]|$)", text, re.MULTILINE):
        raise InputError(f"{path}: a face has the index 0; OBJ counts from 1")
    first_corners = re.findall(r"^f -?\d+(?:/(-?\d*))?(?:/(-?\d+))?", text, re.MULTILINE)
    forms = {(bool(uv), bool(normal)) for uv, normal in first_corners}
    if len(forms) < 2 and not re.search(r"^f .*-", text, re.MULTILINE):
        return text

    lines = text.split("\n")
    total = {word: sum(line.startswith(word + " ") for line in lines) for word in ("v", "vt", "vn")}
    missing = ["", "", ""]
    if len(forms) > 1:
        missing = ["", str(total["vt"] + 1), str(total["vn"] + 1)]
        lines += ["vt 0 0", "vn 0 0 0"]
    seen = dict.fromkeys(total, 0)
    for row, line in enumerate(lines):
        keyword, _, corners = line.partition(" ")
        if keyword in seen:
            seen[keyword] += 1
        elif keyword == "f":
            plain = [_absolute_corner(corner, list(seen.values())) for corner in corners.split()]
            if any(corner is None for corner in plain):
                raise InputError(f"{path}: an index of {line[:60]!r} is out of range")
            lines[row] = "f " + " ".join(_joined(corner, missing) for corner in plain if corner)
    return "\n".join(lines)


def _joined(corner: list[str], missing: list[str]) -> str:
    parts = [index or other for index, other in zip(corner, missing, strict=True)]
    return "/".join(parts).rstrip("/")


def _absolute_corner(corner: str, seen: list[int]) -> list[str] | None:
    """Return vertex, uv and normal index of ``v/vt/vn``, absent ones as ""; None if out of range.

    A negative index counts back from the last of the ``seen`` entries.
    """
    parts = ["", "", ""]
    for place, index in enumerate(corner.split("/")[:3]):
        if re.fullmatch(r"-\d{1,18}", index):
            absolute = seen[place] + 1 + int(index)
            if absolute < 1:
                return None
            index = str(absolute)
        parts[place] = index
    return parts


def with_concave_cut(text: str) -> str:
    """Return plain OBJ text with triangles in place of polygons that no fan covers.

    Text that is malformed is returned as it is, for the reader to refuse.
    """
    by_size: dict[int, list[tuple[int, int]]] = {}
    for match in re.finditer(r"^f(?: \S+){4,}$", text, re.MULTILINE):
        size = text.count(" ", *match.span())
        by_size.setdefault(size, []).append(match.span())
    if not by_size:
        return text
    cuts: dict[tuple[int, int], str] = {}
    try:
        found = re.findall(r"^v (\S+ \S+ \S+)", text, re.MULTILINE)
        points = np.array(list(map(float, " ".join(found).split()))).reshape(-1, 3)
        for size, spans in by_size.items():
            words = " ".join(text[start + 2 : end] for start, end in spans)
            corners = np.array(list(map(int, re.sub(r"/\S*", "", words).split()))) - 1
            polygons = points[corners.reshape(-1, size)]
            for row in np.flatnonzero(folded(polygons)):
                start, end = spans[row]
                names = text[start + 2 : end].split()
                pieces = ears(polygons[row]).tolist()
                lines = (" ".join(names[place] for place in piece) for piece in pieces)
                cuts[start, end] = "\n".join(f"f {line}" for line in lines)
    except (ValueError, IndexError, OverflowError):
        return text
    parts, at = [], 0
    for (start, end), lines in sorted(cuts.items()):
        parts += [text[at:start], lines]
        at = end
    return "".join([*parts, text[at:]])
