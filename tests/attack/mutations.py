"""Ways to damage a file, all drawn from one random generator: bytes, JSON, TOML, PNG, PLY, safetensors, glTF."""

import copy
import json
import random
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

Mutation = Callable[[random.Random, bytes], bytes]

NUMBERS = (0, -1, 1, 2, 255, 256, 65536, 2**31, 2**32, 2**63, -(2**63), 10**30, 10**400, 0.5, -0.5, 1e-320, 1e-30, 1e30)
NUMBERS = (*NUMBERS, 1e308, -1e308, 1e400, -1e400, float("nan"))
TEXTS = (
    "",
    "x",
    "0",
    "nan",
    "..",
    "/",
    "/dev/zero",
    "/dev/null",
    "../../etc/passwd",
    "a\0b",
    "\ud800",
    "é",
    "𝛑",
    "%s%n",
)
TEXTS = (*TEXTS, "x" * 300, "x" * 100_000, "images", ".", "train", "boxsat", "True", "-", "\n", "a/b/c.png", "CON")


def hostile(rng: random.Random) -> Any:
    """A JSON value that nobody expects."""
    kind = rng.randrange(8)
    if kind < 3:
        return rng.choice(NUMBERS)
    if kind < 5:
        return rng.choice(TEXTS)
    return rng.choice((None, True, False, [], {}, [[]], [None], {"": None}, [0] * 1000, [1e308] * 3, {"a": {"b": {}}}))


def of_bytes(rng: random.Random, data: bytes) -> bytes:
    """Flipped bits, other bytes, pieces cut out, doubled, put in, moved, or the end gone."""
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        size = len(found)
        start = rng.randrange(size + 1)
        end = min(size, start + rng.choice((1, 1, 2, 4, 16, 256, 4096)))
        kind = rng.randrange(8)
        if kind == 0 and start < size:
            found[start] ^= 1 << rng.randrange(8)
        elif kind == 1 and start < size:
            found[start] = rng.choice((0, 1, 127, 128, 255, 10, 32, 45))
        elif kind == 2:
            del found[start:end]
        elif kind == 3:
            found[start:start] = found[start:end]
        elif kind == 4:
            found[start:start] = rng.randbytes(rng.choice((1, 4, 64)))
        elif kind == 5:
            found[start:end] = bytes(end - start)
        elif kind == 6:
            found[start:end] = struct.pack(rng.choice("<>") + "I", rng.choice((0, 1, 2**31 - 1, 2**32 - 1, size)))
        else:
            del found[start:]
    return bytes(found)


def other_file(rng: random.Random, _: bytes) -> bytes:
    """Something else altogether."""
    return rng.choice(
        (
            b"",
            b"\0",
            b"{}",
            b"[]",
            b"null",
            b"ply\n",
            b"\x89PNG\r\n\x1a\n",
            b"glTF\2\0\0\0",
            b"\xff" * 64,
            b"[" * 100_000,
            b'{"a":' * 50_000,
            b"\xef\xbb\xbf{}",
            bytes(10_000),
        )
    )


def of_json(rng: random.Random, data: bytes) -> bytes:
    """A value replaced, taken away, doubled, renamed or scaled, some times over."""
    value = json.loads(data)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        value = _changed(rng, value)
    return _dumped(value)


def _dumped(value: Any) -> bytes:
    try:
        return json.dumps(value).encode("utf-8", "surrogatepass")
    except ValueError:  # an integer of more digits than Python prints
        return b"1" + b"0" * 5000


def _places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [at, *(place for key, inner in items for place in _places(inner, (*at, key)))]


def _changed(rng: random.Random, value: Any) -> Any:
    value = copy.deepcopy(value)
    places = _places(value)
    depths = sorted({len(place) for place in places})
    depth = rng.choice(depths)  # as often near the top as at the bottom, where most values are
    place = rng.choice([place for place in places if len(place) == depth])
    if not place:
        return hostile(rng) if rng.random() < 0.3 else value
    owner = value
    for key in place[:-1]:
        owner = owner[key]
    key, old = place[-1], owner[place[-1]]
    kind = rng.randrange(8)
    if kind < 4:
        owner[key] = hostile(rng)
    elif kind == 4:
        del owner[key]
    elif kind == 5 and isinstance(owner, dict):
        owner[rng.choice((*TEXTS[:20], f"{key}x"))] = owner.pop(key)
    elif kind == 5:
        owner.insert(key, copy.deepcopy(old))
    elif kind == 6 and isinstance(old, (int, float)) and not isinstance(old, bool):
        owner[key] = old * rng.choice((-1, 0, 1e3, 1e9, 1e150, 1e-9, 1.5)) + rng.choice((0, 1, -1))
    elif kind == 6 and isinstance(old, list):
        owner[key] = old * 2 if len(old) < 10_000 else old[:1]
    else:
        owner[key] = copy.deepcopy(value_at(rng, value, places))
    return value


