"""What is drawn behind the objects."""

from dataclasses import dataclass, replace

from spacesim.data.errors import expect
from spacesim.scenes.lights.earth import EarthConfig

PLACEMENTS = ("behind", "fixed")
WORDS = ("earth", "stars")


@dataclass(frozen=True)
class BackgroundConfig:
    """What is drawn behind the objects; pictures are opaque then. Raises InputError for a value out of range."""

    earth: bool = True  #: a sphere of oceans, continents, ice and clouds under air, lit by the scene's Sun
    stars: bool = True  #: points all over the sky, fixed in the world frame
    #: of the Earth: "behind" the objects, wherever the camera looks from, whatever `[earth]` says, as in SPEED+, or
    #: "fixed" in the world where `[earth]` says; none: fixed where there is an `[earth]`. Its altitude is that of
    #: `[earth]`, 500 km without one. Behind the objects it lights nothing, and no label says where it is
    placement: str | None = None
    share: float = 1.0  #: of the pictures that have the Earth behind the objects, where it is not fixed
    star_gain: float = 1.0  #: factor on the light of stars; at 1 an exposure for sunlit surfaces shows hardly any

    def __post_init__(self) -> None:
        known = self.placement is None or self.placement in PLACEMENTS
        expect(known, "placement", f"one of {', '.join(PLACEMENTS)}", self.placement)
        expect(0 <= self.share <= 1, "share", "a fraction from 0 to 1", self.share)
        expect(0 <= self.star_gain <= 1e9, "star_gain", "a factor from 0 to 1e9", self.star_gain)

    def is_fixed(self, earth: EarthConfig | None) -> bool:
        """Whether the Earth that is drawn is the scene's own, None without one."""
        return (self.placement or ("fixed" if earth else "behind")) == "fixed"

    def showing(self, words: str) -> "BackgroundConfig":
        """The same with what `words` name, "earth", "stars" or "earth,stars", in place of what it draws."""
        named = [word.strip() for word in words.split(",")]
        expect(set(named) <= set(WORDS), "background", f"one or more of {', '.join(WORDS)}", words)
        return replace(self, earth="earth" in named, stars="stars" in named)
