"""The vertices of an animated .glb at a time, by lines that share nothing with the package."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """A .glb whose accessors are plain: no sparse ones, nothing in other files."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        self.json: dict[str, Any] = json.loads(data[20 : 20 + length])
        self.binary = data[28 + length :]

    def read(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        kind, width = np.dtype("<" + TYPES[accessor["componentType"]]), WIDTHS[accessor["type"]]
        view = self.json["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        step = view.get("byteStride", kind.itemsize * width)
        rows = [
            np.frombuffer(self.binary, kind, width, start + i * step)
            for i in range(accessor["count"])
        ]
        values = np.array(rows)
        if accessor.get("normalized"):
            return values / float(np.iinfo(kind).max)
        if "sparse" in accessor:
            raise NotImplementedError
        return values.astype(float)

    def value(self, sampler: dict[str, Any], path: str, time: float) -> np.ndarray:
        """Return what a sampler gives at a time."""
        times = self.read(sampler["input"])[:, 0]
        values = self.read(sampler["output"])
        kind = sampler.get("interpolation", "LINEAR")
        values = values.reshape(len(times), 3 if kind == "CUBICSPLINE" else 1, -1)
        key = values[:, 1] if kind == "CUBICSPLINE" else values[:, 0]
        if time <= times[0]:
            return key[0]
        if time >= times[-1]:
            return key[-1]
        i = max(k for k, other in enumerate(times) if other <= time)
        if kind == "STEP":
            return key[i]
        span = times[i + 1] - times[i]
        t = (time - times[i]) / span
        a, b = key[i], key[i + 1]
        if kind == "CUBICSPLINE":
            m0, m1 = span * values[i, 2], span * values[i + 1, 0]
            # Horner's scheme of the cubic with these ends and slopes.
            c, d = 3 * (b - a) - 2 * m0 - m1, 2 * (a - b) + m0 + m1
            out = a + t * (m0 + t * (c + t * d))
            return out / np.linalg.norm(out) if path == "rotation" else out
        if path != "rotation":
            return (1 - t) * a + t * b
        if a @ b < 0:
            b = -b
        # Rotate a towards b in their common plane; files round their quaternions.
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        away = b - (a @ b) * a
        if np.linalg.norm(away) < 1e-12:
            return a
        away /= np.linalg.norm(away)
        angle = t * np.arctan2(b @ away, b @ a)
        return np.cos(angle) * a + np.sin(angle) * away

    def local(self, index: int, clips: list[int], time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix and morph weights of a node."""
        node = self.json["nodes"][index]
        parts = {
            "translation": node.get("translation", [0, 0, 0]),
            "rotation": node.get("rotation", [0, 0, 0, 1]),
            "scale": node.get("scale", [1, 1, 1]),
            "weights": node.get("weights", self.mesh_weights(node)),
        }
        animated = set()
        for clip in clips:
            animation = self.json["animations"][clip]
            for channel in animation["channels"]:
                target = channel["target"]
                if target.get("node") == index and target["path"] not in animated:
                    sampler = animation["samplers"][channel["sampler"]]
                    parts[target["path"]] = self.value(sampler, target["path"], time)
                    animated.add(target["path"])
        matrix = np.eye(4)
        if "matrix" in node:
            matrix = np.array(node["matrix"], float).reshape(4, 4).T
        else:
            *axis, w = np.array(parts["rotation"], float) / np.linalg.norm(parts["rotation"])
            # Rodrigues' formula, column by column.
            for column, unit in enumerate(np.eye(3)):
                turned = unit + 2 * np.cross(axis, np.cross(axis, unit) + w * unit)
                matrix[:3, column] = turned * parts["scale"][column]
            matrix[:3, 3] = parts["translation"]
        return matrix, np.array(parts["weights"], float)

    def mesh_weights(self, node: dict[str, Any]) -> list[float]:
        if "mesh" not in node:
            return []
        mesh = self.json["meshes"][node["mesh"]]
        return mesh.get("weights", [0.0] * len(mesh["primitives"][0].get("targets", [])))

    def corners(self, clips: list[int], time: float) -> list[np.ndarray]:
        """Return the corners of the triangles of each drawn primitive, ``(m, 3, 3)``, by nodes."""
        world: dict[int, np.ndarray] = {}
        weights: dict[int, np.ndarray] = {}
        pending = [(i, np.eye(4)) for i in self.json["scenes"][self.json.get("scene", 0)]["nodes"]]
        order = []
        while pending:
            index, above = pending.pop(0)
            matrix, weights[index] = self.local(index, clips, time)
            world[index] = above @ matrix
            order.append(index)
            below = self.json["nodes"][index].get("children", [])
            pending[:0] = [(child, world[index]) for child in below]
        found = []
        for index in order:
            node = self.json["nodes"][index]
            if "mesh" not in node:
                continue
            for primitive in self.json["meshes"][node["mesh"]]["primitives"]:
                found.append(self.primitive(primitive, node, world, weights[index], index))
        return found

    def primitive(self, primitive, node, world, weights, index) -> np.ndarray:
        points = self.read(primitive["attributes"]["POSITION"])
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if "POSITION" in target:
                points = points + weight * self.read(target["POSITION"])
        homogeneous = np.column_stack([points, np.ones(len(points))])
        if "skin" in node:
            skin = self.json["skins"][node["skin"]]
            binds = self.read(skin["inverseBindMatrices"]).reshape(-1, 4, 4)
            joints = self.read(primitive["attributes"]["JOINTS_0"]).astype(int)
            shares = self.read(primitive["attributes"]["WEIGHTS_0"])
            moved = np.zeros_like(homogeneous)
            for vertex in range(len(points)):
                for joint, share in zip(joints[vertex], shares[vertex], strict=True):
                    matrix = world[skin["joints"][joint]] @ binds[joint].T
                    moved[vertex] += share * (matrix @ homogeneous[vertex])
            points = moved[:, :3]
        else:
            points = (homogeneous @ world[index].T)[:, :3]
        if "indices" in primitive:
            points = points[self.read(primitive["indices"])[:, 0].astype(int)]
        return points.reshape(-1, 3, 3)
