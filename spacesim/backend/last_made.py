"""What was made last of some arrays, kept in case it is asked for again."""

from collections.abc import Sequence
from typing import Generic, TypeVar

from spacesim.backend import ad
from spacesim.backend.arrays import Float

Made = TypeVar("Made")


class LastMade(Generic[Made]):
    """What was made last, for as long as it is asked for with the same arrays: the same ones, not equal ones."""

    def __init__(self) -> None:
        self._arrays: list[Float] = []
        self._asked: object = None
        self._made: Made | None = None

    def find(self, arrays: Sequence[Float], asked: object = None) -> Made | None:
        """What was kept of these arrays. Of others nothing: what was made of them goes, and the next has its memory.
        asked: what it depends on beside them, compared as equal"""
        indices = [[array.index for array in some] for some in (arrays, self._arrays)]
        if self._made is not None and indices[0] == indices[1] and asked == self._asked:
            return self._made
        self.forget()
        return None

    def keep(self, made: Made, arrays: Sequence[Float], asked: object = None) -> None:
        """For `find`. The arrays are held: the number of one that is in use is never another's."""
        self._arrays, self._asked, self._made = [ad.Float(array) for array in arrays], asked, made

    def forget(self) -> None:
        """What was kept."""
        self._arrays, self._asked, self._made = [], None, None
