"""When a log continues in another file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brakeline.logs.segment import Segment


@dataclass(frozen=True)
class Rotation:
    """When the recorder finishes a file and continues in the next one. You can move a finished file away."""

    mib: float = 512.0
    """Begin the next file of the log when a file has reached this size [MiB]."""
    seconds: float = 3600.0
    """Begin the next file of the log after this time [s]."""

    def __post_init__(self) -> None:
        if not self.mib > 0.0 or not self.seconds > 0.0:
            raise ValueError(
                f"the size and the duration of a log file must be above 0, not {self.mib} MiB, {self.seconds} s"
            )

    def due(self, segment: Segment, age: float) -> bool:
        """Return whether to finish the file, of this age [s]. A file without a message is never finished."""
        return not segment.empty and (segment.size >= self.mib * 2**20 or age >= self.seconds)
