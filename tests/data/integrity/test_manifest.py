"""SHA256SUMS: what generate writes, sha256sum reads, and verify and --resume find with it."""

import random
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from tiny import GENERATE

from spacesim.data.errors import InputError
from spacesim.data.images import read_exr, write_exr, write_png
from spacesim.data.integrity.manifest import NAME, check_manifest, read_manifest
from spacesim.data.integrity.verify import verify_files


@pytest.fixture
def data(tiny_data, tmp_path) -> Path:
    return Path(shutil.copytree(tiny_data, tmp_path / "data"))


def test_every_file_is_listed_and_sha256sum_agrees(tiny_data):
    found = {str(path.relative_to(tiny_data)) for path in tiny_data.rglob("*") if path.is_file()}
    assert set(read_manifest(tiny_data)) == found - {NAME}
    if shutil.which("sha256sum"):
        done = subprocess.run(["sha256sum", "--check", "--quiet", NAME], cwd=tiny_data, capture_output=True, text=True)
        assert (done.returncode, done.stdout) == (0, "")


def test_single_bits_are_found(data):
    rng = random.Random(0)
    files = sorted(path for path in data.rglob("*") if path.is_file() and path.name != NAME)
    for path in rng.sample(files, 20):
        honest = path.read_bytes()
        bit = rng.randrange(8 * len(honest))
        damaged = bytearray(honest)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        assert list(check_manifest(data)) == [str(path.relative_to(data))]
        path.write_bytes(honest)
    assert check_manifest(data) == {}


def test_another_whole_file_is_found(spacesim, data):
    path = data / "gt/train_00001.exr"
    layers = read_exr(path)
    layers["depth"][3, 4] += 1e-3
    write_exr(path, layers)
    refused = spacesim("verify", data)
    assert refused.code == 1
    assert refused.errors[0].startswith(f"{path}: expected the bytes that {NAME} knows")
    assert len(refused.errors) == 2


def test_without_digests_checksums_of_png_are_held_against(spacesim, data):
    (data / NAME).unlink()
    path = data / "id/train_00002.png"
    content = bytearray(path.read_bytes())
    content[content.index(b"IDAT") + 6] ^= 4
    path.write_bytes(content)
    refused = spacesim("verify", data)
    assert refused.code == 1
    assert "checksum of its chunk IDAT" in refused.errors[0]
    write_png(path, np.zeros((40, 40), np.uint8))
    done = spacesim("verify", data)
    assert done.code == 0
    assert NAME in done.errors[0]


def test_resume_makes_damaged_frames_again(spacesim, data, tiny_data, caplog):
    damaged = data / "gt/train_00003.exr"
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    done = spacesim("generate", "boxsat", "--out", data, *GENERATE, "--resume")
    assert done.code == 0, done.errors
    assert "1 files are damaged, gt/train_00003.exr the first" in caplog.text
    names = {str(path.relative_to(tiny_data)) for path in tiny_data.rglob("*") if path.is_file()}
    assert all((data / name).read_bytes() == (tiny_data / name).read_bytes() for name in names)
    assert verify_files(data)[1] == []


@pytest.mark.parametrize("line", ["x", f"{'0' * 64}  /etc/passwd", f"{'0' * 64}  ../a", f"{'g' * 64}  a", "\xff"])
def test_a_broken_manifest_is_refused(data, line):
    with (data / NAME).open("ab") as file:
        file.write(f"{line}\n".encode("latin-1"))
    with pytest.raises(InputError, match=f"{NAME}, line [0-9]+: expected a digest and a path below the folder"):
        read_manifest(data)
    assert len(verify_files(data)[1]) == 1
