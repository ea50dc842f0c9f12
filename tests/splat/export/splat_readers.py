"""Readers of Gaussians in files, written from the formats' texts and apart from our writers: each gives linear scales,
opacities, unit quaternions (w, x, y, z) and harmonics [N, K, 3], and what else the file says."""

import gzip
import json
import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Decoded(NamedTuple):
    means: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    said: dict


def glb_chunks(path: Path) -> tuple[dict, bytes]:
    """(document, binary chunk), with the container's own rules checked (glTF 2.0, chapter 4.4)."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    start = 20 + size
    body_size, body_kind = struct.unpack_from("<I4s", content, start)
    assert body_kind == b"BIN\0"
    assert body_size % 4 == 0
    assert start + 8 + body_size == len(content)
    return json.loads(content[20:start]), content[start + 8 :]


def glb_array(document: dict, body: bytes, index: int) -> np.ndarray:
    """[N] or [N, C]."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    assert view["byteOffset"] + view["byteLength"] <= len(body)
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    kind = np.dtype({5125: "<u4", 5126: "<f4"}[accessor["componentType"]])
    array = np.frombuffer(body, kind, accessor["count"] * columns, view["byteOffset"])
    assert view["byteLength"] == array.nbytes
    return array if columns == 1 else array.reshape(-1, columns)


def read_glb(path: Path) -> Decoded:
    document, body = glb_chunks(path)
    (primitive,) = document["meshes"][document["nodes"][0]["mesh"]]["primitives"]
    name = "KHR_gaussian_splatting"
    of = {key: glb_array(document, body, index) for key, index in primitive["attributes"].items()}
    degree = max(int(key.split("_")[-3]) for key in of if "SH_DEGREE" in key)
    harmonics = [of[f"{name}:SH_DEGREE_{m}_COEF_{k}"] for m in range(degree + 1) for k in range(2 * m + 1)]
    assert len(of) == 5 + len(harmonics)
    quaternions = of[f"{name}:ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    box = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal([box["min"], box["max"]], [of["POSITION"].min(axis=0), of["POSITION"].max(axis=0)])
    said = primitive["extensions"][name] | {"mode": primitive["mode"], "used": document["extensionsUsed"]}
    said["COLOR_0"] = of["COLOR_0"]
    sh = np.stack(harmonics, axis=1)
    opacities = of[f"{name}:OPACITY"]
    assert opacities.min() >= 0
    assert opacities.max() <= 1
    return Decoded(of["POSITION"], of[f"{name}:SCALE"], np.roll(quaternions, 1, axis=1), opacities, sh, said)


def read_spz(path: Path) -> Decoded:
    content = path.read_bytes()
    if content[:2] == b"\x1f\x8b":
        content = gzip.decompress(content)
        magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", content)
        assert (magic, version, reserved) == (b"NGSP", 3, 0)
        body = content[16:]
    else:
        import zstandard

        magic, version, count, degree, bits, flags, streams, offset = struct.unpack_from("<4sIIBBBBI", content)
        assert (magic, version, offset, content[20:32]) == (b"NGSP", 4, 32, bytes(12))
        place, parts = offset + 16 * streams, []
        for packed, size in struct.iter_unpack("<QQ", content[offset:place]):
            parts.append(zstandard.ZstdDecompressor().decompress(content[place : place + packed], size))
            assert len(parts[-1]) == size
            place += packed
        assert place == len(content)
        body = b"".join(parts)
    terms = (degree + 1) ** 2 - 1
    widths = (9, 1, 3, 3, 4, 3 * terms)
    sizes = np.array(widths) * count
    assert len(body) == sizes.sum()
    rows = np.split(np.frombuffer(body, np.uint8).astype(np.int64), np.cumsum(sizes)[:-1])
    points, alphas, colors, scales, turns, rest = (row.reshape(count, n) for row, n in zip(rows, widths, strict=True))
    low = points[:, 0::3] + (points[:, 1::3] << 8) + (points[:, 2::3] << 16)
    means = (low - (low >> 23 << 24)) / 2.0**bits
    word = turns @ (1 << np.array([0, 8, 16, 24]))
    quaternions = np.empty((count, 4))
    for row, bits_of in enumerate(word):
        largest, others = bits_of >> 30, []
        for shift in (20, 10, 0):
            part = bits_of >> shift & 1023
            others.append((-1 if part >> 9 else 1) * (part & 511) / 511 * 0.5**0.5)
        xyzw = np.insert(others, largest, np.sqrt(1 - np.sum(np.square(others))))
        quaternions[row] = xyzw[[3, 0, 1, 2]]
    first = (colors / 255 - 0.5) / 0.15
    sh = np.concatenate([first[:, None], (rest.reshape(count, terms, 3) - 128) / 128], axis=1)
    said = {"version": version, "antialiased": flags & 1, "bits": bits}
    return Decoded(means, np.exp(scales / 16 - 10), quaternions, alphas[:, 0] / 255, sh, said)


def read_usda(path: Path) -> Decoded:
    text = path.read_text()
    assert text.startswith("#usda 1.0\n")
    assert (
        re.search(r'\ndef ParticleField3DGaussianSplat "(\w+)"', text)[1]
        == re.search(r'defaultPrim = "(\w+)"', text)[1]
    )

    def numbers(declared: str, columns: int) -> np.ndarray:
        values = re.search(rf"\n    {re.escape(declared)} = \[(.*?)\]", text)[1]
        return np.array(re.sub("[(),]", " ", values).split(), np.float64).reshape(-1, columns)

    degree = int(re.search(r"uniform int radiance:sphericalHarmonicsDegree = (\d)", text)[1])
    means = numbers("point3f[] positions", 3)
    sh = numbers("float3[] radiance:sphericalHarmonicsCoefficients", 3).reshape(len(means), (degree + 1) ** 2, 3)
    said = {key: value.strip('"') for key, value in re.findall(r"(upAxis|metersPerUnit|colorSpace) = (\S+)", text)}
    said["extent"] = numbers("float3[] extent", 3)
    quaternions = numbers("quatf[] orientations", 4)
    return Decoded(means, numbers("float3[] scales", 3), quaternions, numbers("float[] opacities", 1)[:, 0], sh, said)


def read_inria(path: Path) -> Decoded:
    import trimesh

    found = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    names = found.dtype.names
    columns = {name: np.asarray(found[name], np.float64).ravel() for name in names}

    def pick(*chosen: str) -> np.ndarray:
        return np.stack([columns[name] for name in chosen], axis=1)

    rest = [name for name in names if name.startswith("f_rest_")]
    first = pick("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    more = pick(*rest).reshape(len(found), 3, -1).transpose(0, 2, 1) if rest else first[:, :0]
    return Decoded(
        pick("x", "y", "z"),
        np.exp(pick("scale_0", "scale_1", "scale_2")),
        pick("rot_0", "rot_1", "rot_2", "rot_3"),
        1 / (1 + np.exp(-columns["opacity"])),
        np.concatenate([first, more], axis=1),
        {},
    )


READERS = {"ply": read_inria, "glb": read_glb, "spz": read_spz, "usd": read_usda}
