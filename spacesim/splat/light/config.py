"""How light becomes colour: the configuration of a relightable model."""

import dataclasses

from spacesim.data.errors import InputError
from spacesim.data.images.tone import PEAK, STANDARD_EXPOSURE, WHITES, Curve, Tone
from spacesim.data.structure import check_fields
from spacesim.splat.light.field import Decoding, FieldConfig
from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.refine import ShadowRefinementConfig

MAX_EMITTERS = 2**14  #: of one bounce; `Surroundings.met` numbers their sides in 16 bits
MAX_EXPOSURE = 40  #: of an exposure, as large as a scene's camera can have


@dataclasses.dataclass(frozen=True)
class LightConfig:
    """How light becomes colour."""

    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)  #: the network that gives colours
    shadow: ShadowConfig | None = None  #: how shadows are cast; none leaves them to the field (the method `relight`)
    #: so many of the Gaussians, each for those around it, scatter sunlight once onto all that see them; 0 for none
    bounce: int = 0
    #: of the bounce: Gaussians scatter what the field paints, not what their albedos say, and mirror what arrives, by a
    #: specular reflectance that each learns, too; without a bounce it says nothing
    gloss: bool = False
    #: add what the Earth gives; none: where every training picture names an Earth whose albedo is not 0 and the
    #: field has normals, as `train` finds out
    earth: bool | None = None
    #: colours are linear, shares of what is white, and blended as such, and pictures go through the tone curve
    #: afterwards; else they are sRGB values, as in the thesis (section 7.2 asks for the former)
    linear: bool = False
    #: the curve of linear colours; none: the dataset's own, which `train` fills in, else srgb
    tone: Tone | None = None
    #: EV of the pictures trained on, of linear colours; none: the dataset's own, which `train` fills in, else 0
    exposure: float | None = None
    #: learn from radiance (gt/*.exr), not from 8-bit pictures, by sRGB values that go on beyond white as logarithms:
    #: colours reach 16 times white
    radiance: bool = False
    #: the field gives linear colours encoded, see `field_color`; older runs did not
    encoded: bool = dataclasses.field(default=True, metadata={"option": False})

    def __post_init__(self) -> None:
        check_fields(self)
        if not 0 <= self.bounce <= MAX_EMITTERS:
            raise InputError(f"bounce: expected 0 to {MAX_EMITTERS}, found {self.bounce}")
        for name, value, off in (("bounce", self.bounce, "0"), ("earth", self.earth, "false")):
            if value and not self.field.surface:
                needed = "light.field.inputs=surface, whose normals it needs"
                raise InputError(f"{name}: expected {off} or {needed}, found {self.field.inputs.kind}")
        if self.shadow and not self.field.knows_sun:
            raise InputError("field: expected inputs with the Sun, which casts shadows, found view")
        for name in ("tone", "exposure"):
            if getattr(self, name) is not None and not self.linear:
                raise InputError(f"{name}: expected linear colours (light.linear = true), found sRGB values")
        if self.radiance and not self.linear:
            raise InputError("radiance: expected linear colours (light.linear = true), found sRGB values")
        if self.exposure is not None and not abs(self.exposure) <= MAX_EXPOSURE:
            raise InputError(f"exposure: expected -{MAX_EXPOSURE} to {MAX_EXPOSURE} EV, found {self.exposure}")

    @property
    def curve(self) -> Curve | None:
        """How linear colours are shown, None of others."""
        tone: Tone = self.tone or "srgb"
        return Curve(tone, self.exposure or 0.0, PEAK if self.radiance else WHITES[tone]) if self.linear else None

    @property
    def decoding(self) -> Decoding | None:
        """Of linear colours, from what the field gives; None where they are what it gives."""
        return ("radiance" if self.radiance else "srgb") if self.linear and self.encoded else None

    @property
    def peaks(self) -> float | None:
        """Shares of PEAK that a radiance of 1 W m^-2 sr^-1 is; None where radiance is not learned."""
        return STANDARD_EXPOSURE * 2.0 ** (self.exposure or 0.0) / PEAK if self.radiance else None

    @property
    def refine(self) -> ShadowRefinementConfig | None:
        """The refinement of shadows, if there is one."""
        return self.shadow.refine if self.shadow else None

    @property
    def features(self) -> int:
        """F: numbers that each Gaussian has for the field, then for the refinement of shadows, then of what it
        reflects."""
        return self.albedos + 3 * (self.bounce > 0 or bool(self.earth)) + 3 * self.mirrors

    @property
    def albedos(self) -> int:
        """Which of these numbers are the logits of the albedo (RGB) for bounce and Earth: this and the next two."""
        return self.field.stored + (self.refine.features if self.refine else 0)

    @property
    def specular(self) -> int | None:
        """Which of them are the logits of the specular reflectance (RGB), likewise; None where there are none."""
        return self.albedos + 3 if self.mirrors else None

    @property
    def sunlit_white(self) -> float:
        """The colour, linear, of a white surface that faces the Sun, as light that bounces has it: 1 where albedos say
        what is scattered, whatever the curve."""
        return 2.0**self.curve.exposure / self.curve.white if self.curve and self.mirrors else 1.0

    @property
    def mirrors(self) -> bool:
        """Whether surfaces mirror what bounces."""
        return self.gloss and self.bounce > 0
