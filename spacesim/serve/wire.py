"""Protocol Buffers' wire format (protobuf.dev/programming-guides/encoding), as far as messages are read here."""

import struct
from collections.abc import Iterator

import numpy as np

from spacesim.data.errors import InputError

Value = int | bytes
_MAX_NUMBER = (1 << 29) - 1  # of a field


def fields(message: bytes) -> Iterator[tuple[int, Value]]:
    """(number, value) of each field: a whole number of a varint, else its bytes. Raises InputError for what is cut off
    or is no message."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, kind = key >> 3, key & 7
        if not 1 <= number <= _MAX_NUMBER:
            raise InputError(f"message: expected fields numbered from 1 to {_MAX_NUMBER}, found {number}")
        if kind == 0:
            value, position = _varint(message, position)
            yield number, value
            continue
        if kind == 2:
            length, position = _varint(message, position)
        elif kind in (1, 5):
            length = 8 if kind == 1 else 4
        else:
            raise InputError(f"message: expected wire types 0, 1, 2 and 5, found {kind}")
        if length > len(message) - position:
            raise InputError("message: expected a whole one, found one that is cut off")
        yield number, message[position : position + length]
        position += length


def text(value: Value) -> str:
    """Of a field of kind string."""
    return _bytes(value).decode("utf-8", "replace")


def doubles(value: Value) -> np.ndarray:
    """[N] of a field of kind double, repeated ones packed or one of them. Raises InputError for another length."""
    content = _bytes(value)
    if len(content) % 8:
        raise InputError(f"message: expected numbers of 8 bytes, found {len(content)} bytes")
    return np.frombuffer(content, "<f8")


def integers(value: Value) -> list[int]:
    """Of a field of kind int64, repeated ones packed or one of them."""
    if isinstance(value, int):
        return [_signed(value)]
    position, numbers = 0, []
    while position < len(value):
        number, position = _varint(value, position)
        numbers.append(_signed(number))
    return numbers


def double(value: Value) -> float:
    """Of a field of kind double. Raises InputError for another number of them."""
    content = _bytes(value)
    if len(content) != 8:
        raise InputError(f"message: expected a number of 8 bytes, found {len(content)} bytes")
    return float(struct.unpack("<d", content)[0])


def _bytes(value: Value) -> bytes:
    if isinstance(value, int):
        raise InputError("message: expected bytes, found a whole number")
    return value


def _signed(number: int) -> int:
    return number - (1 << 64) if number >= 1 << 63 else number


def _varint(message: bytes, position: int) -> tuple[int, int]:
    """(number, position after it)."""
    number = 0
    for shift in range(0, 64, 7):
        if position >= len(message):
            raise InputError("message: expected a whole one, found one that is cut off")
        byte = message[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number & ((1 << 64) - 1), position
    raise InputError("message: expected numbers of at most 10 bytes, found a longer one")
