"""Binary glTF 2.0 of one mesh (Khronos: glTF 2.0 Specification, chapters 3.6, 3.7 and 4.4)."""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from spacesim.data.errors import InputError
from spacesim.data.files import JsonMapping, JsonValue, write_bytes

POINTS, TRIANGLES = 0, 4  #: modes of a primitive
_MAX_BYTES = 0xFFFFFFFF  # what the header can hold
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_COMPONENTS = {"float32": 5126, "uint32": 5125}
_VERTICES, _INDICES = 34962, 34963  # targets of a buffer view


def write_glb(
    path: Path,
    attributes: Mapping[str, np.ndarray],
    mode: int,
    primitives: Sequence[tuple[np.ndarray | None, JsonMapping]],
    document: JsonMapping | None = None,
) -> None:
    """Write primitives that share their vertices.

    attributes: {semantic: [N] or [N, C]}, float32; "POSITION" is one of them
    primitives: of each its indices, uint32 [M] or None, and what else its object says;  document: what else the file
    says
    Raises InputError where it does not fit into the format's 4 GB, and where it cannot be written.
    """
    views: list[dict[str, JsonValue]] = []
    accessors: list[dict[str, JsonValue]] = []
    parts: list[bytes] = []

    def add(array: np.ndarray, target: int) -> dict[str, JsonValue]:
        table = np.ascontiguousarray(array.reshape(len(array), -1), array.dtype.newbyteorder("<"))
        content = table.tobytes()
        start = sum(len(part) for part in parts)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content), "target": target})
        parts.append(content + bytes(-len(content) % 4))
        kind, component = _KINDS[table.shape[1]], _COMPONENTS[array.dtype.name]
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(table), "type": kind})
        return accessors[-1]

    numbers: dict[str, JsonValue] = {}
    for name, array in attributes.items():
        numbers[name] = len(accessors)
        accessor = add(array, _VERTICES)
        if name == "POSITION":  # which must have its bounds
            accessor["min"], accessor["max"] = (edge.tolist() for edge in (array.min(axis=0), array.max(axis=0)))
    described: list[JsonValue] = []
    for indices, rest in primitives:
        own: dict[str, JsonValue] = {"attributes": numbers, "mode": mode}
        if indices is not None:
            own["indices"] = len(accessors)
            add(indices, _INDICES)
        described.append({**own, **rest})
    body = b"".join(parts)
    whole = {
        "asset": {"version": "2.0", "generator": "spacesim"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": described}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
        **(document or {}),
    }
    text = json.dumps(whole, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(body)
    if size > _MAX_BYTES:
        raise InputError(f"{path}: expected at most {_MAX_BYTES:,} bytes, which is what glTF can hold, found {size:,}")
    head = struct.pack("<4sII", b"glTF", 2, size)
    write_bytes(
        path,
        b"".join([head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(body), b"BIN\0"), body]),
    )
