"""The container of glTF 2.0: JSON, buffers and accessors, every value and range checked before use.

What is checked is what is read: an unused accessor may be broken.  Errors are named by JSON path.

Source: Khronos Group, "glTF 2.0 Specification", sections 3 and 4.
"""

from __future__ import annotations

import base64
import json
import math
import re
import reprlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from psf_cl.errors import InputError
from psf_cl.files import read_file

# JSON numbers end up in float32 on the device.
MAX_NUMBER = float(np.finfo(np.float32).max)

# An accessor without a buffer view is all zeros: no file size bounds the count, only this, which is
# for all of them together.
MAX_ZEROS = 1 << 24

_COMPONENTS = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
UNSIGNED = (5121, 5123, 5125)
QUANTISED_OR_FLOAT = (5120, 5121, 5122, 5123, 5126)
FLOAT = (5126,)

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
_ELEMENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class MissingData(InputError):
    """A buffer has neither a URI nor a BIN chunk; glTF allows that, extensions may fill it in."""


@dataclass(frozen=True)
class Item:
    """One JSON object and its place in the file, for typed reading.

    Every getter raises ``InputError`` with file, JSON path, expectation and value found.
    """

    file: str
    place: str
    values: dict[str, Any]

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def fail(self, key: str, expected: str, got: str | None = None) -> NoReturn:
        """Raise the error that ``key`` is not as ``expected``; ``got`` defaults to its value."""
        if got is None:
            got = reprlib.repr(self.values[key]) if key in self.values else "nothing"
        raise InputError(f"{self.file}: {self.path_of(key)}: expected {expected}, got {got}")

    def integer(self, key: str, default: int | None = None, low: int = 0) -> int:
        """Return an integer of at least ``low``; without a default it must be there."""
        value = self.values.get(key, default)
        # JSON has one kind of number: 1.0 is the integer 1.
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            self.fail(key, f"an integer of at least {low}")
        return value

    def number(
        self,
        key: str,
        default: float | None = None,
        low: float = -MAX_NUMBER,
        high: float = MAX_NUMBER,
    ) -> float:
        """Return a number in ``[low, high]``; without a default it must be there."""
        value = self.values.get(key, default)
        if not _is_number(value, low, high):
            self.fail(key, "a number" + _range_text(low, high))
        return float(value)

    def numbers(
        self,
        key: str,
        default: Sequence[float],
        low: float = -MAX_NUMBER,
        high: float = MAX_NUMBER,
    ) -> tuple[float, ...]:
        """Return as many numbers in ``[low, high]`` as ``default`` has."""
        values = self.values.get(key, default)
        right = isinstance(values, (list, tuple)) and len(values) == len(default)
        if not right or not all(_is_number(value, low, high) for value in values):
            self.fail(key, f"{len(default)} numbers" + _range_text(low, high))
        return tuple(float(value) for value in values)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string that can be printed; without a default it must be there."""
        value = self.values.get(key, default)
        if not isinstance(value, str):
            self.fail(key, "a string")
        return _printable(value)

    def flag(self, key: str, default: bool = False) -> bool:
        """Return a boolean."""
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, "true or false")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a list of strings, empty if absent."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            self.fail(key, "a list of strings")
        return [_printable(text) for text in value]

    def item(self, key: str) -> Item:
        """Return the object under ``key``; absent, it is empty."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            self.fail(key, "an object")
        return Item(self.file, self.path_of(key), value)

    def length(self, key: str) -> int:
        """Return the length of the list under ``key``, 0 if absent."""
        value = self.values.get(key, [])
        if not isinstance(value, list):
            self.fail(key, "a list")
        return len(value)

    def element(self, key: str, index: int) -> Item:
        """Return the object at ``index`` of the list ``key``, which is that long."""
        value = self.values[key][index]
        place = f"{self.path_of(key)}[{index}]"
        if not isinstance(value, dict):
            got = reprlib.repr(value)
            raise InputError(f"{self.file}: {place}: expected an object, got {got}")
        return Item(self.file, place, value)

    def extension_names(self) -> list[str]:
        """Return the names of all extensions of this object."""
        return [_printable(name) for name in self.item("extensions").values]

    def extension(self, name: str) -> Item | None:
        """Return the object of an extension, or None if it is not there."""
        extensions = self.item("extensions")
        return extensions.item(name) if name in extensions else None

    def path_of(self, key: str) -> str:
        """Return the JSON path of ``key``."""
        return f"{self.place}.{key}" if self.place else key


