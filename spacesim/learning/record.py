"""What files of a training say of it, of any method: its history, how a run was trained, a checkpoint's header."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spacesim.data.errors import InputError, check_ranges


@dataclass(frozen=True, kw_only=True)
class HistoryEntry:
    """What training noted of a step."""

    iteration: int  #: how many were finished
    loss: float  #: of the last one


@dataclass(frozen=True, kw_only=True)
class TrainingRecord:
    """What training.json says: how a run was trained."""

    history: tuple[HistoryEntry, ...]  #: of some iterations, in order
    seconds: float  #: of training
    backend: str  #: that trained
    device: str | None = None  #: that trained
    command: str | None = None  #: the command line, or None of another caller
    versions: Mapping[str, str] = field(default_factory=dict)  #: of libraries

    def __post_init__(self) -> None:
        if not self.history:
            raise InputError("history: expected at least one entry, found none")


@dataclass(frozen=True, kw_only=True)
class CheckpointHeader:
    """What a checkpoint says beside its arrays."""

    iteration: int  #: finished ones
    history: tuple[HistoryEntry, ...]  #: of some iterations, in order
    format: str  #: by which such files are known

    def __post_init__(self) -> None:
        check_ranges(self, iteration=(0, 2**53))
