"""SHA256SUMS: the digest of every file of a dataset, in the format of coreutils, which `sha256sum -c SHA256SUMS` reads.

PNG and EXR have checksums of their own, but not of all bytes, and a file may be another whole one.
"""

import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

from spacesim.data.errors import InputError
from spacesim.data.files import open_regular, read_bytes, write_bytes

NAME = "SHA256SUMS"
MAX_MANIFEST_BYTES = 1 << 30  #: bytes: of ten million files
_BLOCK = 1 << 20  # bytes read at once
_THREADS = min(8, os.cpu_count() or 1)

_LINE = re.compile(r"([0-9a-f]{64})  (.+)")


def digest_of(path: Path) -> str:
    """SHA-256 of a file (FIPS 180-4), in hexadecimal. Raises InputError where it cannot be read."""
    digest = hashlib.sha256()
    with open_regular(path) as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def write_manifest(root: Path, paths: Iterable[str], known: Mapping[str, str]) -> None:
    """Write SHA256SUMS of files below `root`, by their paths from there. known: digests of further files, which are not
    read. Raises InputError where a file cannot be read."""
    paths = list(paths)
    with ThreadPoolExecutor(_THREADS) as pool:
        digests = dict(zip(paths, pool.map(lambda path: digest_of(root / path), paths), strict=True)) | dict(known)
    lines = [f"{digest}  {path}\n" for path, digest in sorted(digests.items())]
    write_bytes(root / NAME, "".join(lines).encode())


def read_manifest(root: Path) -> dict[str, str]:
    """{path below `root`: digest} of SHA256SUMS; {} where there is none. Raises InputError where it is broken."""
    path = root / NAME
    if not os.path.lexists(path):
        return {}
    digests = {}
    *lines, rest = read_bytes(path, most=MAX_MANIFEST_BYTES).decode("utf-8", "replace").split("\n")
    if not lines or rest:
        raise InputError(f"{path}: expected a digest and a path in each line, found a file that is empty or cut off")
    for number, line in enumerate(lines, start=1):
        match = _LINE.fullmatch(line)
        if match is None or PurePosixPath(match[2]).is_absolute() or ".." in PurePosixPath(match[2]).parts:
            raise InputError(
                f"{path}, line {number}: expected a digest and a path below the folder, found {line[:60]!r}"
            )
        digests[match[2]] = match[1]
    return digests


def check_manifest(root: Path) -> dict[str, str]:
    """{path below `root`: what is wrong, a sentence} of the files that SHA256SUMS names and that are missing, cannot be
    read or have other bytes. Raises InputError where SHA256SUMS is broken."""

    def problem(path: str, digest: str) -> str | None:
        try:
            actual = digest_of(root / path)
        except InputError as error:
            return str(error)
        return None if actual == digest else f"{root / path}: expected the bytes that {NAME} knows, found others"

    digests = read_manifest(root)
    with ThreadPoolExecutor(_THREADS) as pool:
        problems = dict(zip(digests, pool.map(problem, digests, digests.values()), strict=True))
    return {path: words for path, words in problems.items() if words is not None}
