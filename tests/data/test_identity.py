"""What tells that data are the same."""

import json
import os

import numpy as np
import pytest

from spacesim.data import identity
from spacesim.data.identity import same_digest, training_digest
from spacesim.data.images import write_png
from spacesim.data.integrity.manifest import write_manifest
from spacesim.data.store import read_dataset


def write(root, value=0, silhouette=None, mask=None):
    """A dataset of one picture, whose bytes are as many whatever its `value`."""
    entry = {"file_path": "a.ppm", "transform_matrix": np.eye(4).tolist(), "w": 2, "h": 2, "fl_x": 2.0}
    root.mkdir(exist_ok=True)
    (root / "a.ppm").write_bytes(b"P6 2 2 255\n" + bytes([value]) * 12)
    for name, pixels in (("silhouette", silhouette), ("mask", mask)):
        if pixels is not None:
            write_png(root / f"{name}.png", np.full((2, 2), pixels, np.uint8))
            entry[f"{name}_path"] = f"{name}.png"
    meta = {"frames": [entry], "train_filenames": ["a.ppm"], "test_filenames": []}
    (root / "transforms.json").write_text(json.dumps(meta))
    return read_dataset(root)


def test_content_silhouettes_and_masks_tell_data_apart(tmp_path):
    data = [(0,), (1,), (0, 255), (0, 0), (0, None, 255), (0, None, 0), (0, 255, 255)]
    digests = [training_digest(write(tmp_path / str(k), *one)) for k, one in enumerate(data)]
    assert len(set(digests)) == len(data)
    assert training_digest(write(tmp_path / "again")) == digests[0]
    assert len({digest.split("-")[0] for digest in digests}) == 1  # the older form of a digest


def test_what_older_versions_wrote_still_matches(tmp_path):
    digest = training_digest(write(tmp_path / "a"))
    head, content = digest.split("-")
    assert same_digest(head, digest)
    assert same_digest(digest, head)
    assert not same_digest(head, content)
    assert not same_digest(digest, f"{head}-{head}")


def test_digests_beside_the_data_stand_for_files_that_are_older(tmp_path, monkeypatch):
    dataset = write(tmp_path / "a", 7, 255)
    digest = training_digest(dataset)
    write_manifest(dataset.root, ["a.ppm", "silhouette.png"], {})
    os.utime(dataset.root / "SHA256SUMS", ns=(2**60, 2**60))
    os.utime(dataset.root / "a.ppm", ns=(2**60, 2**60))
    os.utime(dataset.root / "silhouette.png", ns=(2**60, 2**60))
    with monkeypatch.context() as patch:
        patch.setattr(identity, "digest_of", lambda path: pytest.fail(f"{path} is read"))
        assert training_digest(dataset) == digest
    write(dataset.root, 8, 255)  # SHA256SUMS is out of date
    assert training_digest(dataset) == training_digest(write(tmp_path / "b", 8, 255)) != digest
    (dataset.root / "SHA256SUMS").write_text("broken")
    assert training_digest(dataset) != digest


def test_a_silhouette_that_is_gone_counts_as_none(tmp_path):
    dataset = write(tmp_path / "a", 0, 255)
    (dataset.root / "silhouette.png").unlink()
    assert training_digest(dataset) == training_digest(write(tmp_path / "b"))
