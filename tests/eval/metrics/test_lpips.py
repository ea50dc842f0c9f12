"""LPIPS against an independent numpy implementation, on AlexNet-shaped random weights."""

import hashlib
import pickle

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from safetensors.numpy import save_file

from spacesim.data.errors import InputError
from spacesim.eval.metrics import lpips

CONVOLUTIONS = {  # torchvision's alexnet().features
    "features.0": (64, 3, 11),
    "features.3": (192, 64, 5),
    "features.6": (384, 192, 3),
    "features.8": (256, 384, 3),
    "features.10": (256, 256, 3),
}


@pytest.fixture(scope="module")
def weights():
    generator = np.random.default_rng(5)
    tensors = {}
    for layer, (name, (outputs, inputs, size)) in enumerate(CONVOLUTIONS.items()):
        deviation = (2 / (inputs * size * size)) ** 0.5
        tensors[f"{name}.weight"] = generator.normal(0, deviation, (outputs, inputs, size, size)).astype(np.float32)
        tensors[f"{name}.bias"] = generator.normal(0, 0.1, outputs).astype(np.float32)
        tensors[f"lin{layer}.model.1.weight"] = generator.random((1, outputs, 1, 1)).astype(np.float32)
    return tensors


@pytest.fixture(scope="module")
def pictures():
    generator = np.random.default_rng(6)
    truth = generator.random((35, 52, 3))
    return np.clip(truth + 0.2 * generator.normal(size=truth.shape), 0, 1), truth


