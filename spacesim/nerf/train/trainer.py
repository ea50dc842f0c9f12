"""The training loop of a radiance field: `step`, a look at what is empty now and then, checkpoints."""

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import numpy as np

from spacesim.backend import ad, recorded
from spacesim.backend.arrays import Float, UInt32
from spacesim.backend.memory import check_free_memory
from spacesim.backend.upload import upload, upload_numbers
from spacesim.data.errors import check_ranges
from spacesim.data.files import JsonDict
from spacesim.data.records import Dataset
from spacesim.learning.adam import corrections
from spacesim.learning.loop import TrainingLoop
from spacesim.learning.record import CheckpointHeader
from spacesim.nerf.config import NerfConfig
from spacesim.nerf.fields.model import Networks
from spacesim.nerf.sampling.box import SceneBox, scene_box
from spacesim.nerf.sampling.sampler import step_key
from spacesim.nerf.train.pixels import training_pixels
from spacesim.nerf.train.step import StepNumbers, look_at_cells, note_densities, step

FORMAT = "spacesim-nerf-1"
#: first steps, at most a tenth of all, in which the step size grows to its full: at full size at once, every unit of a
#: colour network may come to give 0 for good, and the field stays black
RATE_WARM_UP = 100
CELLS = 2**17  #: of the occupancy grid that are looked at together
A_CELL = 32  #: bytes on the device, of its state before and after, and whether it is filled
SLOPE = 10.0  #: of the power of proposals' weights as they warm up (Barron et al. 2022, annealing)


@dataclass(frozen=True, kw_only=True)
class NerfCheckpointHeader(CheckpointHeader):
    """What a checkpoint of a radiance field says beside its arrays."""

    proposal_steps: int  #: in which proposals have learned
    format: str = FORMAT  #: by which such files are known

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, proposal_steps=(0, 2**53))


class NerfTrainer(TrainingLoop):
    """The parameters of a radiance field, their moments, and what is known as empty, one step after another."""

    form, header = FORMAT, NerfCheckpointHeader

    def __init__(self, dataset: Dataset, config: NerfConfig) -> None:
        self.config, self.iteration, self.proposal_steps = config, 0, 0
        check_free_memory(config.ray_bytes * config.rays, f"rays: a step of {config.rays} rays")
        check_free_memory(A_CELL * config.occupancy**3, f"occupancy: {config.occupancy} cells a side")
        self.box = scene_box(dataset, config.margin)
        self.networks = Networks(config)
        self.pixels = training_pixels(dataset, self.box, config.knows_sun)
        self.parameters = [upload(values) for values in self.networks.initial(config.seed)]
        self.first = [dr.zeros(ad.Float, dr.width(values)) for values in self.parameters]
        self.second = [dr.zeros(ad.Float, dr.width(values)) for values in self.parameters]
        self.occupancy = dr.opaque(ad.Float, 0, config.occupancy**3)  #: see `Occupancy`
        self.filled = dr.opaque(ad.Float, 1, config.occupancy**3)
        self.history, self.seconds = [], {}
        self._step, self._look = recorded(step), recorded(look_at_cells, elements=None)
        self._note = recorded(note_densities)

    def step(self) -> Float:
        """One update. Returns the mean squared error of colours, Float of width 1."""
        config, index = self.config, self.iteration
        warm = index >= config.warm_up
        learn = not warm or index % config.proposals_every == 0
        self.proposal_steps += learn
        done = index / max(config.iterations - 1, 1)
        rate = config.rate ** (1 - done) * config.rate_final**done if config.rate_final > 0 else config.rate
        rate *= min((index + 1) / max(min(RATE_WARM_UP, config.iterations // 10), 1), 1)
        begun = 1.0 if warm else index / config.warm_up
        numbers = StepNumbers(
            self._key(index),
            dr.opaque(ad.Float, SLOPE * begun / ((SLOPE - 1) * begun + 1)),
            dr.opaque(ad.Float, float(warm)),
            upload_numbers([*corrections(index + 1), *corrections(max(self.proposal_steps, 1)), rate]),
        )
        self.parameters, self.first, self.second, loss = self._step(
            self.networks, self.parameters, self.first, self.second, self.pixels, self.filled, numbers, learn
        )
        self.iteration += 1
        if self.iteration % config.occupancy_every == 0:
            self._look_around(self._key(2**40 + index))
        return loss

    def _look_around(self, key: UInt32) -> None:
        """Look at all cells, so many at a time as bound the memory."""
        cells = self.config.occupancy**3
        parts = [
            self._look(self.networks, self.parameters, key, dr.opaque(ad.UInt32, first), min(CELLS, cells - first))
            for first in range(0, cells, CELLS)
        ]
        density = parts[0] if len(parts) == 1 else dr.concat(parts)
        self.occupancy, self.filled = self._note(self.networks, self.occupancy, density)

    def model_tensors(self) -> dict[str, np.ndarray]:
        """Grids, networks, which cells are filled, the box."""
        own = {name: np.array(values) for name, values in zip(self.networks.names(), self.parameters, strict=True)}
        return {**own, "occupancy": np.array(self.occupancy), "box": np.stack([self.box.low, self.box.size])}

    def state_tensors(self) -> dict[str, np.ndarray]:
        """Adam's moments, and what rays skip."""
        tensors: dict[str, np.ndarray] = {}
        for name, values in (("adam.first", self.first), ("adam.second", self.second), ("filled", [self.filled])):
            tensors |= {f"{name}.{i:02d}": np.array(value) for i, value in enumerate(values)}
        return tensors

    def counts(self) -> dict[str, int]:
        """Steps in which proposals have learned."""
        return {"proposal_steps": self.proposal_steps}

    def put(self, tensors: Mapping[str, np.ndarray], header: NerfCheckpointHeader) -> None:
        """See `TrainingLoop.put`; nothing has changed where it raises."""
        parameters = self.networks.parameters(tensors)
        first, second = (
            [_sized(tensors, f"adam.{order}.{i:02d}", dr.width(one)) for i, one in enumerate(parameters)]
            for order in ("first", "second")
        )
        occupancy, filled = (_sized(tensors, name, dr.width(self.occupancy)) for name in ("occupancy", "filled.00"))
        box = box_of(tensors)
        if not (np.array_equal(box.low, self.box.low) and np.array_equal(box.size, self.box.size)):
            raise ValueError("box: expected this data's scene box, found another")
        self.parameters, self.first, self.second = parameters, first, second
        self.occupancy, self.filled, self.proposal_steps = occupancy, filled, header.proposal_steps

    def summary(self) -> JsonDict:
        """How many numbers were trained."""
        return {"parameters": sum(dr.width(values) for values in self.parameters)}

    def _key(self, number: int) -> UInt32:
        return dr.opaque(ad.UInt32, step_key(self.config.seed, number))


def box_of(tensors: Mapping[str, np.ndarray]) -> SceneBox:
    """The box that `NerfTrainer.model_tensors` names. Raises KeyError, or ValueError where it is none."""
    box = tensors["box"].astype(np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > 0).all():
        raise ValueError("box: expected a corner and three sides above 0, found others")
    return SceneBox(box[0], box[1])


def _sized(tensors: Mapping[str, np.ndarray], name: str, size: int) -> Float:
    values = tensors[name]
    if values.shape != (size,) or not np.isfinite(values).all():
        raise ValueError(f"{name}: expected {size} finite numbers, found others")
    return upload(values)
