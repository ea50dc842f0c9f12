"""What shading depends on beside weights, as its parts read it."""

from dataclasses import dataclass

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Array3f, Array4f, Float, TensorXf
from spacesim.backend.packet import numbers_at
from spacesim.splat.light.field import FieldInputs
from spacesim.splat.light.padded_batch import PaddedBatch
from spacesim.splat.light.shadow.light_camera import towards_sun
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig, refine_inputs
from spacesim.splat.light.sunlight import SunEncoding
from spacesim.splat.light.surroundings import Surroundings
from spacesim.splat.raster.cameras import Projection


@dataclass
class ShadingInputs:
    """What all Gaussians, a camera and a Sun give."""

    features: Float  #: Float, packed [F * N]
    means: Array3f  #: Array3f [3, N], metres
    rotations_and_scales: tuple[Array4f, Array3f]  #: quaternions and log scales
    logits: Float  #: of opacities
    camera: Projection | None  #: None where the Sun's light alone is wanted
    raw_shadows: list[Float]  #: occlusion, normal alignment, light extent and bias, [N] each, or nothing
    sun: SunEncoding  #: as networks and shadows read it
    training_frame: Float  #: Float [4], centre and scale of the training frame
    surroundings: Surroundings | None  #: None without a bounce

    def of_field(self) -> FieldInputs:
        """What the field reads of the world."""
        assert self.camera is not None
        towards = towards_sun(self.sun.light_axes)
        return FieldInputs(self.features, self.means, self.rotations_and_scales, self.camera, towards, self.sun.beams)

    def refine_items(self, refine: ShadowRefinementConfig, first: int, batch: PaddedBatch) -> TensorXf:
        """Items of the refinement, TensorXf [B, C, m]: 4.11, lengths in training scale. first: of its rows among the
        features"""
        x, y, z, scale = numbers_at(self.training_frame, range(4))
        per_metre = dr.rcp(scale)
        positions = (batch.repeat_last(self.means) - ad.Array3f(x, y, z)) * per_metre
        if refine.positions == "light":
            numbers = numbers_at(self.sun.light_axes, range(9))
            axes = [ad.Array3f(numbers[i : i + 3]) for i in (0, 3, 6)]
            positions = ad.Array3f([dr.dot(axis, positions) for axis in axes])
        occlusion, alignment, thickness, bias = (batch.repeat_last(value) for value in self.raw_shadows)
        features = batch.block(self.features, first, refine.features)
        info = [alignment, thickness * per_metre, bias * per_metre]
        return batch.matrix(refine_inputs(refine, occlusion, features, positions, info), refine.shape.rows)