@pytest.fixture(scope="module")
def single_file(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "lpips.safetensors"
    save_file(weights, path)
    return path


@pytest.fixture(scope="module")
def two_files(weights, tmp_path_factory):
    torch = pytest.importorskip("torch", reason="torch (extra: lpips) is not installed")
    folder = tmp_path_factory.mktemp("checkpoints")
    tensors = {name: torch.from_numpy(value) for name, value in weights.items()}
    classifier = {"classifier.6.bias": torch.zeros(1000)}
    backbone = {name: value for name, value in tensors.items() if name.startswith("features")}
    torch.save(backbone | classifier, folder / "alexnet-owt-7be5be79.pth")
    torch.save({n: v for n, v in tensors.items() if n.startswith("lin")}, folder / "alex.pth")
    return folder


def convolve(x, weight, bias, stride, padding):
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = sliding_window_view(x, weight.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
    return np.einsum("chwij,ocij->ohw", windows, weight, optimize=True) + bias[:, None, None]


def pool(x):
    return sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(axis=(3, 4))


def features(picture, w):
    """The five rectified activations [C, h, w], float64."""
    x = (picture * 2 - 1).transpose(2, 0, 1)
    x = (x - np.array([-0.030, -0.088, -0.188])[:, None, None]) / np.array([0.458, 0.448, 0.450])[:, None, None]
    w = {name: value.astype(np.float64) for name, value in w.items()}
    a = np.maximum(convolve(x, w["features.0.weight"], w["features.0.bias"], 4, 2), 0)
    b = np.maximum(convolve(pool(a), w["features.3.weight"], w["features.3.bias"], 1, 2), 0)
    c = np.maximum(convolve(pool(b), w["features.6.weight"], w["features.6.bias"], 1, 1), 0)
    d = np.maximum(convolve(c, w["features.8.weight"], w["features.8.bias"], 1, 1), 0)
    return a, b, c, d, np.maximum(convolve(d, w["features.10.weight"], w["features.10.bias"], 1, 1), 0)


def reference(prediction, truth, w):
    total = 0.0
    for layer, (a, b) in enumerate(zip(features(prediction, w), features(truth, w), strict=True)):
        a, b = (f / (np.linalg.norm(f, axis=0) + 1e-10) for f in (a, b))
        linear = w[f"lin{layer}.model.1.weight"][0].astype(np.float64)
        total += (linear * (a - b) ** 2).sum(axis=0).mean()
    return total


def publish(monkeypatch, folder):
    """Take the files in a folder for the published ones."""
    for path in folder.glob("*.pth"):
        monkeypatch.setitem(lpips.SHA256, path.name, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.mark.parametrize("source", ["single_file", "two_files"])
def test_agrees_with_numpy(source, weights, pictures, request, monkeypatch):
    pytest.importorskip("torch", reason="torch (extra: lpips) is not installed")
    path = request.getfixturevalue(source)
    if path.is_dir():
        publish(monkeypatch, path)
    network, sentence = lpips.load(path)
    assert str(path) in sentence
    assert network(*pictures) == pytest.approx(reference(*pictures, weights), rel=1e-5)
    assert network(pictures[1], pictures[1]) == 0


def test_pictures_too_small_for_the_network(single_file):
    pytest.importorskip("torch", reason="torch (extra: lpips) is not installed")
    network, _ = lpips.load(single_file)
    generator = np.random.default_rng(7)
    assert network(generator.random((30, 60, 3)), generator.random((30, 60, 3))) is None
    assert network(generator.random((31, 31, 3)), generator.random((31, 31, 3))) > 0


def test_torchs_cache_is_found(two_files, monkeypatch, tmp_path):
    (tmp_path / "hub").mkdir()
    (tmp_path / "hub" / "checkpoints").symlink_to(two_files)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    location, sentence = lpips.find_weights()
    assert location == tmp_path / "hub" / "checkpoints"
    assert str(location) in sentence


def test_no_weights_is_none_and_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    location, sentence = lpips.find_weights()
    assert location is None
    assert "alex.pth" in sentence
    assert "(download.pytorch.org/models/alexnet-owt-7be5be79.pth" in sentence
    assert "lpips_weights" in sentence
    assert lpips.load()[0] is None


def test_no_torch_is_none_and_a_sentence(monkeypatch, single_file):
    monkeypatch.setattr(lpips.importlib.util, "find_spec", lambda name: None)
    network, sentence = lpips.load(single_file)
    assert network is None
    assert "torch" in sentence


def test_named_weights_must_be_there(tmp_path):
    with pytest.raises(InputError, match=r"lpips_weights: .*found no alexnet"):
        lpips.find_weights(tmp_path)


def test_wrong_tensors_are_named(weights, tmp_path):
    pytest.importorskip("torch", reason="torch (extra: lpips) is not installed")
    lacking = {name: value for name, value in weights.items() if name != "lin3.model.1.weight"}
    save_file(lacking, tmp_path / "lacking.safetensors")
    with pytest.raises(InputError, match=r"lin3\.model\.1\.weight .*found none"):
        lpips.load(tmp_path / "lacking.safetensors")
    save_file(weights | {"features.0.bias": np.zeros(3, np.float32)}, tmp_path / "wrong.safetensors")
    with pytest.raises(InputError, match=r"features\.0\.bias of shape \(64,\), found \(3,\)"):
        lpips.load(tmp_path / "wrong.safetensors")
    (tmp_path / "cut.safetensors").write_bytes(b"\x10\0\0\0\0\0\0\0{")
    with pytest.raises(InputError, match="expected a safetensors file"):
        lpips.load(tmp_path / "cut.safetensors")


def test_other_files_than_the_published_ones_are_refused(two_files, monkeypatch, tmp_path):
    """Damage that leaves tensors would give other distances."""
    with pytest.raises(InputError, match=r"7be5be79\.pth: expected the published file, whose SHA-256 begins 7be5be79,"):
        lpips.load(two_files)
    publish(monkeypatch, two_files)
    content = bytearray((two_files / "alex.pth").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "alex.pth").write_bytes(content)
    (tmp_path / "alexnet-owt-7be5be79.pth").symlink_to(two_files / "alexnet-owt-7be5be79.pth")
    with pytest.raises(InputError, match=r"alex\.pth: expected the published file"):
        lpips.load(tmp_path)


class Exploit:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was run",))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_pickles_are_refused(two_files, tmp_path, monkeypatch):
    (tmp_path / "alexnet-owt-7be5be79.pth").symlink_to(two_files / "alexnet-owt-7be5be79.pth")
    (tmp_path / "alex.pth").write_bytes(pickle.dumps({"lin0.model.1.weight": Exploit()}))
    publish(monkeypatch, tmp_path)
    with pytest.raises(InputError, match=r"alex\.pth: expected a file of tensors alone"):
        lpips.load(tmp_path)
