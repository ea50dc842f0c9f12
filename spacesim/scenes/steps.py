"""Work in steps, between which the device is at work: meanwhile the host may do steps of other work."""

from collections.abc import Generator
from typing import TypeVar

T = TypeVar("T")
Steps = Generator[None, None, T]
"""Gives a T in the end."""


def completed(steps: Steps[T]) -> T:
    """What they give in the end."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
