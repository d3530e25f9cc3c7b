"""Index assertions: sources whose accesses to device arrays are bound-checked, for debugging.

A checked buffer has a header before its first item: a magic word, its size and room for what went
wrong.  Sources are rewritten before they are compiled: each ``array[index]``, ``array + index``,
``vload4(index, array)`` and ``vstore4(value, index, array)`` of an array in device memory asks the
header first.  An index that is too large is noted in the header, and item 0 is taken instead.
Gathers do the same (``lanes.h``).  What begins inside of a buffer has no header: where it begins is
checked, but not how far one goes from there.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

#: Words before the first item.
HEADER_WORDS = 8
_MAGIC = (0x5EEDC0DE, 0x1DEC5A1E)

#: What checked sources begin with.
PROLOGUE = f"""
#define CHECK_INDICES
/// Return `index`, or 0 where an array of items of `size` bytes does not have `count` there.
static inline ulong index_checked(
    __global const void *array, ulong index, uint count, uint size, uint site)
{{
    volatile __global uint *header = (volatile __global uint *)array - {HEADER_WORDS};
    if (header[0] != {_MAGIC[0]}u || header[1] != {_MAGIC[1]}u)
        return index;
    const ulong bytes = header[2] | (ulong)header[3] << 32;
    if (index < bytes / size / count)
        return index;
    if (atomic_inc(&header[4]) == 0u) {{
        header[5] = site;
        header[6] = (uint)index;
        header[7] = size * count;
    }}
    return 0;
}}
#define SITE (SITE_FILE << 16 | __LINE__)
#define GROUP_AT(array, index, count) \\
    index_checked( \\
        (__global const void *)(array), (ulong)(index), count, (uint)sizeof(*(array)), SITE)
#define AT(array, index) GROUP_AT(array, index, 1u)
"""

_SEAM = re.compile(r'#line \d+ "(.+)"')
_PARAMETER = re.compile(r"(?:__)?global\s+(?:\w+\s+)*?(\w+)\s*\*\s*(?:restrict\s+)?(\w+)\s*[,)]")
_CAST = r"\((?:__)?global\s[^()]*\*\)"
_LOCAL = re.compile(r"(?:__)?global\s+(?:const\s+|volatile\s+)*\w+\s*\*\s*(\w+)\s*=")


@dataclass(frozen=True)
class Violation:
    """The first index of a buffer that was too large.

    Attributes:
        count: how many there were.
        site: file and line, as ``site_name`` tells.
        index: item; its low 32 bits.
        size: bytes of an item.
    """

    count: int
    site: int
    index: int
    size: int


def header_of(size: int) -> np.ndarray:
    """Return the header of a buffer of ``size`` bytes: uint32 [HEADER_WORDS]."""
    low, high = size & 0xFFFFFFFF, size >> 32
    return np.array([*_MAGIC, low, high, 0, 0, 0, 0], np.uint32)


def violation_in(header: np.ndarray) -> Violation | None:
    """Return what a header tells."""
    return Violation(*(int(word) for word in header[4:8])) if header[4] else None


def site_number(file: str) -> int:
    """Return the number of a file, as ``#line`` names it, in sites; 16 bits."""
    return zlib.crc32(file.encode()) & 0xFFFF


def checked_source(text: str) -> tuple[str, dict[int, str]]:
    """Return an assembled source with its accesses checked, and the files of its sites."""
    files: dict[int, str] = {}
    lines = []
    for line in _with_checks(text).splitlines():
        seam = _SEAM.fullmatch(line)
        if seam:
            number = site_number(seam[1])
            files[number] = seam[1]
            lines += ["#undef SITE_FILE", f"#define SITE_FILE {number}u"]
        lines.append(line)
    return PROLOGUE + "\n".join(lines) + "\n", files


def _with_checks(text: str) -> str:
    parts, done = [], 0
    for begin, end in _functions(text):
        parts += [text[done:begin], _checked_function(text[begin:end])]
        done = end
    return "".join([*parts, text[done:]])


def _functions(text: str) -> Iterator[tuple[int, int]]:
    """Yield where functions begin, at their return type, and end."""
    end = 0
    for body in re.finditer(r"\)\n?( ?)\{\s", text):
        if body.start() < end:
            continue
        marks = (text.rfind(mark, 0, body.start()) for mark in (";\n", "}\n", "\n\n", "\n#"))
        begin, end = max(marks) + 1, _closing(text, body.end() - 2) + 1
        yield begin, end


def _checked_function(text: str) -> str:
    body = text.index("{")
    names = {name for _, name in _PARAMETER.findall(text[:body])}
    names |= set(_LOCAL.findall(text[body:]))
    if not names:
        return text
    return text[:body] + _checked_text(
        text[body:],
        re.compile(
            rf"//[^\n]*|\bv(load|store)(\d+)\(|(?<![\w.>])({'|'.join(sorted(names))})\["
            rf"|((?:{_CAST})?)(?<![\w.>])({'|'.join(sorted(names))}) \+ "
        ),
        names,
    )


def _checked_text(text: str, access: re.Pattern[str], names: set[str]) -> str:
    parts, done = [], 0
    while match := access.search(text, done):
        parts.append(text[done : match.start()])
        done = match.end()
        if match[0].startswith("//"):
            parts.append(match[0])
            continue
        if match[5]:
            array, end = f"{match[4]}{match[5]}", _operand_end(text, done)
            index = _checked_text(text[done:end], access, names)
            parts.append(f"{match[0]}AT({array}, {index})")
            done = end
            continue
        close = _closing(text, done - 1)
        inner = text[done:close]
        done = close + 1
        if match[3]:
            index = _checked_text(inner, access, names)
            parts.append(f"{match[3]}[AT({match[3]}, {index})]")
            continue
        arguments = [_checked_text(part, access, names) for part in _arguments(inner)]
        array = arguments[-1].strip()
        if array in names:
            arguments[-2] = f"GROUP_AT({array}, {arguments[-2]}, {match[2]}u)"
        parts.append(f"{match[0]}{', '.join(arguments)})")
    return "".join([*parts, text[done:]])


def _closing(text: str, begin: int) -> int:
    """Return where the bracket at ``begin`` is closed."""
    depth = 0
    for place in range(begin, len(text)):
        depth += (text[place] in "([{") - (text[place] in ")]}")
        if depth == 0:
            return place
    raise ValueError(f"a bracket is not closed: {text[begin : begin + 40]!r}")


def _operand_end(text: str, begin: int) -> int:
    """Return where what is added to a pointer ends: at what closes, or parts, what is around it."""
    depth = 0
    for place in range(begin, len(text)):
        if depth == 0 and text[place] in ",;)]}":
            return place
        depth += (text[place] in "([{") - (text[place] in ")]}")
    return len(text)


def _arguments(text: str) -> list[str]:
    """Return what commas outside of brackets part."""
    parts, depth, begin = [], 0, 0
    for place, letter in enumerate(text):
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0:
            parts.append(text[begin:place])
            begin = place + 1
    return [*parts, text[begin:]]
