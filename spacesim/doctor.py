"""What works here, and what to type for the rest. Never raises: what cannot be checked is said so."""

import importlib
import importlib.metadata
import platform
import sys
from collections.abc import Callable

from spacesim import backend
from spacesim.data.files import JsonDict
from spacesim.version import __version__

_PACKAGES = ("mitsuba", "drjit", "numpy", "torch")
_TITLES = {"python": "Python", "cuda": "CUDA", "llvm": "LLVM", "lpips": "LPIPS"}

Finding = JsonDict


def report() -> JsonDict:
    """Findings as JSON values.

    "versions": {package: version or null}; "backend": the one that runs by default, or null; and an entry
    {"ok": bool, "found": sentence} for each of python, cuda, llvm and lpips.
    """
    return {
        "backend": _default_backend(),
        "versions": {"spacesim": __version__, **{name: _version(name) for name in _PACKAGES}},
        "python": _attempt(_check_python),
        "cuda": _attempt(_check_cuda),
        "llvm": _attempt(_check_llvm),
        "lpips": _attempt(_check_lpips),
    }


def describe(report: JsonDict) -> str:
    """Plain lines of a `report()`, the verdict last."""
    versions = [f"{name} {version}" for name, version in report["versions"].items() if version is not None]
    lines = [f"{'versions':<10}{', '.join(versions)}"]
    for key, title in _TITLES.items():
        finding = report[key]
        lines.append(f"{title:<10}{'ok: ' if finding['ok'] else 'no: '}{finding['found']}")
    if report["backend"] is None:
        lines.append("Nothing can be rendered here: see the lines CUDA and LLVM.")
    else:
        lines.append(f"Ready: --backend auto runs on {report['backend']}.")
    return "\n".join(lines)


def _attempt(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:  # a broken installation must be described, not end the description
        return _finding(False, f"cannot be checked ({type(error).__name__}: {error})")


def _finding(ok: bool, found: str) -> Finding:
    return {"ok": ok, "found": found}


def _check_python() -> Finding:
    return _finding(True, f"{platform.python_version()} at {sys.executable}")


def _default_backend() -> str | None:
    try:
        reasons = backend.available()
    except Exception:  # reported by the entries of the backends
        return None
    return next((name for name in ("cuda", "llvm") if reasons[name] is None), None)


def _check_cuda() -> Finding:
    reason = backend.available()["cuda"]
    return _finding(reason is None, reason or "a CUDA device answers")


def _check_llvm() -> Finding:
    reason = backend.available()["llvm"]
    return _finding(reason is None, reason or backend.find_llvm()[1])


def _check_lpips() -> Finding:
    if _version("torch") is None:
        return _finding(False, "torch is not installed; type: pip install 'spacesim[lpips]'")
    importlib.import_module("torch")
    weights, sentence = importlib.import_module("spacesim.eval.metrics.lpips").find_weights()
    return _finding(weights is not None, sentence)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
