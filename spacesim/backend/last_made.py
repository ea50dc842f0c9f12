"""What was made last of some arrays, kept in case it is asked for again."""

from collections.abc import Sequence
from typing import Generic, TypeVar

from spacesim.backend import ad
from spacesim.backend.arrays import Float

Made = TypeVar("Made")


class LastMade(Generic[Made]):
    """What was made last, for as long as it is asked for with the same arrays: the same ones, not equal ones."""

    def __init__(self) -> None:
        self._last: tuple[list[Float], object, Made] | None = None  # one thing, for threads that share a model

    def find(self, arrays: Sequence[Float], asked: object = None) -> Made | None:
        """What was kept of these arrays. Of others nothing: what was made of them goes, and the next has its memory.
        asked: what it depends on beside them, compared as equal"""
        if (last := self._last) is not None:
            made_of, asked_before, made = last
            if asked == asked_before and [array.index for array in arrays] == [array.index for array in made_of]:
                return made
        self.forget()
        return None

    def keep(self, made: Made, arrays: Sequence[Float], asked: object = None) -> None:
        """For `find`. The arrays are held: the number of one that is in use is never another's."""
        self._last = [ad.Float(array) for array in arrays], asked, made

    def forget(self) -> None:
        """What was kept."""
        self._last = None
