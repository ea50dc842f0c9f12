"""The model: N anisotropic 3D Gaussians (thesis 2.7) as named tensors, and their activations.

Stored parameters are unconstrained: log scales, logit opacities, quaternions of any length. Arrays are kept
component by component ([3, N] in memory), the layout in which a Dr.Jit kernel reads them without gathers. What a
network reads of each Gaussian, its features, is one packed array: hundreds of rows would be hundreds of pointers.
"""

from collections.abc import Iterable, Mapping

import drjit as dr
import numpy as np

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Array4f, ArrayXf, Float, NumberT, UInt32
from spacesim.backend.upload import upload, upload_rows
from spacesim.data.errors import expect
from spacesim.data.structure import checked

SH_C0 = 0.28209479177387814  #: Y_00, the constant spherical harmonic
NAMES = ("means", "log_scales", "quaternions", "logit_opacities", "sh")
ROWS = dict(zip(NAMES, (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 11), slice(11, None)), strict=True))


class Gaussians:
    """The one mutable owner of the parameters. Assign to a field to change it. Of numpy arrays: `from_numpy`.

    means: Array3f [3, N] metres, world or model frame
    log_scales: Array3f [3, N] natural logarithm of the standard deviations in metres
    quaternions: Array4f [4, N] (w, x, y, z), world from principal axes; need not be of unit length
    logit_opacities: Float [N]
    sh: ArrayXf [3 K, N] spherical-harmonic coefficients, row 3 k + channel; K = 1, 4, 9 or 16, or 0 where colours come
        from an appearance field
    features: Float [F * N], row by row, or None for F = 0: what networks know of each Gaussian (thesis 4.2, 4.11)
    """

    def __init__(
        self,
        means: Array3f,
        log_scales: Array3f,
        quaternions: Array4f,
        logit_opacities: Float,
        sh: ArrayXf,
        features: Float | None = None,
    ) -> None:
        for name, rows in zip(NAMES, (means, log_scales, quaternions, logit_opacities, sh), strict=True):
            if not isinstance(rows, dr.ArrayBase):
                hint = "for numpy arrays there is Gaussians.from_numpy"
                raise TypeError(f"{name}: expected a Dr.Jit array, found {type(rows).__name__}; {hint}")
        self.means = means
        self.log_scales = log_scales
        self.quaternions = quaternions
        self.logit_opacities = logit_opacities
        self.sh = sh
        self.features = features

    @property
    def count(self) -> int:
        """N."""
        return int(dr.width(self.logit_opacities))

    @property
    def sh_degree(self) -> int:
        """Degree L of the coefficients, K = (L + 1)^2."""
        return round((len(self.sh) // 3) ** 0.5) - 1

    @property
    def feature_count(self) -> int:
        """F."""
        return 0 if self.features is None else int(dr.width(self.features)) // self.count

    def parameters(self) -> dict[str, Array3f | Array4f | Float | ArrayXf]:
        """{name: array} of what a Gaussian is drawn by, in a fixed order; features are not among them."""
        return {name: getattr(self, name) for name in NAMES}

    def rows(self) -> list[Float]:
        """The parameters as a list of Floats [N], row after row in the order of `ROWS`; features, if any, are the last,
        [F * N]."""
        drawn = [*self.shape_rows(), *self.sh]
        return drawn if self.features is None else [*drawn, self.features]

    def shape_rows(self) -> list[Float]:
        """The first of `rows`: what places Gaussians and makes them opaque, without their looks. 11 Floats [N]."""
        return [*self.means, *self.log_scales, *self.quaternions, self.logit_opacities]

    @staticmethod
    def from_rows(rows: list[Float]) -> "Gaussians":
        """The inverse of `rows`; shares the arrays."""
        means, log_scales, quaternions = (rows[ROWS[name]] for name in NAMES[:3])
        sh = rows[ROWS["sh"]]
        features = sh.pop() if len(sh) % 3 == 1 else None  # harmonics come in threes
        return Gaussians(
            ad.Array3f(means), ad.Array3f(log_scales), ad.Array4f(quaternions), rows[10], ad.ArrayXf(sh), features
        )

    def replace(self, rows: list[Float]) -> None:
        """Take other parameters, `rows` of them as in `from_rows`."""
        other = Gaussians.from_rows(rows)
        for name in (*NAMES, "features"):
            setattr(self, name, getattr(other, name))

    def to_numpy(self) -> dict[str, np.ndarray]:
        """{name: float32 array with N first}: means [N, 3], log_scales [N, 3], quaternions [N, 4],
        logit_opacities [N], sh [N, K, 3]; features [N, F] where there are any."""
        arrays = {name: np.array(value, dtype=np.float32).T for name, value in self.parameters().items()}
        arrays["sh"] = arrays["sh"].reshape(self.count, len(self.sh) // 3, 3)
        if self.features is not None:
            arrays["features"] = np.array(self.features).reshape(-1, self.count).T
        return {name: np.ascontiguousarray(array) for name, array in arrays.items()}

    @staticmethod
    @checked
    def random(count: int, radius: float, scale: float, seed: int = 0) -> "Gaussians":
        """`count` grey, half-transparent balls, evenly within a sphere of `radius` metres about the origin; scale:
        their standard deviation, metres. Raises InputError for numbers that no Gaussians have."""
        for name, number in (("count", count), ("seed", seed)):
            expect(number >= 0, name, "0 or more", number)
        for name, metres in (("radius", radius), ("scale", scale)):
            expect(metres > 0, name, "metres above 0", metres)
        rng = np.random.default_rng(seed)
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return Gaussians.from_numpy(
            {
                "means": radius * np.cbrt(rng.uniform(size=(count, 1))) * directions,
                "log_scales": np.full((count, 3), np.log(scale)),
                "quaternions": rng.normal(size=(count, 4)),
                "logit_opacities": np.zeros(count),
                "sh": np.zeros((count, 1, 3)),
            }
        )

    @staticmethod
    def from_numpy(arrays: Mapping[str, np.ndarray]) -> "Gaussians":
        """The inverse of `to_numpy`. Raises ValueError naming the array whose shape does not fit."""
        if not isinstance(arrays, Mapping):
            raise TypeError(f"arrays: expected a dict, as to_numpy gives, found {type(arrays).__name__}")
        for name in NAMES:
            if name not in arrays:
                raise ValueError(f"{name}: expected an array, found none")
        if np.ndim(arrays["means"]) != 2:
            raise ValueError(f"means: expected shape (N, 3), found {np.shape(arrays['means'])}")
        count = len(arrays["means"])
        expected: dict[str, tuple[int, ...]] = {
            "means": (count, 3),
            "log_scales": (count, 3),
            "quaternions": (count, 4),
        }
        expected["logit_opacities"] = (count,)
        for name, shape in expected.items():
            if np.shape(arrays[name]) != shape:
                raise ValueError(f"{name}: expected shape {shape}, found {np.shape(arrays[name])}")
        sh = np.asarray(arrays["sh"], dtype=np.float32)
        if sh.ndim != 3 or sh.shape[0] != count or sh.shape[1] not in (0, 1, 4, 9, 16) or sh.shape[2] != 3:
            raise ValueError(f"sh: expected shape ({count}, 0 | 1 | 4 | 9 | 16, 3), found {sh.shape}")
        features = arrays.get("features")
        shape = (count, 1) if features is None else np.shape(features)
        if len(shape) != 2 or shape[0] != count or shape[1] == 0:
            raise ValueError(f"features: expected shape ({count}, F), found {shape}")
        rows = {name: np.asarray(arrays[name], dtype=np.float32).T for name in expected}
        harmonics = sh.reshape(count, sh.shape[1] * 3)
        return Gaussians(
            means=upload_rows(rows["means"]),
            log_scales=upload_rows(rows["log_scales"]),
            quaternions=ad.Array4f(*(upload(row) for row in rows["quaternions"])),
            logit_opacities=upload(rows["logit_opacities"]),
            sh=ad.ArrayXf([upload(row) for row in harmonics.T]) if sh.shape[1] else ad.ArrayXf([]),
            features=None if features is None else upload(np.asarray(features).T.ravel()),
        )


def stack_rows(rows: Iterable[Float]) -> np.ndarray:
    """[K, N] of K Floats [N]. Dr.Jit's own way compiles a kernel for each N, for it writes the rows as one array."""
    return np.stack([np.array(row) for row in rows])


def gather_entries(row: NumberT, index: UInt32, count: int) -> NumberT:
    """Entries index [M] of a row [count], or of each of the C rows of a packed one: [C * count] to [C * M]."""
    copies, chosen = dr.width(row) // count, dr.width(index)
    if copies == 1:
        return dr.gather(type(row), row, index)
    place = dr.arange(ad.UInt32, copies * chosen)
    old, new = dr.opaque(ad.UInt32, count), dr.opaque(ad.UInt32, chosen)  # as literals each size would be compiled
    return dr.gather(type(row), row, place // new * old + dr.gather(ad.UInt32, index, place % new))


def opacities(logit_opacities: Float) -> Float:
    """o = sigmoid(logit) [N], in (0, 1)."""
    return dr.rcp(1 + dr.exp(-logit_opacities))


def principal_axes(quaternions: Array4f) -> list[Array3f]:
    """The principal axes in world axes: three columns (Array3f [3, N]) of the rotations of quaternions Array4f [4, N].

    Quaternions that have no direction (0, not finite, beyond 1e12) count as no rotation and get no gradients.
    """
    length2 = dr.squared_norm(quaternions)
    sane = dr.detach((length2 > 1e-24) & (length2 < 1e24))
    q = dr.select(sane, quaternions, ad.Array4f(1, 0, 0, 0)) * dr.rsqrt(dr.select(sane, length2, 1))
    w, x, y, z = q[0], q[1], q[2], q[3]
    return [
        ad.Array3f(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        ad.Array3f(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        ad.Array3f(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