def value_at(rng: random.Random, value: Any, places: list[tuple[Any, ...]]) -> Any:
    """What stands at a random one of the places that are still there."""
    for key in rng.choice(places):
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def of_toml(rng: random.Random, data: bytes) -> bytes:
    """Values of lines replaced, lines doubled, moved or taken away."""
    lines = data.decode().splitlines()
    for _ in range(rng.choice((1, 1, 2, 4))):
        number = rng.randrange(len(lines))
        kind = rng.randrange(6)
        name, equals, _ = lines[number].partition("=")
        if kind < 3 and equals:
            value = hostile(rng)
            text = (
                {None: '""', True: "true", False: "false"}.get(value) if not isinstance(value, (list, dict)) else None
            )
            plain = text or (repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)[:1000])
            lines[number] = f"{name}= {plain}"
        elif kind == 3:
            lines.insert(number, rng.choice(lines))
        elif kind == 4:
            del lines[number]
            lines = lines or [""]
        else:
            lines.insert(number, rng.choice(("x = 1", "[camera]", "[[objects]]", "[a.b.c]", 'kind = "x"', "= 1", "[[")))
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def of_png(rng: random.Random, data: bytes) -> bytes:
    """Header fields of a PNG with checksums that fit, or chunks doubled, moved or taken away."""
    chunks, position = [], 8
    while position + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, position)
        chunks.append((kind, data[position + 8 : position + 8 + size]))
        position += 12 + size
    choice = rng.randrange(4)
    if choice < 2:
        header = bytearray(chunks[0][1])
        at, form = rng.choice(((0, ">I"), (4, ">I"), (8, "B"), (9, "B"), (12, "B")))
        values = (0, 1, 2, 3, 4, 6, 15, 16, 17, 255) if form == "B" else (0, 1, 15, 17, 16384, 13300, 65536, 2**31 - 1)
        struct.pack_into(form, header, at, rng.choice(values))
        chunks[0] = (chunks[0][0], bytes(header))
    elif choice == 2:
        chunks.insert(rng.randrange(len(chunks) + 1), rng.choice(chunks))
    else:
        del chunks[rng.randrange(len(chunks))]
    packed = (
        struct.pack(">I4s", len(body), kind) + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    return data[:8] + b"".join(packed)


def of_ply(rng: random.Random, data: bytes) -> bytes:
    """Numbers and words of the header."""
    head, end, body = data.partition(b"end_header\n")
    words = re.split(rb"(\s+)", head)
    numbers = [i for i, word in enumerate(words) if word.isdigit()]
    names = [i for i, word in enumerate(words) if word.isalpha()]
    if rng.random() < 0.5 and numbers:
        words[rng.choice(numbers)] = str(rng.choice((0, 1, 2, 3, 10**6, 2**31, 2**32, 10**18))).encode()
    elif names:
        new = (
            b"",
            b"x",
            b"float",
            b"double",
            b"char",
            b"list",
            b"vertex",
            b"face",
            b"ascii",
            b"comment TextureFile a.png",
        )
        words[rng.choice(names)] = rng.choice(new)
    return b"".join(words) + end + body


def of_floats(rng: random.Random, data: bytes) -> bytes:
    """Numbers of binary data as none, endless, huge, or all alike."""
    found, start = bytearray(data), rng.randrange(max(1, len(data) // 2)) & ~3
    value = struct.pack("<f", rng.choice((float("nan"), float("inf"), -3e38, 3e38, 1e-40, 0.0, 1.0)))
    count = rng.choice((1, 3, 30, 10_000))
    for i in range(start, min(len(found) - 4, start + 4 * count), 4):
        found[i : i + 4] = value
    return bytes(found)


def of_words(rng: random.Random, data: bytes) -> bytes:
    """Words of a text as others, gone, doubled, or lines that are."""
    lines = [line.split(" ") for line in data.decode().split("\n")]
    for _ in range(rng.choice((1, 1, 2, 5))):
        line = rng.randrange(len(lines))
        kind, at = rng.randrange(6), rng.randrange(len(lines[line]) or 1)
        if kind < 3 and lines[line]:
            lines[line][at] = str(hostile(rng))
        elif kind == 3:
            del lines[line][at : at + 1]
        elif kind == 4:
            lines[line].insert(at, rng.choice(("0", "-1", "nan", "a b", "#")))
        else:
            lines.insert(line, [] if rng.random() < 0.3 else list(rng.choice(lines)))
    return "\n".join(map(" ".join, lines)).encode("utf-8", "surrogatepass")


def of_safetensors(rng: random.Random, data: bytes) -> bytes:
    """The JSON of a safetensors file: shapes, types, names, its metadata, what lies within that."""
    size = struct.unpack_from("<Q", data)[0]
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    names = [name for name in header if name != "__metadata__"]
    kind = rng.randrange(6)
    if kind == 0:  # arrays of no length, the first of which all are
        for name in names if rng.random() < 0.5 else rng.sample(names, 1):
            shape = header[name]["shape"]
            header[name] = {**header[name], "shape": [0, *shape[1:]], "data_offsets": [0, 0]}
        body = b"" if all(header[name]["data_offsets"] == [0, 0] for name in names) else body
    elif kind == 1:
        del header[rng.choice(names)]
    elif kind == 2:
        header = _changed(rng, header)
    elif kind == 3 and "__metadata__" in header:
        inner = header["__metadata__"].get("spacesim", "{}")
        header["__metadata__"]["spacesim"] = _dumped(_changed(rng, json.loads(inner))).decode("utf-8", "replace")
    elif kind == 4:
        one, other = rng.choice(names), rng.choice(names)
        header[one], header[other] = header[other], header[one]
    else:
        body = of_floats(rng, body)
    text = _dumped(header)
    return struct.pack("<Q", len(text)) + text + body


def of_glb(rng: random.Random, data: bytes) -> bytes:
    """The JSON chunk of a glb, its lengths right again."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = of_json(rng, data[20 : 20 + size]), data[20 + size :]
    text += b" " * (-len(text) % 4)
    return (
        data[:8] + struct.pack("<I", 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON") + text + rest
    )
