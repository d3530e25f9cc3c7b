"""The ``[[animation]]`` tables of a TOML scene: keyframes by the names of what they move."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from psf_cl.scene import transform
from psf_cl.scene.curve import INTERPOLATIONS, Curve, smooth_curve
from psf_cl.scene.model import MAX_RADIANCE, Node
from psf_cl.scene.schema import (
    Key,
    Place,
    Schema,
    either,
    number,
    read_table,
    several,
    text,
    vector,
)

MAX_LENGTH = 1e18

#: What may be animated of what.
PROPERTIES = {
    "shape": ("translation", "rotation", "scale", "emission"),
    "light": ("translation", "rotation", "position", "intensity"),
    "camera": ("translation", "rotation", "position", "target"),
    "material": ("emission",),
}
_PLACING = ("translation", "rotation", "scale")
_ALL = tuple(dict.fromkeys(itertools.chain(*PROPERTIES.values())))

ANIMATION: Schema = {
    "target": Key(text(), "name of a shape, light, material or camera", required=True),
    "property": Key(text(*_ALL), required=True),
    "times": Key(several(number(0)), "seconds", required=True),
    "values": Key(several(either(number(), vector(3), vector(4))), "one a time", required=True),
    "interpolation": Key(text(*INTERPOLATIONS)),
    "pivot": Key(vector(3, -MAX_LENGTH, MAX_LENGTH), "fixed point of turns and scales, meters"),
}

# Numbers that a value may consist of, and the smallest and the largest of them.
_VALUES = {
    "translation": ((3,), -MAX_LENGTH, MAX_LENGTH),
    "position": ((3,), -MAX_LENGTH, MAX_LENGTH),
    "target": ((3,), -MAX_LENGTH, MAX_LENGTH),
    "rotation": ((3, 4), -1e6, 1e6),
    "scale": ((1, 3), -1e9, 1e9),
    "emission": ((3,), 0.0, MAX_RADIANCE),
    "intensity": ((1,), 0.0, MAX_RADIANCE),
}
_MEANING = {
    (3,): "3 numbers",
    (3, 4): "3 angles in degrees, or a quaternion x, y, z, w",
    (1, 3): "a number or 3",
    (1,): "a number",
}


@dataclass
class Track:
    """One table."""

    target: str
    name: str
    curve: Curve
    pivot: tuple[float, float, float] | None
    place: Place
    used: bool = False


@dataclass
class Animations:
    """All tables, to be asked for by those that they move.

    Attributes:
        nodes: what was made to move things with; the scene's.
    """

    tracks: list[Track]
    nodes: list[Node] = field(default_factory=list)

    def of(self, kind: str, name: str | None) -> dict[str, Track]:
        """Return the tracks of the thing of that kind and name, by property."""
        found: dict[str, Track] = {}
        for track in self.tracks:
            if track.target != name or track.name not in PROPERTIES[kind]:
                continue
            if track.name in found:
                raise track.place.error(f"{name!r} has its {track.name} animated already")
            track.used = True
            found[track.name] = track
        return found

    def check_all_used(self) -> None:
        """Refuse tracks that nothing has asked for.

        Raises:
            InputError: a name that nothing has which may have its property animated.
        """
        for track in self.tracks:
            if not track.used:
                kinds = [kind for kind, names in PROPERTIES.items() if track.name in names]
                raise track.place.key("target").error(
                    f"no {' or '.join(kinds)} is called {track.target!r}, which could have its "
                    f"{track.name} animated"
                )

    def add(self, node: Node) -> int:
        """Return the index of a new node."""
        self.nodes.append(node)
        return len(self.nodes) - 1

    def placed(self, tracks: dict[str, Track], matrix: np.ndarray) -> int:
        """Return the node of something that ``matrix`` places and ``tracks`` then move; or -1.

        It moves by world axes; turns and scales are about the pivot, which is its own origin
        unless a track says otherwise.
        """
        moving = [track for name, track in tracks.items() if name in _PLACING]
        if not moving:
            return -1
        pivots = [track for track in moving if track.pivot is not None]
        if len({track.pivot for track in pivots}) > 1:
            raise pivots[1].place.key("pivot").error("another track of it has another pivot")
        pivot = pivots[0].pivot if pivots else matrix[:3, 3]
        still = self.add(Node(matrix=transform.translation(pivot)))
        turning = self.add(Node(still, curves={track.name: track.curve for track in moving}))
        return self.add(Node(turning, matrix=transform.translation(-np.array(pivot)) @ matrix))


def read_animations(raw: Sequence[dict[str, Any]], place: Place) -> Animations:
    """Return the checked tables of ``[[animation]]``.

    Raises:
        InputError: a key is unknown or of another kind, times do not grow, or values do not fit.
    """
    return Animations([_read_track(table, place.item(i)) for i, table in enumerate(raw)])


def _read_track(raw: dict[str, Any], place: Place) -> Track:
    table = read_table(raw, ANIMATION, place)
    name, times = table["property"], table["times"]
    if any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise place.key("times").error("expected times that grow")
    widths, low, high = _VALUES[name]
    values = [np.atleast_1d(value) for value in table["values"]]
    here = place.key("values")
    if len(values) != len(times):
        raise here.error(f"expected one value a time, {len(times)}; got {len(values)}")
    if len({len(value) for value in values}) > 1 or len(values[0]) not in widths:
        raise here.error(f"expected for each time of {name}: {_MEANING[widths]}")
    keys = np.array(values, float)
    if not ((keys >= low) & (keys <= high)).all():
        raise here.error(f"expected numbers from {low:g} to {high:g}")
    turning = name == "rotation" and keys.shape[1] == 4
    if turning:
        lengths = np.linalg.norm(keys, axis=1, keepdims=True)
        if not lengths.all():
            raise here.error("expected quaternions that are not zero")
        keys /= lengths
    if "pivot" in table and name not in ("rotation", "scale"):
        raise place.key("pivot").error("is for rotation and scale")
    if name == "scale":
        keys = np.broadcast_to(keys, (len(keys), 3)).copy()
    interpolation = table.get("interpolation", "linear")
    if interpolation == "cubic":
        curve = smooth_curve(np.array(times), keys, turning)
    else:
        curve = Curve(np.array(times), keys, interpolation, turning)
    return Track(table["target"], name, curve, table.get("pivot"), place)