@dataclass
class GltfFile:
    """An opened .gltf or .glb.

    Attributes:
        root: the whole JSON.
        folder: where relative URIs start; nothing outside it is read.
        binary: the BIN chunk of a .glb, else None.
        files: those that were read besides the file itself.
    """

    root: Item
    folder: Path
    binary: memoryview | None
    files: list[str] = field(default_factory=list)
    _buffers: dict[int, memoryview] = field(default_factory=dict)
    _accessors: dict[tuple[int, bool], np.ndarray] = field(default_factory=dict)
    _decoded: dict[int, np.ndarray] = field(default_factory=dict)
    _zeros: int = 0

    def index(self, owner: Item, key: str, array: str) -> int | None:
        """Return ``owner[key]``, an index into the root's list ``array``, or None if absent."""
        if key not in owner:
            return None
        index = owner.integer(key)
        length = self.root.length(array)
        if index >= length:
            owner.fail(key, f"an index of {array}, which has {length} entries")
        return index

    def indices(self, owner: Item, key: str, array: str) -> list[int]:
        """Return the list ``owner[key]`` of indices into the root's list ``array``."""
        length = self.root.length(array)
        owner.length(key)
        values = owner.values.get(key, [])
        whole = [int(v) if isinstance(v, float) and v.is_integer() else v for v in values]
        for index in whole:
            if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < length:
                owner.fail(key, f"indices of {array}, which has {length} entries")
        return whole

    def view_data(self, view_index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self.root.element("bufferViews", view_index)
        buffer_index = self.index(view, "buffer", "buffers")
        if buffer_index is None:
            view.fail("buffer", "an index of buffers")
        offset = view.integer("byteOffset", 0)
        length = view.integer("byteLength", low=1)
        buffer = self._buffer_data(buffer_index)
        left = max(len(buffer) - offset, 0)
        if length > left:
            view.fail("byteLength", f"at most {left}, the rest of buffers[{buffer_index}]")
        return buffer[offset : offset + length]

    def resource(self, owner: Item) -> bytes:
        """Return the bytes that ``owner["uri"]`` names: a data URI or a file in the folder."""
        uri = owner.text("uri")
        if uri.startswith("data:"):
            head, comma, body = uri.partition(",")
            try:
                if comma and head.endswith(";base64"):
                    return base64.b64decode(unquote(body), validate=True)
            except ValueError:
                owner.fail("uri", "valid base64 after the comma")
            if not comma:
                owner.fail("uri", "a data URI with a comma")
            return unquote_to_bytes(body)
        try:
            folder = self.folder.resolve()
            path = (folder / unquote(uri)).resolve()
            inside = path.is_relative_to(folder)
        except (OSError, ValueError, RuntimeError):
            inside = False
        if not inside or _SCHEME.match(uri):
            owner.fail("uri", "a relative path that stays inside the folder of the file")
        try:
            data = read_file(path)
        except InputError as error:
            raise InputError(f"{owner.file}: {owner.path_of('uri')}: {error}") from None
        self.files.append(str(path))
        return data

    def accessor(
        self,
        owner: Item,
        key: str,
        element_type: str,
        components: Sequence[int],
        as_float: bool = True,
    ) -> np.ndarray | None:
        """Return the elements of accessor ``owner[key]``, or None if the key is absent.

        Args:
            element_type: the accessor type that is wanted, such as ``"VEC3"``.
            components: the component types that are wanted, such as ``FLOAT``.
            as_float: whether to convert to float32, scaled if the accessor is normalised.

        Returns:
            ``(count, components of the type)``, float32 or the stored integers; do not write.
        """
        index = self.index(owner, key, "accessors")
        if index is None:
            return None
        item = self.root.element("accessors", index)
        if item.text("type") != element_type:
            item.fail("type", f"{element_type} for {owner.place}.{key}")
        component = item.integer("componentType")
        if component not in components:
            names = ", ".join(str(number) for number in components)
            item.fail("componentType", f"one of {names} for {owner.place}.{key}")
        if (index, as_float) not in self._accessors:
            stored = self._decoded.get(index)
            if stored is None:
                stored = self._stored(item, _COMPONENTS[component], _ELEMENTS[element_type])
            normalised = item.flag("normalized")
            values = _float(stored, normalised) if as_float else stored.copy()
            values.flags.writeable = False  # several meshes may share it
            self._accessors[index, as_float] = values
        return self._accessors[index, as_float]

    def put(self, owner: Item, key: str, index: int, values: np.ndarray) -> None:
        """Give accessor ``index``, which ``owner[key]`` names, elements that were decompressed.

        Args:
            values: ``(count, components)``, converted to what the accessor says that it stores.
        """
        item = self.root.element("accessors", index)
        component = _COMPONENTS.get(item.integer("componentType"))
        elements = _ELEMENTS.get(item.text("type"), 0)
        count = item.integer("count", low=1)
        if component is None or values.shape != (count, elements):
            got = " x ".join(str(size) for size in values.shape)
            owner.fail(key, f"as much compressed data as accessors[{index}] says", got)
        # Overflow on the way to integers is a picture that looks wrong, no error.
        with np.errstate(all="ignore"):
            self._decoded[index] = values.astype(component)

    def _buffer_data(self, index: int) -> memoryview:
        if index not in self._buffers:
            item = self.root.element("buffers", index)
            if "uri" in item:
                data = memoryview(self.resource(item))
            elif index == 0 and self.binary is not None:
                data = self.binary
            else:
                raise MissingData(f"{item.file}: {item.place}.uri: expected a URI, got nothing")
            length = item.integer("byteLength", low=1)
            if length > len(data):
                item.fail("byteLength", f"at most {len(data)}, the bytes that are there")
            self._buffers[index] = data[:length]
        return self._buffers[index]

    def _stored(self, item: Item, component: np.dtype, elements: int) -> np.ndarray:
        """Return the elements as stored, sparse ones put in."""
        count = item.integer("count", low=1)
        view_index = self.index(item, "bufferView", "bufferViews")
        if view_index is None:
            self._zeros += count
            if self._zeros > MAX_ZEROS:
                item.fail("count", f"at most {MAX_ZEROS} in all accessors without a bufferView")
            stored = np.zeros((count, elements), component)
        else:
            stride = self.root.element("bufferViews", view_index).integer("byteStride", 0)
            stored = self._strided(item, "count", view_index, component, elements, stride)
        if "sparse" in item:
            stored = self._with_sparse(item, stored)
        return stored

    def _with_sparse(self, item: Item, stored: np.ndarray) -> np.ndarray:
        sparse = item.item("sparse")
        count = sparse.integer("count", low=1)
        if count > len(stored):
            sparse.fail("count", f"at most {len(stored)}, the accessor's count")
        parts = []
        for key, elements in (("indices", 1), ("values", stored.shape[1])):
            part = sparse.item(key)
            view_index = self.index(part, "bufferView", "bufferViews")
            if view_index is None:
                part.fail("bufferView", "an index of bufferViews")
            component = stored.dtype
            if key == "indices":
                number = part.integer("componentType")
                if number not in UNSIGNED:
                    part.fail("componentType", "one of " + ", ".join(str(n) for n in UNSIGNED))
                component = _COMPONENTS[number]
            counted = Item(part.file, part.place, {**part.values, "count": count})
            parts.append(self._strided(counted, "byteOffset", view_index, component, elements, 0))
        where = parts[0][:, 0].astype(np.int64)
        if where[-1] >= len(stored) or (np.diff(where) <= 0).any():
            sparse.fail("indices", f"accessor data that ascends and stays below {len(stored)}")
        patched = stored.copy()
        patched[where] = parts[1]
        return patched

    def _strided(
        self, item: Item, key: str, view_index: int, component: np.dtype, elements: int, stride: int
    ) -> np.ndarray:
        """Return ``item["count"]`` elements of a buffer view; blame ``key`` if they do not fit."""
        data = self.view_data(view_index)
        count = item.integer("count", low=1)
        offset = item.integer("byteOffset", 0)
        size = component.itemsize * elements
        stride = stride or size
        if stride < size:
            self.root.element("bufferViews", view_index).fail("byteStride", f"at least {size}")
        needed = offset + stride * (count - 1) + size
        if needed > len(data):
            item.fail(key, f"{needed} bytes to fit in the {len(data)} of bufferViews[{view_index}]")
        strides = (stride, component.itemsize)
        return np.ndarray((count, elements), component, data, offset, strides)


def open_gltf(path: Path) -> GltfFile:
    """Read the container and the JSON of a .gltf or .glb, told apart by content.

    Raises:
        InputError: not a readable glTF 2.0 container.
    """
    data = memoryview(read_file(path))
    binary = None
    if data[:4] == b"glTF":
        data, binary = _glb_chunks(path, data)
    try:
        values = json.loads(str(data, "utf-8-sig"), parse_constant=_refuse_constant)
    except ValueError as error:
        raise InputError(f"{path}: expected glTF (JSON or GLB), got: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: expected glTF, got JSON nested too deeply") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a JSON object, got {reprlib.repr(values)}")
    return GltfFile(Item(str(path), "", values), path.parent, binary)


def _glb_chunks(path: Path, data: memoryview) -> tuple[memoryview, memoryview | None]:
    """Return the JSON and BIN chunks of a GLB file; later chunks are for extensions."""
    if len(data) < 20:
        raise InputError(f"{path}: expected a GLB header of 20 bytes, got {len(data)}: truncated")
    version, length = struct.unpack_from("<2I", data, 4)
    if version != 2:
        raise InputError(f"{path}: expected GLB version 2, got {version}")
    if length > len(data):
        raise InputError(f"{path}: expected {length} bytes, got {len(data)}: truncated")
    chunks = []
    offset = 12
    while offset + 8 <= length and len(chunks) < 2:
        size, kind = struct.unpack_from("<I4s", data, offset)
        offset += 8
        if size > length - offset:
            raise InputError(f"{path}: expected a GLB chunk of {size} bytes, got {length - offset}")
        chunks.append((kind, data[offset : offset + size]))
        offset += size
    if not chunks or chunks[0][0] != b"JSON":
        raise InputError(f"{path}: expected a JSON chunk first in the GLB file, got none")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return chunks[0][1], binary


def _float(stored: np.ndarray, normalised: bool) -> np.ndarray:
    """Return float32, with normalised integers mapped to [0, 1] or [-1, 1] (section 3.11)."""
    values = stored.astype(np.float32)
    if normalised and stored.dtype.kind in "iu":
        values /= np.iinfo(stored.dtype).max
        np.maximum(values, -1.0, out=values)
    return values


def _printable(text: str) -> str:
    # JSON escapes can spell half a surrogate pair, which no output stream takes.
    return text.encode("utf-8", "replace").decode("utf-8")


def _is_number(value: Any, low: float, high: float) -> bool:
    # Comparing in Python is exact, so that integers beyond the range of floats are refused, too.
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and not (isinstance(value, float) and math.isnan(value))
        and low <= value <= high
    )


def _range_text(low: float, high: float) -> str:
    if high < MAX_NUMBER:
        return f" from {low:.9g} to {high:.9g}" if low > -MAX_NUMBER else f" of at most {high:.9g}"
    return f" of at least {low:.9g}" if low > -MAX_NUMBER else ""


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
