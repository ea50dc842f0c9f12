"""A Sun as the kernels of light read it, and what of its light no camera changes."""

from dataclasses import dataclass, field

import drjit as dr

from spacesim.backend import ad
from spacesim.backend.arrays import Float
from spacesim.learning.reflectance import past_earth


@dataclass
class SunEncoding:
    """A Sun as the kernels read it, Floats."""

    light_axes: Float  #: [9], `light_rows`
    field_encoding: Float  #: input of the field's network: the Sun's encoding, then the picture's embedding
    refine_encoding: list[Float]  #: input of the refinement's network in a list, or nothing where it is the field's
    beams: list[Float]  #: the Earth's, Float [4 * BEAMS] of `Earth.beams` in a list, or nothing
    eclipse: list[Float]  #: where the Earth hides some of the Sun, Float [2] of `eclipse_numbers` in a list, or nothing

    @property
    def of_refinement(self) -> Float:
        """Input of the refinement's network."""
        return (self.refine_encoding or [self.field_encoding])[0]

    def left(self, light: list[Float]) -> list[Float]:
        """What the Earth leaves of sunlight [M]."""
        return [value * dr.gather(ad.Float, left, ad.UInt32(0)) for left in self.eclipse for value in light] or light

    def colors_left(self, colors: list[Float]) -> tuple[list[Float], list[Float]]:
        """`past_earth` of colours [M], which are as they were where there is no eclipse."""
        for numbers in self.eclipse:
            return past_earth(colors, numbers)
        return colors, [ad.Float(1) for _ in colors]


@dataclass
class Sunlight:
    """What of a Sun's light no camera changes."""

    visibility: Float | None  #: Float [N], what dims colours (4.17), or None for 1
    bounced: list[Float]  #: of `bounce.received_on_sides`, Floats [N], or nothing
    #: of `bounce.emission`, where surfaces mirror it, or nothing
    emitted: list[Float] = field(default_factory=list)

    @property
    def bytes(self) -> int:
        """Of memory."""
        rows = [*([] if self.visibility is None else [self.visibility]), *self.bounced, *self.emitted]
        return 4 * sum(map(dr.width, rows))
