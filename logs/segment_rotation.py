"""When a log goes on in another file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brakeline.logs.segment import Segment


@dataclass(frozen=True)
class Rotation:
    """When a file is finished and the log goes on in the next one. What is finished can be moved away."""

    mib: float = 512.0
    """MiB in a file of the log; then the next one is begun."""
    seconds: float = 3600.0
    """s that a file of the log covers; then the next one is begun."""

    def __post_init__(self) -> None:
        if not self.mib > 0.0 or not self.seconds > 0.0:
            raise ValueError(f"a log's files have a size and a duration above 0, not {self.mib} MiB, {self.seconds} s")

    def due(self, segment: Segment, age: float) -> bool:
        """Has the file had enough? One without a message never has."""
        return not segment.empty and (segment.size >= self.mib * 2**20 or age >= self.seconds)
