"""Typed reading of tables: what a key may hold is said once, and every error names the key.

A ``Kind`` says what it expects and converts a value or refuses it; a schema is a table of key to
``Key``; ``read_table`` checks a table against a schema.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from psf_cl.errors import InputError, shown


@dataclass(frozen=True)
class Place:
    """Where a value stands: the file as the user wrote it, and the path of keys inside it."""

    source: str
    path: str = ""

    def key(self, name: str) -> Place:
        """Return the place of ``name`` inside this table."""
        spelled = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else repr(name)
        return Place(self.source, f"{self.path}.{spelled}" if self.path else spelled)

    def item(self, index: int) -> Place:
        """Return the place of element ``index`` of this array."""
        return Place(self.source, f"{self.path}[{index}]")

    def error(self, message: str) -> InputError:
        """Return, not raise, an error of one line about this place."""
        where = f"{self.source}: {self.path}" if self.path else self.source
        return InputError(" ".join(f"{where}: {message}".split()))


@dataclass(frozen=True)
class Kind:
    """What a value must be.

    Attributes:
        expects: completes the sentence "expected ...".
        read: returns the converted value, or raises ValueError.
    """

    expects: str
    read: Callable[[Any], Any]


@dataclass(frozen=True)
class Key:
    """One key of a table: its kind, its meaning (unit), and whether it must be there."""

    kind: Kind
    doc: str = ""
    required: bool = False


Schema = Mapping[str, Key]


def read_table(table: Any, schema: Schema, place: Place) -> dict[str, Any]:
    """Return the keys that ``table`` gives, converted; keys that it leaves out stay out.

    Raises:
        InputError: not a table, an unknown key, a value of another kind, or a required key missing.
    """
    if not isinstance(table, dict):
        raise place.error(f"expected a table; got {shown(table)}")
    for name in table:
        if name not in schema:
            close = difflib.get_close_matches(name, schema, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(schema)}"
            raise place.key(name).error(f"unknown key; {hint}")
    for name, key in schema.items():
        if key.required and name not in table:
            raise place.key(name).error(f"missing; expected {_described(key)}")
    return {name: _read(schema[name], value, place.key(name)) for name, value in table.items()}


def _read(key: Key, value: Any, place: Place) -> Any:
    try:
        return key.kind.read(value)
    except ValueError:
        raise place.error(f"expected {_described(key)}; got {shown(value)}") from None


def _described(key: Key) -> str:
    return f"{key.kind.expects} ({key.doc})" if key.doc else key.kind.expects


def number(low: float = -math.inf, high: float = math.inf, *, above: float = -math.inf) -> Kind:
    """Return the kind of a finite number from ``low`` to ``high``, and greater than ``above``."""
    bounds = _range_text(low, high)
    if above > -math.inf:
        bounds = f" above {above:g}" + (f", at most {high:g}" if high < math.inf else "")

    def read(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError
        try:
            converted = float(value)
        except OverflowError:
            raise ValueError from None
        if not (math.isfinite(converted) and low <= converted <= high and converted > above):
            raise ValueError
        return converted

    return Kind(f"a finite number{bounds}", read)


def integer(low: int, high: int) -> Kind:
    """Return the kind of an integer from ``low`` to ``high``."""

    def read(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return Kind(f"an integer from {low} to {high}", read)


def flag() -> Kind:
    """Return the kind of true and false."""

    def read(value: Any) -> bool:
        if not isinstance(value, bool):
            raise ValueError
        return value

    return Kind("true or false", read)


def text(*choices: str) -> Kind:
    """Return the kind of a string that is not empty; with ``choices``, one of them."""

    def read(value: Any) -> str:
        if not isinstance(value, str) or not value or (choices and value not in choices):
            raise ValueError
        return value

    return Kind(f"one of {', '.join(choices)}" if choices else "a string", read)


def vector(count: int, low: float = -math.inf, high: float = math.inf) -> Kind:
    """Return the kind of an array of ``count`` finite numbers, read as a tuple."""
    element = number(low, high)

    def read(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ValueError
        return tuple(element.read(item) for item in value)

    return Kind(f"{count} finite numbers{_range_text(low, high)}", read)


def matrix(rows: int) -> Kind:
    """Return the kind of a square array of arrays of finite numbers, row by row."""
    row = vector(rows)

    def read(value: Any) -> tuple[tuple[float, ...], ...]:
        if not isinstance(value, list) or len(value) != rows:
            raise ValueError
        return tuple(row.read(item) for item in value)

    return Kind(f"a {rows}x{rows} matrix (rows of finite numbers)", read)


def several(element: Kind) -> Kind:
    """Return the kind of an array, not empty, of ``element``; it is read as a list."""

    def read(value: Any) -> list[Any]:
        if not isinstance(value, list) or not value:
            raise ValueError
        return [element.read(item) for item in value]

    return Kind(f"an array, not empty, of: {element.expects}", read)


def either(*kinds: Kind) -> Kind:
    """Return the kind of a value that fits one of ``kinds``; the first that fits reads it."""

    def read(value: Any) -> Any:
        for kind in kinds:
            try:
                return kind.read(value)
            except ValueError:
                continue
        raise ValueError

    return Kind(" or ".join(kind.expects for kind in kinds), read)


def table() -> Kind:
    """Return the kind of a table whose keys are checked elsewhere."""

    def read(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise ValueError
        return value

    return Kind("a table", read)


def tables() -> Kind:
    """Return the kind of an array of tables whose keys are checked elsewhere."""
    element = table()

    def read(value: Any) -> list[dict[str, Any]]:
        if not isinstance(value, list):
            raise ValueError
        return [element.read(item) for item in value]

    return Kind("an array of tables", read)


def _range_text(low: float, high: float) -> str:
    if low > -math.inf and high < math.inf:
        return f" from {low:g} to {high:g}"
    if low > -math.inf:
        return f", at least {low:g}"
    return f", at most {high:g}" if high < math.inf else ""
