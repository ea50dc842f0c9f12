"""The rasterizer beside gsplat's, where both can run."""

import sys
from pathlib import Path

import pytest

from spacesim import backend

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"


@pytest.mark.gpu
def test_picture_and_gradients_match_gsplat(monkeypatch):
    """Colour, alpha and depth within 2e-3, gradients within 1e-3 relative, on 1,000 random splats."""
    if backend.select() != "cuda":
        pytest.skip("needs a CUDA device")
    pytest.importorskip("torch", reason="needs torch with CUDA")
    pytest.importorskip("gsplat", reason="needs gsplat 1.5")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    sys.modules.pop("against_gsplat", None)
    from against_gsplat import compare_pictures

    found = compare_pictures(1_000, 256)
    assert max(found["color"], found["alpha"], found["depth"]) < 2e-3
    assert max(value for name, value in found.items() if name.startswith("gradient")) < 1e-3
