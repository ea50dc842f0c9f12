"""What training holds and does over and over: memory a Gaussian, recordings, kernels compiled, kernels traced."""

import gc
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from spacesim import backend
from spacesim.splat.train.config import preset
from spacesim.splat.train.trainer import Trainer
from support.common import Row, resident, sphere_arrays
from support.synthetic import still_trainer, write_dataset

SCENE = 2_000, 64  #: Gaussians and pixels of the run over many steps
MAX_GAUSSIANS = 6_000  #: Gaussians that refinement may reach in it
MIN_STEPS = 200  #: of `over_steps`: ten before each mark are under the kernel history, the others are timed
UNSEEN = -20.0  #: logit of an opacity too faint to be drawn


def memory(count: int, pixels: int) -> Row:
    """Bytes a Gaussian beside the tile lists: what `count` Gaussians hold more than a few of them, over how many more.

    Those few, an eighth or less and a power of two, are drawn; the others are too faint, so that lists and picture are
    the same.
    """
    drawn = 2 ** max(int(np.log2(count)) - 3, 0)
    few, many = _watermark(drawn, 0, pixels), _watermark(drawn, count - drawn, pixels)
    return {
        "Gaussians": count,
        "pixels": pixels,
        "peak, MB": many / 1e6,
        "of those drawn, MB": few / 1e6,
        "bytes a Gaussian": round((many - few) / (count - drawn)),
    }


def _watermark(seen: int, unseen: int, pixels: int) -> int:
    """Most bytes that Dr.Jit had allocated at any moment of a few warm training steps."""
    arrays = sphere_arrays(seen + unseen)
    drawn = sphere_arrays(seen)
    arrays["means"][:seen], arrays["log_scales"][:seen] = drawn["means"], drawn["log_scales"]
    arrays["logit_opacities"] = np.where(np.arange(seen + unseen) < seen, 1.0, UNSEEN)
    with tempfile.TemporaryDirectory() as folder:
        dataset = write_dataset(Path(folder) / "data", seen + unseen, pixels)
        trainer = still_trainer(dataset, seen + unseen, arrays)
        for _ in range(12):
            trainer.step()
        dr.sync_thread()
        gc.collect()
        dr.flush_malloc_cache()
        dr.detail.malloc_clear_statistics()
        for _ in range(3):
            trainer.step()
        dr.sync_thread()
    return _peak()


def _peak() -> int:
    """Most bytes that Dr.Jit has held at a moment since its statistics were cleared."""
    kind = dr.JitBackend.CUDA if backend.select() == "cuda" else dr.JitBackend.LLVM
    return int(dr.detail.malloc_watermark(kind))


def over_steps(steps: int, marks: int = 10) -> list[Row]:
    """Train `steps` steps with refinement going on to the end; a row at each of `marks` moments."""
    count, pixels = SCENE
    config = replace(preset("fast"), iterations=steps, init_count=count)
    refinement = replace(config.refinement, refine_stop=steps + 1, max_gaussians=MAX_GAUSSIANS, screen_size_stop=steps)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(write_dataset(Path(folder) / "data", count, pixels), replace(config, refinement=refinement))
        for mark in range(1, marks + 1):
            start, first = time.perf_counter(), trainer.iteration
            dr.detail.malloc_clear_statistics()
            before = _new_kernels()
            while trainer.iteration < steps * mark // marks - 10:
                trainer.step()
            dr.sync_thread()
            milliseconds = 1e3 * (time.perf_counter() - start) / max(trainer.iteration - first, 1)
            rows.append(_row(trainer, milliseconds, _new_kernels() - before))
    return rows


def _new_kernels() -> int:
    """Kernels so far that were not in memory when they were launched: compiled, or loaded from Dr.Jit's disk cache."""
    _, loaded, compiled = dr.detail.launch_stats()
    return int(loaded + compiled)


def _row(trainer: Trainer, milliseconds: float, compiled: int) -> Row:
    """The counters now, and ten more steps under Dr.Jit's kernel history."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        for _ in range(10):
            trainer.step()
        dr.sync_thread()
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    traced = sum(entry["recording_mode"] != dr.KernelRecordingMode.Replayed for entry in history)
    gc.collect()
    row: dict[str, Any] = {"step": trainer.iteration, "Gaussians": trainer.gaussians.count, "ms a step": milliseconds}
    row |= {"recordings so far": backend.recordings(), "new kernels since": compiled}
    row |= {"kernels a step": len(history) / 10, "traced a step": traced / 10}
    return row | {"arrays' peak, MB": _peak() / 1e6, "process, MB": resident() / 1e6}
