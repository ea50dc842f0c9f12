"""Splats that several test files draw."""

import numpy as np


def random_splats(count: int, seed: int = 0, degree: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "means": rng.uniform(-0.6, 0.6, (count, 3)),
        "log_scales": rng.uniform(-3.2, -1.4, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "logit_opacities": rng.uniform(-2.5, 2.0, count),
        "sh": rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.25,
    }
